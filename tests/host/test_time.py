"""The board's clock and the place of samples in time: wraps, losses, delays, restarts."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from linkpose.cli import group
from linkpose.device.clock import DeviceClock
from linkpose.recording.reader import load_recording
from linkpose.sensors.conversion import GAP_BEFORE
from linkpose.sensors.timeline import BoardClock, Timeline
from linkpose.simulation import board
from linkpose.wire import frames
from linkpose.wire.messages import Sample

WRAP = 1 << 32


def sample(tick: int, t_us: int) -> Sample:
    return frames.sample(tick % 65536, t_us % WRAP, 1, (0,) * 7, baro=(0, 0, 0))


class Bench:
    """A board whose clock runs `ppm` fast and starts at `t0_us`, asked once a second over a line with delays."""

    def __init__(self, ppm: float, t0_us: int = 0, seed: int = 0) -> None:
        self.rate, self.t0_us = 1 + 1e-6 * ppm, t0_us
        self.rng = np.random.default_rng(seed)
        self.clock = DeviceClock()

    def t_us(self, host_s: float) -> int:
        return int(self.t0_us + host_s * 1e6 * self.rate)

    def ping(self, host_s: float, delay_s: float | None = None) -> None:
        there, back = self.rng.exponential(3e-4, 2) + 3e-4
        if delay_s is not None:
            back += delay_s
        self.clock.pong(self.t_us(host_s + there) % WRAP, host_s, host_s + there + back)


@pytest.mark.parametrize("ppm", [0, 300, -5000, 5000])
def test_drift_and_time_are_found(ppm):
    bench = Bench(ppm)
    times = []
    for tick in range(6000):
        host = tick * 0.01
        if tick % 100 == 0:
            bench.ping(host)
        times.append(bench.clock.host_time(bench.clock.unwrap(bench.t_us(host) % WRAP, host)))
    assert bench.clock.drift_ppm == pytest.approx(ppm, abs=10)
    assert abs(bench.clock.drift_ppm - ppm) < 4 * bench.clock.drift_std_ppm
    intervals = np.diff(times)
    assert np.all(np.abs(intervals[1500:] - 0.01) < 0.01 * 2e-4)
    # However wrong the first guess of the drift, no interval is off by more than the guess and the slew together.
    assert np.all(np.abs(intervals - 0.01) < 0.01 * (abs(ppm) * 1e-6 + 1.5e-3))
    assert times[-1] - 59.99 == pytest.approx(0, abs=1.5e-3)


def test_a_delayed_answer_changes_little_and_a_changed_world_is_believed_in_the_end():
    bench = Bench(100)
    for second in range(60):
        bench.ping(second)
    before = bench.clock.drift_ppm
    bench.ping(60, delay_s=0.5)
    assert bench.clock.drift_ppm == pytest.approx(before, abs=5)
    bench.t0_us -= 3_000_000  # the host was asleep for three seconds
    for second in range(61, 200):
        bench.ping(second)
    bench.clock.host_time(bench.clock.unwrap(bench.t_us(200) % WRAP, 200))
    assert bench.clock.drift_ppm == pytest.approx(100, abs=60)


def test_a_board_faster_than_any_resonator_keeps_its_own_seconds():
    bench = Bench(3_000_000)
    for second in range(20):
        bench.ping(second)
    assert abs(bench.clock.drift_ppm) < 10_000


@pytest.mark.parametrize("seq0", [0, 65000])
def test_wraps_of_time_and_count_are_no_gap(seq0):
    t0 = WRAP - 2_000_000
    bench = Bench(200, t0_us=t0)
    timeline = Timeline(100)
    timeline.lost = -seq0  # a stream that begins here
    places = []
    for tick in range(1000):
        host = tick * 0.01
        if tick % 100 == 0:
            bench.ping(host)
        places.append(timeline.place(sample(seq0 + tick, bench.t_us(host)), bench.clock, host + 0.002))
    time_s = np.array([p.time_s for p in places])
    assert np.allclose(time_s, np.arange(1000) * 0.01, atol=2e-3)
    assert [p.seq for p in places] == list(range(seq0, seq0 + 1000))
    assert timeline.lost == 0


def test_lost_samples_are_counted_over_the_wrap_of_the_count():
    clock = BoardClock()
    timeline = Timeline(100)
    kept = [0, 1, 2, 10, 11, 65534, 65537, 65538, 65538 + 70000]
    places = [timeline.place(sample(tick, tick * 10_000), clock, 0.0) for tick in kept]
    assert [p.seq for p in places] == kept
    assert timeline.lost == kept[-1] + 1 - len(kept)
    assert [bool(p.flags & GAP_BEFORE) for p in places] == [False] * 3 + [True, False, True, True, False, True]
    assert [gap.lost for gap in timeline.gaps] == [7, 65522, 2, 69999]


def test_a_sample_that_comes_twice_is_taken_once():
    timeline, clock = Timeline(100), BoardClock()
    places = [timeline.place(sample(tick, tick * 10_000), clock, 0.0) for tick in (0, 1, 1, 2)]
    assert [p and p.seq for p in places] == [0, 1, None, 2]
    assert (timeline.samples, timeline.lost) == (3, 0)


@pytest.mark.parametrize(
    "order",
    [
        (0, 1, 2, 1, 2, 3),
        (0, 1, 2, 0, 1, 2, 3),
        (0, 1, 2, 2, 2, 3),
        (0, 2, 3, 2, 3, 7, 3, 7, 8),
        (65534, 65535, 65536, 65535, 65536, 65537),
        (*range(150), *range(60, 150), 150),
    ],
    ids=["two again", "all again", "one again", "with losses", "over the wrap", "most of a second"],
)
def test_a_part_of_the_stream_that_comes_twice_is_taken_once_live_and_in_replay(tmp_path, order):
    """Its samples were taken for those of a board that had been reset: rows without a step of time, and no loss."""
    samples = [sample(tick, 4_294_000_000 + 10_000 * tick) for tick in order]
    timeline, clock = Timeline(100.0), BoardClock()
    live = [place for each in samples if (place := timeline.place(each, clock, 0.0))]
    first = order[0]
    assert [place.seq for place in live] == sorted(set(order))
    assert timeline.lost - first == max(order) - first + 1 - len(set(order))
    capture = tmp_path / "twice.bin"
    capture.write_bytes(b"".join(map(frames.encode, [board.hello(board.DEFAULTS), *samples])))
    replayed = load_recording(capture).measurements
    assert replayed.time_s == pytest.approx([place.time_s for place in live], abs=1e-6)
    assert ((replayed.flags & GAP_BEFORE) != 0).tolist() == [bool(place.flags & GAP_BEFORE) for place in live]


@pytest.mark.parametrize(
    ("seq", "t_us"),
    [
        (lambda tick: tick - 150, lambda tick: 10_000 * (tick - 150)),
        (lambda tick: tick + 5000, lambda tick: 10_000 * tick),
        (lambda tick: tick + 150, lambda tick: 10_000 * tick + 60_000_000),
    ],
    ids=["started again", "count jumps", "clock jumps over a loss"],
)
def test_samples_of_another_stream_are_left_out_live_and_in_replay(tmp_path, seq, t_us):
    """They came to 5000 samples lost within 0.01 s, to times a minute ahead, or to values in another scale."""
    ours = [sample(tick, 10_000 * tick) for tick in range(150)]
    others = [sample(seq(tick), t_us(tick)) for tick in range(150, 170)]
    again = [sample(tick, 30_000_000 + 10_000 * tick) for tick in range(50)]
    timeline = Timeline(100.0)
    for each in ours:
        assert timeline.follows(each) and timeline.place(each, BoardClock(), 0.0)
    assert not timeline.follows(others[0])
    capture, hello = tmp_path / "others.bin", board.hello(board.DEFAULTS)
    capture.write_bytes(b"".join(map(frames.encode, [hello, *ours, *others, hello, *again])))
    replayed = load_recording(capture).measurements
    assert replayed.time_s == pytest.approx(np.arange(200) / 100, abs=1e-6)
    assert np.flatnonzero(replayed.flags & GAP_BEFORE).tolist() == [150]
    capture.write_bytes(b"".join(map(frames.encode, [hello, *ours, *others])))  # with no HELLO behind them, they stay
    replayed = load_recording(capture)
    assert np.flatnonzero(replayed.measurements.flags & GAP_BEFORE).tolist() == [150]
    assert len(replayed.measurements) == 170 and not any("samples lost" in remark for remark in replayed.remarks)


@pytest.mark.parametrize("ticks", [101, 5000, 65536 + 150, 200_000])
def test_a_long_loss_is_no_other_stream(ticks):
    timeline = Timeline(100.0)
    timeline.place(sample(0, WRAP - 5_000), BoardClock(), 0.0)
    assert timeline.follows(sample(ticks, WRAP - 5_000 + 10_000 * ticks))


def test_samples_lost_before_the_first_one_count():
    timeline = Timeline(100)
    place = timeline.place(sample(3, 0), BoardClock(), 0.0)
    assert place == (0.0, 3, 1 | GAP_BEFORE)
    assert timeline.lost == 3


def placed(t_us: Callable[[int], int], ticks: Iterable[int] = range(400)) -> tuple[list[float], list[str]]:
    """Times of samples with these stamps at 100 Hz, and the faults of the board's clock that were found."""
    timeline, clock = Timeline(100.0), BoardClock()
    times, faults = [], []
    for tick in ticks:
        place = timeline.place(sample(tick, t_us(tick)), clock, 0.0)
        assert place is not None
        times.append(place.time_s)
        faults += [timeline.stamps.fault] * bool(timeline.stamps.fault)
    return times, faults


