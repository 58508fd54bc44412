"""The paper's four filters: known answers, the paper's order on its Tests, and what no input may do to them."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from linkpose import filters
from linkpose.errors import LinkposeError
from linkpose.filters import tilt
from linkpose.sensors.devices import Sensors
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Imu, Joint, Rig
from linkpose.simulation.link import LinkRun
from linkpose.wire.messages import SampleFlags

PAPER = ("joint", "tilt", "imu-baro", "baro")
INERTIAL = ("joint", "tilt")
OURS = "tilt-inertial"


@lru_cache(maxsize=20)
def recorded(test: int = 1, seed: int = 0, duration_s: float = 65.0) -> tuple[LinkRun, Measurements]:
    run = LinkRun(test, seed, duration_s)
    return run, run.measurements()


def measurements(time_s, accel, gyro) -> Measurements:
    n = len(time_s)
    return Measurements(
        np.asarray(time_s, float), np.ascontiguousarray(accel, float), np.ascontiguousarray(gyro, float),
        np.full(n, 25.0), np.full(n, np.nan), np.full(n, np.nan), np.zeros(n, bool), np.empty((n, 0, 2)),
        np.ones(n, np.uint16),
    )  # fmt: skip


def height_rmse_cm(name: str, test: int, seed: int) -> float:
    run, block = recorded(test, seed)
    estimate = filters.create(name, run.rig).process(block)[:, 0]
    return 100 * float(np.sqrt(np.nanmean((estimate - run.truth().height_m) ** 2)))


# ---- known answers ----


@pytest.mark.parametrize("name", [*INERTIAL, OURS])
@pytest.mark.parametrize(("roll", "pitch"), [(0, 0), (30, -20), (-120, 45), (10, 80)])
def test_static_tilt(name, roll, pitch):
    r, p = np.radians([roll, pitch])
    tilt = np.array([-np.sin(p), np.cos(p) * np.sin(r), np.cos(p) * np.cos(r)])
    block = measurements(np.arange(50) / 100, np.tile(STANDARD_GRAVITY * tilt, (50, 1)), np.zeros((50, 3)))
    estimate = filters.create(name, Rig().with_j2s((0.2, -0.1, 1.0))).process(block)
    assert estimate[-1, 2:4] == pytest.approx([roll, pitch], abs=1e-6)
    assert estimate[-1, 0] == pytest.approx(tilt @ [0.2, -0.1, 1.0], abs=1e-9)
    assert estimate[-1, 1] > 0
    if name in INERTIAL:  # with a bias that is unknown, the first second is less certain than the first sample
        assert estimate[-1, 1] < estimate[0, 1]


def test_arrays_of_any_layout_and_whole_numbers_need_no_other_machine_code():
    """The compiler would take seconds for each other type."""
    usual = measurements(np.arange(50) / 100, np.tile([0.0, 0.0, 9.8], (50, 1)), np.zeros((50, 3)))
    expected = filters.create("tilt", Rig(joint=Joint((0.0, 0.0, 1.0), 0.0))).process(usual)
    types = list(tilt._process.signatures)
    read_only = usual.gyro_rad_s.copy()
    read_only.flags.writeable = False
    other = replace(
        usual, accel_m_s2=np.asfortranarray(usual.accel_m_s2), gyro_rad_s=read_only, flags=usual.flags.astype(np.int64)
    )
    for block in (other, replace(other, gyro_rad_s=read_only.astype(np.float32))):
        assert np.array_equal(filters.create("tilt", Rig(joint=Joint((0, 0, 1), 0))).process(block), expected)
    assert list(tilt._process.signatures) == types


@pytest.mark.parametrize("name", ["tilt", "joint"])
def test_an_axis_of_j2s_counts_as_far_as_it_points_upwards(name):
    """Upright, an error of 3 cm across the link does not reach the height; one along it does."""
    time_s = np.arange(200) / 100
    block = measurements(time_s, np.tile([0.0, 0.0, STANDARD_GRAVITY], (200, 1)), np.zeros((200, 3)))
    across, along = (
        filters.create(name, Rig(joint=Joint((0.0, 0.0, 1.0), std))).process(block)[-1, 1]
        for std in ((0.03, 0.03, 0.001), (0.001, 0.001, 0.03))
    )
    assert across < 0.002
    assert along == pytest.approx(0.03, rel=0.01)


@pytest.mark.parametrize("name", INERTIAL)
def test_pure_rotation_at_a_constant_rate(name):
    """A sensor on the joint's axis turns about x at 1 rad/s: roll is the angle turned by."""
    t = np.arange(300) / 100
    angle = t
    tilt = np.column_stack([np.zeros(300), np.sin(angle), np.cos(angle)])
    block = measurements(t, STANDARD_GRAVITY * tilt, np.tile([1.0, 0, 0], (300, 1)))
    estimate = filters.create(name, Rig().with_j2s((0.5, 0, 0))).process(block)
    assert np.abs(estimate[:, 2] - np.degrees(angle)).max() < 1e-6
    assert np.abs(estimate[:, 3]).max() < 1e-6


