"""calibrate noise: known coefficients are found again; what is no rest is named; simulators use the figures."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from linkpose.calibration.allan import FLICKER, allan_deviation, averaging_counts, fit_noise
from linkpose.calibration.noise import DATA_SHEET_GYRO, calibrate_noise, with_calibration
from linkpose.cli import calibrate_noise as noise_command
from linkpose.cli import simulate_link
from linkpose.errors import FileFormatError, LinkposeError
from linkpose.recording.reader import Recording
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Imu, Noise, Rig
from linkpose.simulation.imu import BiasDrift
from linkpose.simulation.link import LinkRun

RATE = 100
GYRO, ACCEL = 1.0e-4, 2.0e-3  # densities, per √Hz
UP = np.array([0.0, 0.0, STANDARD_GRAVITY])


def rest(seconds: float, *, gyro=0.0, accel=0.0, temp_degC=25.0, seed=1) -> Recording:
    """A sensor at rest with white noise; `gyro` and `accel` are added to the readings."""
    rng, count = np.random.default_rng(seed), int(seconds * RATE)
    time = np.arange(count) / RATE
    root = math.sqrt(RATE)
    block = Measurements.from_imu(
        time,
        UP + ACCEL * root * rng.standard_normal((count, 3)) + accel,
        GYRO * root * rng.standard_normal((count, 3)) + gyro,
    )
    block.imu_temp_degC[:] = temp_degC
    return Recording(Path("rest.csv"), block, None, float(RATE), {}, [])


def save(recording: Recording, path: Path) -> Path:
    m = recording.measurements
    names = "time_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,imu_temp_degC"
    np.savetxt(
        path, np.column_stack([m.time_s, m.accel_m_s2, m.gyro_rad_s, m.imu_temp_degC]), "%.8f", ",", header=names,
        comments="",
    )  # fmt: skip
    return path


def test_the_allan_deviation_is_the_definition():
    """Means of m samples, one after the other, from each of the first m samples on."""
    values = np.random.default_rng(0).standard_normal(200).cumsum()
    for m, found in zip((1, 3, 20), allan_deviation(values, np.array([1, 3, 20])), strict=True):
        means = np.convolve(values, np.ones(m) / m, "valid")
        assert found == pytest.approx(math.sqrt(0.5 * np.mean((means[m:] - means[:-m]) ** 2)), rel=1e-9)


def test_one_second_is_among_the_averaging_times():
    counts = averaging_counts(60_000, 99.3)
    assert 99 in counts and counts[0] == 1 and 60_000 / counts[-1] < 10.5


@pytest.mark.parametrize("walk", [0.0, 2e-5, 1e-4])
def test_white_noise_and_random_walk_are_found(walk):
    rng, count = np.random.default_rng(3), 360_000
    values = 1e-3 * rng.standard_normal(count) + walk / 10 * np.cumsum(rng.standard_normal(count))
    found = fit_noise(values, RATE, 0.1)
    assert found.density == pytest.approx(1e-4, rel=0.03)
    assert abs(found.density - 1e-4) < 4 * found.density_std
    if walk:
        assert found.walk is not None
        assert abs(found.walk - walk) < 4 * found.walk_std < walk
        assert not found.instability_is_bound
    else:
        assert found.walk is None and found.instability_is_bound


def test_a_simulated_bias_instability_is_found():
    """The drift alone: its Allan deviation is flat at 0.664 B."""
    drift = BiasDrift(Noise(gyro_instability_rad_s=(1e-4, 2e-4, 0.0)), (5,))
    time = np.arange(0, 8000, 2.0)
    gyro, accel = drift.at(time, np.full(len(time), 25.0))
    for axis, instability in ((0, 1e-4), (1, 2e-4)):
        flat = allan_deviation(gyro[:, axis], np.array([3, 5, 10, 20])).mean()
        assert flat == pytest.approx(FLICKER * instability, rel=0.1)
    assert not gyro[:, 2].any() and not accel.any()


def test_a_drift_is_a_function_of_time_alone():
    noise = Noise(gyro_walk_rad_s_sqrts=(1e-3,) * 3, accel_instability_m_s2=(1e-3,) * 3)
    time = np.arange(0, 30, 0.01)
    whole = np.hstack(BiasDrift(noise, (1, 2)).at(time, np.full(3000, 25.0)))
    late = BiasDrift(noise, (1, 2))
    assert np.array_equal(np.hstack(late.at(time[2500:], np.full(500, 25.0))), whole[2500:])
    assert np.array_equal(np.hstack(late.at(time[:10], np.full(10, 25.0))), whole[:10])


def test_the_noise_of_a_rest_and_its_drift_with_the_temperature():
    temp = 25.0 + 6.0 * (1 - np.exp(-np.arange(60_000) / 20_000))
    per_degC = np.array([4e-4, -2e-4, 0.0])
    found = calibrate_noise([rest(600.0, gyro=np.outer(temp, per_degC), temp_degC=temp)])
    assert found.is_rest
    assert found.temperature_range_degC == pytest.approx(np.ptp(temp), abs=0.2)
    for axis, slope in zip(found.gyro, per_degC, strict=True):
        assert axis.model.density == pytest.approx(GYRO, rel=0.02)
        assert abs(axis.drift - slope) < 4 * axis.drift_std < 2e-5
    assert [a.model.density for a in found.accel] == pytest.approx([ACCEL] * 3, rel=0.02)
    rig = with_calibration(Rig(imu=Imu(gyro_bias_rad_s=(1.0, 2.0, 3.0))), found)
    assert rig.imu.gyro_bias_rad_s == (1.0, 2.0, 3.0)
    assert rig.imu.gyro_noise_rad_s == pytest.approx(GYRO * 10, rel=0.02)
    assert rig.noise.gyro_drift_rad_s_degC == pytest.approx(per_degC, abs=1e-5)


def test_what_is_not_observed_stays_out_of_the_rig():
    found = calibrate_noise([rest(120.0)])
    assert found.gyro[0].drift is None and not found.is_long_enough
    rig = with_calibration(Rig(), found)
    assert rig.noise.gyro_drift_rad_s_degC is None and rig.noise.gyro_walk_rad_s_sqrts is None
    assert "degC" not in rig.to_toml()


@pytest.mark.parametrize(
    "disturbance, named",
    [
        ({"accel": 0.12 * np.sin(2 * np.pi * 24.7 * np.arange(9000) / RATE)[:, None]}, "vibration"),
        ({"accel": np.outer(np.linspace(0, 0.2, 9000), [1.0, 0.0, 0.0])}, "tilted"),
        ({"gyro": 0.008 * np.sin(np.arange(9000) / 300)[:, None]}, "changed by more"),
    ],
)
def test_what_is_no_rest_is_named_and_not_written(tmp_path, disturbance, named):
    path, rig = save(rest(90.0, **disturbance), tmp_path / "rest.csv"), tmp_path / "rig.toml"
    arguments = [str(path), "--rig", str(rig)]
    refused = CliRunner().invoke(noise_command.command, arguments)
    assert isinstance(refused.exception, LinkposeError) and named in str(refused.exception)
    assert not rig.exists()
    assert CliRunner().invoke(noise_command.command, [*arguments, "--force"]).exit_code == 0
    assert Rig.load(rig).noise.gyro_density_rad_s_sqrtHz is not None


def test_too_short_a_rest_and_none_at_all_are_refused():
    with pytest.raises(LinkposeError, match="and noise needs 60 s"):
        calibrate_noise([rest(20.0)])
    with pytest.raises(LinkposeError, match="there is no rest"):
        calibrate_noise([rest(20.0, gyro=np.sin(np.arange(2000))[:, None])])


def test_a_touch_splits_the_rest_and_the_longest_part_counts():
    touch = np.zeros((20_000, 3))
    touch[5000:5100] = 0.5
    found = calibrate_noise([rest(200.0, gyro=touch)])
    assert 145 < found.duration_s < 150 and found.is_rest


def test_a_noisy_chip_is_named():
    found = calibrate_noise([rest(300.0)]).worse_than_data_sheet
    assert found == {"gyro": pytest.approx([GYRO / DATA_SHEET_GYRO] * 3, rel=0.04)}


def test_the_command_and_a_simulation_of_the_same_sensor(tmp_path):
    path, rig = save(rest(120.0), tmp_path / "rest.csv"), tmp_path / "rig.toml"
    result = CliRunner().invoke(noise_command.command, [str(path), "--rig", str(rig), "--json", "-q"])
    found = json.loads(result.stdout)
    assert result.exit_code == 0 and "next" not in result.stderr
    assert found["is_rest"] and not found["is_long_enough"]
    assert found["gyro_density_rad_s_sqrtHz"] == pytest.approx([GYRO] * 3, rel=0.08)
    assert len(found["gyro_allan"]["tau_s"]) == len(found["gyro_allan"]["deviation_rad_s"][0])
    shown = CliRunner().invoke(noise_command.command, [str(path), "--rig", str(rig)])
    assert "bias instability ≤" in shown.stdout and "too short" in shown.stdout
    assert f"next: linkpose record rests.csv\nthen: linkpose calibrate imu rests.csv --rig {rig}" in shown.stderr
    still = tmp_path / "still.csv"
    outputs = ["-o", str(still), "--truth", str(tmp_path / "truth.csv"), "--still", "--duration", "70"]
    simulated = CliRunner().invoke(simulate_link.command, [*outputs, "--errors", str(rig)])
    assert f"next: linkpose calibrate noise {still} --rig rig.toml" in simulated.stderr
    again = CliRunner().invoke(noise_command.command, [str(still), "--rig", str(tmp_path / "again.toml")])
    assert again.exit_code == 0 and "99 % of the recording" in again.stdout
    assert "--port 'sim://link?test=1&seed=0&errors=calibrated&motion=sides'" in again.stderr
    assert Rig.load(tmp_path / "again.toml").noise.gyro_density_rad_s_sqrtHz == pytest.approx([GYRO] * 3, rel=0.1)
    run = LinkRun(duration_s=2.0, noise_of=Rig.load(rig))
    assert run.imu_errors.gyro_noise_rad_s == pytest.approx(np.full(3, GYRO * 10), rel=0.08)
    assert CliRunner().invoke(simulate_link.command, [*outputs, "--errors", "best"]).exit_code == 2


def test_a_negative_density_is_refused():
    with pytest.raises(FileFormatError, match="no axis may be below 0"):
        Rig.from_dict({"noise": {"gyro_density_rad_s_sqrtHz": [1e-4, -1e-4, 1e-4]}}, "rig.toml")
