"""calibrate imu and calibrate joint: known sensors and levers are found again; insufficient data are refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.signal import butter, lfilter

from linkpose import filters
from linkpose.calibration.imu import calibrate_imu, with_calibration
from linkpose.calibration.joint import LARGE_RESIDUAL_M_S2, JointCalibration, calibrate_joint, is_calibrated
from linkpose.calibration.joint import with_calibration as joint_with_calibration
from linkpose.cli import calibrate_imu as imu_command
from linkpose.cli import calibrate_joint as joint_command
from linkpose.cli import simulate_link
from linkpose.errors import LinkposeError
from linkpose.recording.reader import Recording
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Imu, Rig
from linkpose.simulation.link import LinkRun
from linkpose.wire.messages import SampleFlags

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


@pytest.mark.parametrize("bandwidth_hz", [None, 44.0, 5.0])
@pytest.mark.parametrize("seconds", [1.2, 60.0])
def test_the_noise_is_that_of_a_sample_however_the_low_pass_filter_is_set(bandwidth_hz, seconds):
    """At 500 Hz neighbours are nearly alike behind the filter; a gyro that warms up by 1 °/s is no noise."""
    rng, rate = np.random.default_rng(7), 500
    time = np.arange(int((seconds + 1.0) * rate)) / rate
    noise = rng.normal(size=(2000 + len(time), 60))
    if bandwidth_hz:
        noise = lfilter(*butter(2, bandwidth_hz, fs=rate), noise, axis=0)
    noise = (noise / noise[1000:].std())[-len(time) :]
    warming = np.radians(1.0) * np.exp(-time / 100.0)
    rests = [
        replace(
            LinkRun(1, 0, 1.0).measurements()[np.zeros(len(time), int)],
            time_s=time,
            gyro_rad_s=warming[:, np.newaxis] + 0.0006 * noise[:, 6 * k : 6 * k + 3],
            accel_m_s2=np.array([0.0, 0.0, 9.8]) + 0.03 * noise[:, 6 * k + 3 : 6 * k + 6],
        )
        for k in range(10)
    ]
    found = calibrate_imu([recording(rest) for rest in rests])
    close = 0.15 if bandwidth_hz == 5.0 and seconds < 2 else 0.05
    assert found.gyro_noise_rad_s == pytest.approx(0.0006, rel=close)
    assert found.accel_noise_m_s2 == pytest.approx(0.03, rel=close)


def test_from_one_attitude_the_accelerometer_stays_as_it_was():
    before = Rig(imu=Imu(accel_offset_m_s2=(0.1, 0.2, 0.3)))
    found = calibrate_imu([turned_over(SIX_SIDES[:1])])
    after = with_calibration(before, found)
    assert found.accel_scale is None
    assert after.imu.accel_offset_m_s2 == (0.1, 0.2, 0.3)
    assert after.imu.gyro_bias_rad_s == pytest.approx(BIAS, abs=2e-4)


def test_rests_in_one_plane_leave_the_accelerometer_as_it_was(tmp_path):
    angle = np.radians([0, 60, 120, 180, 240, 300])
    in_a_plane = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(6)])
    path = saved(tmp_path / "rests.csv", turned_over(in_a_plane).measurements)
    done = CliRunner().invoke(imu_command.command, [path, "--rig", str(tmp_path / "rig.toml")], catch_exceptions=False)
    assert "6 attitudes recorded" in done.stderr and "Add a rest with +z, -z upwards." in done.stderr
    after = Rig.load(tmp_path / "rig.toml").imu
    assert after.gyro_bias_rad_s == pytest.approx(BIAS, abs=2e-4) and after.accel_offset_std_m_s2 is None


def test_no_rest_is_refused():
    block = LinkRun(3, 0, 30.0).measurements()[700:2300]
    with pytest.raises(LinkposeError, match=r"rec\.csv: the sensor is never at rest; .* by [\d.]+ m/s² and"):
        calibrate_imu([recording(block)])


@pytest.mark.parametrize(("seconds", "motor", "sentence"), [(0.5, 0.0, "the longest rest lasts"), (3.0, 0.5, "motors")])
def test_rests_that_are_too_short_or_shaken_are_named(seconds, motor, sentence):
    block = turned_over(SIX_SIDES, seconds).measurements
    shaking = motor * np.sin(270 * block.time_s[:, None] + np.arange(3))
    with pytest.raises(LinkposeError, match=sentence):
        calibrate_imu([recording(replace(block, accel_m_s2=block.accel_m_s2 + shaking))])


def test_saturated_rests_are_left_out():
    """The side that is missing then is named, and the gyro's bias is still found."""
    block = turned_over(SIX_SIDES).measurements
    is_up = block.accel_m_s2[:, 0] > 8.0
    flags = block.flags | np.where(is_up, SampleFlags.ACCEL_SATURATED, 0).astype(block.flags.dtype)
    found = calibrate_imu([recording(replace(block, flags=flags))])
    assert (found.rests, found.saturated, found.missing_sides) == (5, 1, ("+x",))
    assert found.accel_scale is None and found.gyro_bias_rad_s == pytest.approx(BIAS, abs=2e-4)
    with pytest.raises(LinkposeError, match="saturated at each rest"):
        calibrate_imu([recording(replace(block, flags=block.flags | int(SampleFlags.ACCEL_SATURATED)))])