def test_joint_sees_through_a_constant_centripetal_acceleration():
    """Turning about the vertical at 3 rad/s, 1 m off: the accelerometer leans by 43°, the constraint explains it."""
    t, rate = np.arange(3000) / 100, 3.0
    force = np.tile([-(rate**2), 0, STANDARD_GRAVITY], (3000, 1))
    block = measurements(t, force, np.tile([0, 0, rate], (3000, 1)))
    rig = Rig().with_j2s((1.0, 0.0, 0.0))
    pitch = {name: filters.create(name, rig).process(block)[:, 3] for name in INERTIAL}
    assert np.abs(pitch["joint"][20:]).max() < 0.5
    assert np.abs(pitch["tilt"][20]) > 5


def test_rig_calibration_is_applied():
    rig = Rig(imu=Imu((0.1, -0.2, 0.3), (0.5, -0.5, 0.2), (1.02, 0.98, 1.01)))
    force = np.array([0, 0, STANDARD_GRAVITY]) * rig.imu.accel_scale + rig.imu.accel_offset_m_s2
    block = measurements(np.arange(500) / 100, np.tile(force, (500, 1)), np.tile(rig.imu.gyro_bias_rad_s, (500, 1)))
    estimate = filters.create("tilt", rig).process(block)
    assert np.abs(estimate[:, 2:4]).max() < 1e-6


def test_baro_follows_the_barometric_formula():
    n = 400
    fresh = np.zeros(n, bool)
    fresh[::2] = True
    pressure = np.where(np.arange(n) < 200, 101_325.0, 100_129.0)  # the standard atmosphere at 0 m and at 100 m
    block = replace(
        measurements(np.arange(n) / 100, np.tile([0, 0, STANDARD_GRAVITY], (n, 1)), np.zeros((n, 3))),
        pressure_Pa=pressure, baro_fresh=fresh,
    )  # fmt: skip
    height = filters.create("baro", Rig()).process(block)[:, 0]
    assert np.abs(height[:200]).max() == 0
    assert height[-1] == pytest.approx(100.0, abs=0.2)
    with_j2s = filters.create("baro", Rig().with_j2s((0.3, 0.0, 1.5))).process(block)[:, 0]
    assert with_j2s - height == pytest.approx(1.5)


# ---- the paper's Tests ----


@pytest.mark.parametrize("test", [1, 2, 3])
def test_methods_stand_in_the_papers_order(test):
    errors = np.array([[height_rmse_cm(name, test, seed) for name in PAPER] for seed in range(5)])
    joint, tilt, imu_baro, baro = errors.mean(axis=0)
    assert joint <= 1.1
    assert joint < tilt < imu_baro < baro
    assert (errors[:, 0] < errors[:, 1]).all()


