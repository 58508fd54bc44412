"""The chain filter on a simulated hinge and ball joint with known answers, through public doors."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import linkpose as lp
from linkpose.errors import InvalidValue
from linkpose.filters.chain import ChainFilter
from linkpose.filters.chain.state import BA, BG, OF_SENSOR
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Chain, Rig
from linkpose.simulation.chain import ChainRun

RATE_HZ, SECONDS = 100.0, 30.0
R1, R2 = np.array([0.05, -0.02, -0.20]), np.array([-0.03, 0.04, 0.15])


def _turn(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotation matrices (N, 3, 3) about a unit axis (Rodrigues)."""
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + s * k + (1 - c) * (k @ k)


def _rate(rotation: np.ndarray, h: float) -> np.ndarray:
    """Angular rate in body axes from central differences."""
    before, after = rotation[:-2], rotation[2:]
    step = np.einsum("nji,njk->nik", before, after)
    angle = np.arccos(np.clip((np.trace(step, axis1=1, axis2=2) - 1) / 2, -1, 1))
    scale = np.where(angle > 1e-9, angle / (2 * np.sin(np.maximum(angle, 1e-9))), 0.5)
    vee = np.stack([step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]], 1)
    return scale[:, None] * vee / (2 * h)


def _chain(joint: str, seed: int = 0) -> tuple[lp.Measurements, np.ndarray, np.ndarray]:
    """A chain moved by hand: measurements, rotations 2 → 1 (N, 3, 3), and the hinge angle (N,) since the start."""
    rng, h = np.random.default_rng(seed), 1 / RATE_HZ
    t = np.arange(-1, round(SECONDS * RATE_HZ) + 1) * h
    grow = np.clip((t - 1) / 2, 0, 1) ** 2 * (3 - 2 * np.clip((t - 1) / 2, 0, 1))

    def wave(size: float) -> np.ndarray:
        tones = [np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in rng.uniform(0.2, 0.9, 3)]
        return size * grow * sum(tones)

    x, y, z = np.eye(3)
    first = _turn(z, wave(0.4)) @ _turn(y, 0.2 + wave(0.25)) @ _turn(x, -0.3 + wave(0.25))
    mount = _turn(np.array([0.6, 0.0, 0.8]), np.array([2.0]))[0]
    angle = wave(0.4)
    relative = _turn(y, angle) @ mount
    if joint == "ball":
        relative = _turn(y, angle) @ _turn(x, wave(0.3)) @ _turn(z, wave(0.3)) @ mount
    second = first @ relative
    centre = np.stack([wave(0.10), wave(0.10), wave(0.08)], 1)
    out = []
    for rotation, r in ((first, R1), (second, R2)):
        place = centre + rotation @ r
        accel = (place[2:] - 2 * place[1:-1] + place[:-2]) / h**2 + [0, 0, STANDARD_GRAVITY]
        force = np.einsum("nji,nj->ni", rotation[1:-1], accel) + 0.04 * rng.standard_normal(accel.shape)
        gyro = _rate(rotation, h) + 0.0009 * rng.standard_normal(accel.shape) + 0.002 * rng.standard_normal(3)
        out += [force + 0.03 * rng.standard_normal(3), gyro]
    measured = lp.Measurements.from_imu(t[1:-1], out[0], out[1], accel2_m_s2=out[2], gyro2_rad_s=out[3])
    return measured, relative[1:-1], np.degrees(angle[1:-1] - angle[1])


