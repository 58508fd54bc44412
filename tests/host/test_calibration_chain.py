"""`calibrate chain`: mounting and kind of the joint from simulated motion, and what the motion does not show."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import linkpose as lp
from linkpose.calibration.chain import calibrate_chain, remarks, with_calibration
from linkpose.errors import LinkposeError
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Rig
from linkpose.simulation.chain import ChainRun, about


def recording(measured: lp.Measurements) -> Any:
    return SimpleNamespace(measurements=measured, path=Path("r.csv"))


def nearest_on_axis(levers: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """The same levers, from the point of the axis that is nearest to both sensors."""
    return np.asarray(levers - 0.5 * float(np.sum(levers * axes)) * axes)


@pytest.mark.parametrize(
    ("joint", "errors", "largest_m"), [("hinge", "calibrated", 0.002), ("ball", "datasheet", 0.006)]
)
def test_mounting_and_kind_are_found(joint: str, errors: str, largest_m: float) -> None:
    run = ChainRun(joint, seed=4, duration_s=40.0, errors=errors)
    found, truth = calibrate_chain([recording(run.measurements())], Rig()), run.calibrated_rig.chain
    assert found.joint == joint
    levers = np.array([truth.r1_m, truth.r2_m])
    if joint == "hinge":
        axes = np.array([truth.axis1, truth.axis2])
        assert found.axes is not None
        apart = np.degrees(np.arccos(np.clip((found.axes * axes).sum(axis=1), -1, 1)))
        assert (apart < 2 * found.motion.std_deg).all() and found.motion.std_deg.max() < 1.5
        levers = nearest_on_axis(levers, axes)
    error = np.abs(found.levers_m - levers)
    assert error.max() < largest_m and (error < 3 * found.std_m).all()


def one_link_in_motion() -> lp.Measurements:
    """Link 1 is at rest; link 2 turns about sensor 2's x axis, which is horizontal."""
    t = np.arange(3000) / 100
    angle = 0.8 * np.sin(2 * np.pi * 0.5 * t) * np.clip((t - 2) / 2, 0, 1)
    rate, noise = np.gradient(angle, t), np.random.default_rng(0).standard_normal((3000, 12))
    at_m, zero = np.array([0.0, 0.0, 0.2]), np.zeros(3000)
    rates = np.column_stack([rate, zero, zero])
    turning = np.cross(np.gradient(rates, t, axis=0), at_m) + np.cross(rates, np.cross(rates, at_m))
    force2 = STANDARD_GRAVITY * np.column_stack([zero, np.sin(angle), np.cos(angle)]) + turning
    force1 = np.broadcast_to([0.0, 0.0, STANDARD_GRAVITY], (3000, 3))
    return lp.Measurements.from_imu(
        t, force1 + 0.04 * noise[:, :3], 0.001 * noise[:, 3:6],
        accel2_m_s2=force2 + 0.04 * noise[:, 6:9], gyro2_rad_s=rates + 0.001 * noise[:, 9:],
    )  # fmt: skip


def test_what_the_motion_does_not_show_has_a_large_deviation_and_no_axis() -> None:
    found = calibrate_chain([recording(one_link_in_motion())], Rig())
    assert found.joint == "hinge"
    assert (found.std_m[0] > 0.1).all()  # link 1 does not turn
    assert found.levers_m[1, 2] == pytest.approx(0.2, abs=0.01) and found.std_m[1, 2] < 0.02
    assert found.axes is None  # the heading of sensor 1 to the axis is unknown
    # Any heading fits, and a uniform one has a standard deviation of 104°.
    assert found.motion.std_deg[1] < 3.0 and found.motion.std_deg[0] > 90.0
    chain = with_calibration(Rig(), found).chain
    assert (chain.joint, chain.axis1, chain.axis2) == ("hinge", None, None)
    assert isinstance(chain.r1_std_m, tuple) and min(chain.r1_std_m) > 0.1


def test_without_a_rest_the_bias_of_a_fixed_sensor_is_its_mean_rate_and_the_axis_as_unknown_as_the_heading() -> None:
    once = one_link_in_motion()[400:]
    forces, rates = (np.tile(np.hstack(of), (4, 1)) for of in (
        (once.accel_m_s2, once.accel2_m_s2), (once.gyro_rad_s, once.gyro2_rad_s),
    ))  # fmt: skip
    t = np.arange(len(forces)) / 100
    rates[:, 2] += 0.15 + 0.037 * np.sin(2 * np.pi * 17.0 * t)  # 9 °/s, and a motor's vibration, which hides the rest
    shaken = lp.Measurements.from_imu(
        t, forces[:, :3], rates[:, :3], accel2_m_s2=forces[:, 3:], gyro2_rad_s=rates[:, 3:]
    )
    found = calibrate_chain([recording(shaken)], Rig(), "hinge")
    assert found.motion.play_deg < 10.0 and found.motion.std_deg[1] < 10.0  # 23° with a bias that nothing holds
    assert found.axes is None and found.motion.std_deg[0] > 90.0


