"""Reads a long table as a picture needs it: the extremes of every column, and rows at equal distances between them."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from linkpose.recording.table import LONGEST_HOLE, Progress, Table, TableFile, Whole
from linkpose.recording.textfile import Part
from linkpose.sensors.measurements import Floats

MOST_ROWS = 500_000  # of a table that is kept whole: 83 min at 100 Hz. Doubling it doubles the memory of a plot
# Rows at equal distances. They are at least four times as many as the extremes, so that the usual step between two kept
# rows is the distance. Doubling it doubles the memory of a plot, and a picture has a few thousand columns of pixels.
_REGULAR_ROWS = 240_000
_EXTREME_ROWS = 60_000


def read_thinned(path: Path, progress: Progress | None = None) -> Table:
    """The table of a file; of more than MOST_ROWS rows, those that a picture shows, with facts on the whole file.

    Kept are the rows with the least and the largest value of each column in each of equal parts, the first row without
    a value there, the rows beside gaps, and rows at equal distances. Raises as `read_table` does.
    """
    with contextlib.closing(TableFile(path)) as file:
        parts: list[Part] = []
        source = file.parts(progress)
        rows = 0
        for part in source:
            parts.append(part)
            rows += len(part)
            if rows > MOST_ROWS:
                return _thin(file, parts, source)
        return file.table(parts)


def _thin(file: TableFile, parts: list[Part], rest: Iterator[Part]) -> Table:
    file.require("time_s")
    total = sum(map(len, parts)) / max(file.share_read, 1e-6)
    thinner = Thinner(total, len(file.names))
    kept = []
    while parts:
        kept.append(thinner.thin(parts.pop(0)))
    kept += [thinner.thin(part) for part in rest]
    return file.table(kept, thinner.whole)


class Thinner:
    """Selects rows of consecutive parts: some at equal distances, and those with the extremes of each column."""

    def __init__(self, total: float, columns: int, share: float = 1.0) -> None:
        """For about `total` rows of `columns` columns; `share` of the usual number of rows is kept."""
        self._distance = max(1, math.ceil(total / (share * _REGULAR_ROWS)))
        windows = max(1, int(share * _EXTREME_ROWS) // (2 * columns))
        self._window = max(2, math.ceil(total / windows))
        self._rows = self._gaps = self._lost = 0
        self._interval_s = 0.0
        self._last_s = math.nan

    @property
    def whole(self) -> Whole:
        """Facts on all parts so far."""
        return Whole(self._rows, self._interval_s, self._gaps, self._lost)

    def thin(self, part: Part) -> Part:
        """The rows of a part that are kept."""
        time_s = part.columns["time_s"]
        regular = np.arange(-self._rows % self._distance, len(part), self._distance)
        found = [regular, self._beside_gaps(time_s)]
        found += [self._extremes(values) for name, values in part.columns.items() if name != "time_s"]
        at = np.unique(np.concatenate(found))
        self._rows += len(part)
        return Part({name: values[at] for name, values in part.columns.items()}, part.first_line)

    def _beside_gaps(self, time_s: Floats) -> NDArray[np.intp]:
        """The rows before and after each gap; counts the gaps."""
        steps = np.diff(time_s, prepend=self._last_s)
        if not self._interval_s:
            positive = steps[steps > 0]
            self._interval_s = float(np.median(positive)) if len(positive) else 0.0
        after = np.flatnonzero(steps > LONGEST_HOLE * self._interval_s) if self._interval_s else np.empty(0, np.intp)
        self._gaps += len(after)
        self._lost += int(np.maximum(1, np.rint(steps[after] / self._interval_s) - 1).sum()) if len(after) else 0
        self._last_s = float(time_s[-1])
        return np.concatenate([np.maximum(after - 1, 0), after])

    def _extremes(self, values: Floats) -> NDArray[np.intp]:
        """The first rows with the least, the largest and no value in each window; the last window may be shorter."""
        size = -(-len(values) // self._window) * self._window
        padded = np.full(size, np.nan)
        padded[: len(values)] = values
        windows = padded.reshape(-1, self._window)
        missing = ~np.isfinite(windows)
        start = np.arange(0, size, self._window)
        least = start + np.where(missing, np.inf, windows).argmin(axis=1)
        largest = start + np.where(missing, -np.inf, windows).argmax(axis=1)
        none = (start + missing.argmax(axis=1))[missing.any(axis=1)]
        found = np.concatenate([least, largest, none])
        return found[found < len(values)]
