"""PS/2 mice and the firmware: counts in are counts out, whatever happens to a mouse."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rig_signals import RigFeed
from wire_link import WATCHED_BUS, WireLink, burst_starts, us

from linkpose.simulation.mice import MiceRun
from linkpose.wire.messages import Configure, GetInfo, Hello, ResetMice, Sample, SampleFlags, Start

MakeBoard = Callable[..., WireLink]
CLOCKS_HZ = (12_500, 10_200, 16_600, 14_000)
MICE: list[dict[str, Any]] = [{"clockHz": clock_hz} for clock_hz in CLOCKS_HZ]
VALID = (SampleFlags.MOUSE1_VALID, SampleFlags.MOUSE2_VALID, SampleFlags.MOUSE3_VALID, SampleFlags.MOUSE4_VALID)
COUNTS_PER_MM = 8
UP_MS = 1500.0  # from power-on until usual mice stream


def path(seconds: float, seed: int, top_speed_mm_s: float = 1000.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A movement in x and y whose speed swings up to `top_speed_mm_s` with halts between, at 200 rows a second."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0, seconds, 0.005)
    speed = np.zeros((len(time_s), 2))
    for axis in (0, 1):
        periods = rng.uniform(0.4, 6.0, 4)
        phases = rng.uniform(0, 2 * np.pi, 4)
        speed[:, axis] = sum(np.sin(2 * np.pi * time_s / p + phase) for p, phase in zip(periods, phases, strict=True))
    speed *= top_speed_mm_s / np.abs(speed).max()
    speed *= (np.sin(2 * np.pi * time_s / 7.0) > -0.7)[:, None]
    return time_s, np.cumsum(speed, axis=0) * 0.005


def totals(samples: list[Sample]) -> NDArray[np.int64]:
    """Sums of the counts, (mice, 2)."""
    return np.sum(np.array([sample.mice for sample in samples], dtype=np.int64), axis=0, dtype=np.int64)


def reported(link: WireLink) -> NDArray[np.int64]:
    """What the mice have put into their packets, (mice, 2)."""
    return np.array([mouse.state()["reported"] for mouse in link.uno.mice])


def invalid_samples(samples: list[Sample], flag: SampleFlags) -> int:
    return sum(not sample.flags & flag for sample in samples)


def streaming(link: WireLink, rate_hz: int = 100) -> WireLink:
    """Gives the mice time from power-on, and starts the stream."""
    link.run_ms(UP_MS)
    link.carry_out(Configure(rate_hz, 8, 1000, 3, 1, COUNTS_PER_MM))
    link.run_ms(500)
    link.carry_out(Start())
    link.run_ms(100)
    link.forget()
    return link


def move_all(link: WireLink, seconds: float) -> None:
    for seed, mouse in enumerate(link.uno.mice):
        mouse.feed(*path(seconds, seed), start_s=link.uno.time_s)


def whole(samples: list[Sample]) -> bool:
    return not ((np.diff([sample.seq for sample in samples]) - 1) & 0xFFFF).any()


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
    link.carry_out(Configure(100, 8, 1000, 3, 1, 2))
    link.run_ms(500)
    assert [mouse.state()["resolution"] for mouse in link.uno.mice] == [1, 1]


def test_counts_out_are_counts_in_for_a_minute(board: MakeBoard) -> None:
    """Three mice at up to 1 m/s, a parity error of each every 2 s, full traffic: nothing lost, nothing twice."""
    link = streaming(board(mice=MICE[:3]))
    before = reported(link)
    link.uno.watch(WATCHED_BUS)
    move_all(link, 59.5)
    for mouse in link.uno.mice:
        mouse.spoil_parity_every(2.0)
    link.run_ms(60_000)
    moved = reported(link) - before
    assert np.abs(moved).sum() > 10_000
    assert totals(link.samples).tolist() == moved.tolist()
    assert all(mouse.state()["counters"] == [0, 0] for mouse in link.uno.mice)
    assert whole(link.samples)
    assert len(link.samples) == 6000
    starts = burst_starts(link.uno.events())
    assert np.ptp(us(starts - starts[0]) - 10_000 * np.arange(len(starts))) <= 5.0
    status = link.status
    assert (status.ticks_missed, status.frames_dropped) == (0, 0)
    assert [mouse.parity_errors for mouse in status.mice[:3]] == pytest.approx([29] * 3, abs=1)
    assert link.uno.state()["contentions"] == 0


def test_load_and_stack_with_three_mice(board: MakeBoard) -> None:
    link = streaming(board(mice=MICE[:3]))
    move_all(link, 4.5)
    before = link.uno.state()
    link.run_ms(4000)
    after = link.uno.state()
    assert 1 - (after["sleep_cycles"] - before["sleep_cycles"]) / (after["cycle"] - before["cycle"]) <= 0.40
    assert link.status.stack_free >= 250


def test_the_simulated_robot_reaches_the_wire_unchanged(board: MakeBoard) -> None:
    """Over several stretches of the feed, the counts on the wire are those of the run."""
    link = streaming(board(mice=MICE[:3]))
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
    link = streaming(board(mice=MICE[:1]))
    start_s = link.uno.time_s
    time_s, way_mm = path(5.0, 5)
    link.uno.mice[0].feed(time_s, way_mm, start_s=start_s)
    link.run_ms(5000)
    out = np.cumsum([sample.mice[0].dx for sample in link.samples])
    at_s = (np.arange(len(out)) + 1) * 0.01
    lag_s = 0.03
    early, late = (np.interp(at_s - lag, time_s, way_mm[:, 0]) * COUNTS_PER_MM for lag in (lag_s, -0.01))
    slack = COUNTS_PER_MM * 1000 * lag_s  # 1 m/s for as long
    assert np.all(out >= np.minimum(early, late) - slack)
    assert np.all(out <= np.maximum(early, late) + slack)


def test_three_mice_at_200_hz(board: MakeBoard) -> None:
    link = streaming(board(mice=MICE[:3]), 200)
    before = reported(link)
    move_all(link, 4.5)
    link.run_ms(5000)
    assert len(link.samples) == pytest.approx(1000, abs=1)
    assert whole(link.samples)
    assert totals(link.samples).tolist() == (reported(link) - before).tolist()
    assert link.status.ticks_missed == 0


def test_a_mouse_pulled_and_put_back(board: MakeBoard) -> None:
    """Pulled at six moments, in the middle of bytes too: the others lose nothing, it is back within 2 s."""
    link = streaming(board(mice=MICE[:3]))
    before = reported(link)
    move_all(link, 16.0)
    for turn in range(6):
        link.run_ms(100 + 7.3 * turn)
        link.uno.mice[1].unplug()
        link.run_ms(500)
        assert not link.samples[-1].flags & VALID[1]
        link.uno.mice[1].plug()
        link.run_ms(2000)
        assert link.samples[-1].flags & VALID[1]
    link.run_ms(1000)
    others = [0, 2]
    assert totals(link.samples)[others].tolist() == (reported(link) - before)[others].tolist()
    assert all(invalid_samples(link.samples, VALID[other]) == 0 for other in others)
    assert whole(link.samples)


def test_a_mouse_plugged_in_later(board: MakeBoard) -> None:
    link = streaming(board(mice=[MICE[0], {**MICE[1], "plugged": False}]))
    link.run_ms(100)
    assert len(link.samples[-1].mice) == 1
    link.uno.mice[1].plug()
    link.run_ms(2000)
    assert len(link.samples[-1].mice) == 2
    assert link.samples[-1].flags & VALID[1]
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
    streaming(link)
    before = reported(link)
    move_all(link, 2.5)
    link.uno.mice[1].spoil_parity_every(0.7)
    link.run_ms(3000)
    assert all(sample.flags & VALID[1] for sample in link.samples)
    assert totals(link.samples).tolist() == (reported(link) - before).tolist()


@pytest.mark.parametrize(
    "odd",
    [{"ignores": [0xFF]}, {"refuses": [0xE8, 0xF3]}, {"ignores": [0xF4]}, {"refuses": [0xE9]}],
    ids=["no answer to RESET", "refuses settings", "no answer to ENABLE", "refuses STATUS"],
)
def test_a_mouse_that_does_not_obey_harms_no_other(board: MakeBoard, odd: dict[str, Any]) -> None:
    link = streaming(board(mice=[{**MICE[0], **odd}, MICE[1], MICE[2]]))
    before = reported(link)
    move_all(link, 2.5)
    link.run_ms(3000)
    assert totals(link.samples)[1:].tolist() == (reported(link) - before)[1:].tolist()
    assert whole(link.samples)
    for flag in VALID[1:3]:
        assert invalid_samples(link.samples, flag) == 0


def test_lost_clocks_put_nothing_out_of_step(board: MakeBoard) -> None:
    link = streaming(board(mice=MICE[:3]))
    before = reported(link)
    move_all(link, 4.5)
    for turn in range(15):
        link.run_ms(300 + turn)
        link.uno.mice[turn % 3].lose_clocks(1)
    link.run_ms(2000)
    assert totals(link.samples).tolist() == (reported(link) - before).tolist()


def test_overflow_is_flagged(board: MakeBoard) -> None:
    """40 mm within one report are more than nine bits of counts."""
    link = streaming(board(mice=MICE[:1]))
    now = link.uno.time_s
    link.uno.mice[0].feed([now, now + 0.002], np.array([[0, 0], [40.0, 0]]))
    link.run_ms(200)
    flagged = [sample for sample in link.samples if sample.flags & SampleFlags.MOUSE1_OVERFLOW]
    assert flagged
    assert totals(link.samples).tolist() == [[255, 0]]


def test_mice_are_reset_on_command(board: MakeBoard) -> None:
    link = streaming(board(mice=MICE[:2]))
    link.uno.watch(["mouse_command"])
    link.carry_out(ResetMice(0b10))
    link.run_ms(2000)
    resets = [value for value in link.uno.events()["value"] if value & 0xFF == 0xFF]
    assert resets == [0x2FF]
    assert link.samples[-1].flags & VALID[1]
    assert invalid_samples(link.samples, VALID[0]) == 0


def test_four_mice(board: MakeBoard) -> None:
    link = streaming(board(mice=MICE))
    before = reported(link)
    move_all(link, 2.5)
    link.run_ms(3000)
    assert totals(link.samples).tolist() == (reported(link) - before).tolist()
    assert whole(link.samples)