def test_a_gyro_that_turns_at_rest_is_refused():
    block = turned_over(SIX_SIDES).measurements
    with pytest.raises(LinkposeError, match="which no MPU-6050 does"):
        calibrate_imu([recording(replace(block, gyro_rad_s=8 * block.gyro_rad_s))])


def normalised(run: LinkRun, found: JointCalibration):
    return (found.j2s_m - run.j2s_m) / found.std_m


@pytest.mark.parametrize("test", [1, 2, 3])
def test_joint_to_millimetres_from_a_minute(test):
    for seed in range(2):
        run = LinkRun(test, seed, 60.0)
        found = calibrate_joint([recording(run.measurements())], Rig())
        assert np.abs(found.j2s_m - run.j2s_m).max() <= 0.003
        assert np.abs(normalised(run, found)).max() <= 3
        assert found.std_m.max() <= 0.003
        assert found.residual_m_s2 < 0.03


def test_joint_from_a_sensor_that_was_never_calibrated():
    """Along the lever the scales are found; across it the axes' tilt within the chip cannot be, and is in the std."""
    scores = []
    for seed in range(3):
        run = LinkRun(1, seed, 60.0, errors="datasheet")
        found = calibrate_joint([recording(run.measurements())], Rig())
        assert abs(found.j2s_m[2] - run.j2s_m[2]) <= 0.004
        scores.append(normalised(run, found))
    assert 0.3 <= np.sqrt(np.mean(np.square(scores))) <= 2.0


def test_the_sensors_errors_are_found_with_the_joint():
    """Over what the rig file contains already; without them the gyro's bias alone would lean the tilt by degrees."""
    run = LinkRun(1, 0, 60.0, errors="datasheet")
    errors, block = run.imu_errors, run.measurements()
    known = Imu(gyro_bias_rad_s=(0.1, -0.1, 0.05), accel_offset_m_s2=(0.1, 0.0, -0.2), accel_scale=(1.01, 0.99, 1.02))
    found = calibrate_joint([recording(block)], Rig(imu=known))
    assert not is_calibrated(known, found)
    assert found.imu.gyro_bias_rad_s == pytest.approx(errors.gyro_bias_rad_s, abs=0.001)
    assert found.imu.accel_offset_m_s2 == pytest.approx(errors.accel_bias_m_s2, abs=0.1)
    assert found.imu.accel_scale == pytest.approx(np.diag(errors.accel_matrix), abs=0.01)
    again = calibrate_joint([recording(block)], Rig(imu=found.imu))
    assert is_calibrated(found.imu, again)
    with_j2s = joint_with_calibration(Rig(imu=known), found, with_imu=False)
    assert with_j2s.imu == known and with_j2s.joint.j2s_m == pytest.approx(found.j2s_m, abs=1e-5)
    estimates = [
        filters.create("tilt", joint_with_calibration(Rig(imu=known), found, with_imu)).process(block)[500:, 0]
        for with_imu in (False, True)
    ]
    before, after = (np.sqrt(np.mean((height - run.truth().height_m[500:]) ** 2)) for height in estimates)
    assert after < 0.05 < 0.3 < before


