"""The simulated link: its truth obeys mechanics, its raw values are the sensors', a run is one however it is cut."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from linkpose.errors import LinkposeError
from linkpose.sensors.bmp180 import compensate
from linkpose.sensors.health import HealthMonitor
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY, accel_scale, gyro_scale
from linkpose.simulation import baro
from linkpose.simulation.link import PAPER_J2S_M, TESTS, LinkRun, simulate
from linkpose.wire.messages import SampleFlags

D = np.array(PAPER_J2S_M)


@pytest.mark.parametrize("test", [1, 2, 3])
@pytest.mark.parametrize("duration_s", [10.0, 65.0, 600.0])
def test_mean_acceleration_is_the_papers(test, duration_s):
    for seed in range(3):
        accel = simulate(test, seed, duration_s).truth().accel_m_s2
        mean = np.linalg.norm(accel, axis=1).mean()
        assert mean == pytest.approx(TESTS[test].mean_accel_m_s2, rel=0.05)


def test_starts_and_ends_at_rest_and_moves_in_between():
    truth = simulate(3, 1).truth()
    speed = np.linalg.norm(truth.rate_rad_s, axis=1)
    assert speed[:200].max() == 0 and speed[-200:].max() == 0
    assert (speed[400:-400] > 0.05).mean() > 0.99
    # yaw turns as well: the rate about Z is no rounding error beside the tilts'
    about_z = np.einsum("ij,ij->i", truth.rate_rad_s, truth.tilt)
    assert about_z.std() > 0.3
    assert truth.roll_deg.std() > 5 and truth.pitch_deg.std() > 5


def test_truth_obeys_mechanics():
    """Against numerical derivatives of the tilt alone and of the height: dZ/dt = −ω × Z, d²h/dt² = Z·a."""
    run, t, step = simulate(2, 4), np.linspace(4, 60, 500), 1e-4
    before, now, after = run.at(t - step), run.at(t), run.at(t + step)
    tilt_rate = (after.tilt - before.tilt) / (2 * step)
    assert np.abs(tilt_rate + np.cross(now.rate_rad_s, now.tilt)).max() < 1e-6
    rate_derivative = (after.rate_rad_s - before.rate_rad_s) / (2 * step)
    assert np.abs(rate_derivative - now.rate_derivative_rad_s2).max() < 1e-5
    lifted = (after.height_m - 2 * now.height_m + before.height_m) / step**2
    assert np.abs(lifted - np.einsum("ij,ij->i", now.tilt, now.accel_m_s2)).max() < 1e-4
    assert np.allclose(now.specific_force_m_s2, STANDARD_GRAVITY * now.tilt + now.accel_m_s2)
    assert np.allclose(np.linalg.norm(now.tilt, axis=1), 1)
    assert np.allclose(now.height_m, now.tilt @ D)


def test_counts_without_errors_and_noise_are_the_truth_rounded():
    run = LinkRun(1, 0, 20.0, errors="none")
    run.imu_errors = replace(run.imu_errors, accel_noise_m_s2=0.0, gyro_noise_rad_s=0.0)
    block, truth = run.block(0, 2000), run.truth()
    assert np.abs(block.accel * accel_scale(8) - truth.specific_force_m_s2).max() <= accel_scale(8) / 2 + 1e-9
    assert np.abs(block.gyro * gyro_scale(1000) - truth.rate_rad_s).max() <= gyro_scale(1000) / 2 + 1e-9


@pytest.mark.parametrize("accel_range_g", [2, 16])
def test_sensors_without_errors_have_a_converters_noise_and_are_not_taken_for_frozen(accel_range_g):
    run = LinkRun(1, 0, 60.0, errors="none", motion="rest", imu2=True, mag=True, accel_range_g=accel_range_g)
    block = run.measurements()
    monitor = HealthMonitor(run.rate_hz, {"imu": "ok", "imu2": "ok", "baro": "ok", "mag": "ok"})
    _, changes = monitor.check(block)
    assert not changes and all(not sensor.invalid for sensor in monitor.sensors.values())
    truth = run.truth()
    for readings, true, scale in (
        (block.accel_m_s2, truth.specific_force_m_s2, accel_scale(accel_range_g)),
        (block.gyro_rad_s, truth.rate_rad_s, gyro_scale(1000)),
    ):
        errors = (readings - true) / scale
        assert errors.std(axis=0) == pytest.approx(np.full(3, 0.76), rel=0.05)  # 0.7, and the rounding's 1/√12
        assert np.abs(errors.mean(axis=0)).max() < 0.05


def test_calibrated_errors_have_the_stated_size():
    gyro, accel, bias = [], [], []
    for seed in range(12):
        run = LinkRun(1, seed, 2.0)
        block, truth = run.block(0, 25), run.at(np.arange(25) / 100)
        gyro.append(block.gyro * gyro_scale(1000) - truth.rate_rad_s)
        accel.append(block.accel * accel_scale(8) - truth.specific_force_m_s2)
        bias.append(run.imu_errors.gyro_bias_rad_s)
    assert np.std(np.array(gyro) - np.mean(gyro, axis=1, keepdims=True)) == pytest.approx(np.radians(0.05), rel=0.15)
    assert np.std(np.array(accel) - np.mean(accel, axis=1, keepdims=True)) == pytest.approx(0.04, rel=0.1)
    assert np.std(bias) == pytest.approx(np.radians(0.05), rel=0.3)


def test_a_run_is_the_same_whole_in_blocks_and_one_by_one():
    run = LinkRun(2, 3, 25.0)
    whole = run.block(0, 2500)
    for first, count in ((0, 1), (999, 2), (1700, 800), (37, 1500)):
        for part, all_of_it in zip(run.block(first, count), whole, strict=True):
            assert np.array_equal(part, all_of_it[first : first + count])
    assert list(run.samples()) == list(whole.samples())
    again = LinkRun(2, 3, 25.0)
    again.block(2000, 10)
    assert list(again.samples()) == list(run.samples())
    assert next(LinkRun(2, 4, 25.0).samples()) != next(run.samples())


def test_a_run_without_end_goes_on_and_wraps_its_counters():
    run = LinkRun(1, 0, None)
    assert len(list(itertools.islice(run.samples(), 3000))) == 3000
    late = next(run.block(450_000, 1).samples())  # 75 minutes
    assert late.seq == 450_000 % 65536
    assert late.t_us == 450_000 * 10_000 % 2**32
    assert np.linalg.norm(run.at(np.array([4500.0, 4500.5])).rate_rad_s, axis=1).min() > 0.01
    with pytest.raises(LinkposeError, match="duration"):
        run.truth()


def test_saturation_is_flagged_and_held():
    run = LinkRun(3, 0, 20.0, accel_range_g=2)
    block = run.block(0, 2000)
    saturated = (block.flags & int(SampleFlags.ACCEL_SATURATED)) != 0
    assert saturated.any() and not saturated.all()
    assert np.array_equal(saturated, ((block.accel == 32767) | (block.accel == -32768)).any(axis=1))


def test_barometer_is_read_as_the_firmware_reads_it():
    """One conversion to a tick at 100 Hz, one temperature to nine pressures; more ticks at other settings."""
    run = LinkRun(1, 0, 10.0)
    count = run.block(0, 1000).baro_count
    assert count[:13].tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 10, 11, 12]
    assert count[-1] == pytest.approx(900, abs=3)
    fast = LinkRun(1, 0, 10.0, 500.0).block(0, 5000)  # 7.5 ms and silence: four ticks of 2 ms
    assert fast.baro_count[-1] == pytest.approx(5000 * 9 / (3 + 9 * 4), abs=5)
    slow = LinkRun(1, 0, 10.0, oversampling=3).block(0, 1000)  # 25.5 ms: three ticks of 10 ms
    assert slow.baro_count[-1] == pytest.approx(1000 * 9 / (1 + 9 * 3), abs=4)


@pytest.mark.parametrize("oversampling", range(4))
def test_raw_pressure_is_the_inverse_of_the_data_sheets_compensation(oversampling):
    """To the truncations of the data sheet's integers: (p >> 8)² alone is worth 2.3 Pa."""
    temp, pressure = np.linspace(-10, 50, 13), np.linspace(80_000, 105_000, 13)
    ut = baro.raw_temperature(temp)
    up = baro.raw_pressure(pressure, temp, oversampling)
    found_temp, found_pressure = compensate(ut, up, baro.DATASHEET_WORDS, oversampling)
    assert np.abs(found_temp / 10 - temp).max() <= 0.11
    assert np.abs(found_pressure - pressure).max() < 6


