"""Scores of estimates of any length: both files are read in blocks, several times.

The first pass over a long file keeps its stamps and some of its rows, which show about where the offset between the two
clocks is. The second pass keeps short stretches of all rows, which show the offset exactly. The third pass scores.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from linkpose.errors import FileFormatError
from linkpose.evaluation.errors import CommonStart, errors_of
from linkpose.evaluation.mismatches import mismatches
from linkpose.evaluation.references import read_take
from linkpose.evaluation.scores import (
    SCORED,
    Evaluation,
    common_offset,
    comparable,
    evaluate,
    pairs_of,
    window_of,
)
from linkpose.evaluation.scoring import Compared, Score, Scorer, Window, scores_of
from linkpose.evaluation.series import SPARSER, Lag, interval, paired, strongest_lag, usual
from linkpose.quantities import HEIGHT, Quantity, by_filter, split
from linkpose.recording import thinned
from linkpose.recording.ahead import ahead
from linkpose.recording.table import LONGEST_HOLE, Progress, Table, TableFile, Whole
from linkpose.recording.textfile import Part
from linkpose.recording.thinned import Thinner
from linkpose.sensors.measurements import Floats

# Rows by which the offset is searched, at equal distances. Doubling it doubles the memory, and the precision of the lag
# from which the second pass starts.
_COARSE_ROWS = 1_000_000
# Stretches of this many rows show the offset exactly: 100 of 10 s at 100 Hz. Twice of either doubles the memory.
_STRETCHES, _STRETCH_ROWS = 100, 1000
_FAR_S = 1e300  # stamps beyond are infinite
# Rows scored in one piece, and the most rows of the other file in the same interval. Doubling it doubles the memory.
_PIECE_ROWS, _MOST_OTHER_ROWS = 50_000, 200_000
# Rows of one file at once; ten times as many as the usual step gives. Doubling it doubles the memory of a file whose
# stamps do not increase.
_MOST_HELD_ROWS = 10 * _MOST_OTHER_ROWS
_KEPT_FOR_PICTURES = 0.4  # of the rows that the picture of a table has. Doubling it doubles their memory


def evaluate_files(
    estimate: Path,
    reference: Path,
    up: str | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """As `evaluate` of the two files; the remarks on the reference come first.

    `progress` is called with the share of the work that is done. Raises as `evaluate` and the readers do.
    """
    with contextlib.ExitStack() as stack:
        ours = _open(estimate, None, stack)
        theirs = _open(reference, read_take(reference, up), stack)
        our_table, their_table = ours.short_table(), theirs.short_table()
        if our_table is not None and their_table is not None:
            found = evaluate(our_table, their_table, from_s, to_s)
        else:
            found = _Comparison(ours, theirs, progress).evaluate(window_of(from_s, to_s))
        return Evaluation(found.scores, [*theirs.remarks, *found.remarks])


def _open(path: Path, take: Table | None, stack: contextlib.ExitStack) -> _Source:
    if take is not None:
        return _Source(take)
    return _Source(stack.enter_context(contextlib.closing(TableFile(path))))


class _Source:
    """A table in a file or in memory, as blocks of rows."""

    def __init__(self, table: TableFile | Table) -> None:
        table.require("time_s")
        self._table = table
        self.path, self.kind, self.remarks = table.path, table.kind, table.remarks
        self.names = table.names if isinstance(table, TableFile) else list(table.columns)

    def short_table(self) -> Table | None:
        """The table as a whole if it is short."""
        if isinstance(self._table, Table):
            return self._table
        parts: list[Part] = []
        rows = 0
        for part in self._table.parts():
            parts.append(part)
            rows += len(part)
            if rows > thinned.MOST_ROWS * self._table.share_read:  # by the rows so far
                return None
        return self._table.table(parts)

    def parts(self, progress: Progress) -> Iterator[Part]:
        """All rows in blocks; `progress` is called with the share that was read."""
        if isinstance(self._table, Table):
            return iter([Part(self._table.columns, self._table.first_line)])
        return ahead(self._table.parts(progress))

    def table(self, columns: dict[str, Floats], whole: Whole) -> Table:
        """Some rows as a table."""
        return Table(self.path, self.kind, columns, {}, None, 1, (), whole)


class _Scan(NamedTuple):
    """Facts on a whole file."""

    rows: int
    coarse: dict[str, Floats]  # some columns of rows at equal distances
    presence: dict[str, Floats]  # one row: 0 for a column with a value, NaN for one without
    interval_s: float  # the usual step between two rows


def _scan(source: _Source, wanted: Collection[str], progress: Progress) -> _Scan:
    """Reads the whole file; `wanted` are the columns of `coarse`."""
    share = 0.0

    def note(read: float) -> None:
        nonlocal share
        share = read
        progress(read)

    kept = {name: _Growing() for name in wanted}
    steps = _Growing()
    presence = {name: np.full(1, np.nan) for name in source.names}
    rows = every = 0
    for part in source.parts(note):
        total = len(part) / max(share, 1e-6)
        every = every or max(1, math.ceil(total / _COARSE_ROWS))
        for name, values in part.columns.items():
            if name in kept:
                kept[name].add(values[-rows % every :: every], total / every)
            if np.isnan(presence[name][0]) and np.isfinite(values).any():
                presence[name][0] = 0.0
        steps.add(np.diff(part.columns["time_s"])[::every], total / every)
        rows += len(part)
    coarse = {name: column.values for name, column in kept.items()}
    return _Scan(rows, coarse, presence, usual(steps.values))


class _Growing:
    """A column that grows part by part, in one piece of memory: many small ones would keep the parts' memory in use."""

    def __init__(self) -> None:
        self._held: Floats = np.empty(0)
        self._size = 0

    def add(self, values: Floats, expected: float) -> None:
        """The next values; `expected` is about how many there are in all."""
        needed = self._size + len(values)
        if needed > len(self._held):
            larger = np.empty(max(2 * needed if self._size else 0, int(1.1 * expected), needed))
            larger[: self._size] = self._held[: self._size]
            self._held = larger
        self._held[self._size : needed] = values
        self._size = needed

    @property
    def values(self) -> Floats:
        """All values so far."""
        return self._held[: self._size]


