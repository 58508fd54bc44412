"""tilt-inertial on free motion made by code: faults of real recordings that must not lean the tilt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from free_motion import motion

from linkpose.filters.inertial.state import MA, MG
from linkpose.filters.tilt_inertial import TiltInertialFilter
from linkpose.sensors.rig import Rig
from linkpose.simulation.link import LinkRun
from linkpose.wire.messages import SampleFlags


def still(t: float) -> np.ndarray:
    return np.zeros(3)


@pytest.mark.parametrize("rest_s", [1.0, 20.0])
def test_a_launch_after_a_rest_does_not_lean_the_tilt(rest_s):
    """0.7 s at 1.2 m/s out and back, as a robot arm starts. The velocity must not be mistaken for a tilt or a bias."""

    def launch(time_s):
        accel = np.zeros((len(time_s), 3))
        for begin, sign in ((0.0, 1), (0.7, -1), (0.8, -1), (1.5, 1)):
            accel[(time_s >= rest_s + begin) & (time_s < rest_s + begin + 0.1), 0] = 12.0 * sign
        return accel

    made = motion(rest_s + 10.0, still, launch)
    block = made.block()
    block = replace(block, gyro_rad_s=block.gyro_rad_s + np.radians([5.0, -4.0, 3.0]))
    error = made.tilt_error_deg(TiltInertialFilter(Rig()).process(block)[:, 2:4])
    assert error[100:].max() < 1.0


def test_an_accelerometer_whose_scale_is_off_is_no_reason_to_restart():
    """An MPU-6050 may read 9.4 m/s² at rest: outside the errors that the filter estimates, but no tilt."""
    made = motion(20.0, lambda t: np.array([0.5 * np.sin(t) * (t > 5), 0.0, 0.0]), lambda t: np.zeros((len(t), 3)))
    block = made.block()
    f = TiltInertialFilter(Rig())
    error = made.tilt_error_deg(f.process(replace(block, accel_m_s2=0.96 * block.accel_m_s2))[:, 2:4])
    assert f.restarts == 0
    assert error[100:].max() < 1.0


def test_shaking_does_not_shrink_the_accelerometers_matrix():
    """The velocity is in both the measurement 0 = v + e and the integrated force: M_a = 1 would explain both."""

    def shaken(time_s):
        return 15.0 * np.column_stack([np.sin(7 * time_s), np.sin(8 * time_s), np.sin(9 * time_s)])

    made = motion(100.0, lambda t: np.array([2 * np.sin(3 * t), 2 * np.cos(4 * t), np.sin(5 * t)]), shaken)
    f = TiltInertialFilter(Rig())
    error = made.tilt_error_deg(f.process(made.block())[:, 2:4])
    assert np.abs(f.state.nominal[MA:MG]).max() < 0.001
    assert np.sqrt(np.mean(error[3000:] ** 2)) < 0.5


def test_a_fast_turn_is_no_spike():
    """±14 rad/s at 2 Hz: the rate changes by 1.8 rad/s from one sample to the next."""

    def rate(t):
        return min(max(t - 2.0, 0.0), 1.0) * np.array([14 * np.sin(12.6 * t), 5 * np.sin(9 * t), 10 * np.cos(11 * t)])

    made = motion(20.0, rate, lambda time_s: np.column_stack([3 * np.sin(8 * time_s)] * 3) * (time_s > 2.0)[:, None])
    error = made.tilt_error_deg(TiltInertialFilter(Rig()).process(made.block())[:, 2:4])
    assert np.sqrt(np.mean(error**2)) < 0.7


@pytest.mark.parametrize(("rest_s", "least_deg", "most_deg"), [(0.0, 1.0, 6.0), (20.5, 10.0, 20.0)])
def test_after_a_gap_sigma_is_that_of_the_motion_before_it(rest_s, least_deg, most_deg):
    """A gap of 1 s after 20 s of motion, or of rest: then nothing is known of the motion, and σ is larger."""

    def rate(t):
        return np.array([2 * np.sin(3 * t), np.cos(2 * t), 0.0]) * (t >= rest_s)

    def accel(time_s):
        swing = 0.7 * np.column_stack([np.sin(5 * time_s), np.cos(4 * time_s), np.sin(6 * time_s)])
        return swing * (time_s >= rest_s)[:, None]

    made = motion(26.0, rate, accel)
    block = made.block()
    arrived = (block.time_s < 20.0) | (block.time_s >= 21.0)
    block = replace(block, **{name: getattr(block, name)[arrived] for name in block.__slots__})
    found = TiltInertialFilter(Rig()).process(block)
    error, std = made._replace(tilt=made.tilt[arrived]).tilt_error_deg(found[:, 2:4]), found[:, 4:6]
    after = block.time_s >= 21.5
    assert (error < 2 * np.hypot(*std.T))[after].mean() > 0.95
    assert np.all((std[after][0] > least_deg) & (std[after][0] < most_deg))


def test_a_saturated_gyro_widens_sigma():
    """Blows of 15 rad/s in 20 ms, of which a range of 4 rad/s shows the beginning, flagged: σ counts the rest."""

    def rate(t):
        blow = 15.0 * np.exp(-(((t % 3.0 - 1.5) / 0.02) ** 2)) * (1 if t % 6.0 < 3.0 else -1)
        return np.array([np.sin(4 * t), 0.5 * np.cos(3 * t) + blow, 0.0])

    made = motion(30.0, rate, lambda time_s: np.column_stack([np.sin(5 * time_s)] * 3))
    block, limit = made.block(), 4.0
    flags = block.flags | np.where(
        (np.abs(block.gyro_rad_s) > limit).any(axis=1), np.uint32(SampleFlags.GYRO_SATURATED), np.uint32(0)
    )
    estimate = TiltInertialFilter(Rig()).process(
        replace(block, gyro_rad_s=np.clip(block.gyro_rad_s, -limit, limit), flags=flags)
    )
    error, std = made.tilt_error_deg(estimate[:, 2:4]), np.hypot(estimate[:, 4], estimate[:, 5])
    assert np.mean(error[300:] < 2 * std[300:]) > 0.95
    assert np.sqrt(np.mean(error[300:] ** 2)) < 6


def errors_over_sigma(test: int, seed: int):
    """Errors of roll, pitch and yaw over σ (N, 3) of a sensor within the data sheet; the state's restarts."""
    run = LinkRun(test, seed, errors="datasheet", duration_s=30.0)
    f, truth = TiltInertialFilter(Rig()), run.truth()
    found = f.process(run.measurements())
    true = np.column_stack([truth.roll_deg, truth.pitch_deg, truth.yaw_deg - truth.yaw_deg[0] + found[0, 6]])
    error = (found[:, [2, 3, 6]] - true + 180.0) % 360.0 - 180.0
    return error[1:] / found[1:, [4, 5, 7]], f.restarts


def test_sigma_of_a_sensor_as_sold():
    """Offset, scale and bias within the data sheet, nothing declared: once, half of the errors were within 2σ.

    Test 1 of seed 102 has a gyro bias of 31 °/s, which is possible.
    """
    runs = [errors_over_sigma(test, seed) for test, seed in [(1, 102), (2, 100), (3, 103)]]
    assert [restarts for _, restarts in runs] == [0, 0, 0]
    shares = np.mean([np.mean(np.abs(errors) < 2, axis=0) for errors, _ in runs], axis=0)
    assert np.all(shares > 0.75) and shares[:2].mean() > 0.9


def test_sigma_between_the_first_sample_and_the_first_propagation():
    """A bias of 20 °/s turns the attitude by 0.2° a sample. σ was that of the first sample, 0, for three of them."""
    block = motion(1.0, still, lambda time_s: np.zeros((len(time_s), 3))).block()
    rate = block.gyro_rad_s + np.radians([0.0, 0.0, 20.0])
    found = TiltInertialFilter(Rig()).process(replace(block, gyro_rad_s=rate))
    assert np.all(np.abs(found[1:10, 6] / found[1:10, 7]) < 3.0)