def test_test_1_reaches_the_papers_figure():
    assert np.mean([height_rmse_cm("joint", 1, seed) for seed in range(5)]) <= 0.58


# ---- the standard deviation is that of the error ----


def height_nees(name: str, rig: Rig, block: Measurements, height_m: np.ndarray) -> float:
    """Mean square of the height's error in standard deviations."""
    estimate = filters.create(name, rig).process(block)
    return float(np.nanmean(((estimate[:, 0] - height_m) / estimate[:, 1]) ** 2))


@pytest.mark.parametrize("test", [1, 2, 3])
@pytest.mark.parametrize("name", PAPER)
def test_the_error_is_as_large_as_the_standard_deviation_says(name, test):
    found = []
    for seed in range(5):
        run, block = recorded(test, seed)
        found.append(height_nees(name, run.rig, block, run.truth().height_m))
    assert 0.5 < np.mean(found) < 2


@pytest.mark.parametrize(
    ("otherwise", "start"),
    [
        pytest.param({"errors": "datasheet"}, 0, id="uncalibrated"),
        pytest.param({"rate_hz": 50.0}, 0, id="50 Hz"),
        pytest.param({"rate_hz": 500.0}, 0, id="500 Hz"),
        pytest.param({"j2s_m": (0.0, -0.005, 0.05)}, 0, id="5 cm"),
        pytest.param({"j2s_m": (0.1, 0.0, 2.0)}, 0, id="2 m"),
        pytest.param({"j2s_m": (0.6, 0.3, 0.1)}, 0, id="level"),
        pytest.param({}, 1500, id="start in motion"),
    ],
)
def test_it_is_so_for_other_sensors_rates_links_and_starts(otherwise, start):
    found = []
    for test, seed in [(1, 0), (2, 1), (3, 2)]:
        run = LinkRun(test, seed, 40.0, **otherwise)
        block, height = run.measurements()[start:], run.truth().height_m[start:]
        rig = replace(run.rig, joint=Joint(run.j2s_m, 1e-6))  # the simulated link's is exact
        found.append([height_nees(name, rig, block, height) for name in PAPER])
    mean = dict(zip(PAPER, np.mean(found, axis=0), strict=True))
    assert all(0.3 < value < 3 for value in mean.values()), mean


@pytest.mark.parametrize("name", PAPER)
def test_the_standard_deviation_grows_in_motion_and_shrinks_at_rest(name):
    """The last second, which is one of rest, is repeated for half a minute."""
    run, block = recorded(1, 0)
    rows = np.concatenate([np.arange(6500), 6400 + np.arange(3000) % 100])
    longer = Measurements(*(np.ascontiguousarray(getattr(block, f)[rows]) for f in block.__slots__))
    longer = replace(longer, time_s=np.arange(9500) / 100)
    std = np.sqrt(np.convolve(filters.create(name, run.rig).process(longer)[:, 1] ** 2, np.ones(100) / 100, "valid"))
    # The air's pressure goes on changing at rest.
    share = {"joint": 0.8, "tilt": 0.3}.get(name, 0.97)
    assert std[0] < share * std[400:6000].max()
    assert std[-1] < share * std[400:6000].max()


@pytest.mark.parametrize("name", INERTIAL)
def test_a_bias_of_the_gyro_is_in_the_standard_deviation(name):
    """At rest with the rate 0.2 °/s off about y: the tilt leans towards x, and the residual is what it leans by."""
    n = 6000
    force = np.tile([0, 0, STANDARD_GRAVITY], (n, 1))
    block = measurements(np.arange(n) / 100, force, np.tile([0, np.radians(0.2), 0], (n, 1)))
    height, std = filters.create(name, Rig().with_j2s((1.0, 0.0, 0.0))).process(block)[-1, :2]
    assert abs(height) > 0.01
    assert std == pytest.approx(abs(height) / np.sqrt(2), rel=0.1)  # of both axes across Z alike


