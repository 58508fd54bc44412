"""The simulated chain: its truth obeys mechanics, both sensors measure it, and sim://chain is this run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import linkpose as lp
from linkpose.errors import LinkposeError
from linkpose.estimation import Estimator
from linkpose.sensors.devices import Sensors
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY, accel_scale, gyro_scale
from linkpose.simulation.chain import ChainRun
from linkpose.wire.messages import IMU2_OFFSET_US_400_KHZ, IMU_OFFSET_US

LATER_S = 1e-6 * (IMU2_OFFSET_US_400_KHZ - IMU_OFFSET_US)  # sensor 2 is read after sensor 1


def matrices(q: np.ndarray) -> np.ndarray:
    """Rotation matrices (N, 3, 3) of unit quaternions (N, 4), the scalar first."""
    w, v = q[:, 0], q[:, 1:]
    cross = np.cross(np.eye(3), v[:, None, :])
    return np.eye(3) + 2 * w[:, None, None] * cross + 2 * cross @ cross


def poses(run: ChainRun, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (N, 3, 3) of sensor 2 into n, and its place (N, 3) from the fixed joint, from the truth's columns."""
    truth, chain = run.truth_columns(time_s), run.calibrated_rig.chain
    half = np.radians([truth[f"{name}_deg"] for name in ("roll", "pitch", "yaw")]) / 2
    turns = [matrices(np.column_stack([np.cos(h), *(np.sin(h) * row for row in np.eye(3)[:, k, None])]))
             for k, h in enumerate(half)]  # fmt: skip
    first = turns[2] @ turns[1] @ turns[0]
    second = first @ matrices(np.column_stack([truth[name] for name in ("qw", "qx", "qy", "qz")]))
    place = first @ (np.array(run.j2s_m) - np.array(chain.r1_m)) + second @ np.array(chain.r2_m)
    assert place[:, 2] == pytest.approx(truth["height2_m"], abs=1e-7)
    return second, place


@pytest.mark.parametrize("joint", ["ball", "hinge"])
def test_with_a_free_first_joint_both_sensors_feel_one_more_acceleration(joint: str) -> None:
    fixed, free = (ChainRun(joint, 3, 30.0, errors="none", first_joint=first) for first in ("fixed", "free"))
    one, two = fixed.measurements(), free.measurements()
    assert np.array_equal(one.gyro_rad_s, two.gyro_rad_s) and np.array_equal(one.gyro2_rad_s, two.gyro2_rad_s)
    q = np.column_stack([free.truth_columns(one.time_s + LATER_S)[name] for name in ("qw", "qx", "qy", "qz")])
    carried = two.accel_m_s2 - one.accel_m_s2
    seen = np.einsum("nij,nj->ni", matrices(q), two.accel2_m_s2 - one.accel2_m_s2)
    assert 0.7 < np.sqrt(np.mean(np.sum(carried[1000:2000] ** 2, axis=1))) < 3.0 and np.abs(carried[:150]).max() == 0
    assert np.abs(seen - carried).max() < 0.05  # two quantisations and 0.65 ms between the sensors
    truth = free.truth_columns(one.time_s)
    assert free.rig.joint.j2s_m is None and not {"height_m", "height1_m", "height2_m", "x_m"} & set(truth)


@pytest.mark.parametrize("joint", ["ball", "hinge"])
def test_sensor_2_measures_what_its_path_demands(joint: str) -> None:
    """Against numerical derivatives of the truth's quaternions and positions."""
    run, step = ChainRun(joint, seed=3, duration_s=30.0, errors="none"), 1e-4
    run.imu2_errors = replace(run.imu2_errors, accel_noise_m_s2=0.0, gyro_noise_rad_s=0.0)
    block = run.block(0, 3000)
    time_s = np.arange(3000) / 100 + LATER_S
    (_, before), (rotation, now), (after, ahead) = (poses(run, time_s + k * step) for k in (-1, 0, 1))
    upward = np.array([0.0, 0.0, STANDARD_GRAVITY])
    force = np.einsum("nji,nj->ni", rotation, (ahead - 2 * now + before) / step**2 + upward)
    assert np.abs(block.imu2[:, :3] * accel_scale(8) - force).max() < accel_scale(8)
    small = np.einsum("nji,njk->nik", rotation, after) / step
    rate = np.column_stack([small[:, 2, 1], small[:, 0, 2], small[:, 1, 0]])
    assert np.abs(block.imu2[:, 4:] * gyro_scale(1000) - rate).max() < 0.02


def test_a_hinge_turns_about_its_axis_by_its_angle() -> None:
    run = ChainRun("hinge", seed=1, duration_s=20.0)
    time_s, chain = np.linspace(0, 20, 400), run.calibrated_rig.chain
    truth = run.truth_columns(time_s)
    q = np.column_stack([truth[name] for name in ("qw", "qx", "qy", "qz")])
    rotation, (axis1, axis2) = matrices(q), (np.array(axis) for axis in (chain.axis1, chain.axis2))
    assert np.abs(rotation @ axis2 - axis1).max() < 1e-7
    turned = np.einsum("ji,njk->nik", rotation[0], rotation)
    assert np.trace(turned, axis1=1, axis2=2) == pytest.approx(1 + 2 * np.cos(np.radians(truth["angle_deg"])))
    assert np.abs(truth["angle_deg"]).max() > 20 and truth["angle_deg"][0] == 0


def test_the_simulated_board_is_this_run() -> None:
    with lp.open("sim://chain?joint=ball&seed=2&speed=0") as board:
        assert board.rig.chain.joint == "ball"
        measured = np.concatenate([block.gyro2_rad_s for block in board.stream(duration_s=3.0)])
    counts = ChainRun("ball", 2, None).block(0, len(measured)).imu2[:, 4:]
    assert len(measured) > 290 and measured == pytest.approx(counts * gyro_scale(1000), abs=1e-7)


def test_the_filter_runs_by_default_where_a_second_sensor_is_and_only_there() -> None:
    run = ChainRun("hinge")
    both = Estimator((), run.rig, run.hello_sensors)
    assert "chain" in [f.name for f in both.filters] and "chain_angle_deg" in both.columns
    alone = Estimator((), run.rig, run.hello_sensors & ~Sensors.IMU2)
    assert "chain" not in [f.name for f in alone.filters] and "chain" in alone.left_out


def test_a_joint_that_does_not_exist_is_refused() -> None:
    with pytest.raises(LinkposeError, match="take ball or hinge"):
        ChainRun("saddle")
    with pytest.raises(LinkposeError, match="take fixed or free"):
        ChainRun("ball", first_joint="slider")
