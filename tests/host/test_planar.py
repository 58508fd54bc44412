"""planar-ekf and planar-ukf: the robot's pose from mice and gyro, honest about its doubt, live as replayed."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from linkpose import filters
from linkpose.filters.planar import PlanarEkf, PlanarUkf
from linkpose.sensors.measurements import Measurements
from linkpose.simulation.mice import Fault, MiceRun

BOTH = pytest.mark.parametrize("name", ["planar-ekf", "planar-ukf"])


@lru_cache(maxsize=10)
def recorded(seed: int = 1, faults: tuple[Fault, ...] = (), rate_hz: float = 100.0) -> tuple[MiceRun, Measurements]:
    run = MiceRun(seed, 30.0, rate_hz, faults=faults)
    return run, run.measurements()


def errors(run: MiceRun, estimates: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    truth = np.column_stack(list(run.at(time_s).columns().values())[1:])
    off = estimates[:, :6] - truth
    off[:, 2] = (off[:, 2] + math.pi) % (2 * math.pi) - math.pi
    return off


@BOTH
def test_the_gyro_makes_a_better_pose_than_mice_alone(name):
    for seed in (0, 1):
        run, block = recorded(seed)
        planar = errors(run, filters.create(name, run.rig).process(block), block.time_s)
        mice = filters.create("mice", run.rig).process(block)
        alone = errors(run, mice[:, [6, 7, 8, 0, 1, 2]], block.time_s)
        rms, rms_alone = (np.sqrt(np.nanmean(e**2, axis=0)) for e in (planar, alone))
        assert rms[2] < 0.5 * rms_alone[2] and rms[5] < 0.2 * rms_alone[5]
        assert np.hypot(*rms[:2]) < np.hypot(*rms_alone[:2]) and np.hypot(*rms[:2]) < 0.1


@BOTH
def test_the_velocity_s_standard_deviation_is_honest(name):
    run, block = recorded()
    out = filters.create(name, run.rig).process(block)
    nees = np.mean((errors(run, out, block.time_s)[100:] / out[100:, 6:]) ** 2, axis=0)
    assert (nees[3:5] > 0.4).all() and (nees[3:5] < 2).all()
    assert (nees < 6).all()


@BOTH
def test_a_lifted_mouse_does_not_move_the_robot(name):
    sound, lifted = recorded(2), recorded(2, (Fault("lift", 1, 13.0, 18.0),))
    rms = [
        np.sqrt(np.mean(errors(run, filters.create(name, run.rig).process(block), block.time_s) ** 2, axis=0))
        for run, block in (sound, lifted)
    ]
    assert (rms[1][3:5] < 1.3 * rms[0][3:5]).all() and np.hypot(*rms[1][:2]) < 0.1


@BOTH
def test_a_gyro_that_was_never_calibrated_is_calibrated_under_way(name):
    run, block = recorded()
    biased = replace(block, gyro_rad_s=block.gyro_rad_s + np.array([0.0, 0.0, 0.2]))
    off = errors(run, filters.create(name, run.rig).process(biased), block.time_s)
    assert np.abs(off[500:, 5]).max() < 0.05 and np.abs(off[:, 2]).max() < 0.1


@BOTH
def test_without_the_gyro_the_mice_do(name):
    run, block = recorded()
    blind = replace(block, gyro_rad_s=np.full_like(block.gyro_rad_s, math.nan))
    out = filters.create(name, run.rig, filters.Sensors(0), 3).process(blind)
    assert np.sqrt(np.mean(errors(run, out, block.time_s)[:, 3:5] ** 2)) < 0.01


@BOTH
def test_missing_values_only_widen_the_doubt(name):
    run, block = recorded()
    counts = block.mice_counts.copy()
    counts[1000:1050] = math.nan
    filter_ = filters.create(name, run.rig)
    out = filter_.process(replace(block, mice_counts=counts))
    assert np.isfinite(out).all() and filter_.rejected == 51  # the first counts after it cover who knows what
    assert (np.diff(out[1001:1049, 9:11], axis=0) > 0).all() and (out[1100, 9:11] < out[1049, 9:11]).all()


@BOTH
@pytest.mark.parametrize("rate_hz", [250, 500])
def test_between_two_readings_of_the_mice_the_state_is_predicted(name, rate_hz):
    rms = []
    for rate in (125, rate_hz):
        run, block = recorded(1, rate_hz=rate)
        filter_ = filters.create(name, run.rig)
        rms.append(np.sqrt(np.mean(errors(run, filter_.process(block), block.time_s)[50:] ** 2, axis=0)))
        assert filter_.rejected == 0
    assert (rms[1][3:5] < 1.1 * rms[0][3:5]).all() and np.hypot(*rms[1][:2]) < 0.1


@pytest.mark.parametrize("rate_hz", [100, 250])
@pytest.mark.parametrize("cls", [PlanarEkf, PlanarUkf])
def test_blocks_of_any_size_give_the_same_to_the_bit(cls, rate_hz):
    run, block = recorded(rate_hz=rate_hz)
    block = block[1300:1700]
    whole, parts = cls(run.rig).process(block), cls(run.rig)
    np.testing.assert_array_equal(np.concatenate([parts.process(block[i : i + 1]) for i in range(len(block))]), whole)


@BOTH
def test_the_columns_are_pose_velocity_and_their_standard_deviations(name):
    prefix = name.replace("-", "_")
    assert filters.create(name, recorded()[0].rig).columns == tuple(
        f"{prefix}_{column}"
        for column in (
            *("x_m", "y_m", "heading_rad", "vx_m_s", "vy_m_s", "wz_rad_s"),
            *("x_std_m", "y_std_m", "heading_std_rad", "vx_std_m_s", "vy_std_m_s", "wz_std_rad_s"),
        )
    )
