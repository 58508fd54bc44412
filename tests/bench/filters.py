"""Time of each filter for one sample of a recording, beside VQF's (C++) and ahrs' Madgwick (NumPy) on the same samples.

    python tests/bench/filters.py [--json]

The recording is ten seconds of the simulated link, Test 1: the shortest of many short runs depends little on what else
the machine does. Compilation and the creation of the filters are not in it. `chain` takes a sample of two sensors, on
thirty seconds of a simulated hinge of unknown mounting: beside one VQF, and beside two, one for each sensor.
"""

from __future__ import annotations

from collections.abc import Iterator

from _report import Row, best_of, report
from ahrs.filters import Madgwick
from vqf import VQF

from linkpose import filters
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.rig import Rig
from linkpose.simulation.chain import ChainRun
from linkpose.simulation.link import LinkRun

DURATION_S, CHAIN_S = 10.0, 30.0
TIMES, CHAIN_TIMES = 400, 50
BENCHES = ("joint", "joint-inertial", "tilt", "tilt-inertial", "imu-baro", "baro")


def rows() -> Iterator[Row]:
    """The peer is timed anew beside each filter, so that both see the same load of the machine."""
    run = LinkRun(1, 0, DURATION_S)
    block = run.measurements()
    filters.warm_up(BENCHES)
    rate, force = block.gyro_rad_s, block.accel_m_s2
    slow = best_of(lambda: Madgwick(gyr=rate, acc=force, frequency=100.0), 3) / len(block)
    for name in BENCHES:
        ours, peer = timed(name, run.rig, block, [(rate, force)], TIMES)
        yield Row(name, ours, "vqf", peer)
        yield Row(name, ours, "ahrs", slow)
    yield from of_chain()


def of_chain() -> Iterator[Row]:
    """The filter of two sensors."""
    run = ChainRun(seed=0, duration_s=CHAIN_S)
    block = run.measurements()
    filters.warm_up(["chain"])
    pair = [(block.gyro_rad_s, block.accel_m_s2), (block.gyro2_rad_s, block.accel2_m_s2)]
    for peer, sensors in (("vqf", pair[:1]), ("two vqf", pair)):
        ours, theirs = timed("chain", run.rig, block, sensors, CHAIN_TIMES)
        yield Row("chain", ours, peer, theirs)


def timed(
    name: str, rig: Rig, block: Measurements, sensors: list[tuple[Floats, Floats]], times: int
) -> tuple[float, float]:
    """µs a sample of a filter, and of a VQF for each of these sensors' rates and forces."""
    made = iter([filters.create(name, rig) for _ in range(times)])
    ours = best_of(lambda: next(made).process(block), times)
    peers = iter([[VQF(0.01) for _ in sensors] for _ in range(times)])
    peer = best_of(lambda: [vqf.updateBatch(*of) for vqf, of in zip(next(peers), sensors, strict=True)], times)
    return ours / len(block), peer / len(block)


if __name__ == "__main__":
    report(rows())
