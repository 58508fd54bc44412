"""Flexion, abduction and axial rotation of a ball joint: known answers, and the filter on simulated joints."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

import linkpose as lp
from linkpose.errors import FileFormatError
from linkpose.filters.chain import ChainFilter
from linkpose.rotations import of_vectors, product, swing_twist
from linkpose.sensors.rig import Chain, Rig
from linkpose.simulation.chain import ChainRun

ANGLES = ("flexion", "abduction", "axial_rotation")


def about(axis: str, degrees: float) -> np.ndarray:
    """Quaternion (1, 4)."""
    return of_vectors(np.radians(degrees) * np.eye(3)[["xyz".index(axis)]])


@pytest.mark.parametrize(
    ("turns", "expected"),
    [
        ([("x", 90.0)], (90, 0, 0)),  # flexion alone, where a joint coordinate system agrees
        ([("y", 150.0)], (0, 150, 0)),  # beyond its singularity at 90°
        ([("z", -170.0)], (0, 0, -170)),
        ([("x", 60.0), ("z", 25.0)], (60, 0, 25)),  # first the twist, then the swing
        ([("z", 25.0), ("x", 60.0)], (60 * np.cos(np.radians(25)), 60 * np.sin(np.radians(25)), 25)),
    ],
)
def test_swing_and_twist_of_known_rotations(turns: list[tuple[str, float]], expected: tuple[float, ...]) -> None:
    q = np.array([[1.0, 0.0, 0.0, 0.0]])
    for axis, degrees in turns:
        q = product(q, about(axis, degrees))
    np.testing.assert_allclose(np.degrees(swing_twist(q)[0]), expected, atol=1e-9)
    np.testing.assert_allclose(swing_twist(-q), swing_twist(q), atol=1e-12)


def estimated(run: ChainRun, rig: Rig, smooth: bool = False) -> tuple[lp.Estimates, dict[str, np.ndarray]]:
    """Estimates and the truth of the three angles."""
    measured = run.measurements()
    truth = run.truth_columns(measured.time_s)
    return lp.estimate(measured, filters=["chain"], rig=rig, smooth=smooth), {n: truth[f"{n}_deg"] for n in ANGLES}


def errors(estimates: lp.Estimates, truth: dict[str, np.ndarray], name: str) -> np.ndarray:
    return np.asarray((estimates[f"chain_{name}_deg"] - truth[name] + 180) % 360 - 180)


def test_before_the_rotation_is_known_the_angles_are_empty_and_then_their_std_holds() -> None:
    within = []
    for seed in (0, 1):
        run = ChainRun("ball", seed, 40.0)
        estimates, truth = estimated(run, run.rig)
        for name in ANGLES:
            known = np.isfinite(estimates[f"chain_{name}_deg"])
            np.testing.assert_array_equal(known, np.isfinite(estimates["chain_qw"]))
            np.testing.assert_array_equal(known, np.isfinite(estimates[f"chain_{name}_std_deg"]))
            late = estimates["time_s"] > 15
            error, std = errors(estimates, truth, name)[late], estimates[f"chain_{name}_std_deg"][late]
            within.append(np.mean(np.abs(error) < 2 * std))
            assert np.sqrt(np.mean(error**2)) < 4.0
    assert np.mean(within) > 0.9


def test_a_stated_neutral_pose_and_axes_make_the_angles_as_good_as_the_rotation() -> None:
    run = ChainRun("ball", 2, 40.0)
    estimates, truth = estimated(run, run.calibrated_rig)
    late = estimates["time_s"] > 15
    for name in ANGLES:
        error, std = errors(estimates, truth, name)[late], estimates[f"chain_{name}_std_deg"][late]
        assert np.sqrt(np.mean(error**2)) < 1.0
        assert np.mean(np.abs(error) < 2 * std) > 0.9
        assert std.max() < 4.0


def test_gyro_biases_of_the_data_sheet_do_not_turn_the_first_pose() -> None:
    """Up to 20 °/s, which the rest at the start shows: 6° in the time that it takes."""
    run = ChainRun("ball", 0, 30.0, errors="datasheet")
    estimates, truth = estimated(run, run.rig)
    late = estimates["time_s"] > 15
    assert all(np.sqrt(np.mean(errors(estimates, truth, name)[late] ** 2)) < 4.0 for name in ANGLES)


def test_the_smoother_counts_from_the_first_pose() -> None:
    run = ChainRun("ball", 2, 40.0)
    estimates, truth = estimated(run, run.rig, smooth=True)
    for name in ANGLES:
        error = errors(estimates, truth, name)
        assert np.sqrt(np.nanmean(error**2)) < 3.0
        assert np.nanmean(np.abs(error) < 2 * estimates[f"chain_{name}_std_deg"]) > 0.9
        assert abs(estimates[f"chain_{name}_deg"][0]) < 0.01


def test_without_stated_axes_the_length_is_vertical_at_the_start_and_flexion_about_an_axis_of_the_sensor() -> None:
    run = ChainRun("ball", 1, 1.0)
    chain = ChainFilter(Rig())
    chain.process(run.measurements())
    flexion, abduction, length = chain.segment_axes.T
    up = run.at(np.zeros(1)).tilt[0]
    assert length @ up > np.cos(np.radians(2))
    assert max(abs(flexion @ axis) for axis in np.eye(3)) > 0.9
    np.testing.assert_allclose(np.cross(length, flexion), abduction, atol=1e-12)
    np.testing.assert_allclose(chain.segment_axes.T @ chain.segment_axes, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("stated", "column", "expected"),
    [
        ({"flexion_axis": (0.0, 0.0, 2.0)}, 0, (0.0, 0.0, 1.0)),  # along gravity at the start
        ({"long_axis": (3.0, 0.0, 0.0)}, 2, (1.0, 0.0, 0.0)),
        ({"long_axis": (1.0, 0.0, 0.0), "flexion_axis": (1.0, 1.0, 0.0)}, 0, (0.0, 1.0, 0.0)),  # at right angles
    ],
)
def test_stated_axes(stated: dict[str, tuple[float, ...]], column: int, expected: tuple[float, ...]) -> None:
    chain = ChainFilter(Rig(chain=Chain("ball", **stated)))  # type: ignore[arg-type]
    force, rate = np.tile([0.1, 0.0, 9.8], (2, 1)), np.zeros((2, 3))
    chain.process(lp.Measurements.from_imu(np.array([0, 0.01]), force, rate, accel2_m_s2=force, gyro2_rad_s=rate))
    np.testing.assert_allclose(chain.segment_axes[:, column], expected, atol=1e-12)
    np.testing.assert_allclose(chain.segment_axes.T @ chain.segment_axes, np.eye(3), atol=1e-12)


def test_blocks_do_not_change_the_angles() -> None:
    run = ChainRun("ball", 0, 8.0)
    measured = run.measurements()
    whole, parts = ChainFilter(run.rig), ChainFilter(run.rig)
    pieces = [parts.process(measured[a:b]) for a, b in pairwise([0, 1, 37, 500, 800])]
    np.testing.assert_array_equal(whole.process(measured), np.vstack(pieces))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("neutral = [1, 0, 0]", "must be four numbers"),
        ("neutral = [1, 1, 0, 0]", "must have length 1"),
        ("long_axis = [0, 0, 1]\nflexion_axis = [0, 0.1, -1]", "are parallel"),
        ("flexion_axis = [0, 0, 0]", "must not be zero"),
    ],
)
def test_the_rig_refuses_axes_that_define_nothing(tmp_path, line: str, message: str) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "rig.toml"
    path.write_text(f"[chain]\n{line}\n")
    with pytest.raises(FileFormatError, match=message):
        Rig.load(path)


def test_the_rig_keeps_axes_and_neutral_pose(tmp_path) -> None:  # type: ignore[no-untyped-def]
    chain = Chain("ball", long_axis=(0.0, 0.0, 1.0), flexion_axis=(0.0, 1.0, 0.0), neutral=(0.6, 0.0, 0.8, 0.0))
    Rig(chain=chain).save(tmp_path / "rig.toml")
    assert Rig.load(tmp_path / "rig.toml").chain == chain
