"""calibrate imu and calibrate joint: known sensors and levers are found again; what does not tell them is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from linkpose.calibration.imu import calibrate_imu, with_calibration
from linkpose.calibration.joint import calibrate_joint
from linkpose.cli import calibrate_imu as imu_command
from linkpose.cli import calibrate_joint as joint_command
from linkpose.cli import simulate_link
from linkpose.errors import LinkposeError
from linkpose.recording.reader import Recording
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Imu, Rig
from linkpose.simulation.link import LinkRun

BIAS = np.radians([3.0, -7.0, 12.0])
OFFSET, SCALE = np.array([0.4, -0.3, 0.2]), np.array([1.02, 0.985, 0.97])
SIX_SIDES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)


def recording(block: Measurements) -> Recording:
    return Recording(Path("rec.csv"), block, None, 100.0, {}, [])


def turned_over(sides, seconds: float = 3.0) -> Recording:
    """Each side in turn at rest, moved by hand in between."""
    rng = np.random.default_rng(4)
    n, hand = int(100 * seconds), 100
    force, rate = [], []
    for side in sides:
        force += [np.tile(side * STANDARD_GRAVITY, (n, 1)), rng.normal(0, 8, (hand, 3))]
        rate += [np.zeros((n, 3)), rng.normal(0, 1, (hand, 3))]
    true_force, true_rate = np.concatenate(force), np.concatenate(rate)
    count = len(true_force)
    block = Measurements(
        np.arange(count) / 100,
        true_force * SCALE + OFFSET + rng.normal(0, 0.04, (count, 3)),
        true_rate + BIAS + rng.normal(0, 0.001, (count, 3)),
        np.full(count, 25.0), 1e5 + rng.normal(0, 3.0, count), np.full(count, 25.0), np.ones(count, bool),
        np.empty((count, 0, 2)), np.ones(count, np.uint16),
    )  # fmt: skip
    return recording(block)


def test_imu_from_six_sides():
    found = calibrate_imu([turned_over(SIX_SIDES)])
    assert (found.rests, found.attitudes) == (6, 6)
    assert found.gyro_bias_rad_s == pytest.approx(BIAS, abs=2e-4)
    assert found.accel_offset_m_s2 == pytest.approx(OFFSET, abs=0.01)
    assert found.accel_scale == pytest.approx(SCALE, abs=0.001)
    assert found.gyro_noise_rad_s == pytest.approx(0.001, rel=0.1)
    assert found.accel_noise_m_s2 == pytest.approx(0.04, rel=0.1)
    assert found.pressure_noise_Pa == pytest.approx(3.0, rel=0.1)


def test_from_one_attitude_the_accelerometer_stays_as_it_was():
    before = Rig(imu=Imu(accel_offset_m_s2=(0.1, 0.2, 0.3)))
    found = calibrate_imu([turned_over(SIX_SIDES[:1])])
    after = with_calibration(before, found)
    assert found.accel_scale is None
    assert after.imu.accel_offset_m_s2 == (0.1, 0.2, 0.3)
    assert after.imu.gyro_bias_rad_s == pytest.approx(BIAS, abs=2e-4)


def test_rests_that_do_not_tell_the_axes_apart_are_refused():
    angle = np.radians([0, 60, 120, 180, 240, 300])
    in_a_plane = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(6)])
    with pytest.raises(LinkposeError, match="six sides"):
        calibrate_imu([turned_over(in_a_plane)])


def test_no_rest_is_refused():
    block = LinkRun(3, 0, 30.0).measurements()[700:2300]
    with pytest.raises(LinkposeError, match=r"no rest.*rec\.csv"):
        calibrate_imu([recording(block)])


@pytest.mark.parametrize("test", [1, 2, 3])
def test_joint_to_millimetres_from_a_minute(test):
    for seed in range(3):
        run = LinkRun(test, seed, 60.0)
        found = calibrate_joint([recording(run.measurements())], Rig())
        error = np.abs(found.j2s_m - run.j2s_m)
        assert error.max() <= 0.008
        assert (error <= 3 * found.std_m).all()
        assert found.residual_m_s2 < 0.1


def test_joint_of_a_short_link_from_two_recordings():
    runs = [LinkRun(2, seed, 30.0, j2s_m=(0.05, -0.2, 0.3)) for seed in (0, 1)]
    found = calibrate_joint([recording(run.measurements()) for run in runs], Rig())
    assert found.j2s_m == pytest.approx([0.05, -0.2, 0.3], abs=0.004)


def test_rotation_about_one_axis_names_the_axis_it_does_not_tell():
    t = np.arange(4000) / 100
    angle, rate = 0.5 * np.sin(3 * t), 1.5 * np.cos(3 * t)
    tilt = np.column_stack([np.zeros(4000), np.sin(angle), np.cos(angle)])
    omega = np.column_stack([rate, np.zeros(4000), np.zeros(4000)])
    slope = np.column_stack([-4.5 * np.sin(3 * t), np.zeros(4000), np.zeros(4000)])
    d = np.array([0.3, 0.2, 1.0])
    force = STANDARD_GRAVITY * tilt + np.cross(slope, d) + np.cross(omega, np.cross(omega, d))
    block = replace(LinkRun(1, 0, 40.0).measurements(), time_s=t, accel_m_s2=force, gyro_rad_s=omega)
    with pytest.raises(LinkposeError, match="sensor's x axis"):
        calibrate_joint([recording(block)], Rig())


def test_rest_alone_is_refused():
    with pytest.raises(LinkposeError, match="swing the link"):
        calibrate_joint([turned_over(SIX_SIDES[:1])], Rig())


def test_commands_complete_the_rig_file(tmp_path):
    """From the recording of a link to a rig file with J2S that keeps its other tables."""
    rec, truth, rig_file = tmp_path / "rec.csv", tmp_path / "truth.csv", tmp_path / "rig.toml"
    made = CliRunner().invoke(simulate_link.command, ["-o", str(rec), "--truth", str(truth), "--test", "2"])
    assert made.exit_code == 0
    rig_file.write_text("[baro]\npressure_noise_Pa = 4.5\n\n[[mouse]]\nx_m = 0.1\ny_m = 0.2\n")
    for command in (imu_command.command, joint_command.command):
        result = CliRunner().invoke(command, [str(rec), "--rig", str(rig_file), "--json"], catch_exceptions=False)
        assert result.exit_code == 0
        shown = json.loads(result.stdout.splitlines()[0])
    rig = Rig.load(rig_file)
    assert rig.joint.j2s_m == pytest.approx((-0.09, -0.04, 1.65), abs=0.008)
    assert shown["j2s_m"] == pytest.approx(rig.joint.j2s_m, abs=1e-4)
    assert 0.0001 < rig.joint.j2s_std_m < 0.01
    assert (rig.mouse[0].x_m, rig.mouse[0].y_m) == (0.1, 0.2)
    assert rig.imu.gyro_bias_rad_s != (0.0, 0.0, 0.0)
