"""Localizes from a stream of rows as they come, for `linkpose localize -`."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from linkpose.errors import LinkposeError
from linkpose.localization.events import (
    FEWEST_SET_BACK,
    NAMED,
    SET_BACK_S,
    Event,
    Log,
    is_negative,
    stream_events,
)
from linkpose.localization.localizer import Localizer, Method, Row, check
from linkpose.localization.measuring import default_constants
from linkpose.localization.options import LocalizationOptions
from linkpose.localization.output import header_line, row_line
from linkpose.localization.plausibility import check_units
from linkpose.localization.settings import Settings
from linkpose.localization.tables import Beacons
from linkpose.localization.track import Track
from linkpose.localization.tuning import described, tune
from linkpose.localization.vehicle import kinds_of
from linkpose.presentation import counted

ORIGIN = "standard input"
# The beginning of the stream from which the motion model and the start follow (s of the log, and rows at the most).
# Longer delays the first pose; shorter may miss a slow sensor. Rows that are ranges alone are a tag's: the head then
# ends with the range to the last of PLACING beacons, which place the tag or bound the area.
HEAD_S, HEAD_ROWS, PLACING = 1.0, 500, 3
# After this many ranges and bearings the noises are estimated from the rows so far, and in use this much later: a fixed
# number, so that the same rows give the same poses however fast they come. The estimate takes up to 8 s.
TUNED_AFTER, USED_AFTER = (100, 300, 1200), 1.5
UNITS_CHECKED_AFTER = (20, 200)  # rows: a median needs some


class Stream:
    """One pass of rows through a filter. `run` is None until the head of the stream is complete."""

    def __init__(
        self,
        method: Method,
        options: LocalizationOptions,
        beacons: Beacons,
        report: Callable[[str], None],
    ) -> None:
        """`report` receives a line when other noises are in use."""
        self.report = report
        self.method, self.options, self.beacons = method, options, beacons
        self.settings = options.settings(options.estimate or ())
        # A filter under way has no states for the constants of the water.
        self._free = tuple(name for name in options.free if name not in ("current", "sound"))
        self.run: Localizer | None = None
        self.last: Row | None = None
        self.late = self.negative = 0
        self.is_cut = False
        self._late_in_a_row = 0
        self._rows: Log = []  # for the noises
        self._sightings = 0
        self._tuning: Future[Settings] | None = None

    def csv_lines(self, lines: Iterable[str]) -> Iterator[str]:
        """The header and a line for each row, as `rows` yields them."""
        for row in self.rows(lines):
            if self.last is None and self.run is not None:
                yield header_line(self.method, self.run.states)
            self.last = row
            yield row_line(row)

    def track(self) -> Track | None:
        """The last row with the counts so far; None before the first. Raises NothingApplied."""
        if self.run is None or self.last is None:
            return None
        track = self.run.track([self.last])
        track.check_applied(ORIGIN, self.method)
        return track

    def rows(self, lines: Iterable[str]) -> Iterator[Row]:
        """The estimate after each row, as soon as the head of the stream is read.

        Negative ranges, rows older than the one before, and a last row that is cut short are left out and counted.
        Raises LinkposeError for what cannot be a measurement, as `localize` does.
        """
        events = self._valid(lines)
        head: list[Event] = []
        for event in events:
            head.append(event)
            if len(head) >= HEAD_ROWS or (event.time_s >= head[0].time_s + HEAD_S and self._can_start(head)):
                break
        if not head:
            raise LinkposeError(f"{ORIGIN} holds no measurements; send the header time_s,kind,a,b,c and rows")
        head.sort(key=lambda event: event.time_s)
        self.run = self._start(list(head))
        with ThreadPoolExecutor(1) as pool:
            for event in itertools.chain(head, events):
                if event.time_s < self.run.now:
                    self._count_late(event, self.run.now)
                    continue
                self._late_in_a_row = 0
                self._tune(self.run, event, pool)
                yield self.run.feed([event])
        if len(self._rows) < max(UNITS_CHECKED_AFTER):
            check_units(self._rows, self.beacons, ORIGIN)

    def _count_late(self, event: Event, now_s: float) -> None:
        """Counts a row that is late. Raises LinkposeError where the sender's clock was set back."""
        self.late += 1
        self._late_in_a_row = self._late_in_a_row + 1 if event.time_s < now_s - SET_BACK_S else 0
        if self._late_in_a_row >= FEWEST_SET_BACK:
            raise LinkposeError(
                f"{ORIGIN} line {event.line}: the clock jumps back from {now_s:.6g} to {event.time_s:.6g} s; restart "
                "the stream"
            )

    def remarks(self) -> list[str]:
        """What was left out, with counts."""
        found = [counted(self.negative, "negative range") + " left out"] if self.negative else []
        if self.late:
            found.append(counted(self.late, "row") + " older than the one before left out")
        return found + (["the last row is cut short and left out"] if self.is_cut else [])

    def _valid(self, lines: Iterable[str]) -> Iterator[Event]:
        """The measurements of the lines."""
        ended = _Ended()
        try:
            for event in stream_events(ended.watch(lines), Path(ORIGIN)):
                if event.beacon and event.beacon not in self.beacons:
                    raise LinkposeError(f"{ORIGIN} line {event.line}: beacon {event.beacon} is not in the beacon file")
                if is_negative(event):
                    self.negative += 1
                else:
                    yield event
        except LinkposeError:
            if not ended.within_a_line:
                raise
            self.is_cut = True

    def _can_start(self, head: list[Event]) -> bool:
        """Whether the start is given, or the rows are not those of a tag that few beacons have placed."""
        is_tag = all(event.kind == "range" for event in head)
        return not is_tag or self.settings.start is not None or len({event.beacon for event in head}) >= PLACING

    def _start(self, head: Log) -> Localizer:
        kinds = kinds_of(head)
        if self.options.estimate is None and "bearing_range" not in kinds:
            self.settings = replace(self.settings, estimate=default_constants(kinds, len(self.beacons)))
        check(head, self.method, self.settings, None, self.beacons, ORIGIN)
        return Localizer(head, self.method, self.settings, None, self.beacons)

    def _tune(self, run: Localizer, event: Event, pool: ThreadPoolExecutor) -> None:
        """Checks the units of the first rows, and estimates the noises from them in another thread."""
        if self._sightings > USED_AFTER * TUNED_AFTER[-1]:
            return
        self._rows.append(event)
        if len(self._rows) in UNITS_CHECKED_AFTER:
            check_units(self._rows, self.beacons, ORIGIN)
        if event.kind not in NAMED:
            return
        self._sightings += 1
        if self._sightings in TUNED_AFTER:
            self._tuning = pool.submit(tune, self._rows.copy(), self.settings, self.beacons, self._free)
        elif self._tuning is not None and self._sightings in [int(USED_AFTER * after) for after in TUNED_AFTER]:
            tuned = self._tuning.result()
            run.use(tuned)
            self.report(f"noises estimated from the rows until {event.time_s:.6g} s: {described(tuned, self._rows)}")
            self._tuning = None
        if self._sightings > USED_AFTER * TUNED_AFTER[-1]:
            self._rows.clear()


class _Ended:
    """Whether the lines of a stream ended within a line."""

    within_a_line = False

    def watch(self, lines: Iterable[str]) -> Iterator[str]:
        """The lines."""
        for line in lines:
            self.within_a_line = not line.endswith("\n")
            yield line
