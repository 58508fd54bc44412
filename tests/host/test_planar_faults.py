"""planar-ekf where a part lies: its pose beside ten lines of gyro and mice, its σ, and what it reports."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from robot_counts import DEG, Robot, counts, gyro, measurements, rig, robot

from linkpose.experiments.planar import PlanarRun, baseline, pose_error
from linkpose.filters.planar import PlanarEkf
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

JUMP_S = 20.0


def estimated(run: Robot, rig_: Rig, block: Measurements) -> tuple[PlanarEkf, np.ndarray, float]:
    """The filter, its estimates, and its position error relative to the baseline's."""
    filter_ = PlanarEkf(rig_)
    out = filter_.process(block)
    theirs = pose_error(baseline(PlanarRun(rig_, block, run.pose)), run.pose).position_m
    return filter_, out, pose_error(out[:, :3], run.pose).position_m / theirs


def share_within(run: Robot, out: np.ndarray, sigmas: float = 2.0) -> tuple[float, float]:
    """Share of the errors of position and heading within so many of the stated σ."""
    off = np.hypot(*(out[:, :2] - run.pose[:, :2]).T)
    turned = np.abs((out[:, 2] - run.pose[:, 2] + math.pi) % (2 * math.pi) - math.pi)
    return float(np.mean(off < sigmas * np.hypot(out[:, 6], out[:, 7]) + 1e-3)), float(
        np.mean(turned < sigmas * out[:, 8] + 1e-3)
    )


def jumped(run: Robot, degrees_per_s: float, after_s: float = JUMP_S) -> np.ndarray:
    return gyro(run) + degrees_per_s * DEG * (run.time_s >= after_s)


# ---- the gyro ----


@pytest.mark.parametrize("after_s", [11.0, 13.5, 17.5, 24.3])
@pytest.mark.parametrize("degrees_per_s", [1.0, -4.0, 10.0])
def test_a_jump_of_the_gyro_s_bias_under_way_is_found_and_undone(degrees_per_s, after_s):
    run = robot()
    filter_, out, ratio = estimated(run, rig(), measurements(run, counts(run), jumped(run, degrees_per_s, after_s)))
    assert ratio < 0.4
    assert math.degrees(filter_.gyro_jumps.last_rad_s) == pytest.approx(degrees_per_s, abs=0.5)
    assert after_s < filter_.gyro_jumps.last_time_s < after_s + 10.0
    assert min(share_within(run, out)) > 0.75 and min(share_within(run, out, 4.0)) > 0.9
    off = abs((out[-1, 2] - run.pose[-1, 2] + math.pi) % (2 * math.pi) - math.pi)
    assert math.degrees(off) < 2.0


def slips(share: float, start_s: float, end_s: float) -> Callable[[Robot], np.ndarray]:
    def seen(run: Robot) -> np.ndarray:
        time_s = np.arange(len(run.speed)) / 1000
        return np.where((time_s >= start_s) & (time_s < end_s), share, 1.0)[:, np.newaxis].repeat(3, axis=1)

    return seen


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.9])
@pytest.mark.parametrize("start_s", [5.0, 7.0, 15.0, 19.5, 25.0])
def test_mice_that_slip_together_are_no_jump_of_the_gyro(share, start_s):
    run = robot(1)
    filter_, out, _ = estimated(
        run, rig(), measurements(run, counts(run, seen=slips(share, start_s, start_s + 2.5)(run)), gyro(run))
    )
    assert filter_.gyro_jumps.count == 0
    turned = np.abs((out[:, 2] - run.pose[:, 2] + math.pi) % (2 * math.pi) - math.pi)
    assert math.degrees(turned.max()) < 1.3