def test_joint_of_a_short_link_from_two_recordings():
    runs = [LinkRun(2, seed, 30.0, j2s_m=(0.05, -0.2, 0.3)) for seed in (0, 1)]
    found = calibrate_joint([recording(run.measurements()) for run in runs], Rig())
    assert found.j2s_m == pytest.approx([0.05, -0.2, 0.3], abs=0.001)


def test_joint_in_spite_of_lost_held_and_wild_samples():
    run = LinkRun(2, 1, 60.0)
    block, rng = run.measurements(), np.random.default_rng(3)
    rate, force = block.gyro_rad_s.copy(), block.accel_m_s2.copy()
    wild = rng.choice(len(block), 12, replace=False)
    rate[wild[:6], 1] += 17.0
    force[wild[6:], 0] -= 70.0
    kept = np.flatnonzero(rng.random(len(block)) > 0.05)
    found = calibrate_joint([recording(replace(block, gyro_rad_s=rate, accel_m_s2=force)[kept])], Rig())
    assert np.abs(found.j2s_m - run.j2s_m).max() <= 0.003
    held = np.arange(len(block)) // 4 * 4
    held_block = replace(block, gyro_rad_s=block.gyro_rad_s[held], accel_m_s2=block.accel_m_s2[held])
    found = calibrate_joint([recording(held_block)], Rig())
    assert np.abs(found.j2s_m - run.j2s_m).max() <= 0.004


def test_saturated_samples_are_left_out():
    run = LinkRun(3, 0, 60.0)
    block = run.measurements()
    most = 3.0  # rad/s
    flags = block.flags | np.where((np.abs(block.gyro_rad_s) > most).any(axis=1), SampleFlags.GYRO_SATURATED, 0)
    clipped = replace(block, gyro_rad_s=np.clip(block.gyro_rad_s, -most, most), flags=flags.astype(np.uint16))
    assert (clipped.gyro_rad_s != block.gyro_rad_s).any(axis=1).sum() >= 20
    found = calibrate_joint([recording(clipped)], Rig())
    assert np.abs(found.j2s_m - run.j2s_m).max() <= 0.003


def test_play_in_the_joint_shows_in_the_std():
    run = LinkRun(2, 1, 60.0)
    block = run.measurements()
    shake = 0.03 * 25.0 * np.sin(5.0 * block.time_s)  # 3 cm to and fro
    found = calibrate_joint([recording(block)], Rig())
    loose = calibrate_joint(
        [recording(replace(block, accel_m_s2=block.accel_m_s2 + np.outer(shake, [1, 0, 0])))], Rig()
    )
    assert loose.residual_m_s2 > 5 * found.residual_m_s2
    assert loose.std_m.max() > 3 * found.std_m.max()
    assert np.abs(normalised(run, loose)).max() <= 3


def test_a_step_of_the_temperature_shows_in_the_std():
    """Bias, offset and scale change halfway. Residuals are then correlated for half the recording, not for a second."""
    run = LinkRun(2, 41, 60.0, errors="datasheet")
    block, rng, late = run.measurements(), np.random.default_rng(1), slice(3000, None)
    accel, gyro = block.accel_m_s2.copy(), block.gyro_rad_s.copy()
    accel[late] += rng.normal(0, 0.3, 3)
    gyro[late] += np.radians(rng.normal(0, 2, 3))
    accel[late] *= 1 + rng.normal(0, 0.005, 3)
    found = calibrate_joint([recording(replace(block, accel_m_s2=accel, gyro_rad_s=gyro))], Rig())
    error = found.j2s_m - run.j2s_m
    assert error @ np.linalg.solve(found.covariance_m2, error) < 9.0
    assert found.residual_m_s2 > LARGE_RESIDUAL_M_S2  # which the command names


def test_a_sensor_on_no_joint_is_refused():
    """A hand that carries it about while it turns."""
    run = LinkRun(2, 0, 40.0, j2s_m=(0.0, 0.0, 0.02))
    block = run.measurements()
    t = block.time_s[:, None]
    carried = 3.0 * np.sin(np.array([5.1, 6.3, 7.7]) * t + np.array([0.0, 1.0, 2.0]))
    with pytest.raises(LinkposeError, match="no joint that stays in its place"):
        calibrate_joint([recording(replace(block, accel_m_s2=block.accel_m_s2 + carried))], Rig())