@pytest.mark.parametrize("jump_us", [50_000_000, 3_000_000, 300_000, -500_000, -3_000_000])
def test_a_board_clock_that_jumps_is_replaced_by_its_ticks(jump_us):
    times, faults = placed(lambda tick: 10_000 * tick + jump_us * (tick > 100))
    assert times == pytest.approx([tick / 100 for tick in range(400)], abs=1e-6)
    assert faults == [f"jumped by {jump_us * 1e-6:.2f} s"]


def test_one_stamp_that_is_wrong_moves_no_other():
    times, _ = placed(lambda tick: 10_000 * tick + 300_000 * (tick == 100))
    assert times == pytest.approx([tick / 100 for tick in range(400)], abs=1e-6)


@pytest.mark.parametrize(
    ("rate", "fault", "lost_s"),
    [(0.0, "stands still", 0.06), (0.1, "runs at 0.10 of its rate", 0.06), (3.0, "runs at 3.00 of its rate", -0.06)],
)
def test_a_board_clock_that_stands_still_or_runs_at_a_wrong_rate_is_replaced_by_its_ticks(rate, fault, lost_s):
    times, faults = placed(lambda tick: 10_000 * min(tick, 100) + round(10_000 * rate * max(0, tick - 100)))
    assert faults == [fault]
    assert times[-1] == pytest.approx(3.99 - lost_s, abs=0.011)
    assert np.diff(times[120:]) == pytest.approx(np.full(279, 0.01), abs=1e-6)


