"""Mice that deviate from the PS/2 documents as real ones do, on the firmware."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from measuring import DEFAULTS, MICE, MOUSE_VALID, invalid, lost, move_all, movements, reported, stream, totals
from wire_link import WireLink

from linkpose.wire.messages import DeviceState, GetInfo, Hello, MouseLacks, SampleFlags

MakeBoard = Callable[..., WireLink]
REMOTE, ENABLED = 0x40, 0x20  # of the STATUS byte
READ_DATA, SET_DEFAULTS, REMOTE_MODE, ENABLE = 0xEB, 0xF6, 0xF0, 0xF4
SLOW: dict[str, Any] = {"clockHz": 10_000, "responseUs": 20_000}


def hello(link: WireLink) -> Hello:
    link.send(GetInfo())
    return link.expect(Hello, 50)


def moved_exactly(link: WireLink, seconds: float = 2.0) -> bool:
    """All mice move for a while, then stand: the counts in the SAMPLEs are those that the mice reported."""
    link.forget()
    before = reported(link)
    move_all(link, seconds)
    link.run_ms(1000 * seconds + 300)
    moved = reported(link) - before
    assert np.abs(moved).sum(axis=1).min() > 100
    return totals(link.samples).tolist() == moved.tolist()


@pytest.mark.parametrize(
    ("odd", "status", "lacks"),
    [
        ({"darkUntilEnable": True}, REMOTE | ENABLED, 0),
        ({"pullUps": False}, REMOTE | ENABLED, 0),
        (SLOW, REMOTE | ENABLED, 0),
        ({"requestUs": 14_000, "responseUs": 20_000}, REMOTE | ENABLED, 0),
        ({"refusesOnce": [SET_DEFAULTS, 0xF2, 0xE8, 3, 0xF3, 200, REMOTE_MODE, ENABLE, 0xE9]}, REMOTE | ENABLED, 0),
        ({"refuses": [0xE9]}, 0, MouseLacks.STATUS),
        ({"refuses": [0xE6, 0xE8]}, REMOTE | ENABLED, MouseLacks.RESOLUTION),
        ({"errors": [0xF3]}, REMOTE | ENABLED, MouseLacks.SAMPLE_RATE),
        ({"refuses": [200]}, REMOTE | ENABLED, MouseLacks.SAMPLE_RATE),
        ({"ignores": [0xF2, 0xF3]}, REMOTE | ENABLED, MouseLacks.SAMPLE_RATE),
        ({"refuses": [ENABLE]}, REMOTE, MouseLacks.ENABLE),
        ({"refuses": [REMOTE_MODE]}, ENABLED, MouseLacks.REMOTE_MODE),
        ({"noRemoteMode": True, "darkUntilEnable": True}, ENABLED, MouseLacks.REMOTE_MODE),
        ({"refuses": [READ_DATA]}, ENABLED, MouseLacks.REMOTE_MODE),
        ({"errors": [READ_DATA]}, ENABLED, MouseLacks.REMOTE_MODE),
    ],
    ids=lambda value: "-".join(map(str, value)) if isinstance(value, dict) else "",
)
def test_an_unusual_mouse_works_beside_two_usual_ones(
    board: MakeBoard, odd: dict[str, Any], status: int, lacks: int
) -> None:
    link = stream(board(mice=[{**MICE[0], **odd}, MICE[1], MICE[2]]))
    mouse = hello(link).mice[0]
    assert (mouse.state, mouse.status, mouse.lacks) == (DeviceState.OK, status, lacks)
    emulated = link.uno.mice[0].state()
    assert (mouse.counts_per_mm, mouse.report_rate_hz) == (2 ** emulated["resolution"], emulated["report_rate_hz"])
    assert moved_exactly(link)
    assert lost(link.samples) == 0
    assert [invalid(link.samples, flag) for flag in MOUSE_VALID[:3]] == [0, 0, 0]


@pytest.mark.parametrize("slow", [1, 3])
def test_movements_of_a_sample_cover_the_same_interval(board: MakeBoard, slow: int) -> None:
    """At constant speed the counts of a SAMPLE are proportional to the time since the last one with movement, for slow
    mice too and after parity errors."""
    mice = [{**mouse, **SLOW} if index < slow else mouse for index, mouse in enumerate(MICE[:3])]
    link = stream(board(mice=mice))
    before, speed_mm_s = reported(link), 250.0
    for mouse in link.uno.mice:
        mouse.feed([0, 3], [[0, 0], [3 * speed_mm_s, 0]], start_s=link.uno.time_s)
        mouse.spoil_parity_every(0.7)
    link.run_ms(100)
    link.forget()
    counted_before = reported(link)
    link.run_ms(2500)
    samples = link.samples
    fresh = np.array([not sample.flags & SampleFlags.MICE_STALE for sample in samples])
    counts = movements(samples)[..., 0]
    assert not counts[~fresh].any()
    ticks = np.diff(np.flatnonzero(fresh))
    expected = ticks * 0.01 * speed_mm_s * DEFAULTS.mouse_counts_per_mm
    assert np.abs(counts[fresh][1:] - expected[:, None]).max() <= 1
    assert np.median(ticks) == (3 if slow else 1) and ticks.max() > np.median(ticks)
    assert counted_before.tolist() != before.tolist()
    link.run_ms(1000)
    assert lost(link.samples) == 0


def test_a_mouse_that_is_read_at_its_report_rate_beats_less_at_200_hz(board: MakeBoard) -> None:
    """Its sensor is read by its own clock: a poll is late by up to one of its periods, 5 ms of 10."""
    link = stream(board(mice=[{**MICE[0], "sensorAtReportRate": True, "reportRateError": 0.003}]))
    assert hello(link).mice[0].report_rate_hz == 200
    link.uno.mice[0].feed([0, 4], [[0, 0], [1000, 0]], start_s=link.uno.time_s)
    link.run_ms(200)
    link.forget()
    link.run_ms(3000)
    counts = movements(link.samples)[:, 0, 0]
    assert counts.mean() == pytest.approx(20, abs=0.2)
    assert np.abs(counts - 20).max() <= 11


@pytest.mark.parametrize("answer", ["refusesOnce", "errors"])
def test_a_refused_poll_is_repeated_at_once(board: MakeBoard, answer: str) -> None:
    """A lone RESEND or ERROR ends the poll, not the time limit, and no counts are lost."""
    link = stream(board(mice=MICE[:2]))
    before = reported(link)
    move_all(link, 1.0)
    link.run_ms(300)
    link.uno.mice[0].set(**{answer: [READ_DATA]})
    link.run_ms(12)
    link.uno.mice[0].set(errors=[])
    link.run_ms(1000)
    stale = [sample.seq for sample in link.samples if sample.flags & SampleFlags.MICE_STALE]
    assert 1 <= len(stale) <= 3
    assert totals(link.samples).tolist() == (reported(link) - before).tolist()


def test_a_mouse_in_set_up_is_reported_as_starting(board: MakeBoard) -> None:
    link = board(mice=[MICE[0], {**MICE[1], **SLOW}, MICE[2], MICE[3]])
    first = link.boot()
    for _ in range(200):
        states = [mouse.state for mouse in hello(link).mice]
        if DeviceState.STARTING in states:
            break
        link.run_ms(10)
    assert DeviceState.STARTING in states, first
    link.run_ms(1500)
    assert [mouse.state for mouse in hello(link).mice] == [DeviceState.OK] * 4
    link.uno.mice[3].unplug()
    link.run_ms(1500)
    assert [mouse.state for mouse in hello(link).mice] == [DeviceState.OK] * 3 + [DeviceState.FAILED]


def test_a_gated_mouse_that_was_pulled_is_found_again(board: MakeBoard) -> None:
    link = stream(board(mice=[{**MICE[0], "noRemoteMode": True}, MICE[1]]))
    link.uno.mice[0].unplug()
    link.run_ms(2000)
    assert not link.samples[-1].flags & MOUSE_VALID[0]
    link.uno.mice[0].plug()
    link.run_ms(2500)
    assert moved_exactly(link)