def test_a_sensor_that_cannot_be_is_refused():
    block = LinkRun(2, 0, 40.0).measurements()
    with pytest.raises(LinkposeError, match=r"a scale of \[1\.15.*which no MPU-6050 has"):
        calibrate_joint([recording(replace(block, accel_m_s2=1.15 * block.accel_m_s2))], Rig())


def hinge(axis, seed: int = 0, seconds: float = 40.0, d=(0.3, 0.2, 1.0), vibration: float = 0.0) -> Measurements:
    """A link on a hinge, swung to and fro. `vibration`: amplitude of a motor at 43 Hz (m/s²)."""
    t = np.arange(int(100 * seconds)) / 100
    angle, rate, slope = 0.5 * np.sin(3 * t), 1.5 * np.cos(3 * t), -4.5 * np.sin(3 * t)
    axis, up = np.array(axis, dtype=float), np.array([0.48, 0.6, 0.64])
    up -= (up @ axis) * axis
    up /= np.linalg.norm(up)
    tilt = np.outer(np.cos(angle), up) - np.outer(np.sin(angle), np.cross(axis, up))
    omega, alpha = np.outer(rate, axis), np.outer(slope, axis)
    force = STANDARD_GRAVITY * tilt + np.cross(alpha, d) + np.cross(omega, np.cross(omega, d))
    noise = np.random.default_rng(seed).normal(size=(2, len(t), 3))
    shaken = vibration * np.sin(2 * np.pi * 43 * t[:, None] + np.array([0.0, 1.0, 2.0]))
    return Measurements.from_imu(t, force + 0.04 * noise[0] + shaken, omega + 0.0009 * noise[1])


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 0, 1), (0.6, 0.0, 0.8)])
def test_a_hinge_gives_two_directions_and_the_sigma_of_the_third(axis, tmp_path):
    found = calibrate_joint([recording(hinge(axis))], Rig())
    assert abs(found.worst_direction @ np.array(axis)) > 0.999
    error = found.j2s_m - (0.3, 0.2, 1.0)
    assert error @ np.linalg.solve(found.covariance_m2, error) < 16.0
    assert found.worst_std_m > max(0.05, abs(error @ np.array(axis)) / 2)
    assert np.sqrt(np.linalg.eigvalsh(found.covariance_m2)[1]) < 0.005
    assert found.weak_axis == np.argmax(np.abs(axis))
    joint = joint_with_calibration(Rig(), found, with_imu=False).joint
    joint_with_calibration(Rig(), found, with_imu=False).save(tmp_path / "rig.toml")
    assert Rig.load(tmp_path / "rig.toml").joint == joint
    assert joint.j2s_std_m == pytest.approx(found.std_m, abs=1e-4)
    assert joint.known_j2s_m is None  # only filters that estimate J2S use it


def test_a_hinge_is_named_with_its_cure(tmp_path):
    rig = tmp_path / "rig.toml"
    path = saved(tmp_path / "rec.csv", hinge((0, 1, 0)))
    done = CliRunner().invoke(joint_command.command, [path, "--rig", str(rig)], catch_exceptions=False)
    assert done.exit_code == 0
    assert "J2S is not observable along the sensor's y axis (direction" in done.stderr
    assert "Rotate the link about its x and z axes too" in done.stderr
    shown = CliRunner().invoke(joint_command.command, [path, "--rig", str(rig), "--json"], catch_exceptions=False)
    assert json.loads(shown.stdout)["observable"] == [True, False, True]


def test_motion_that_is_too_slow_is_refused():
    """A sensor on the hinge's axis that turns slowly: neither distance shows in the accelerations."""
    still = np.zeros((6000, 3))
    still[:, 0] = 0.21  # rad/s
    t = np.arange(6000) / 100
    up = np.column_stack([0 * t, np.sin(0.21 * t), np.cos(0.21 * t)])
    noise = np.random.default_rng(1).normal(size=(2, 6000, 3))
    block = Measurements.from_imu(t, STANDARD_GRAVITY * up + 0.04 * noise[0], still + 0.0009 * noise[1])
    with pytest.raises(LinkposeError, match="too slow or too short"):
        calibrate_joint([recording(block)], Rig())


