"""--smooth: better than the filter on every Test, consistent, and as patient with its input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from linkpose.filters.joint_inertial import JointInertialFilter
from linkpose.filters.smoother import JointInertialSmoother
from linkpose.sensors.rig import Imu, Joint, Rig
from linkpose.simulation.link import PAPER_J2S_M, LinkRun
from linkpose.wire.messages import SampleFlags

KNOWN = Rig().with_j2s(PAPER_J2S_M)
UNKNOWN = Rig(joint=Joint((0.0, 0.0, 0.0), 1.0))


def rmse_cm(estimate, truth) -> float:
    return 100 * float(np.sqrt(np.nanmean((estimate[:, 0] - truth.height_m) ** 2)))


@pytest.mark.parametrize("test", [1, 2, 3])
def test_better_than_the_filter(test):
    filtered, smoothed, unknown, nees = [], [], [], []
    for seed in range(3):
        run = LinkRun(test, seed)
        block, truth = run.measurements(), run.truth()
        filtered.append(rmse_cm(JointInertialFilter(KNOWN).process(block), truth))
        estimate = JointInertialSmoother(KNOWN).process(block)
        smoothed.append(rmse_cm(estimate, truth))
        nees.append(np.mean(((estimate[:, 0] - truth.height_m) / estimate[:, 1]) ** 2))
        unknown.append(rmse_cm(JointInertialSmoother(UNKNOWN).process(block), truth))
    assert np.mean(smoothed) < 0.8 * np.mean(filtered)
    assert np.mean(smoothed) < 0.045
    assert np.mean(unknown) < 0.25  # from the first sample on, where the filter has not found J2S yet
    assert 0.2 < np.mean(nees) < 2


@pytest.mark.parametrize("rig", [KNOWN, UNKNOWN])
def test_what_the_whole_recording_tells_of_the_sensors_holds_from_its_first_sample_on(rig):
    """Errors of an uncalibrated part, which the filter must find out first."""
    filtered, smoothed, nees = [], [], []
    for test in (1, 2, 3):
        run = LinkRun(test, 0, errors="datasheet")
        block, truth = run.measurements(), run.truth()
        filtered.append(rmse_cm(JointInertialFilter(rig).process(block), truth))
        estimate = JointInertialSmoother(rig).process(block)
        smoothed.append(rmse_cm(estimate, truth))
        nees.append(np.mean(((estimate[:, 0] - truth.height_m) / estimate[:, 1]) ** 2))
    assert np.mean(smoothed) < min(0.8 * np.mean(filtered), 0.35)
    assert np.mean(nees) < 4


def test_readings_that_are_late_are_so_in_both_directions():
    delay_s = 0.02
    early = LinkRun(1, 0, 30.0)
    block, time_s = early.measurements(), early.measurements().time_s
    late = replace(block, time_s=time_s + delay_s)
    rig = replace(KNOWN, imu=Imu(delay_s=delay_s))
    height = early.at(time_s + delay_s).height_m
    error = 100 * np.sqrt(np.mean((JointInertialSmoother(rig).process(late)[:, 0] - height) ** 2))
    assert error < 0.1


def test_a_gyro_bias_that_drifts_is_not_that_of_the_end_at_the_beginning():
    """3 °/s in a minute, some hundred times what a sensor that warms up does."""
    run = LinkRun(2, 0)
    block, truth = run.measurements(), run.truth()
    drift = np.radians(3 / 60) * block.time_s[:, None] * [1.0, -1.0, 1.0]
    estimate = JointInertialSmoother(KNOWN).process(replace(block, gyro_rad_s=block.gyro_rad_s + drift))
    assert rmse_cm(estimate, truth) < 0.45


def test_a_gyro_bias_of_the_rig_file_holds_backwards_too():
    run, bias = LinkRun(2, 1, 30.0), (0.1, -0.2, 0.15)
    block, truth = run.measurements(), run.truth()
    biased = replace(block, gyro_rad_s=block.gyro_rad_s + bias)
    rig = replace(KNOWN, imu=Imu(gyro_bias_rad_s=bias))
    plain, shifted = JointInertialSmoother(KNOWN).process(block), JointInertialSmoother(rig).process(biased)
    assert shifted == pytest.approx(plain, abs=1e-6)
    assert rmse_cm(plain, truth) < 0.1


def test_held_readings_belong_to_the_first_of_their_samples_in_both_directions():
    run = LinkRun(1, 0, 40.0)
    block, truth = run.measurements(), run.truth()
    at = np.arange(len(block))
    held = replace(block, accel_m_s2=block.accel_m_s2[at // 4 * 4], gyro_rad_s=block.gyro_rad_s[at // 4 * 4])
    error = JointInertialSmoother(KNOWN).process(held)[::4, 0] - truth.height_m[::4]
    assert 100 * np.sqrt(np.mean(error**2)) < 0.2


def test_a_saturated_reading_keeps_its_flag_in_both_directions():
    """The accelerometer's 25 Hz in a log of 100 Hz: backwards a reading is held over other samples, with its flag."""
    run = LinkRun(3, 0, 30.0)
    block, truth = run.measurements(), run.truth()
    force = block.accel_m_s2[np.arange(len(block)) // 4 * 4]
    lost = (np.abs(force) > 14.7).any(axis=1)
    assert lost.sum() > 100
    flags = block.flags | np.where(lost, np.uint16(SampleFlags.ACCEL_SATURATED), np.uint16(0))
    clipped = replace(block, accel_m_s2=np.clip(force, -14.7, 14.7), flags=flags)
    at_readings = run.at(truth.time_s[::4])
    flagged, silent = (
        rmse_cm(JointInertialSmoother(KNOWN).process(b)[::4], at_readings)
        for b in (clipped, replace(clipped, flags=block.flags))
    )
    assert flagged < min(silent, 1.0)


def test_an_unusable_beginning_is_told_by_what_follows():
    run = LinkRun(1, 0, 20.0)
    block, truth = run.measurements(), run.truth()
    accel = block.accel_m_s2.copy()
    accel[:90] = np.nan
    estimate = JointInertialSmoother(KNOWN).process(replace(block, accel_m_s2=accel))
    assert np.isfinite(estimate).all()
    assert 100 * np.abs(estimate[:, 0] - truth.height_m).max() < 1


@pytest.mark.parametrize("rows", [0, 1])
def test_next_to_nothing(rows):
    estimate = JointInertialSmoother(KNOWN).process(LinkRun(1, 0, 1.0).measurements()[:rows])
    assert estimate.shape == (rows, len(JointInertialSmoother.columns))
