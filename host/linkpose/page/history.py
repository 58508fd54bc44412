"""The rows that the page draws: those of the last seconds, and the path so far."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from linkpose.sensors.measurements import Floats

SPAN_S = 20.0  # of the past that the charts show
POINT_INTERVAL_S = 0.05  # between two rows of a chart: closer ones share a pixel
PATH_POINTS = 2000  # of a path; when there are more, every second one is dropped


class History:
    """Rows as they arrive, thinned out in time, and all of the path (thinned out in number)."""

    def __init__(self, columns: Sequence[str]) -> None:
        self._most = round(SPAN_S / POINT_INTERVAL_S) + 1
        # Rows [start, end) are kept. At the end of the array, the kept rows move to its beginning. Each column is one
        # piece of memory: the charts read a few of them.
        self._rows: Floats = np.empty((4 * self._most, len(columns)), order="F")
        self._start = self._end = 0
        self._path: list[Floats] = []
        self._step = 1  # rows between two of the path
        self._count = 0

    def add(self, rows: Floats) -> None:
        """Adds rows (N, columns). A row replaces the one before when they are close in time."""
        kept: list[int] = []  # of these rows
        last = self._rows[max(self._start, self._end - 2) : self._end, 0].tolist()  # times of the last two
        before, newest = last if len(last) == 2 else (-math.inf, *(last or [-math.inf]))
        for at, time_s in enumerate(rows[:, 0].tolist()):
            if time_s - before < POINT_INTERVAL_S:
                newest = time_s
                if kept:
                    kept[-1] = at
                else:
                    self._rows[self._end - 1] = rows[at]
            else:
                before, newest = newest, time_s
                kept.append(at)
        for at in kept:
            self._append(rows[at])

    def _append(self, row: Floats) -> None:
        if self._end == len(self._rows):
            kept = self._rows[self._start : self._end].copy()
            self._start, self._end = 0, len(kept)
            self._rows[: self._end] = kept
        self._rows[self._end] = row
        self._end += 1
        self._start = max(self._start, self._end - self._most)
        if self._count % self._step == 0:
            self._path.append(row.copy())
        self._count += 1
        if len(self._path) > PATH_POINTS:
            self._path, self._step = self._path[::2], 2 * self._step

    def forget(self, columns: Sequence[int], since_s: float) -> None:
        """Takes out of these columns what is not older than `since_s`: a filter without its sensor only predicts."""
        rows = self._rows[self._start : self._end]
        rows[np.searchsorted(rows[:, 0], since_s) :, columns] = math.nan
        for row in reversed(self._path):
            if row[0] < since_s:
                break
            row[columns] = math.nan

    @property
    def newest(self) -> Floats | None:
        """The newest row (columns,)."""
        return self._rows[self._end - 1] if self._end else None

    def window(self) -> Floats:
        """The rows (N, columns) of the last SPAN_S seconds; a view that the next `add` may change."""
        rows: Floats = self._rows[self._start : self._end]
        return rows[int(np.searchsorted(rows[:, 0], rows[-1, 0] - SPAN_S)) :] if len(rows) else rows

    def path(self) -> Floats:
        """Rows (N, columns) along the whole path, with the newest as the last."""
        newest = [] if self.newest is None else [self.newest]
        return np.array([*self._path, *newest]).reshape(-1, self._rows.shape[1])


class Replay:
    """A table of rows with a place in it: the rows up to this place are drawn."""

    def __init__(self, values: Floats) -> None:
        """`values` (N ≥ 1, columns), the first column is the time (s)."""
        self.values = values
        self._end = len(values)

    @property
    def span_s(self) -> tuple[float, float]:
        """Time of the first and of the last row."""
        return float(self.values[0, 0]), float(self.values[-1, 0])

    def seek(self, time_s: float) -> None:
        """Goes to the last row that is not later than `time_s`."""
        self._end = max(1, int(np.searchsorted(self.values[:, 0], time_s, side="right")))

    @property
    def newest(self) -> Floats:
        """The row (columns,) at this place."""
        row: Floats = self.values[self._end - 1]
        return row

    def window(self) -> Floats:
        """The rows (N, columns) of the last SPAN_S seconds, thinned out, with the newest as the last."""
        times = self.values[: self._end, 0]
        first = int(np.searchsorted(times, times[-1] - SPAN_S))
        return _thinned(self.values[first : self._end], round(SPAN_S / POINT_INTERVAL_S))

    def path(self) -> Floats:
        """Rows (N, columns) along the path up to here, thinned out, with the newest as the last."""
        return _thinned(self.values[: self._end], PATH_POINTS)


def _thinned(rows: Floats, most: int) -> Floats:
    every = -(-len(rows) // most)
    return rows[::-1][:: max(every, 1)][::-1]
