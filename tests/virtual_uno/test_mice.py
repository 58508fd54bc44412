"""PS/2 mice and the firmware: counts in are counts out, whatever happens to a mouse."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from measuring import (
    DEFAULTS,
    MICE,
    MOUSE_VALID,
    UP_MS,
    busy,
    invalid,
    jitter_us,
    lost,
    move_all,
    movements,
    path,
    reported,
    stream,
    totals,
)
from rig_signals import RigFeed
from wire_link import WATCHED_BUS, WireLink, burst_starts

from linkpose.filters.mice import MiceFilter
from linkpose.sensors.conversion import BoardSettings, Converter, Placed
from linkpose.sensors.rig import Rig
from linkpose.simulation.mice import MiceRun, ring
from linkpose.wire.messages import GetInfo, Hello, ResetMice, SampleFlags

MakeBoard = Callable[..., WireLink]
COUNTS_PER_MM = DEFAULTS.mouse_counts_per_mm


def test_mice_are_found_and_set_up(board: MakeBoard) -> None:
    link = board(mice=MICE[:3])
    link.boot()
    link.run_ms(UP_MS)
    link.send(GetInfo())
    mice = link.expect(Hello, 50).mice
    assert [mouse.id for mouse in mice[:3]] == [0x00] * 3
    assert [mouse.counts_per_mm for mouse in mice[:3]] == [COUNTS_PER_MM] * 3
    for mouse, emulated in zip(mice, link.uno.mice, strict=False):
        state = emulated.state()
        assert mouse.report_rate_hz == state["report_rate_hz"]
        assert 2 ** state["resolution"] == COUNTS_PER_MM
    assert all(mouse.id == 0xFF and mouse.counts_per_mm == 0 for mouse in mice[3:])


def test_resolution_is_configurable(board: MakeBoard) -> None:
    link = board(mice=MICE[:2])
    link.boot()
    link.run_ms(UP_MS)
    link.carry_out(DEFAULTS._replace(mouse_counts_per_mm=2))
    link.run_ms(500)
    assert [mouse.state()["resolution"] for mouse in link.uno.mice] == [1, 1]


def test_counts_out_are_counts_in_for_a_minute(board: MakeBoard) -> None:
    """Three mice at up to 1 m/s, a parity error of each every 2 s, full traffic: nothing lost, nothing twice."""
    link = stream(board(mice=MICE[:3]))
    before, state = reported(link), link.uno.state()
    link.uno.watch(WATCHED_BUS)
    move_all(link, 59.5)
    for mouse in link.uno.mice:
        mouse.spoil_parity_every(2.0)
    link.run_ms(60_000)
    moved = reported(link) - before
    assert np.abs(moved).sum() > 10_000
    assert totals(link.samples).tolist() == moved.tolist()
    assert all(mouse.state()["counters"] == [0, 0] for mouse in link.uno.mice)
    assert lost(link.samples) == 0
    assert len(link.samples) == 6000
    starts = burst_starts(link.uno.events())
    assert len(starts) == 6000
    assert jitter_us(starts, 100) <= 5.0
    status = link.status
    assert (status.ticks_missed, status.frames_dropped) == (0, 0)
    assert [mouse.parity_errors for mouse in status.mice[:3]] == pytest.approx([29] * 3, abs=1)
    after = link.uno.state()
    assert after["conversions_disturbed"] == state["conversions_disturbed"]
    assert after["contentions"] == 0


def test_load_and_stack_with_three_mice(board: MakeBoard) -> None:
    link = stream(board(mice=MICE[:3]))
    move_all(link, 4.5)
    before = link.uno.state()
    link.run_ms(4000)
    after = link.uno.state()
    assert busy(before, after) <= 0.40
    assert link.status.stack_free >= 400


def test_the_simulated_robot_reaches_the_wire_unchanged(board: MakeBoard) -> None:
    """Over several stretches of the feed, the counts on the wire are those of the run."""
    link = stream(board(mice=MICE[:3]))
    run = MiceRun(3, None)
    before = reported(link)
    feed = RigFeed(link.uno, run)
    for _ in range(250):
        feed.supply()
        link.run_ms(100)
    at_start, at_end = run.counts(np.array([0.0, link.uno.time_s - feed.start_s]))
    for mouse in link.uno.mice:
        mouse.feed([0], [[0, 0]])  # it stands
    link.run_ms(100)
    assert totals(link.samples).tolist() == (reported(link) - before).tolist()
    assert np.abs(totals(link.samples) - (at_end - at_start)).max() <= 1


def test_movement_arrives_when_it_happens(board: MakeBoard) -> None:
    """The counts up to a SAMPLE are the path up to at most two reports before it."""
    link = stream(board(mice=MICE[:1]))
    start_s = link.uno.time_s
    time_s, way_mm = path(5.0, 5)
    link.uno.mice[0].feed(time_s, way_mm, start_s=start_s)
    link.run_ms(5000)
    out = np.cumsum(movements(link.samples)[:, 0, 0])
    at_s = (np.arange(len(out)) + 1) * 0.01
    lag_s = 0.03
    early, late = (np.interp(at_s - lag, time_s, way_mm[:, 0]) * COUNTS_PER_MM for lag in (lag_s, -0.01))
    slack = COUNTS_PER_MM * 1000 * lag_s  # 1 m/s for as long
    assert np.all(out >= np.minimum(early, late) - slack)
    assert np.all(out <= np.maximum(early, late) + slack)


def test_three_mice_at_200_hz(board: MakeBoard) -> None:
    link = stream(board(mice=MICE[:3]), 200)
    before = reported(link)
    move_all(link, 4.5)
    link.run_ms(5000)
    assert len(link.samples) == pytest.approx(1000, abs=1)
    assert lost(link.samples) == 0
    assert totals(link.samples).tolist() == (reported(link) - before).tolist()
    assert link.status.ticks_missed == 0


@pytest.mark.parametrize("rate_hz", [160, 250, 400])
def test_above_133_hz_a_sample_says_whether_it_brings_movement(board: MakeBoard, rate_hz: int) -> None:
    """Mice at constant speed: alike in all SAMPLEs that bring movement, and so are the velocities in all of them."""
    link = stream(board(mice=MICE[:3]), rate_hz)
    ticks, speed_m_s = math.ceil(0.0075 * rate_hz), 0.25
    for mouse in link.uno.mice:
        mouse.feed([0, 10], np.array([[0, 0], [1e4 * speed_m_s, 0]]), start_s=link.uno.time_s)
    link.run_ms(100)
    link.forget()
    link.run_ms(1000)
    stale = np.array([bool(sample.flags & SampleFlags.MICE_STALE) for sample in link.samples])
    counts = movements(link.samples)
    (read,) = np.nonzero(~stale)
    assert set(np.diff(read)) == {ticks} and not counts[stale].any()
    expected = 1e3 * speed_m_s * COUNTS_PER_MM * ticks / rate_hz
    assert np.abs(counts[~stale] - [expected, 0]).max() <= 1
    samples = link.samples
    link.send(GetInfo())
    converter = Converter(BoardSettings.of(link.expect(Hello, 50)))
    places = [Placed(sample.t_us * 1e-6, sample.seq, sample.flags) for sample in samples]
    block = converter.convert_placed(samples, places).measurements
    velocity = MiceFilter(Rig(mouse=ring(3))).process(block)[2 * ticks :, 0]
    assert np.abs(velocity - speed_m_s).max() <= 0.02


def test_a_mouse_pulled_and_put_back(board: MakeBoard) -> None:
    """Pulled at six moments, in the middle of bytes too: the others lose nothing, it is back within 2 s."""
    link = stream(board(mice=MICE[:3]))
    before = reported(link)
    move_all(link, 16.0)
    for turn in range(6):
        link.run_ms(100 + 7.3 * turn)
        link.uno.mice[1].unplug()
        link.run_ms(500)
        assert not link.samples[-1].flags & MOUSE_VALID[1]
        link.uno.mice[1].plug()
        link.run_ms(2000)
        assert link.samples[-1].flags & MOUSE_VALID[1]
    link.run_ms(1000)
    others = [0, 2]
    assert totals(link.samples)[others].tolist() == (reported(link) - before)[others].tolist()
    assert all(invalid(link.samples, MOUSE_VALID[other]) == 0 for other in others)
    assert lost(link.samples) == 0


def test_a_mouse_plugged_in_later(board: MakeBoard) -> None:
    link = stream(board(mice=[MICE[0], {**MICE[1], "plugged": False}]))
    link.run_ms(100)
    assert movements(link.samples[-1:]).shape[1] == 1
    link.uno.mice[1].plug()
    link.run_ms(2000)
    assert movements(link.samples[-1:]).shape[1] == 2
    assert link.samples[-1].flags & MOUSE_VALID[1]
    before = reported(link)
    link.forget()
    move_all(link, 1.0)
    link.run_ms(1200)
    assert totals(link.samples).tolist() == (reported(link) - before).tolist()


@pytest.mark.parametrize(
    "odd",
    [{"repeatsWholePacket": False}, {"selfTestMs": 1500}, {"responseUs": 8000, "requestUs": 5000}, {"clockHz": 9000}],
    ids=["repeats single bytes", "slow self-test", "slow answers", "slow clock"],
)
def test_odd_mice_work(board: MakeBoard, odd: dict[str, Any]) -> None:
    link = board(mice=[MICE[0], {**MICE[1], **odd}])
    link.run_ms(1500)
    stream(link)
    before = reported(link)
    move_all(link, 2.5)
    link.uno.mice[1].spoil_parity_every(0.7)
    link.run_ms(3000)
    assert all(sample.flags & MOUSE_VALID[1] for sample in link.samples)
    assert totals(link.samples).tolist() == (reported(link) - before).tolist()


@pytest.mark.parametrize(
    "odd",
    [{"ignores": [0xFF]}, {"refuses": [0xE8, 0xF3]}, {"ignores": [0xF4]}, {"refuses": [0xE9]}],
    ids=["no answer to RESET", "refuses settings", "no answer to ENABLE", "refuses STATUS"],
)
def test_a_mouse_that_does_not_obey_harms_no_other(board: MakeBoard, odd: dict[str, Any]) -> None:
    link = stream(board(mice=[{**MICE[0], **odd}, MICE[1], MICE[2]]))
    before = reported(link)
    move_all(link, 2.5)
    link.run_ms(3000)
    assert totals(link.samples)[1:].tolist() == (reported(link) - before)[1:].tolist()
    assert lost(link.samples) == 0
    for flag in MOUSE_VALID[1:3]:
        assert invalid(link.samples, flag) == 0


def test_lost_clocks_put_nothing_out_of_step(board: MakeBoard) -> None:
    link = stream(board(mice=MICE[:3]))
    before = reported(link)
    move_all(link, 4.5)
    for turn in range(15):
        link.run_ms(300 + turn)
        link.uno.mice[turn % 3].lose_clocks(1)
    link.run_ms(2000)
    assert totals(link.samples).tolist() == (reported(link) - before).tolist()


def test_overflow_is_flagged(board: MakeBoard) -> None:
    """40 mm within one report are more than nine bits of counts."""
    link = stream(board(mice=MICE[:1]))
    now = link.uno.time_s
    link.uno.mice[0].feed([now, now + 0.002], np.array([[0, 0], [40.0, 0]]))
    link.run_ms(200)
    flagged = [sample for sample in link.samples if sample.flags & SampleFlags.MOUSE1_OVERFLOW]
    assert flagged
    assert totals(link.samples).tolist() == [[255, 0]]


def test_mice_are_reset_on_command(board: MakeBoard) -> None:
    link = stream(board(mice=MICE[:2]))
    link.uno.watch(["mouse_command"])
    link.carry_out(ResetMice(0b10))
    link.run_ms(2000)
    resets = [value for value in link.uno.events()["value"] if value & 0xFF == 0xFF]
    assert resets == [0x2FF]
    assert link.samples[-1].flags & MOUSE_VALID[1]
    assert invalid(link.samples, MOUSE_VALID[0]) == 0


def test_four_mice(board: MakeBoard) -> None:
    link = stream(board(mice=MICE))
    before = reported(link)
    move_all(link, 2.5)
    link.run_ms(3000)
    assert totals(link.samples).tolist() == (reported(link) - before).tolist()
    assert lost(link.samples) == 0


@pytest.mark.parametrize("seed", [1, 2])
def test_everything_goes_wrong_at_once(board: MakeBoard, seed: int) -> None:
    """Half a minute of faults of every kind at random: never a SAMPLE lost nor a reset, and all well soon after."""
    link = stream(board(mice=MICE[:3], seed=seed))
    uno = link.uno
    rng = np.random.default_rng(seed)
    actions: list[Callable[[], object]] = [
        uno.hold_sda, lambda: uno.hold_sda(int(rng.integers(1, 10))), uno.release_sda,
        uno.imu.unplug, uno.imu.plug, uno.baro.unplug, uno.baro.plug,
        lambda: uno.imu.nack(data=True), uno.imu.nack,
        lambda: uno.corrupt_i2c(0.02), lambda: uno.corrupt_i2c(0.0),
        lambda: uno.send(rng.bytes(60)),
    ]  # fmt: skip
    for mouse in uno.mice:
        actions += [mouse.unplug, mouse.plug, partial(mouse.lose_clocks, 1), partial(mouse.spoil_parity, 2)]
    move_all(link, 30.0)
    uno.watch(["reset"])
    for _ in range(300):
        actions[rng.integers(len(actions))]()
        link.run_ms(float(rng.uniform(20, 180)))
    uno.release_sda()
    uno.corrupt_i2c(0.0)
    for part in (uno.imu, uno.baro, *uno.mice):
        part.plug()
    uno.imu.nack()
    uno.send(b"\0")
    link.run_ms(2500)
    assert len(uno.events()) == 0
    assert lost(link.samples) == 0
    assert link.status.ticks_missed == 0
    before = reported(link)
    link.forget()
    move_all(link, 1.5)
    link.run_ms(2000)
    assert totals(link.samples).tolist() == (reported(link) - before).tolist()
    every = SampleFlags.IMU_VALID | SampleFlags.BARO_VALID | MOUSE_VALID[0] | MOUSE_VALID[1] | MOUSE_VALID[2]
    assert all(sample.flags & every == every for sample in link.samples)