def _matrices(w: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Rotation matrices (N, 3, 3) of unit quaternions, each part (N,)."""
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _error_deg(estimates: lp.Estimates, truth: np.ndarray) -> np.ndarray:
    """Angle between the estimated and the true rotation; NaN where not known."""
    found = _matrices(*(estimates[f"chain_q{axis}"] for axis in "wxyz"))
    return np.degrees(np.arccos(np.clip((np.einsum("nij,nij->n", found, truth) - 1) / 2, -1, 1)))


@pytest.mark.parametrize("joint", ["ball", "hinge"])
def test_unknown_mounting_the_rotation_is_found_and_its_std_holds(joint: str) -> None:
    measured, truth, _ = _chain(joint)
    estimates = lp.estimate(measured, filters=["chain"], joint=joint)
    late = measured.time_s > 15
    error, std = _error_deg(estimates, truth)[late], estimates["chain_rotation_std_deg"][late]
    assert np.sqrt(np.mean(error**2)) < 1.0
    assert np.mean(error < 2 * std) > 0.9
    assert std.max() < 5.0  # and the heading has been found


@pytest.mark.parametrize("begin_s", [0.0, 7.0])  # at rest, and in fast motion
@pytest.mark.parametrize("seed", [2, 3])
def test_a_hinge_converges_from_any_start_and_its_std_covers_the_error_meanwhile(seed: int, begin_s: float) -> None:
    run = ChainRun("hinge", seed, 30.0)
    measured = run.measurements()
    truth = run.truth_columns(measured.time_s)
    rotation = _matrices(*(truth[name] for name in ("qw", "qx", "qy", "qz")))
    use = measured.time_s >= begin_s
    estimates = lp.estimate(measured[use], filters=["chain"], joint="hinge")
    error, std = _error_deg(estimates, rotation[use]), estimates["chain_rotation_std_deg"]
    known, late = np.isfinite(error), measured.time_s[use] > begin_s + 15
    assert np.mean(error[known] < 2 * std[known]) > 0.9
    assert np.sqrt(np.mean(error[late] ** 2)) < 0.4


@pytest.mark.parametrize(
    ("errors", "joint", "late_s", "until_s", "most_deg"),
    [
        ("calibrated", "ball", 30.0, 60.0, 1.0),
        ("calibrated", "hinge", 30.0, 60.0, 1.0),
        ("datasheet", "ball", 30.0, 60.0, 4.0),
        ("datasheet", "hinge", 30.0, 60.0, 4.0),
        ("calibrated", "ball", 20.0, 30.0, 1.2),
        ("calibrated", "hinge", 20.0, 30.0, 0.4),
    ],
)
def test_the_std_holds_and_is_small_after_some_seconds_of_motion(
    errors: str, joint: str, late_s: float, until_s: float, most_deg: float
) -> None:
    run = ChainRun(joint, 3, until_s, errors=errors)
    measured = run.measurements()
    truth, late = run.truth_columns(measured.time_s), measured.time_s > late_s
    estimates = lp.estimate(measured, filters=["chain"], joint=joint)  # type: ignore[arg-type]
    error = _error_deg(estimates, _matrices(*(truth[name] for name in ("qw", "qx", "qy", "qz"))))[late]
    std = estimates["chain_rotation_std_deg"][late]
    assert np.mean(error < 2 * std) > 0.9
    assert np.sqrt(np.mean(std**2)) < most_deg


@pytest.mark.parametrize(("joint", "seed"), [("ball", 2), ("ball", 3), ("hinge", 1), ("hinge", 5)])
def test_gyro_biases_of_the_data_sheet_at_a_start_in_motion_stay_within_the_std(joint: str, seed: int) -> None:
    """Biases of up to 20 °/s, without a rest that shows them or the first pose, from which the angle counts."""
    run = ChainRun(joint, seed, 60.0, errors="datasheet", first_joint="free")
    measured = run.measurements()
    use = measured.time_s >= 8
    measured, truth = measured[use], run.truth_columns(measured.time_s[use])
    chain = ChainFilter(Rig(chain=Chain(joint)))  # type: ignore[arg-type]
    found = dict(zip(chain.columns, chain.process(measured).T, strict=True))
    error = _error_deg(found, _matrices(*(truth[name] for name in ("qw", "qx", "qy", "qz"))))
    known, late = np.isfinite(error), measured.time_s > 20
    assert known[late].all() and known.mean() > 0.9
    assert np.mean(error[known] < 2 * found["chain_rotation_std_deg"][known]) > 0.9
    assert np.sqrt(np.mean(error[late] ** 2)) < 4
    if joint == "hinge":
        angle = truth["angle_deg"] - truth["angle_deg"][0]
        turned = min((sign * found["chain_angle_deg"] - angle for sign in (1, -1)), key=lambda e: np.std(e[late]))
        assert np.mean(np.abs(turned[late]) < 2 * found["chain_angle_std_deg"][late]) > 0.9
        assert np.sqrt(np.mean(turned[late] ** 2)) < 8


@pytest.mark.parametrize(("seed", "first_joint"), [(900, "free"), (911, "fixed"), (911, "free")])
def test_a_heading_that_is_still_wrong_does_not_show_calibrated_gyros(seed: int, first_joint: str) -> None:
    """In the first second of motion, the biases of the data sheet passed zero with a small σ."""
    run = ChainRun("hinge", seed, 24.0, errors="datasheet", first_joint=first_joint)
    measured = run.measurements()
    use = measured.time_s >= 8
    measured, truth = measured[use], run.truth_columns(measured.time_s[use])
    chain = ChainFilter(Rig(chain=Chain("hinge")))
    found = dict(zip(chain.columns, chain.process(measured).T, strict=True))
    error = _error_deg(found, _matrices(*(truth[name] for name in ("qw", "qx", "qy", "qz"))))
    use = np.isfinite(error) & (measured.time_s > 10)
    assert not chain.state["is_narrow"].any()
    assert np.mean(error[use] < 2 * found["chain_rotation_std_deg"][use]) > 0.85


def _slow_hinge(seed: int, tempo: float, misfit: float) -> lp.Measurements:
    """A hinge that two links turn slowly in space, from a start in motion: no gyro bias, sensors with a wrong scale.

    `tempo` (Hz): of the motion; `misfit`: σ of the elements of the accelerometers' scale matrices. Those of the gyros
    are 1 %.
    """
    rng, h = np.random.default_rng(seed), 1 / RATE_HZ
    t = np.arange(-1, round(SECONDS * RATE_HZ) + 1) * h

    def wave(size: float) -> np.ndarray:
        return size * sum(np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in tempo * rng.uniform(0.3, 0.8, 3))

    x, y, z = np.eye(3)
    first = _turn(z, wave(0.15)) @ _turn(y, 0.2 + wave(0.1)) @ _turn(x, -0.3 + wave(0.1))
    second = first @ _turn(y, wave(0.15)) @ _turn(np.array([0.6, 0.0, 0.8]), np.array([2.0]))[0]
    centre = np.stack([wave(0.03), wave(0.03), wave(0.02)], 1)
    out = []
    for rotation, r in ((first, R1), (second, R2)):
        place = centre + rotation @ r
        accel = (place[2:] - 2 * place[1:-1] + place[:-2]) / h**2 + [0, 0, STANDARD_GRAVITY]
        scales = [np.eye(3) + size * rng.standard_normal((3, 3)) for size in (misfit, 0.01)]
        force = np.einsum("nji,nj->ni", rotation[1:-1], accel) @ scales[0].T
        out.append(force + 0.03 * rng.standard_normal(force.shape))
        out.append(_rate(rotation, h) @ scales[1].T + 0.002 * rng.standard_normal(force.shape))
    return lp.Measurements.from_imu(t[1:-1], out[0], out[1], accel2_m_s2=out[2], gyro2_rad_s=out[3])


def _vertical_biases(measured: lp.Measurements) -> list[float]:
    """Vertical components of both gyro biases over their σ, where the truth is 0."""
    chain, out = ChainFilter(Rig(chain=Chain("hinge"))), []
    chain.process(measured)
    for k in range(2):
        up, at = chain.state.rotation[k, 2], slice(OF_SENSOR * k + BG, OF_SENSOR * k + BA)
        out.append(up @ chain.state.gyro_bias[k] / np.sqrt(up @ chain.state.covariance[at, at] @ up))
    return out


def test_a_slow_turn_is_no_rest() -> None:
    """Turns of 3 °/s were taken for the biases of sensors at rest, with a σ of a fiftieth of that."""
    ratios = [ratio for seed in range(3) for ratio in _vertical_biases(_slow_hinge(seed, 0.12, 0.02))]
    assert np.sqrt(np.mean(np.square(ratios))) < 2


def test_wrong_scales_in_slow_motion_do_not_make_the_gyro_biases_too_certain() -> None:
    ratios = [ratio for seed in range(4) for ratio in _vertical_biases(_slow_hinge(seed, 0.25, 0.03))]
    assert np.sqrt(np.mean(np.square(ratios))) < 1.15


@pytest.mark.parametrize("errors", ["calibrated", "datasheet"])
def test_motion_shows_whether_the_gyros_were_calibrated(errors: str) -> None:
    measured = ChainRun("ball", 1, 30.0, errors=errors).measurements()
    chain = ChainFilter(Rig(chain=Chain("ball")))
    chain.process(measured[measured.time_s >= 8])
    assert chain.state["is_narrow"].tolist() == [int(errors == "calibrated")] * 2


def test_calibrated_gyros_are_not_taken_for_ones_that_warm_up() -> None:
    """With the walk of a sensor that warms up, σ after a minute is 0.28°."""
    run = ChainRun("ball", 400, 60.0)
    measured = run.measurements()
    truth = _matrices(*(run.truth_columns(measured.time_s)[name] for name in ("qw", "qx", "qy", "qz")))
    estimates = lp.estimate(measured, filters=["chain"], joint="ball")
    late = measured.time_s > 30
    error, std = _error_deg(estimates, truth)[late], estimates["chain_rotation_std_deg"][late]
    assert std.mean() < 0.25 and np.mean(error < 2 * std) > 0.95


def test_the_hinge_angle_counts_from_the_start_and_its_std_holds() -> None:
    measured, _, angle = _chain("hinge")
    estimates = lp.estimate(measured, filters=["chain"], joint="hinge")
    late = measured.time_s > 15
    found = estimates["chain_angle_deg"]
    error = min((sign * found - angle for sign in (1, -1)), key=lambda e: np.square(e[late]).sum())[late]
    assert np.sqrt(np.mean(error**2)) < 1.5  # the zero of the angle is the tilt of the first reading
    assert np.mean(np.abs(error) < 2 * estimates["chain_angle_std_deg"][late]) > 0.9


@pytest.mark.parametrize("seed", [1004, 1007, 1018])
def test_a_wrong_heading_after_a_rest_leaves_no_error_in_the_zero_of_the_angle(seed: int) -> None:
    """It turned the tilts of the first pose by 3°, for ever and with a σ of 1°."""
    run = ChainRun("hinge", seed, 60.0)
    measured = run.measurements()
    angle = run.truth_columns(measured.time_s)["angle_deg"]
    chain = ChainFilter(Rig(chain=Chain("hinge")))
    found = dict(zip(chain.columns, chain.process(measured).T, strict=True))
    late = measured.time_s > 35
    error = min((sign * found["chain_angle_deg"] - angle for sign in (1, -1)), key=lambda e: np.std(e[late]))[late]
    assert np.sqrt(np.mean(error**2)) < 0.6
    assert np.mean(np.abs(error) < 2 * found["chain_angle_std_deg"][late]) > 0.9


def test_a_hypothesis_that_knows_nothing_yet_does_not_end_those_that_do() -> None:
    run = ChainRun("hinge", 2, 15.0)  # the leg of the notebook
    measured = run.measurements()
    angle = run.truth_columns(measured.time_s)["angle_deg"]
    estimates = lp.estimate(measured, filters=["chain"], joint="hinge")
    early = (measured.time_s > 6) & (measured.time_s < 9)
    error = min(
        (sign * estimates["chain_angle_deg"] - angle + angle[0] for sign in (1, -1)), key=lambda e: np.std(e[early])
    )
    assert np.sqrt(np.mean(error[early] ** 2)) < 6


def test_blocks_do_not_change_the_estimates() -> None:
    measured = _chain("hinge")[0][:600]
    whole, parts = ChainFilter(Rig(chain=Chain("hinge"))), ChainFilter(Rig(chain=Chain("hinge")))
    cuts = [0, 1, 2, 37, 400, 600]
    pieces = [parts.process(measured[a:b]) for a, b in pairwise(cuts)]
    np.testing.assert_array_equal(whole.process(measured), np.vstack(pieces))


def test_at_rest_the_heading_is_not_reported() -> None:
    n = 500
    force = np.tile([0.0, 0.0, STANDARD_GRAVITY], (n, 1)) + 0.01 * np.random.default_rng(0).standard_normal((n, 3))
    measured = lp.Measurements.from_imu(
        np.arange(n) / 100, force, np.zeros((n, 3)), accel2_m_s2=force, gyro2_rad_s=np.zeros((n, 3))
    )
    estimates = lp.estimate(measured, filters=["chain"])
    assert np.isnan(estimates["chain_qw"]).all()
    assert estimates["chain_rotation_std_deg"].min() > 57


@pytest.mark.parametrize("joint", ["ball", "hinge"])
def test_at_rest_from_the_start_only_what_rest_shows_is_reported(joint: str) -> None:
    run, rng = ChainRun(joint, 0, 4.0), np.random.default_rng(0)
    measured, at = run.measurements(), rng.integers(0, 40, 1000)  # of 0.4 s without motion
    rest = lp.Measurements.from_imu(
        np.arange(1000) / 100, measured.accel_m_s2[at], measured.gyro_rad_s[at],
        accel2_m_s2=measured.accel2_m_s2[at], gyro2_rad_s=measured.gyro2_rad_s[at],
    )  # fmt: skip
    unknown = lp.estimate(rest, filters=["chain"], rig=run.rig)
    known = {name for name in unknown.columns if np.isfinite(unknown[name]).any()}
    # J2S and tilt give the height of sensor 1; σ of the rotation states that it is unknown.
    assert known == {"time_s", "chain_rotation_std_deg", "chain_height1_m", "chain_height1_std_m"}
    given = lp.estimate(rest, filters=["chain"], rig=run.calibrated_rig)
    assert np.abs(given["chain_height2_m"] - run.truth_columns(np.zeros(1))["height2_m"]).max() < 0.01


def test_a_second_sensor_that_is_frozen_at_rest_gives_nothing() -> None:
    measured = _chain("hinge")[0][:1500]
    held = (np.broadcast_to(of[0], of.shape) for of in (measured.accel2_m_s2, 0.0 * measured.gyro2_rad_s))
    accel2, gyro2 = held
    frozen = lp.Measurements.from_imu(
        measured.time_s, measured.accel_m_s2, measured.gyro_rad_s, accel2_m_s2=accel2, gyro2_rad_s=gyro2
    )
    found = ChainFilter(Rig(chain=Chain("hinge"))).process(frozen)
    assert np.isnan(found[measured.time_s > 2.1]).all()


def test_a_long_gap_blanks_and_keeps_the_mounting() -> None:
    measured, _, _ = _chain("ball")
    gone = (measured.time_s > 15) & (measured.time_s < 17)
    gyro2 = np.where(gone[:, None], np.nan, measured.gyro2_rad_s)
    broken = lp.Measurements.from_imu(
        measured.time_s, measured.accel_m_s2, measured.gyro_rad_s, accel2_m_s2=measured.accel2_m_s2, gyro2_rad_s=gyro2
    )
    chain = ChainFilter(Rig())
    found = chain.process(broken)
    assert np.isnan(found[gone]).all()
    assert (chain.rejected, chain.restarts) == (int(gone.sum()), 1)
    assert np.linalg.norm(chain.state.lever - [R1, R2]) < 0.03


def test_an_unknown_joint_is_refused() -> None:
    with pytest.raises(InvalidValue, match='must be "ball" or "hinge"'):
        lp.estimate(_chain("ball")[0][:10], filters=["chain"], joint="slider")  # type: ignore[arg-type]


def test_the_smoother_is_better_than_the_filter_and_its_std_holds() -> None:
    measured, truth, angle = _chain("hinge")
    filtered = lp.estimate(measured, filters=["chain"], joint="hinge")
    smoothed = lp.estimate(measured, filters=["chain"], joint="hinge", smooth=True)
    early = (measured.time_s > 2.5) & (measured.time_s < 8)
    error = _error_deg(smoothed, truth)
    assert np.isfinite(error).all()  # from the first sample on
    assert np.sqrt(np.mean(error[early] ** 2)) < 0.8 * np.sqrt(np.nanmean(_error_deg(filtered, truth)[early] ** 2))
    assert np.mean(error < 2 * smoothed["chain_rotation_std_deg"]) > 0.9
    turned = smoothed["chain_angle_deg"]
    assert min(np.std(sign * turned - angle) for sign in (1, -1)) < 0.6
    last = smoothed["chain_angle_std_deg"][-1]  # the filter backwards counts from there, with σ = 0
    ends = [sign * (turned[-1] - turned[0]) - (angle[-1] - angle[0]) for sign in (1, -1)]
    assert last < 5 and min(np.abs(ends)) < 3 * last


def test_the_angle_of_a_vertical_hinge_does_not_drift_between_its_end_stops() -> None:
    n = round(120 * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    phase = (t / 6) % 1
    angle = np.pi * np.where(phase < 0.5, 2 * phase, 2 - 2 * phase)
    rate = np.gradient(angle, t)
    rng, up, z = np.random.default_rng(1), [0.0, 0.0, STANDARD_GRAVITY], np.eye(3)[2]
    force1, force2 = (up + 0.04 * rng.standard_normal((n, 3)) for _ in range(2))
    gyro1, gyro2 = (0.0009 * rng.standard_normal((n, 3)) for _ in range(2))
    gyro2 += np.outer(rate + 0.002, z)  # 0.11 °/s: 14° in two minutes
    measured = lp.Measurements.from_imu(t, force1, gyro1, accel2_m_s2=force2, gyro2_rad_s=gyro2)
    found = np.radians(lp.estimate(measured, filters=["chain"], joint="hinge")["chain_angle_deg"])
    late = t > 60
    error = min((np.unwrap(sign * found[late]) - np.unwrap(angle[late]) for sign in (1, -1)), key=np.std)
    assert np.degrees(np.std(error)) < 1.0


def test_heights_over_a_fixed_first_joint_with_unknown_mounting() -> None:
    run = ChainRun("hinge", 0, 40.0)
    measured = run.measurements()
    truth, late = run.truth_columns(measured.time_s), measured.time_s > 20
    estimates = lp.estimate(measured, filters=["chain"], rig=run.rig)
    for k in (1, 2):
        error = (estimates[f"chain_height{k}_m"] - truth[f"height{k}_m"])[late]
        assert np.sqrt(np.mean(error**2)) < 0.01
        assert np.mean(np.abs(error) < 2 * estimates[f"chain_height{k}_std_m"][late]) > 0.9


def test_a_first_rest_gives_the_gyro_biases_of_the_data_sheet() -> None:
    measured, truth, _ = _chain("ball")  # which rests for a second
    bias = np.radians([[12.0, -15.0, 8.0], [-9.0, 14.0, 18.0]])
    measured = lp.Measurements.from_imu(
        measured.time_s, measured.accel_m_s2, measured.gyro_rad_s + bias[0],
        accel2_m_s2=measured.accel2_m_s2, gyro2_rad_s=measured.gyro2_rad_s + bias[1],
    )  # fmt: skip
    error = _error_deg(lp.estimate(measured, filters=["chain"]), truth)[measured.time_s > 15]
    assert np.sqrt(np.mean(error**2)) < 1.5


def _changed(measured: lp.Measurements, **changes: np.ndarray) -> lp.Measurements:
    """Measurements from arrays, some of them in place of the recorded ones."""
    arrays = {name: getattr(measured, name) for name in ("accel2_m_s2", "gyro2_rad_s")} | changes
    return lp.Measurements.from_imu(measured.time_s, measured.accel_m_s2, measured.gyro_rad_s, **arrays)


@pytest.mark.parametrize(
    ("name", "change", "remark"),
    [
        ("gyro2_rad_s", lambda rates: np.degrees(rates), "mean rate of sensor 2 is"),
        (
            "gyro2_rad_s",
            lambda rates: np.where(np.arange(len(rates))[:, None] < 1000, rates, rates[1000]),
            "has failed",
        ),
        ("accel2_m_s2", lambda forces: forces / STANDARD_GRAVITY, "mean acceleration of sensor 2 is 1"),
        ("accel2_m_s2", lambda forces: 0 * forces, "mean acceleration of sensor 2 is 0"),
    ],
)
def test_readings_that_no_joint_gives_are_reported_and_have_no_estimate(name: str, change: Any, remark: str) -> None:
    measured, _, _ = _chain("hinge")
    broken = _changed(measured, **{name: change(getattr(measured, name))})
    with pytest.warns(UserWarning, match=remark):
        estimates = lp.estimate(broken, filters=["chain"], joint="hinge")
    assert any(remark in sentence for sentence in estimates.remarks)
    late = measured.time_s > 20
    assert np.isnan(estimates["chain_qw"][late]).all()
    assert np.isnan(estimates["chain_angle_deg"][late]).all()


def test_a_sensor_that_is_often_absent_is_not_taken_for_one_in_another_unit() -> None:
    measured, _, _ = _chain("hinge")
    seldom = np.where(np.arange(len(measured))[:, None] % 4 == 0, measured.accel2_m_s2, np.nan)
    with pytest.warns(UserWarning, match="could not be used"):
        remarks = lp.estimate(_changed(measured, accel2_m_s2=seldom), filters=["chain"], joint="hinge").remarks
    assert not any("mean acceleration" in remark for remark in remarks)


def test_a_sensor_that_is_remounted_is_found_again() -> None:
    run = ChainRun("hinge", 3, 60.0)
    measured = run.measurements()
    truth = run.truth_columns(measured.time_s)
    rotation = _matrices(*(truth[name] for name in ("qw", "qx", "qy", "qz")))
    late, turn = (measured.time_s > 20)[:, None], np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    changes = {
        name: np.where(late, getattr(measured, name) @ turn.T, getattr(measured, name))
        for name in ("accel2_m_s2", "gyro2_rad_s")
    }
    with pytest.warns(UserWarning, match="do not fit two links"):
        estimates = lp.estimate(_changed(measured, **changes), filters=["chain"], joint="hinge")
    error = _error_deg(estimates, np.where(late[:, None], rotation @ turn.T, rotation))
    end = measured.time_s > 50
    assert np.sqrt(np.mean(error[end] ** 2)) < 1.0  # NaN, which fails, where it is not known
    known = np.isfinite(error)
    assert np.mean(error[known] < 2 * estimates["chain_rotation_std_deg"][known]) > 0.9


@pytest.mark.parametrize("seed", [0, 2])  # which follow a wrong heading for some seconds
def test_a_wrong_heading_of_the_start_is_no_misfit(seed: int) -> None:
    run = ChainRun("hinge", seed, 15.0)
    assert not lp.estimate(run.measurements(), filters=["chain"], rig=run.rig).remarks


def test_readings_in_order_give_no_remark() -> None:
    assert not lp.estimate(_chain("ball")[0], filters=["chain"], joint="ball").remarks


@pytest.mark.parametrize("joint", ["ball", "hinge"])
def test_exchanged_sensors_give_the_inverse_rotation(joint: str) -> None:
    """With an unknown mounting and a free first joint, nothing shows which sensor is on which link."""
    measured, *_ = _chain(joint)
    exchanged = lp.Measurements.from_imu(
        measured.time_s,
        measured.accel2_m_s2,
        measured.gyro2_rad_s,
        accel2_m_s2=measured.accel_m_s2,
        gyro2_rad_s=measured.gyro_rad_s,
    )
    forward, inverse = (lp.estimate(each, filters=["chain"], joint=joint).chain for each in (measured, exchanged))
    last = slice(2 * len(measured.time_s) // 3, None)
    a, b = (_matrices(c.qw, c.qx, c.qy, c.qz)[last] for c in (forward, inverse))
    cosine = (np.einsum("nij,nji->n", a, b) - 1) / 2
    apart_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert np.all(apart_deg < 2 * np.hypot(forward.rotation_std_deg, inverse.rotation_std_deg)[last])
    assert apart_deg.max() < 1.0