def test_baro_without_an_accelerometer_does_not_know_the_height_of_its_start():
    run, block = recorded(1, 0)
    blind = replace(block, accel_m_s2=np.full((len(block), 3), np.nan), gyro_rad_s=np.full((len(block), 3), np.nan))
    estimate = filters.create("baro", run.rig).process(blind)
    error = np.abs(estimate[:, 0] - run.truth().height_m)
    assert error.min() > 0.3
    assert (error < 3 * estimate[:, 1]).all()


@pytest.mark.parametrize("name", [*INERTIAL, "imu-baro", "baro"])
def test_what_is_not_known_of_j2s_is_in_the_standard_deviation(name):
    run, block = recorded(1, 0)
    exact, rough = (
        filters.create(name, replace(run.rig, joint=Joint(run.j2s_m, std_m))).process(block)[:, 1]
        for std_m in (1e-6, 0.02)
    )
    assert rough**2 - exact**2 == pytest.approx(0.02**2)


# ---- tilt-inertial: the gyro's bias, accelerations that last, delayed readings ----


def with_bias(block: Measurements, bias_deg_s: tuple[float, float, float]) -> Measurements:
    return replace(block, gyro_rad_s=block.gyro_rad_s + np.radians(bias_deg_s))


@pytest.mark.parametrize("test", [1, 2, 3])
def test_tilt_inertial_is_below_method_b(test):
    """With the gyro's bias unknown at the start, and in the error."""
    ours, paper = (np.mean([height_rmse_cm(name, test, seed) for seed in range(5)]) for name in (OURS, "tilt"))
    assert ours < min(paper, 1.1)


def test_tilt_inertial_is_no_less_sure_than_it_says():
    squares = []
    for test, seed in [(1, 0), (2, 1), (3, 2)]:
        run, block = recorded(test, seed)
        rig = replace(run.rig, imu=replace(run.rig.imu, accel_offset_std_m_s2=0.02))
        estimate = filters.create(OURS, rig).process(block)
        squares.append(np.mean(((estimate[:, 0] - run.truth().height_m) / estimate[:, 1]) ** 2))
    assert 0.05 < np.mean(squares) < 2


def test_a_bias_at_switch_on_is_found_at_rest():
    n, bias = 2000, np.radians([10.0, -10.0, 10.0])
    rng = np.random.default_rng(4)
    force = [0, 0, STANDARD_GRAVITY] + 0.04 * rng.standard_normal((n, 3))
    f = filters.create(OURS, Rig())
    estimate = f.process(measurements(np.arange(n) / 100, force, bias + 0.001 * rng.standard_normal((n, 3))))
    assert f.gyro_bias_rad_s == pytest.approx(bias, abs=np.radians(0.1))
    assert np.abs(estimate[:, 2:4]).max() < 8
    assert np.abs(estimate[1000:, 2:4]).max() < 0.2


@pytest.mark.parametrize("start", [0, 2000, 4000])
@pytest.mark.parametrize(("test", "seed"), [(1, 0), (2, 1), (3, 2)])
def test_a_bias_at_switch_on_is_found_in_motion(test, seed, start):
    run, block = recorded(test, seed)
    estimate = filters.create(OURS, run.rig).process(with_bias(block[start:], (10.0, 10.0, -10.0)))
    error = estimate[:, 0] - run.truth().height_m[start:]
    assert np.sqrt(np.mean(error[-1000:] ** 2)) < 0.05


