"""The place of each sample in time and in the count of samples; what is missing is counted."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from numpy.typing import NDArray

from linkpose.sensors.conversion import GAP_BEFORE, Placed
from linkpose.wire.messages import Sample

_SEQ_WRAP = 1 << 16
_T_WRAP = 1 << 32
# How far the board's clock may be off its own count of ticks, in ticks, over at most WINDOW_TICKS: 5 %. The timer that
# counts the ticks also stamps the samples, so that they agree. Doubled, a slow clock is detected half as early.
OFF_TICKS = 5
WINDOW_TICKS = 100


class Clock(Protocol):
    """What a timeline needs of a clock."""

    def unwrap(self, t_us: int, host_s: float) -> int: ...
    def host_time(self, t_us: int) -> float: ...


class BoardClock:
    """The board's own seconds, for samples without a time of arrival (a raw capture, a simulation)."""

    def __init__(self) -> None:
        self._last_us = 0

    def unwrap(self, t_us: int, host_s: float) -> int:
        """The first time with these low 32 bits that is not before the last."""
        self._last_us += (t_us - self._last_us) % (1 << 32)
        return self._last_us

    def host_time(self, t_us: int) -> float:
        return t_us * 1e-6


@dataclass(frozen=True, slots=True)
class Gap:
    """Samples that never came."""

    after_s: float  # time of the last sample before it
    duration_s: float
    lost: int
    cause: str  # "link": frames lost or dropped; "reset": the board restarted; "cable": the port was gone

    def as_dict(self) -> dict[str, float | int | str]:
        """For a recording's closing line."""
        return {
            "after_s": round(self.after_s, 6),
            "duration_s": round(self.duration_s, 6),
            "lost": self.lost,
            "cause": self.cause,
        }


class Stamps:
    """Compares the board's clock with its own count of ticks, and replaces it by the ticks where it cannot be right."""

    def __init__(self, period_s: float) -> None:
        self._period_us = period_s * 1e6
        self.shift_us = 0  # what must be added to the board's clock since it jumped
        self.is_trusted = True  # False: the clock stands still or runs at a wrong rate, and the ticks give the time
        self.fault = ""  # what the last sample has shown, such as "jumped by 0.50 s"; "" if nothing new
        self.restart()

    def restart(self) -> None:
        """The next sample starts a new count."""
        self._last: tuple[int, int] | None = None  # seq and t_us of the last sample
        self._ticks = self._off_us = 0.0  # since the window began

    def corrected(self, seq: int, t_us: int) -> int:
        """The sample's stamp (µs, modulo 2³²), or what it should have been."""
        last, self._last, self.fault = self._last, (seq, t_us), ""
        ticks = (seq - last[0]) % _SEQ_WRAP if last else 0
        if last is None or not 0 < ticks <= WINDOW_TICKS:
            self._ticks = self._off_us = 0.0
            return (t_us + self.shift_us) % _T_WRAP
        off_us = off_ticks(t_us - last[1], ticks, self._period_us)
        if not self.is_trusted:
            self.shift_us -= round(off_us)
        elif abs(off_us) > OFF_TICKS * self._period_us:
            self.shift_us -= round(off_us)
            self.fault = f"jumped by {off_us * 1e-6:.2f} s"
        else:
            self._watch_rate(ticks, off_us)
        return (t_us + self.shift_us) % _T_WRAP

    def _watch_rate(self, ticks: int, off_us: float) -> None:
        self._ticks, self._off_us = self._ticks + ticks, self._off_us + off_us
        if abs(self._off_us) > OFF_TICKS * self._period_us:
            rate = 1 + off_us / (ticks * self._period_us)
            self.is_trusted = False
            self.fault = "stands still" if abs(rate) < OFF_TICKS / WINDOW_TICKS else f"runs at {rate:.2f} of its rate"
        if self._ticks >= WINDOW_TICKS:
            self._ticks = self._off_us = 0.0


Steps = TypeVar("Steps", float, NDArray[Any])  # one step or one for each sample


def off_ticks(step_us: Steps, ticks: Steps, period_us: float) -> Steps:
    """By how much (µs) a step of the board's clock differs from these ticks, or from 65536 more of them, and so on."""
    off_us = _difference(step_us, ticks, period_us)
    wrap_us = _SEQ_WRAP * period_us
    wraps = (off_us + wrap_us / 2) // wrap_us
    return off_us - wraps * (wraps > 0) * wrap_us


def is_step(step_us: Steps, ticks: Steps, period_us: float) -> Any:
    """Whether the board's clock (modulo 2³²) has gone on, or back, by these ticks."""
    return abs(_difference(step_us, ticks, period_us)) <= OFF_TICKS * period_us


def is_foreign(step_us: Steps, ticks: Steps, period_us: float) -> Any:
    """Whether no stream goes on in this way: over more ticks than Stamps watches, the clock has gone on differently.

    The board was started again, it is another board, or the sample is damaged.
    """
    most_us = OFF_TICKS / WINDOW_TICKS * ticks * period_us
    return (ticks > WINDOW_TICKS) & (abs(off_ticks(step_us, ticks, period_us)) > most_us)


def _difference(step_us: Steps, ticks: Steps, period_us: float) -> Steps:
    """By how much (µs) a step of the board's clock, modulo 2³², differs from these ticks."""
    return (step_us - ticks * period_us + _T_WRAP / 2) % _T_WRAP - _T_WRAP / 2