class _Span(NamedTuple):
    """A stretch of time on a file's clock (s)."""

    start: float
    stop: float


class _Reader:
    """Reads stretches of time from a file, each beginning no earlier than the one before."""

    def __init__(self, source: _Source, progress: Progress) -> None:
        self._path, self._parts = source.path, source.parts(progress)
        self._held: list[Part] = []

    def within(self, span: _Span) -> dict[str, Floats]:
        """The columns of the rows in this stretch, and of one more row on either side.

        Raises FileFormatError where the stretch has far more rows than the usual step between two rows allows.
        """
        while len(self._held) > 1 and self._held[1].columns["time_s"][0] < span.start:
            del self._held[0]
        while not self._held or self._held[-1].columns["time_s"][-1] <= span.stop:
            part = next(self._parts, None)
            if part is None:
                break
            if self._held and part.columns["time_s"][0] < span.start:
                self._held.clear()
            self._held.append(part)
            if sum(map(len, self._held)) > _MOST_HELD_ROWS:
                raise FileFormatError(
                    self._path,
                    f"{self._path} has more than {_MOST_HELD_ROWS} rows at about {span.start:.6g} s: "
                    "its time_s must increase",
                )
        columns = {name: np.concatenate([part.columns[name] for part in self._held]) for name in self._held[0].columns}
        time_s = columns["time_s"]
        first, last = int(np.searchsorted(time_s, span.start)), int(np.searchsorted(time_s, span.stop, "right"))
        return {name: values[max(0, first - 1) : last + 1] for name, values in columns.items()}

    def all_of(self, spans: Iterable[_Span]) -> dict[str, Floats]:
        """The columns of the rows in these stretches, each row once."""
        pieces: list[dict[str, Floats]] = []
        last_s = -np.inf
        for span in _merged(spans):
            found = self.within(span)
            new = found["time_s"] > last_s
            pieces.append({name: values[new] for name, values in found.items()})
            last_s = found["time_s"][-1]
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def _merged(spans: Iterable[_Span]) -> list[_Span]:
    """The same stretches in ascending order, without overlaps."""
    merged: list[_Span] = []
    for span in sorted(spans):
        if merged and span.start <= merged[-1].stop:
            merged[-1] = _Span(merged[-1].start, max(merged[-1].stop, span.stop))
        else:
            merged.append(span)
    return merged