def test_an_acceleration_that_lasts_does_not_lean_the_tilt():
    """Swung to and fro by 0.2 m, once in 1.3 s, without a turn: 4.7 m/s² at the ends, 25° of the accelerometer."""
    t = np.arange(6000) / 100
    swing = -0.2 * (2 * np.pi / 1.3) ** 2 * np.sin(2 * np.pi * t / 1.3)
    block = measurements(t, np.column_stack([swing, 0 * t, 0 * t + STANDARD_GRAVITY]), np.zeros((6000, 3)))
    pitch = {name: filters.create(name, Rig()).process(block)[2000:, 3] for name in (OURS, "tilt")}
    assert np.abs(pitch[OURS]).max() < 1
    assert np.abs(pitch["tilt"]).max() > 5


def test_a_turn_at_a_constant_rate_is_no_bias():
    n, rate = 3000, 1.0
    angle = rate * np.arange(n) / 100
    tilt = np.column_stack([np.zeros(n), np.sin(angle), np.cos(angle)])
    f = filters.create(OURS, Rig(imu=Imu(delay_s=0.0)))
    f.process(measurements(np.arange(n) / 100, STANDARD_GRAVITY * tilt, np.tile([rate, 0, 0], (n, 1))))
    assert np.abs(f.gyro_bias_rad_s).max() < 1e-6


@pytest.mark.parametrize("name", ["tilt", "joint", "joint-inertial", OURS])
@pytest.mark.parametrize("delay_s", [0.0, 0.0049, 0.02])
def test_readings_that_are_delayed_give_the_tilt_of_now(delay_s, name):
    """What a low-pass filter lets through is that of `delay_s` ago; the sensor rolls to and fro at up to 1.9 rad/s."""
    t = np.arange(3000) / 100
    angle, rate = 0.6 * np.sin(np.pi * (t - delay_s)), 0.6 * np.pi * np.cos(np.pi * (t - delay_s))
    force = STANDARD_GRAVITY * np.column_stack([0 * t, np.sin(angle), np.cos(angle)])
    block = measurements(t, force, np.column_stack([rate, 0 * t, 0 * t]))
    joint = Joint((0.0, 0.0, 0.0))  # it turns about itself
    roll = filters.create(name, Rig(joint, Imu(delay_s=delay_s))).process(block)[:, 2]
    error = np.abs(roll - np.degrees(0.6 * np.sin(np.pi * t)))[1000:].max()
    assert error < 0.25
    late = filters.create(name, Rig(joint, Imu(delay_s=0.0))).process(block)[:, 2]
    assert np.abs(late - np.degrees(0.6 * np.sin(np.pi * t)))[1000:].max() >= np.degrees(0.6 * np.pi) * delay_s * 0.9


def test_a_delay_that_cannot_be_is_refused():
    with pytest.raises(LinkposeError, match=r"imu\.delay_s is -1"):
        Rig.from_dict({"imu": {"delay_s": -1}}, "rig.toml")


# ---- one result, however it is cut ----


@pytest.mark.parametrize("name", [*PAPER, "joint-inertial", OURS])
def test_blocks_of_any_length_give_the_same_bits(name):
    run, block = recorded(3, 1)
    whole = filters.create(name, run.rig).process(block)
    rng = np.random.default_rng(5)
    for longest in (1, 7, 900):
        part, rows, i = filters.create(name, run.rig), [], 0
        while i < 3000:
            count = int(rng.integers(1, longest + 1))
            rows.append(part.process(block[i : min(i + count, 3000)]))
            i += count
        assert np.array_equal(np.concatenate(rows), whole[:3000], equal_nan=True)


# ---- what no input may do ----


def assert_sane(name: str, rig: Rig, block: Measurements) -> np.ndarray:
    f = filters.create(name, rig)
    estimate = f.process(block)
    known = np.isfinite(estimate[:, 0])
    assert known[20:].all()
    assert (estimate[known, 1] >= 0).all() and np.isfinite(estimate[known]).all()
    assert f.rejected > 0
    return estimate


