"""Time of each filter for one sample of a recording, beside VQF's (C++) and ahrs' Madgwick (NumPy) on the same samples.

    python tests/bench/filters.py [--json]

The recording is ten seconds of the simulated link, Test 1: the shortest of many short runs depends little on what else
the machine does. Compilation and the creation of the filters are not in it.
"""

from __future__ import annotations

from collections.abc import Iterator

from _report import Row, best_of, report
from ahrs.filters import Madgwick
from vqf import VQF

from linkpose import filters
from linkpose.simulation.link import LinkRun

DURATION_S = 10.0
TIMES = 400
BENCHES = ("joint", "joint-inertial", "tilt", "tilt-inertial", "imu-baro", "baro")


def rows() -> Iterator[Row]:
    """The peer is timed anew beside each filter, so that both see the same load of the machine."""
    run = LinkRun(1, 0, DURATION_S)
    block = run.measurements()
    filters.warm_up(BENCHES)
    rate, force = block.gyro_rad_s, block.accel_m_s2
    slow = best_of(lambda: Madgwick(gyr=rate, acc=force, frequency=100.0), 3) / len(block)
    for name in BENCHES:
        made = iter([filters.create(name, run.rig) for _ in range(TIMES)])
        ours = best_of(lambda made=made: next(made).process(block), TIMES)  # type: ignore[misc]
        peers = iter([VQF(0.01) for _ in range(TIMES)])
        peer = best_of(lambda peers=peers: next(peers).updateBatch(rate, force), TIMES)  # type: ignore[misc]
        yield Row(name, ours / len(block), "vqf", peer / len(block))
        yield Row(name, ours / len(block), "ahrs", slow)


if __name__ == "__main__":
    report(rows())