class Timeline:
    """Places the samples of one recording one after another, over wraps, losses and restarts of the board."""

    def __init__(self, sample_rate_hz: float, end_s: float = math.inf) -> None:
        """Samples from `end_s` on are not accepted. Those missing before it are counted as lost."""
        self._period_s = 1.0 / sample_rate_hz
        self._end_s = end_s
        self.start_s = 0.0  # the host's time of the first sample
        self._last: Placed | None = None
        self._wire_seq = self._wire_t_us = 0  # the last sample's seq and t_us as they came
        self._cause = "link"
        self._restarted = False
        self.stamps = Stamps(self._period_s)
        self.is_over = False  # the end is reached
        self.missing_at_end = 0  # samples between the last one and the end, a part of `lost`
        self.end_gap_s = 0.0
        self.samples = 0
        self.lost = 0
        self.gaps: list[Gap] = []

    @property
    def duration_s(self) -> float:
        """From the first sample to the end of the last one's interval, or to the end if samples are missing there."""
        if self.missing_at_end:
            return self._end_s
        return self._last.time_s + self._period_s if self._last else 0.0

    @property
    def _last_due_s(self) -> float:
        """A sample from this time on lies behind the end."""
        return self._end_s - self._period_s / 2

    def end_if_past(self, time_s: float) -> None:
        """End the timeline when `time_s`, in seconds since the first sample, is behind the end."""
        if not self.is_over and time_s >= self._end_s:
            self._end()

    def end_at(self, time_s: float) -> None:
        """End the timeline at `time_s`, in seconds since the first sample, if it has a sample and has not ended yet."""
        if self._last and not self.is_over:
            self._end_s = min(self._end_s, time_s)
            self._end()

    def _end(self) -> None:
        """Count what is missing between the last sample and the end."""
        self.is_over = True
        last_s = self._last.time_s if self._last else -self._period_s
        missing = round((self._end_s - last_s) / self._period_s) - 1
        if missing > 0:
            self.missing_at_end, self.end_gap_s = missing, self._end_s - last_s - self._period_s
            self.lost += missing
            self.gaps.append(Gap(last_s, self._end_s - last_s, missing, self._cause))

    def interrupted(self, cause: str) -> None:
        """The next sample comes from a board that was reset ("reset") or away ("cable"): its counters restart."""
        self._cause, self._restarted = cause, True
        self.stamps.restart()

    @property
    def is_interrupted(self) -> bool:
        """Whether no sample has come since `interrupted`."""
        return self._restarted

    def follows(self, sample: Sample) -> bool:
        """Whether the sample can be of the same stream as the last one."""
        if self._last is None or self._restarted or self._is_old(sample):
            return True
        step_us, ticks = sample.t_us - self._wire_t_us, (sample.seq - self._wire_seq) % _SEQ_WRAP
        return not is_foreign(step_us, ticks, self._period_s * 1e6)

    def place(self, sample: Sample, clock: Clock, arrived_s: float) -> Placed | None:
        """Place of a sample that arrived at `arrived_s` (s, the host's clock).

        None for one that came before, and for one from the end on.
        """
        if self.is_over or self._is_old(sample):
            return None
        t_us = self.stamps.corrected(sample.seq, sample.t_us)
        host_s = clock.host_time(clock.unwrap(t_us, arrived_s))
        last = self._last
        if last is None:
            self.start_s = host_s
            time_s, seq, missing = 0.0, sample.seq, sample.seq  # START set the count to 0
        else:
            time_s = max(host_s - self.start_s, last.time_s)
            ticks = self._ticks(sample.seq, (time_s - last.time_s) / self._period_s)
            if time_s >= self._last_due_s:
                self._end()
                return None
            if ticks == 0:
                return None
            seq, missing = last.seq + ticks, ticks - 1
        marked = missing or (self._restarted and last)
        if marked:
            before = last.time_s if last else -missing * self._period_s
            self.gaps.append(Gap(before, time_s - before, missing, self._cause))
            self.lost += missing
        self._restarted, self._cause, self._wire_seq = False, "link", sample.seq
        self._wire_t_us = sample.t_us
        self._last = Placed(time_s, seq, sample.flags | (GAP_BEFORE if marked else 0))
        self.samples += 1
        self.is_over = time_s + self._period_s >= self._last_due_s
        return self._last

    def _is_old(self, sample: Sample) -> bool:
        """Whether the sample came before: a line that repeats a part of the stream, frame by frame or as a whole."""
        if self._last is None or self._restarted:
            return False
        back = (self._wire_seq - sample.seq) % _SEQ_WRAP
        return back <= WINDOW_TICKS and bool(is_step(sample.t_us - self._wire_t_us, -back, self._period_s * 1e6))

    def _ticks(self, seq: int, elapsed: float) -> int:
        """Ticks from the last sample to the one of this seq, which came `elapsed` periods later.

        seq gives the ticks modulo 65536; the clock gives the number of wraps and, after a restart, all ticks.
        """
        step = (seq - self._wire_seq) % _SEQ_WRAP
        if self._restarted:
            return max(1, round(elapsed))
        return step + max(0, round((elapsed - step) / _SEQ_WRAP)) * _SEQ_WRAP