@pytest.mark.parametrize("name", [*PAPER, OURS])
def test_missing_and_saturated_readings_are_passed_by_prediction_and_counted(name):
    run, block = recorded(2, 0)
    rng = np.random.default_rng(1)
    accel, gyro = block.accel_m_s2.copy(), block.gyro_rad_s.copy()
    pressure, flags = block.pressure_Pa.copy(), block.flags.copy()
    accel[rng.random(len(block)) < 0.05, 1] = np.nan
    gyro[rng.random(len(block)) < 0.02] = np.inf
    pressure[rng.random(len(block)) < 0.05] = np.nan
    largest = np.abs(block.accel_m_s2).max(axis=1)
    most = np.quantile(largest, 0.97)
    full = largest > most
    accel = np.clip(accel, -most, most)
    flags[full] |= int(SampleFlags.ACCEL_SATURATED)
    damaged = replace(block, accel_m_s2=accel, gyro_rad_s=gyro, pressure_Pa=pressure, flags=flags)
    estimate = assert_sane(name, run.rig, damaged)
    error = 100 * np.sqrt(np.nanmean((estimate[:, 0] - run.truth().height_m) ** 2))
    assert error < {"joint": 4, "tilt": 8, "imu-baro": 80, "baro": 80, OURS: 8}[name]


@pytest.mark.parametrize("name", [*INERTIAL, OURS])
def test_lost_samples_and_a_hole_of_seconds(name):
    run, block = recorded(1, 2)
    kept = np.random.default_rng(2).random(len(block)) > 0.1
    kept[2000:2400] = False
    thinned = Measurements(*(np.ascontiguousarray(getattr(block, f)[kept]) for f in block.__slots__))
    estimate = filters.create(name, run.rig).process(thinned)
    error = np.abs(estimate[:, 0] - run.truth().height_m[kept])
    assert np.isfinite(estimate).all()
    assert np.sqrt(np.mean(error[:1500] ** 2)) < 0.04
    after = thinned.time_s > 40.0
    assert np.sqrt(np.mean(error[after] ** 2)) < {"joint": 0.015, "tilt": 0.2, OURS: 0.03}[name]


@pytest.mark.parametrize("name", [*INERTIAL, OURS])
def test_repeated_and_backward_stamps_bring_nothing_new(name):
    run, block = recorded(1, 0, 20.0)
    rows = np.sort(np.concatenate([np.arange(len(block)), np.arange(500, 600), [700] * 5]))
    twice = Measurements(*(np.ascontiguousarray(getattr(block, f)[rows]) for f in block.__slots__))
    estimate = assert_sane(name, run.rig, twice)
    plain = filters.create(name, run.rig).process(block)
    assert np.array_equal(estimate[-1], plain[-1])


@pytest.mark.parametrize("stamp", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["joint-inertial", OURS])
def test_a_stamp_that_is_no_time_is_passed_by(name, stamp):
    run, block = recorded(1, 0, 20.0)
    time_s = block.time_s.copy()
    time_s[1000] = stamp
    f = filters.create(name, run.rig)
    estimate = f.process(replace(block, time_s=time_s))
    plain = filters.create(name, run.rig).process(block)
    assert f.rejected == 1
    assert np.isfinite(estimate).all()
    assert np.abs(np.delete(estimate[:, 0] - plain[:, 0], 1000)).max() < 0.005


@pytest.mark.parametrize("gap_s", [5.0, 1e6])
@pytest.mark.parametrize("lost", ["accel_m_s2", "gyro_rad_s"])
@pytest.mark.parametrize("name", ["joint-inertial", OURS])
def test_half_a_sample_does_not_end_a_gap(name, lost, gap_s):
    """After it one sensor is half a second late; the next rate does not show how far the sensor has turned."""
    run, block = recorded(1, 0)
    values, time_s = getattr(block, lost).copy(), block.time_s.copy()
    values[3000:3050] = np.nan
    time_s[3000:] += gap_s
    estimate = filters.create(name, run.rig).process(replace(block, time_s=time_s, **{lost: values}))
    error = estimate[4500:, 0] - run.truth().height_m[4500:]
    assert np.isfinite(estimate[:3000]).all() and np.isfinite(estimate[3055:]).all()
    assert np.sqrt(np.mean(error**2)) < {"joint-inertial": 0.001, OURS: 0.01}[name]