def test_vibration_of_a_motor_is_no_spike():
    """Its samples alternate by more than those of any motion; a spike among them is still left out."""
    block = hinge((1, 0, 0), seed=3, vibration=12.0)
    block.accel_m_s2[1000::1500] += 400.0
    found = calibrate_joint([recording(block)], Rig())
    error = found.j2s_m - (0.3, 0.2, 1.0)
    assert np.abs(error[1:]).max() < 0.01
    assert error @ np.linalg.solve(found.covariance_m2, error) < 16.0


def test_samples_that_come_too_rarely_are_refused():
    block = LinkRun(1, 0, 40.0).measurements()
    with pytest.raises(LinkposeError, match=r"rec\.csv: nowhere is a second with 20 samples"):
        calibrate_joint([recording(block[::10])], Rig())
    assert calibrate_joint([recording(block[::5])], Rig()).std_m.max() < 0.005


def test_rest_alone_is_refused():
    with pytest.raises(LinkposeError, match="swing the link"):
        calibrate_joint([turned_over(SIX_SIDES[:1])], Rig())


def saved(path: Path, block: Measurements, accel_unit: float = 1.0) -> str:
    """A recording of the inertial sensor alone, its accelerations in a unit of so many m/s²."""
    rows = np.column_stack([block.time_s, block.accel_m_s2 / accel_unit, block.gyro_rad_s])
    names = ["time_s", *(f"accel_{axis}_m_s2" for axis in "xyz"), *(f"gyro_{axis}_rad_s" for axis in "xyz")]
    head = "# linkpose recording 1\n# {}\n" + ",".join(names)
    np.savetxt(path, rows, "%.7f", delimiter=",", header=head, footer="# {}", comments="")
    return str(path)


@pytest.mark.parametrize(
    ("sides", "sentence"),
    [
        (SIX_SIDES[:1], "1 rest in 1 attitude\n"),
        (SIX_SIDES, "6 attitudes always fit; record more to get a residual"),
        (np.vstack([SIX_SIDES, np.ones((1, 3)) / np.sqrt(3)]), "residual 0.00"),
    ],
)
def test_a_residual_is_reported_where_there_is_one(tmp_path, sides, sentence):
    path = saved(tmp_path / "r.csv", turned_over(sides).measurements)
    result = CliRunner().invoke(
        imu_command.command, [path, "--rig", str(tmp_path / "rig.toml")], catch_exceptions=False
    )
    assert sentence in result.stdout
    assert ("residual" in result.stdout) == (len(sides) >= 6)


def test_what_a_recording_has_to_say_is_said_before_it_is_calibrated_from(tmp_path):
    path = saved(tmp_path / "r.csv", turned_over(SIX_SIDES).measurements, accel_unit=STANDARD_GRAVITY)
    result = CliRunner().invoke(imu_command.command, [path, "--rig", str(tmp_path / "rig.toml")])
    assert "is it in g? multiply it by 9.80665" in result.stderr


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
    assert rig.joint.j2s_m == pytest.approx((-0.09, -0.04, 1.65), abs=0.003)
    assert shown["j2s_m"] == pytest.approx(rig.joint.j2s_m, abs=1e-4)
    assert 0.0001 < rig.joint.j2s_std_m < 0.01
    assert (rig.mouse[0].x_m, rig.mouse[0].y_m) == (0.1, 0.2)
    assert rig.imu.accel_offset_m_s2 == (0.0, 0.0, 0.0)
    assert rig.imu.gyro_bias_rad_s != (0.0, 0.0, 0.0)


