"""calibrate mag: hard iron, soft iron and axes of a simulated magnetometer are found; too little motion is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from linkpose.calibration.mag import calibrate_mag, with_calibration
from linkpose.cli import calibrate_mag as mag_command
from linkpose.errors import LinkposeError
from linkpose.recording.reader import Recording
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Rig

FIELD = np.array([30.0, 0.0, -42.0])  # µT: north and up
HARD_IRON = np.array([12.0, -25.0, 7.0])
# Axes of a GY-87's QMC5883L, turned by a quarter about z.
AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SOFT_IRON = np.array([[1.06, 0.03, -0.02], [0.03, 0.97, 0.04], [-0.02, 0.04, 0.98]])
SOFT_IRON /= np.cbrt(np.linalg.det(SOFT_IRON))


def tumbled(seconds: float = 60.0, *, about=(1.0, 1.0, 1.0), field=1.0, bias=(0.01, -0.02, 0.015)) -> Measurements:
    """A sensor turned by hand about axes that change; `about` scales the rates about its axes."""
    t = np.arange(int(100 * seconds)) / 100
    rate = np.column_stack([np.sin(0.7 * t), np.sin(0.53 * t + 1), np.cos(0.31 * t)]) * 2.0 * np.array(about)
    attitude, up, north = np.eye(3), [], []
    for k in range(len(t)):
        up.append(attitude[2])
        north.append(attitude[0])
        turn = 0.01 * rate[k] if k == len(t) - 1 else 0.005 * (rate[k] + rate[k + 1])
        angle = np.linalg.norm(turn)
        x, y, z = turn / max(angle, 1e-12)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        attitude = attitude @ (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
    rng = np.random.default_rng(0)
    true = field * (np.array(north) * FIELD[0] + np.array(up) * FIELD[2])
    mag = true @ AXES @ np.linalg.inv(SOFT_IRON) + HARD_IRON + rng.normal(0, 0.2, (len(t), 3))
    return Measurements.from_imu(
        t,
        STANDARD_GRAVITY * np.array(up) + rng.normal(0, 0.04, (len(t), 3)),
        rate + bias + rng.normal(0, 0.001, (len(t), 3)),
        mag_uT=mag,
    )


def recording(block: Measurements) -> Recording:
    return Recording(Path("mag.csv"), block, None, 100.0, {}, [])


def save(block: Measurements, path: Path) -> str:
    names = [
        f"{name}_{axis}_{unit}"
        for name, unit in (("accel", "m_s2"), ("gyro", "rad_s"), ("mag", "uT"))
        for axis in "xyz"
    ]
    rows = np.column_stack([block.time_s, block.accel_m_s2, block.gyro_rad_s, block.mag_uT, block.mag_fresh])
    head = "# linkpose recording 1\n# {}\n" + ",".join(["time_s", *names, "mag_fresh"])
    np.savetxt(path, rows, "%.7g", delimiter=",", header=head, footer="# {}", comments="")
    return str(path)


def test_iron_and_axes_are_found():
    found = calibrate_mag([recording(tumbled())], Rig())
    assert np.abs(found.hard_iron_uT - HARD_IRON).max() < 0.1
    assert (np.abs(found.hard_iron_uT - HARD_IRON) < 4 * found.hard_iron_std_uT).all()
    assert found.soft_iron == pytest.approx(SOFT_IRON, abs=0.003)
    assert found.rotation == pytest.approx(AXES, abs=0.01)
    assert found.field_uT == pytest.approx(np.linalg.norm(FIELD), rel=0.005)
    assert found.dip_deg == pytest.approx(np.degrees(np.arctan2(42, 30)), abs=0.5)
    assert found.residual_uT == pytest.approx(0.2, rel=0.1)
    assert found.coverage > 0.6 and found.is_plausible and found.is_clean


def test_the_calibrated_field_is_in_the_inertial_sensors_axes(tmp_path):
    block = tumbled()
    with_calibration(Rig(), calibrate_mag([recording(block)], Rig())).save(tmp_path / "rig.toml")
    mag = Rig.load(tmp_path / "rig.toml").mag
    field = (block.mag_uT - np.array(mag.hard_iron_uT)) @ np.array([mag.matrix_x, mag.matrix_y, mag.matrix_z]).T
    vertical = np.einsum("ni,ni->n", field, block.accel_m_s2) / STANDARD_GRAVITY
    assert vertical == pytest.approx(np.full(len(block), FIELD[2]), abs=2.0)


def test_a_turn_about_one_axis_is_refused_with_its_cure():
    with pytest.raises(LinkposeError, match=r"do not determine the hard iron.*turn the sensor by hand"):
        calibrate_mag([recording(tumbled(about=(0.0, 0.0, 1.0)))], Rig())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("about", [(0.0, 0.0, 0.0), (0.02, 0.0, 0.0), (0.1, 0.1, 0.1)])
def test_a_sensor_that_hardly_turns_is_refused_without_a_figure_that_is_none(about):
    """The readings at rest are noise on a small sphere, which the fit would cover completely."""
    with pytest.raises(LinkposeError, match="too little to calibrate the magnetometer") as refused:
        calibrate_mag([recording(tumbled(5.0, about=about))], Rig())
    assert "nan" not in str(refused.value) and "%" not in str(refused.value)


def test_spikes_are_left_out_with_their_count(tmp_path):
    block = tumbled(40.0)
    spiked = block.mag_uT.copy()
    spiked[1500], spiked[3000] = [3000.0, -2000.0, 1500.0], [-300.0, 0.0, 0.0]
    path = save(replace(block, mag_uT=spiked), tmp_path / "mag.csv")
    done = CliRunner().invoke(mag_command.command, [path, "--rig", str(tmp_path / "rig.toml"), "--json"])
    found = json.loads(done.stdout)
    assert found["outliers"] == 2 and found["readings"] == len(block) - 2 and found["is_clean"]
    assert found["hard_iron_uT"] == pytest.approx(HARD_IRON, abs=0.2)
    assert "2 readings are left out: the magnitude is far from the median" in done.stderr


def test_hard_iron_stronger_than_the_field_makes_no_outliers():
    block, magnet = tumbled(40.0), np.array([150.0, 0.0, 0.0])
    found = calibrate_mag([recording(replace(block, mag_uT=block.mag_uT + magnet))], Rig())
    assert found.outliers == 0 and found.hard_iron_uT == pytest.approx(HARD_IRON + magnet, abs=0.2)


def test_directions_in_one_plane_of_the_sensor_are_refused():
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, 3000)
    field = 50 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) + 0.2 * rng.standard_normal((3000, 3))
    block = Measurements.from_imu(
        np.arange(3000) / 100, np.tile([0, 0, STANDARD_GRAVITY], (3000, 1)), np.zeros((3000, 3)), mag_uT=field
    )
    with pytest.raises(LinkposeError, match=r"do not determine the hard iron.*turn the sensor by hand"):
        calibrate_mag([recording(block)], Rig())


def test_no_magnetometer_is_refused():
    block = tumbled(5.0)
    with pytest.raises(LinkposeError, match="there is no magnetometer"):
        calibrate_mag([recording(Measurements.from_imu(block.time_s, block.accel_m_s2, block.gyro_rad_s))], Rig())


def test_readings_beside_iron_are_left_out_of_the_fit_and_show_in_the_residual():
    block = tumbled()
    disturbed = block.mag_uT.copy()
    disturbed[2000:2600] += [20.0, -30.0, 10.0]
    found = calibrate_mag([recording(replace(block, mag_uT=disturbed))], Rig())
    assert np.abs(found.hard_iron_uT - HARD_IRON).max() < 1.5
    assert not found.is_clean


@pytest.mark.parametrize("field, is_written", [(1.0, True), (3.0, False)])
def test_the_command(tmp_path, field, is_written):
    rig, path = tmp_path / "rig.toml", save(tumbled(40.0, field=field), tmp_path / "mag.csv")
    done = CliRunner().invoke(mag_command.command, [path, "--rig", str(rig), "--json"])
    assert json.loads(done.stdout)["is_plausible"] == is_written == rig.exists()
    if is_written:
        assert f"next: linkpose record swing.csv\nthen: linkpose calibrate joint swing.csv --rig {rig}" in done.stderr
        shown = CliRunner().invoke(mag_command.command, [path, "--rig", str(rig), "-q"])
        assert "µT, dip 54." in shown.stdout and "% of all attitudes: " in shown.stdout
        assert "next" not in shown.stderr
    else:
        assert isinstance(done.exception, LinkposeError) and "is not the earth's (25 to 65 µT)" in str(done.exception)
        assert CliRunner().invoke(mag_command.command, [path, "--rig", str(rig), "--force"]).exit_code == 0
        assert rig.exists()
