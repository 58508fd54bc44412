"""Time of each filter for one sample of a recording, beside VQF's (C++) and ahrs' Madgwick (NumPy) on the same samples.

    python tests/bench/filters.py [--json]

The recording is a minute of the simulated link, Test 1: the shortest of many short runs depends little on what else the
machine does. Compilation is not in it.
"""

from __future__ import annotations

from collections.abc import Iterator

from _report import Row, best_of, report
from ahrs.filters import Madgwick
from vqf import VQF

from linkpose import filters
from linkpose.simulation.link import LinkRun

DURATION_S = 60.0
TIMES = 100
SLOW_PEERS = 2000  # samples that are enough to time a peer of many microseconds each
BENCHES = ("joint", "joint-inertial", "tilt", "tilt-inertial", "imu-baro", "baro")


def rows() -> Iterator[Row]:
    """The peer is timed anew beside each filter, so that both see the same load of the machine."""
    run = LinkRun(1, 0, DURATION_S)
    block = run.measurements()
    filters.warm_up(BENCHES)
    rate, force = block.gyro_rad_s[:SLOW_PEERS], block.accel_m_s2[:SLOW_PEERS]
    slow = best_of(lambda: Madgwick(gyr=rate, acc=force, frequency=100.0), 3) / SLOW_PEERS
    for name in BENCHES:
        ours = best_of(lambda name=name: filters.create(name, run.rig).process(block), TIMES)  # type: ignore[misc]
        peer = best_of(lambda: VQF(0.01).updateBatch(block.gyro_rad_s, block.accel_m_s2), TIMES)
        yield Row(name, ours / len(block), "vqf", peer / len(block))
        yield Row(name, ours / len(block), "ahrs", slow)


if __name__ == "__main__":
    report(rows())