def test_a_sensor_that_is_not_calibrated_is_said_and_calibrated_on_request(tmp_path):
    rec, truth, rig_file = tmp_path / "rec.csv", tmp_path / "truth.csv", tmp_path / "rig.toml"
    CliRunner().invoke(simulate_link.command, ["-o", str(rec), "--truth", str(truth), "--errors", "datasheet"])
    typed = [str(rec), "--rig", str(rig_file)]
    result = CliRunner().invoke(joint_command.command, typed, catch_exceptions=False)
    assert "are not saved. Add --imu to save them." in result.stderr
    assert "The rig file does not calibrate the sensor: add --imu" in result.stderr
    assert Rig.load(rig_file).imu.gyro_bias_rad_s == (0.0, 0.0, 0.0)
    asked = CliRunner().invoke(joint_command.command, [*typed, "--imu", "--json"], catch_exceptions=False)
    assert "not saved" not in asked.stderr and "does not calibrate" not in asked.stderr
    rig, shown = Rig.load(rig_file), json.loads(asked.stdout)
    assert list(rig.imu.gyro_bias_rad_s) == shown["gyro_bias_rad_s"]
    assert list(rig.imu.accel_scale) == shown["accel_scale"] != [1.0, 1.0, 1.0]
    again = CliRunner().invoke(joint_command.command, typed, catch_exceptions=False)
    assert "not saved" in again.stderr and "does not calibrate" not in again.stderr


def test_the_six_rests_of_a_simulated_sensor_calibrate_it(tmp_path):
    """`simulate link --rests` and then `calibrate imu`, as each names the next command."""
    rec, truth, rig_file = tmp_path / "rec.csv", tmp_path / "truth.csv", tmp_path / "rig.toml"
    typed = ["-o", str(rec), "--truth", str(truth), "--rests", "--errors", "datasheet", "--duration", "40"]
    made = CliRunner().invoke(simulate_link.command, typed, catch_exceptions=False)
    assert f"next: linkpose calibrate imu {rec} --rig rig.toml" in made.stderr
    found = CliRunner().invoke(
        imu_command.command, [str(rec), "--rig", str(rig_file), "--json"], catch_exceptions=False
    )
    assert json.loads(found.stdout)["attitudes"] == 6
    port = "'sim://link?test=1&seed=0&errors=datasheet'"  # the same simulated sensor, on a link that swings
    assert f"next: linkpose record swing.csv --port {port}\nthen: linkpose calibrate joint swing.csv" in found.stderr
    errors = LinkRun(1, 0, 40.0, errors="datasheet", motion="sides").imu_errors
    assert Rig.load(rig_file).imu.gyro_bias_rad_s == pytest.approx(errors.gyro_bias_rad_s, abs=1e-3)
    assert Rig.load(rig_file).imu.accel_offset_m_s2 == pytest.approx(errors.accel_bias_m_s2, abs=0.05)
    with pytest.raises(LinkposeError, match="six rests do not fit 10 s: simulate 23 s or more"):
        LinkRun(1, 0, 10.0, motion="sides")


def test_the_sigma_of_bias_and_offset_reach_the_filters(tmp_path):
    """`calibrate imu` writes its own figures; filters start from them."""
    found = calibrate_imu([turned_over(np.vstack([SIX_SIDES, np.ones((1, 3)) / np.sqrt(3)]))])
    assert np.abs(found.gyro_bias_rad_s - BIAS).max() < 3 * found.gyro_bias_std_rad_s < 0.006
    assert np.abs(found.accel_offset_m_s2 - OFFSET).max() < 3 * found.accel_offset_std_m_s2 < 0.1
    with_calibration(Rig(), found).save(tmp_path / "rig.toml")
    rig = Rig.load(tmp_path / "rig.toml").with_j2s((0.0, 0.0, 1.0))
    gyro, accel = rig.imu.gyro_bias_std_rad_s, rig.imu.accel_offset_std_m_s2
    assert (gyro, accel) == pytest.approx((found.gyro_bias_std_rad_s, found.accel_offset_std_m_s2), rel=0.01)
    states = [*filters.create("joint-inertial", rig).states, filters.create("tilt-inertial", rig).state]
    for state in states:
        assert state.prior[6:9] == pytest.approx(gyro**2) and state.prior[9:12] == pytest.approx(accel**2)
    undeclared = filters.create("tilt-inertial", Rig().with_j2s((0.0, 0.0, 1.0))).state
    assert undeclared.prior[6] > 0.01


@pytest.mark.parametrize("key", ["gyro_bias_std_rad_s", "accel_offset_std_m_s2"])
def test_a_sigma_of_zero_is_refused(key):
    with pytest.raises(LinkposeError, match=f"imu.{key} is 0; it must be above 0"):
        Rig.from_dict({"imu": {key: 0}}, "rig.toml")