def test_a_dead_accelerometer_is_forgotten():
    """It reads nothing for 50 minutes, and then the link's motion."""
    run, block = recorded(1, 0, 30.0)
    n = 50 * 3000
    dead = measurements(np.arange(n) / 50 - n / 50, np.zeros((n, 3)), np.zeros((n, 3)))
    f = filters.create(OURS, run.rig)
    assert np.isnan(f.process(dead)[200:]).all()
    assert np.abs(f.process(block)[-1000:, 0] - run.truth().height_m[-1000:]).max() < 0.03


@pytest.mark.parametrize("name", [*PAPER, OURS])
def test_garbage_leaves_no_trace_of_infinity(name):
    rng = np.random.default_rng(3)
    n = 2000
    wild = np.where(rng.random((n, 3)) < 0.1, np.nan, rng.normal(0, 1e3, (n, 3)))
    block = replace(
        measurements(np.cumsum(rng.exponential(0.05, n)), wild, wild[::-1]),
        pressure_Pa=np.where(rng.random(n) < 0.1, -1.0, rng.uniform(3e4, 1.1e5, n)), baro_fresh=rng.random(n) < 0.5,
    )  # fmt: skip
    assert_sane(name, Rig().with_j2s((0.1, 0.2, 0.5)), block)


@pytest.mark.parametrize("rate_hz", [50, 500])
def test_joint_at_other_rates(rate_hz):
    run = LinkRun(1, 0, 30.0, rate_hz)
    estimate = filters.create("joint", run.rig).process(run.measurements())
    assert 100 * np.sqrt(np.mean((estimate[:, 0] - run.truth().height_m) ** 2)) < 1.5


# ---- what cannot run reports why ----


def test_without_j2s_the_reason_and_the_cure_are_named():
    with pytest.raises(filters.CannotRun, match="joint needs J2S, the vector from the joint centre to the sensor"):
        filters.create("joint", Rig())
    with pytest.raises(filters.CannotRun, match="joint-inertial"):
        filters.create("joint", Rig(joint=Joint((0.0, 0.0, 0.0), 1.0)))
    with pytest.raises(filters.CannotRun, match="BMP180"):
        filters.create("baro", Rig(), Sensors.MPU6050)
    with pytest.raises(LinkposeError, match="did you mean joint"):
        filters.create("jiont", Rig())


@pytest.mark.parametrize("name", ["tilt", OURS])
def test_tilt_without_j2s_gives_the_attitude_but_no_height(name):
    _, block = recorded(1, 0, 20.0)
    estimate = filters.create(name, Rig()).process(block)
    assert np.isnan(estimate[:, :2]).all() and np.isfinite(estimate[:, 2:4]).all()


@pytest.mark.parametrize("gap_s", [1.0, 3.0])
@pytest.mark.parametrize("name", ["tilt", "joint"])
def test_a_gap_in_a_fast_swing_is_followed_by_an_alignment(name, gap_s):
    """Propagated across the gap with a guessed rate, the tilt is wrong by 90° for tens of seconds."""
    run, block = recorded()
    kept = (block.time_s < 20) | (block.time_s > 20 + gap_s)
    cut = Measurements(*(np.ascontiguousarray(getattr(block, field)[kept]) for field in block.__slots__))
    height = filters.create(name, run.rig).process(cut)[:, 0]
    late = cut.time_s > 25 + gap_s
    most_m = {"joint": 0.1, "tilt": 0.3}[name]  # Method B needs some swings to average the acceleration
    assert np.sqrt(np.mean((height[late] - run.truth().height_m[kept][late]) ** 2)) < most_m