def test_a_board_clock_that_jumps_at_every_tick_is_replaced_by_its_ticks():
    times, faults = placed(lambda tick: 100_000 * tick)
    assert times == pytest.approx([tick / 100 for tick in range(400)], abs=1e-6)
    assert set(faults) == {"jumped by 0.09 s"}


def test_a_clock_within_its_tolerance_raises_no_fault_over_losses_and_wraps():
    rng = np.random.default_rng(4)
    ticks = np.cumsum(rng.choice([1, 1, 1, 2, 40, 3000], 400)).tolist()
    _, faults = placed(lambda tick: int(10_050 * tick + rng.integers(-2000, 2000)) + WRAP - 5_000_000, ticks)
    assert not faults
    _, faults = placed(lambda tick: 10_000 * tick, [0, 1, 65538, 65539])  # away for exactly one wrap of seq
    assert not faults


def test_live_and_replay_place_samples_alike_where_the_board_clock_jumps(tmp_path):
    samples = [sample(tick, 10_000 * tick + 3_000_000 * (tick > 50) - 7_000_000 * (tick > 80)) for tick in range(120)]
    capture = tmp_path / "jumps.bin"
    capture.write_bytes(b"".join(map(frames.encode, [board.hello(board.DEFAULTS), *samples])))
    replayed = load_recording(capture)
    timeline, clock = Timeline(100.0), BoardClock()
    live = [timeline.place(each, clock, 0.0).time_s for each in samples]
    assert replayed.measurements.time_s == pytest.approx(live, abs=1e-6)
    assert any("clock jumped 2 times" in remark for remark in replayed.remarks)


@pytest.mark.parametrize("words", ["record", "estimate --live --filter tilt"])
def test_the_date_that_is_set_meanwhile_changes_no_time(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The host's clock goes to and fro by a day at each look at it."""
    days = itertools.cycle((0, 86_400, -86_400))
    now = time.time
    monkeypatch.setattr(time, "time", lambda: now() + next(days))
    out = tmp_path / "out.csv"
    typed = [*words.split(), "--port", "sim://link?speed=20", "--duration", "3", "-o", str(out)]
    if words == "record":
        typed[-2:] = [str(out)]
    done = CliRunner().invoke(group, typed, catch_exceptions=False)
    assert done.exit_code == 0 and "0 lost" in done.stderr
    rows = np.genfromtxt(out, delimiter=",", comments="#", skip_header=3)
    assert len(rows) in (300, 301)  # by the fitted clock, the last one is before or behind the end of the duration
    assert np.abs(np.diff(rows[:, 0]) - 0.01).max() < 1e-3