def slow_arm(seed: int) -> lp.Measurements:
    """A joint that accelerates by 0.02 m/s² rms, less than the errors of both accelerometers: 0.15 m/s² constant, and
    0.04 m/s² that changes slowly. Link 2 turns about the vertical only; the axis of the hinge is x of both sensors.
    """
    rng, t = np.random.default_rng(seed), np.arange(1000) / 25

    def tones(low_hz: float, high_hz: float, largest: float, count: int) -> np.ndarray:
        return largest * np.sin(2 * np.pi * np.outer(t, rng.uniform(low_hz, high_hz, count)) + rng.uniform(0, 6, count))

    begins = np.clip((t - 3) / 3, 0, 1)[:, None] ** 2
    yaw, angle = (begins * tones(0.05, 0.12, 0.5, 2)).T
    accel = np.column_stack([begins * tones(0.1, 0.3, 0.03, 2), np.full(len(t), STANDARD_GRAVITY)])
    link2 = about(np.array([0.0, 0.0, 1.0]), yaw)
    link1 = link2 @ about(np.array([1.0, 0.0, 0.0]), angle)
    turning, zero = np.gradient(yaw, t), np.zeros(len(t))
    rate1 = np.column_stack([np.gradient(angle, t), np.sin(angle) * turning, np.cos(angle) * turning])
    rate2 = np.column_stack([zero, zero, turning])
    force1, force2 = (np.einsum("nji,nj->ni", link, accel) for link in (link1, link2))
    error = tones(0.035, 0.07, 0.05, 6) + 0.15 * rng.standard_normal(6)
    noise = rng.standard_normal((len(t), 12))
    return lp.Measurements.from_imu(
        t, force1 + error[:, :3] + 0.04 * noise[:, :3], rate1 + 0.001 * noise[:, 3:6],
        accel2_m_s2=force2 + error[:, 3:] + 0.04 * noise[:, 6:9], gyro2_rad_s=rate2 + 0.001 * noise[:, 9:],
    )  # fmt: skip


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_the_axis_is_no_surer_than_the_heading_that_weak_accelerations_give(seed: int) -> None:
    found = calibrate_chain([recording(slow_arm(seed))], Rig())
    apart = np.degrees(np.arccos(np.abs(found.motion.axes[:, 0])))
    assert (apart < 2 * found.motion.std_deg).all()
    assert found.joint == "hinge" and found.axes is None and found.as_dict()["axis2"] is None


def test_play_that_an_unknown_gyro_bias_explains_shows_no_ball_joint() -> None:
    without_rest = slow_arm(4)[125:]
    found = calibrate_chain([recording(without_rest)], Rig())
    assert found.motion.play_deg > 10.0 and found.joint is None
    assert calibrate_chain([recording(without_rest)], Rig(), "hinge").axes is None


def test_a_rest_and_a_single_sensor_are_refused() -> None:
    measured = one_link_in_motion()
    with pytest.raises(LinkposeError, match=r"only 0\.0 s show motion; move both links"):
        calibrate_chain([recording(measured[:200])], Rig())
    alone = lp.Measurements.from_imu(measured.time_s, measured.accel_m_s2, measured.gyro_rad_s)
    with pytest.raises(LinkposeError, match="needs a second inertial sensor"):
        calibrate_chain([recording(alone)], Rig())


def test_sensors_on_no_common_joint_are_refused() -> None:
    one, other = (ChainRun("ball", seed, 15.0).measurements() for seed in (0, 1))
    mixed = lp.Measurements.from_imu(
        one.time_s, one.accel_m_s2, one.gyro_rad_s, accel2_m_s2=3 * other.accel2_m_s2, gyro2_rad_s=other.gyro2_rad_s
    )
    with pytest.raises(LinkposeError, match="fit no joint between the two sensors"):
        calibrate_chain([recording(mixed)], Rig())


def test_a_wrong_kind_a_still_sensor_and_swapped_sensors_are_named() -> None:
    run = ChainRun("hinge", seed=4, duration_s=20.0)
    measured = run.measurements()
    found = calibrate_chain([recording(measured)], Rig(), "ball")
    (wrong,) = remarks(found, "ball", Rig())
    assert wrong.startswith("The motion is that of a hinge, not of a ball joint: the links turn by ")
    assert not remarks(found, None, Rig()) and not remarks(found, "hinge", run.calibrated_rig)
    one = calibrate_chain([recording(one_link_in_motion())], Rig())
    assert remarks(one, None, Rig()) == ["Sensor 1 does not turn, so r1 is not observable: move both links."]
    other = lp.Measurements.from_imu(
        measured.time_s, measured.accel2_m_s2, measured.gyro2_rad_s,
        accel2_m_s2=measured.accel_m_s2, gyro2_rad_s=measured.gyro_rad_s,
    )  # fmt: skip
    before = with_calibration(Rig(), calibrate_chain([recording(measured)], Rig()))
    (swapped,) = remarks(calibrate_chain([recording(other)], Rig()), None, before)
    assert swapped.startswith("The sensors look swapped: r1 found here is r2 of the rig file")


def test_the_command_writes_the_chain_and_keeps_the_rest_of_the_rig(linkpose: Any, tmp_path: Path) -> None:
    rec, rig = tmp_path / "r.csv", tmp_path / "rig.toml"
    linkpose("simulate", "chain", "-o", rec, "--truth", tmp_path / "t.csv", "--duration", 20, "-q")
    Rig().with_j2s((0.1, 0.2, 0.3)).save(rig)
    done = linkpose("calibrate", "chain", rec, "--rig", rig)
    assert done.status == 0 and "joint: hinge: the links turn about one axis only" in done.out
    written = Rig.load(rig)
    assert written.joint.j2s_m == (0.1, 0.2, 0.3) and written.chain.joint == "hinge"
    assert written.chain.axis1 and written.chain.r1_m and written.chain.r2_std_m < 0.01  # type: ignore[operator]
    row = json.loads(linkpose("calibrate", "chain", rec, "--rig", rig, "--joint", "ball", "--json", "-q").out)
    assert row["joint"] == "ball" and len(row["r1_std_m"]) == 3 and "axis1" not in row
    assert Rig.load(rig).chain.axis1 is None