def test_data_sheets_example_turned_round():
    assert baro.raw_temperature(np.array([15.0]))[0] == pytest.approx(27898, abs=10)
    assert baro.raw_pressure(np.array([69964.0]), np.array([15.0]), 0)[0] == pytest.approx(23843, abs=5)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"test": 4}, "Test 4"),
        ({"duration_s": 0.5}, "0.5 s"),
        ({"rate_hz": 20}, "50 to 500"),
        ({"errors": "some"}, "calibrated, datasheet, none"),
        ({"j2s_m": (0, 0, 0)}, "J2S"),
        ({"seed": -1}, "seed"),
    ],
)
def test_what_cannot_be_is_refused(arguments, sentence):
    with pytest.raises(LinkposeError, match=sentence):
        LinkRun(**arguments)


def test_the_position_of_the_truth_is_the_lever_turned_by_its_angles():
    """R_ns d with R_ns = Rz(yaw) Ry(pitch) Rx(roll), written out."""
    run = LinkRun(3, 2, 20.0)
    truth = run.truth()
    roll, pitch, yaw = np.radians([truth.roll_deg, truth.pitch_deg, truth.yaw_deg])
    rx, ry, rz = (np.zeros((len(yaw), 3, 3)) for _ in range(3))
    for matrix, angle, (i, j) in ((rx, roll, (1, 2)), (ry, pitch, (2, 0)), (rz, yaw, (0, 1))):
        matrix[:, [0, 1, 2], [0, 1, 2]] = 1.0
        matrix[:, i, i] = matrix[:, j, j] = np.cos(angle)
        matrix[:, i, j], matrix[:, j, i] = -np.sin(angle), np.sin(angle)
    place = rz @ ry @ rx @ np.array(run.j2s_m)
    assert np.allclose(place, np.column_stack([truth.x_m, truth.y_m, truth.height_m]), atol=1e-12)
