"""The N-mouse least squares: the paper's equations, what redundancy buys, and the faults that it must find."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.stats import chi2

from linkpose import filters
from linkpose.errors import LinkposeError
from linkpose.experiments.mice import redundancy
from linkpose.filters.mice import MiceFilter, MiceParameters
from linkpose.filters.mice.faults import fault_limit
from linkpose.sensors.devices import Sensors
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Mouse, Rig
from linkpose.simulation.mice import Fault, MiceRun, ring
from linkpose.wire.messages import SampleFlags

VELOCITY = slice(0, 3)
STD = slice(3, 6)
POSE = slice(6, 9)
EXCLUDED = 9
STALE = int(SampleFlags.MICE_STALE)
EVEN = MiceParameters(scatter=0.0, floor=0.0, mismatch=0.0, noise_m_s=1.0)  # all mice alike, and no fault in sight


@lru_cache(maxsize=20)
def recorded(
    seed: int = 1, faults: tuple[Fault, ...] = (), mice: int = 3, rate_hz: float = 100.0
) -> tuple[MiceRun, Measurements]:
    run = MiceRun(seed, 30.0, rate_hz, ring(mice), faults=faults)
    return run, run.measurements()


def estimate(run: MiceRun, block: Measurements, *mice: Mouse) -> np.ndarray:
    return MiceFilter(Rig(mouse=mice) if mice else run.rig).process(block)


def counted(counts, dt: float = 0.01, gyro_z: float = math.nan, flags=None) -> Measurements:
    """Samples with the given counts (N, M, 2)."""
    counts = np.ascontiguousarray(counts, float)
    n = len(counts)
    gyro = np.full((n, 3), math.nan)
    if not math.isnan(gyro_z):
        gyro[:] = (0.0, 0.0, gyro_z)
    none = np.full(n, math.nan)
    return Measurements(
        dt * np.arange(n), np.full((n, 3), math.nan), gyro, none, none, none, np.zeros(n, bool), counts,
        np.zeros(n, np.uint16) if flags is None else np.asarray(flags, np.uint16),
    )  # fmt: skip


def velocity(mice: tuple[Mouse, ...], each_m_s) -> np.ndarray:
    """What the filter makes of one sample in which the mice have these velocities (M, 2)."""
    counts = np.zeros((2, len(mice), 2))
    counts[1] = np.asarray(each_m_s) * 0.01 * np.array([m.counts_per_m for m in mice])[:, None]
    return MiceFilter(Rig(mouse=mice), EVEN).process(counted(counts))[1]


# ---- the paper's equations ----


def test_the_paper_s_triangle_gives_its_inverse_jacobian_column_by_column():
    d, mice = 0.2, ring(3, 0.2)
    columns = [velocity(mice, np.eye(6)[k].reshape(3, 2))[VELOCITY] for k in range(6)]
    expected = np.zeros((3, 6))  # (14), with l² = 3d²
    for i, mouse in enumerate(mice):
        expected[0, 2 * i], expected[1, 2 * i + 1] = 1 / 3, 1 / 3
        expected[2, 2 * i : 2 * i + 2] = -mouse.y_m / (3 * d**2), mouse.x_m / (3 * d**2)
    np.testing.assert_allclose(np.array(columns).T, expected, atol=1e-12)


def test_the_estimate_of_three_equal_mice_is_the_mean_of_what_each_says():
    d, mice = 0.17, ring(3, 0.17)
    v = np.random.default_rng(0).normal(0, 0.3, (3, 2))
    theta = 2 * math.pi / 3 * np.arange(3)
    w = (-np.sin(theta) * v[:, 0] + np.cos(theta) * v[:, 1]) / d  # (17)
    np.testing.assert_allclose(velocity(mice, v)[VELOCITY], [*v.mean(axis=0), w.mean()], atol=1e-12)  # (16)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_any_placement_and_any_mounting_angle_gives_the_motion_back(count):
    rng = np.random.default_rng(count)
    mice = tuple(
        Mouse(*rng.uniform(-0.2, 0.2, 2), angle_deg=rng.uniform(-180, 180), counts_per_m=rng.uniform(4000, 16000))
        for _ in range(count)
    )
    vx, vy, w = 0.31, -0.12, 1.4
    own = []
    for mouse in mice:
        v = np.array([vx - w * mouse.y_m, vy + w * mouse.x_m])
        c, s = math.cos(math.radians(mouse.angle_deg)), math.sin(math.radians(mouse.angle_deg))
        own.append([c * v[0] + s * v[1], -s * v[0] + c * v[1]])
    np.testing.assert_allclose(velocity(mice, own)[VELOCITY], [vx, vy, w], atol=1e-9)


def test_a_full_circle_closes_by_the_exact_arc():
    mice = ring(3, 0.2, counts_per_m=1e6)
    steps, w, v = 400, 2 * math.pi / 4.0, 0.5
    each = np.array([[v - w * mouse.y_m, w * mouse.x_m] for mouse in mice]) * 0.01 * 1e6
    counts = np.concatenate([np.zeros((1, 3, 2)), np.tile(each, (steps, 1, 1))])
    poses = MiceFilter(Rig(mouse=mice), EVEN).process(counted(counts))[:, POSE]
    np.testing.assert_allclose(poses[-1], [0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(poses[steps // 2, :2], [0, 2 * v / w], atol=1e-9)  # the far side of the circle


def test_three_mice_have_one_over_root_three_of_one_mouse_s_noise():
    for row in redundancy(3, 3):
        assert row.theory_ratio == pytest.approx(1 / math.sqrt(3))
        assert row.ratio == pytest.approx(1 / math.sqrt(3), rel=0.05)


def test_the_standard_deviation_is_honest():
    run, block = recorded()
    out = estimate(run, block)[1:]
    middle = run.at(block.time_s[1:] - 0.5 / run.rate_hz)
    truth = np.column_stack([middle.vx_m_s, middle.vy_m_s, middle.wz_rad_s])
    nees = np.mean(((out[:, VELOCITY] - truth) / out[:, STD]) ** 2, axis=0)
    assert (nees > 0.5).all() and (nees < 1.5).all()


# ---- faults ----


@pytest.mark.parametrize("kind", ["lift", "slip", "unplug"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_faulty_mouse_is_found_within_a_fifth_of_a_second_left_out_and_taken_back(kind, seed):
    port = seed % 3 + 1
    run, block = recorded(seed, (Fault(kind, port, 13.0, 18.0),))
    truth = run.at(block.time_s)
    moving = np.hypot(truth.vx_m_s, truth.vy_m_s) + 0.1 * np.abs(truth.wz_rad_s) > 0.05
    t0 = block.time_s[(block.time_s >= 13.0) & moving][0]
    out = estimate(run, block)
    during = (block.time_s > t0 + 0.2) & (block.time_s < 18.0)
    assert (out[during, EXCLUDED] == 1 << (port - 1)).all()
    assert (out[block.time_s < 13.0, EXCLUDED] == 0).all()
    assert (out[block.time_s > 20.0, EXCLUDED] == 0).all()
    # After the finding, the error is that of the two that remain.
    counts = block.mice_counts.copy()
    counts[:, port - 1] = math.nan
    without = estimate(run, replace(block, mice_counts=counts))
    v = np.column_stack([truth.vx_m_s, truth.vy_m_s])
    error, least = (np.hypot(*(e[during, :2] - v[during]).T) for e in (out, without))
    assert np.sqrt(np.mean(error**2)) <= 1.3 * np.sqrt(np.mean(least**2))


def test_three_mice_find_the_lifted_one_without_a_gyro():
    run, block = recorded(2, (Fault("lift", 3, 13.0, 18.0),))
    blind = replace(block, gyro_rad_s=np.full_like(block.gyro_rad_s, math.nan))
    excluded = estimate(run, blind)[:, EXCLUDED]
    assert (excluded[(block.time_s > 13.2) & (block.time_s < 18.0)] == 4).all()
    assert (excluded[block.time_s < 13.0] == 0).all() and excluded[-1] == 0


def test_a_lifted_mouse_is_found_at_the_paper_s_walking_pace_of_a_snail():
    run = MiceRun(0, 15.0, path="paper", faults=(Fault("lift", 2, 5.0, 10.0),))
    block = run.measurements()
    excluded = estimate(run, block)[:, EXCLUDED]
    assert (excluded[(block.time_s > 5.2) & (block.time_s < 10.0)] == 2).all()
    assert (excluded[block.time_s < 5.0] == 0).all() and excluded[-1] == 0


def test_sound_mice_are_not_accused_though_their_calibration_is_a_few_percent_off():
    run = MiceRun(0, 60.0, errors="datasheet", mice=ring(4))
    assert (estimate(run, run.measurements())[:, EXCLUDED] == 0).all()


def test_two_mice_that_disagree_are_told_apart_only_with_the_gyro():
    run, block = recorded(3, (Fault("lift", 1, 13.0, 18.0),), 2)
    during = (block.time_s > 14.0) & (block.time_s < 18.0)
    assert (estimate(run, block)[during, EXCLUDED] == 1).all()
    blind = replace(block, gyro_rad_s=np.full_like(block.gyro_rad_s, math.nan))
    assert (estimate(run, blind)[during, EXCLUDED] == 0).all()


def test_an_overflowed_count_is_not_used():
    counts = np.full((5, 3, 2), 10.0)
    counts[2, 1] = 32767.0
    flags = [0, 0, int(SampleFlags.MOUSE2_OVERFLOW), 0, 0]
    out = MiceFilter(Rig(mouse=ring(3))).process(counted(counts, flags=flags))
    assert out[:, EXCLUDED].tolist() == [0, 0, 2, 2, 0]
    np.testing.assert_allclose(out[2:, 0], out[1, 0])


@pytest.mark.parametrize("missing", [0.0, math.nan], ids=["flagged valid", "flagged invalid"])
def test_counts_that_come_late_from_a_mouse_that_had_to_repeat_a_packet_harm_nothing(missing):
    run, block = recorded(1)
    counts, late = block.mice_counts, block.mice_counts.copy()
    for k in range(1500, 2000, 100):  # repeated at the next sample; what moved meanwhile comes with the one after
        late[k, 1] = missing
        if missing == 0.0:
            late[k + 1, 1], late[k + 2, 1] = counts[k, 1], counts[k + 1, 1] + counts[k + 2, 1]
        else:
            late[k + 1, 1] = counts[k, 1] + counts[k + 1, 1]
    sound, out = estimate(run, block), estimate(run, replace(block, mice_counts=late))
    assert set(out[:, EXCLUDED]) <= {0, 2} and (out[:, EXCLUDED] == 2).sum() <= 15
    assert np.abs(out[1:, :2] - sound[1:, :2]).max() < 0.03
    assert np.hypot(*(out[-1, 6:8] - sound[-1, 6:8])) < 0.02


def test_the_fault_limit_is_a_chi_square_quantile():
    for freedom in (1, 3, 5):
        assert 1e-7 < chi2.sf(fault_limit(freedom), freedom) < 1.1e-6


# ---- mice that are not read for every sample ----


def stale_but_every(n: int, count: int) -> np.ndarray:
    """Flags of so many samples of which every n-th brings movement."""
    return np.where(np.arange(count) % n, STALE, 0)


@pytest.mark.parametrize("ticks", [2, 4])
def test_between_two_readings_the_velocity_stands_and_the_pose_goes_on(ticks):
    mice, flags = ring(3), stale_but_every(ticks, 400)
    counts = np.where(flags[:, None, None], 0.0, ticks * 0.5 * 0.004 * mice[0].counts_per_m * np.array([1.0, 0.0]))
    block = counted(counts * np.ones((1, 3, 1)), 0.004, flags=flags)
    out = MiceFilter(Rig(mouse=mice)).process(block)[ticks:]
    np.testing.assert_allclose(out[:, VELOCITY], np.tile([0.5, 0.0, 0.0], (len(out), 1)), atol=1e-9)
    np.testing.assert_allclose(out[:, POSE][:, 0], 0.5 * block.time_s[ticks:], atol=1e-9)
    std = out[:, STD][: len(out) // ticks * ticks].reshape(-1, ticks, 3)
    assert (np.diff(std, axis=1) > 0).all()
    assert (out[:, EXCLUDED] == 0).all()


@pytest.mark.parametrize("rate_hz", [160, 250, 500])
def test_samples_between_two_readings_change_nothing_at_the_readings(rate_hz):
    run, block = recorded(2, (Fault("lift", 3, 13.0, 18.0), Fault("unplug", 1, 25.0, 28.0)), rate_hz=rate_hz)
    read = block.flags & STALE == 0
    alone = replace(
        block, time_s=block.time_s[read], mice_counts=block.mice_counts[read], gyro_rad_s=block.gyro_rad_s[read],
        accel_m_s2=block.accel_m_s2[read],
        flags=block.flags[read],
    )  # fmt: skip
    out = estimate(run, block)
    np.testing.assert_array_equal(out[read], estimate(run, alone))
    for column in (*range(3), EXCLUDED):  # held until the next reading
        held = out[read, column][np.cumsum(read) - 1]
        np.testing.assert_array_equal(out[:, column], held)


def test_at_250_hz_the_velocity_is_as_true_as_at_125_hz():
    errors = []
    for rate_hz in (125, 250):
        run, block = recorded(1, rate_hz=rate_hz)
        truth = run.at(block.time_s - 0.004)
        off = estimate(run, block)[10:, :2] - np.column_stack([truth.vx_m_s, truth.vy_m_s])[10:]
        errors.append(np.sqrt(np.mean(off**2)))
    assert errors[1] < 1.1 * errors[0] < 0.01


def test_a_lost_sample_without_movement_is_no_gap_and_a_lost_reading_is_bridged():
    counts = np.where(stale_but_every(2, 100)[:, None, None], 0.0, np.full((1, 3, 2), 40.0))
    whole = counted(counts, 0.005, flags=stale_but_every(2, 100))
    full = MiceFilter(Rig(mouse=ring(3))).process(whole)
    for lost, gap in (([51], 52), ([52], 53)):
        keep = np.setdiff1d(np.arange(100), lost)
        flags = whole.flags.copy()
        flags[gap] |= int(SampleFlags.GAP_BEFORE)
        holey = replace(counted(counts[keep], flags=flags[keep]), time_s=whole.time_s[keep])
        out = MiceFilter(Rig(mouse=ring(3))).process(holey)
        np.testing.assert_allclose(out[50:, VELOCITY], full[keep][50:, VELOCITY], atol=1e-9)
        np.testing.assert_allclose(out[-1, POSE], full[-1, POSE], atol=1e-9)


# ---- one mouse, no mouse, gaps ----


def test_one_mouse_takes_the_rate_from_the_gyro():
    mice = (Mouse(0.1, -0.05),)
    vx, vy, w = 0.4, 0.0, 0.7
    each = np.array([[vx - w * mice[0].y_m, vy + w * mice[0].x_m]]) * 0.01 * 8000
    out = MiceFilter(Rig(mouse=mice)).process(counted(np.tile(each, (5, 1, 1)), gyro_z=w))
    np.testing.assert_allclose(out[-1, VELOCITY], [vx, vy, w], atol=1e-9)
    blind = MiceFilter(Rig(mouse=mice)).process(counted(np.tile(each, (5, 1, 1))))
    assert np.isnan(blind[:, VELOCITY]).all()


def test_without_any_mouse_the_velocity_stands_for_half_a_second_and_is_unknown_then():
    counts = np.full((200, 3, 2), 40.0)
    counts[100:, :] = math.nan
    filter_ = MiceFilter(Rig(mouse=ring(3)))
    out = filter_.process(counted(counts))
    np.testing.assert_allclose(out[100:149, 0], out[99, 0])
    assert (np.diff(out[100:149, STD], axis=0) > 0).all()
    assert np.isnan(out[160:, VELOCITY]).all() and (out[160:, 6] == out[-1, 6]).all()
    assert (out[100:, EXCLUDED] == 7).all()
    assert filter_.rejected == 100


def test_counts_after_lost_samples_cover_one_interval_and_the_gap_is_bridged():
    counts = np.full((100, 3, 2), 40.0)
    whole = counted(counts)
    keep = np.r_[0:50, 60:100]
    flags = np.zeros(len(keep), np.uint16)
    flags[50] = int(SampleFlags.GAP_BEFORE)
    holey = replace(counted(counts[keep], flags=flags), time_s=whole.time_s[keep])
    full, out = (MiceFilter(Rig(mouse=ring(3))).process(block) for block in (whole, holey))
    np.testing.assert_allclose(out[50, VELOCITY], full[60, VELOCITY], atol=1e-9)
    np.testing.assert_allclose(out[-1, POSE], full[-1, POSE], atol=1e-9)


def test_a_time_that_does_not_go_on_changes_nothing():
    block = counted(np.full((10, 3, 2), 40.0))
    again = replace(block, time_s=np.r_[block.time_s[:6], block.time_s[5], block.time_s[6:9]])
    filter_ = MiceFilter(Rig(mouse=ring(3)))
    out = filter_.process(again)
    assert filter_.rejected == 1
    np.testing.assert_array_equal(out[6, POSE], out[5, POSE])


@pytest.mark.parametrize("rate_hz", [100, 250])
@pytest.mark.parametrize("size", [1, 7, 1000])
def test_blocks_of_any_size_give_the_same_to_the_bit(size, rate_hz):
    run, block = recorded(2, (Fault("lift", 3, 13.0, 18.0),), rate_hz=rate_hz)
    whole = estimate(run, block)
    filter_ = MiceFilter(run.rig)
    parts = [filter_.process(block[at : at + size]) for at in range(0, len(block), size)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


# ---- what can run ----


@pytest.mark.parametrize(
    ("mice", "ports", "sensors", "reason"),
    [
        ((), 3, Sensors.MPU6050, "lacks the positions of the mice"),
        (ring(3), 0, Sensors.MPU6050, "no mouse gives counts"),
        (ring(1), 1, Sensors(0), "cannot measure a turn"),
        ((Mouse(0.1, 0.2), Mouse(0.1, 0.2)), 2, Sensors.MPU6050, r"mice 1, 2 all sit at \(0.1, 0.2\) m"),
    ],
)
@pytest.mark.parametrize("name", ["mice", "planar-ekf", "planar-ukf"])
def test_what_cannot_run_says_why(name, mice, ports, sensors, reason):
    with pytest.raises(filters.CannotRun, match=reason) as raised:
        filters.create(name, Rig(mouse=mice), sensors, ports)
    assert isinstance(raised.value, LinkposeError)


def test_reproduce_prints_what_redundancy_buys(linkpose, tmp_path):
    done = linkpose("reproduce", "mice", "--seeds", 2, "--json", "--plot", tmp_path / "f.png")
    assert all(line.startswith("Compiling filters") for line in done.err.splitlines())
    rows = [json.loads(line) for line in done.out.splitlines()]
    assert [(row["quantity"], row["mice"]) for row in rows] == [(q, m) for m in (2, 3) for q in ("vx", "vy", "wz")]
    for row in rows:
        assert row["theory_ratio"] == pytest.approx(1 / math.sqrt(row["mice"]))
        assert row["ratio"] == pytest.approx(row["fused_std"] / row["single_std"])
        assert row["ratio"] == pytest.approx(row["theory_ratio"], rel=0.05)
    assert (tmp_path / "f.png").stat().st_size > 10_000
    assert "30 %" in linkpose("reproduce", "mice", "--seeds", 1).out