class _Comparison:
    """Two files, at least one of which is long."""

    def __init__(self, estimate: _Source, reference: _Source, progress: Progress | None) -> None:
        self._sources = estimate, reference
        self._progress = progress or (lambda _: None)
        wanted = self._most_telling()
        self._scans = (
            _scan(estimate, wanted[0], self._share(0, 6)),
            _scan(reference, wanted[1], self._share(1, 6)),
        )

    def evaluate(self, window: Window) -> Evaluation:
        """The scores of all filters."""
        quantities, offset_s, remarks = self._compare_stretches()
        scores, without = self._score(quantities, offset_s, window)
        return Evaluation(scores, remarks + without)

    def _share(self, done: int, of: int) -> Progress:
        """The progress of one of `of` equal parts of the work, after `done` of them."""
        return lambda share: self._progress((done + share) / of)

    def _tables(self, ours: dict[str, Floats], theirs: dict[str, Floats]) -> tuple[Table, Table]:
        """Some rows of both files, with the usual step between the rows of the whole files."""
        wholes = [Whole(scan.rows, scan.interval_s, 0, 0) for scan in self._scans]
        return self._sources[0].table(ours, wholes[0]), self._sources[1].table(theirs, wholes[1])

    # ---- the offset between the clocks ----

    def _compare_stretches(self) -> tuple[dict[str, list[Quantity]], float, list[str]]:
        """The quantities of each filter that can be compared, the offset, and remarks; from some rows of both files."""
        near = self._find_lag()
        stamps = self._scans[0].coarse["time_s"]
        for scan in self._scans:
            scan.coarse.clear()
        tables = self._stretches(stamps[np.isfinite(stamps)], near)
        compared = pairs_of(*tables)
        offset_s, residual = common_offset(compared.values(), near)
        remarks = mismatches(*tables, compared, offset_s, residual)
        return {name: list(both.pairs) for name, both in compared.items()}, offset_s, remarks

    def _most_telling(self) -> tuple[list[str], list[str]]:
        """Columns of both files by which the lag is searched: of the filter with most estimates at the start."""
        ours, theirs = (
            source.table(next(source.parts(lambda _: None)).columns, Whole(0, 0.0, 0, 0)) for source in self._sources
        )
        found = {name: comparable(both) for name, both in pairs_of(ours, theirs).items()}
        known = {name: sum(np.isfinite(pair[0].value).sum() for pair in pairs) for name, pairs in found.items()}
        chosen = max(known, key=lambda name: known[name])
        columns = by_filter(ours.columns)[chosen]
        names = [name for q, name in columns.items() if q in SCORED]
        references = [name for name in theirs.columns if (part := split(name)) and part.quantity in (*columns, HEIGHT)]
        return ["time_s", *names], ["time_s", *references]

    def _find_lag(self) -> Lag | None:
        """About where the offset is; None where nothing can be compared."""
        ours, theirs = (
            source.table(scan.coarse, Whole(scan.rows, interval(scan.coarse["time_s"]), 0, 0))
            for source, scan in zip(self._sources, self._scans, strict=True)
        )
        (both,) = pairs_of(ours, theirs).values()
        pairs = comparable(both)
        return strongest_lag(pairs) if pairs else None

    def _stretches(self, stamps: Floats, near: Lag | None) -> tuple[Table, Table]:
        """Short stretches of the estimate, and of the reference at their instants with and without the lag.

        `stamps` are some of the estimate's stamps, at equal distances.
        """
        ours, theirs = self._scans
        length = _STRETCH_ROWS * min(ours.interval_s, theirs.interval_s)
        last = int(np.searchsorted(stamps, stamps[-1] - length))
        spans = [_Span(stamps[i], stamps[i] + length) for i in np.linspace(0, last, _STRETCHES).astype(np.int64)]
        margin = LONGEST_HOLE * max(ours.interval_s, theirs.interval_s) + (3 * near.step_s if near else 0.0)
        lags = {0.0, near.lag_s if near else 0.0}
        wanted = [_Span(span.start + lag_s - margin, span.stop + lag_s + margin) for span in spans for lag_s in lags]
        our_rows, their_rows = (_Reader(source, self._share(2 + i, 6)) for i, source in enumerate(self._sources))
        return self._tables(our_rows.all_of(spans), their_rows.all_of(wanted))

    # ---- scores ----

    def _score(
        self, quantities: Mapping[str, Collection[Quantity]], offset_s: float, window: Window
    ) -> tuple[list[Score], list[str]]:
        """Scores all filters over all rows, as `scores_of`."""
        starts = self._common_starts(quantities, offset_s)
        present = pairs_of(*self._tables(*(scan.presence for scan in self._scans)))
        instants = self._scans[self._sparser].rows
        paths = self._sources[0].path, self._sources[1].path
        scorers = {
            name: Scorer(
                name, paths, offset_s, window, instants, present[name].empty, starts[name],
                Thinner(instants, 2 * len(own), _KEPT_FOR_PICTURES),
            )
            for name, own in quantities.items()
        }  # fmt: skip
        for piece in self._pieces(offset_s, self._share(2, 3)):
            for name, both in piece.items():
                scorers[name].add(both)
        return scores_of(scorers.values())

    def _common_starts(self, quantities: Mapping[str, Collection[Quantity]], offset_s: float) -> dict[str, CommonStart]:
        """Of each filter. They are near the beginning of the files as a rule."""
        starts = {name: CommonStart(name, own) for name, own in quantities.items()}
        pieces = self._pieces(offset_s, lambda _: None)
        while not all(start.is_found for start in starts.values()) and (piece := next(pieces, None)) is not None:
            for name, both in piece.items():
                at = {q: paired(*pair, offset_s) for q, pair in both.pairs.items()}
                ours, theirs = ({q: values[side] for q, values in at.items()} for side in (0, 1))
                errors_of(name, ours, theirs, starts[name])
        pieces.close()
        return starts

    @property
    def _sparser(self) -> int:
        """Which of the two files has clearly fewer instants; the estimate if none has."""
        ours, theirs = self._scans
        return int(theirs.interval_s > SPARSER * ours.interval_s)

    def _pieces(self, offset_s: float, progress: Progress) -> Generator[dict[str, Compared]]:
        """What can be compared, piece by piece; each instant of the sparser file is in one of them."""
        other = 1 - self._sparser
        ahead_s = -offset_s if self._sparser else offset_s  # of the other file's clock
        margin = LONGEST_HOLE * self._scans[other].interval_s
        longest = max(_MOST_OTHER_ROWS * self._scans[other].interval_s, 1e-6)
        reader = _Reader(self._sources[other], lambda _: None)
        for part in self._sources[self._sparser].parts(progress):
            time_s = part.columns["time_s"]
            at, end = np.searchsorted(time_s, [-_FAR_S, _FAR_S]).tolist()
            while at < end:
                stop = min(end, at + _PIECE_ROWS, int(np.searchsorted(time_s, time_s[at] + longest, "right")))
                piece = {name: values[at:stop] for name, values in part.columns.items()}
                span = _Span(time_s[at] + ahead_s - margin, time_s[stop - 1] + ahead_s + margin)
                both = [piece, reader.within(span)]
                if self._sparser:
                    both.reverse()
                yield pairs_of(*self._tables(*both))
                at = stop
