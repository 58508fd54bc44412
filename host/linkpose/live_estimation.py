"""Estimates of a live run, in which filters may become ready while measurements arrive already."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from linkpose.estimation import Estimator, side_by_side
from linkpose.precompile import TEXT
from linkpose.sensors.measurements import Floats, Measurements


class LiveRows(NamedTuple):
    """What a live run shows and writes after a block."""

    complete: Floats  # (N, columns) rows that all filters have processed, in order, each one once
    newest: Floats  # (columns,) of the last sample, NaN for filters that are not ready; empty after an empty block
    caught_up: Floats  # (M, columns) all rows so far if a filter has just caught up with them; otherwise M = 0


class LiveEstimator:
    """An estimator whose filters may become ready while measurements arrive already.

    A filter that is not ready yet catches up from the buffered measurements, so every estimate is the same, to the last
    digit, as if all filters had run from the first sample on. Rows are complete when all filters have processed them.
    """

    def __init__(self, estimator: Estimator, is_ready: Callable[[str], bool]) -> None:
        """`is_ready(name)` is True once that filter (or precompile.TEXT) is compiled, and stays True."""
        self._estimator, self._filters = estimator, estimator.filters
        self._width = [len(f.columns) for f in estimator.filters]
        self._is_ready = is_ready
        self._blocks: list[Measurements] = []  # not yet processed by all filters
        self._results: list[list[Floats]] = [[] for _ in self._filters]  # of these blocks, filter by filter

    def process(self, block: Measurements) -> LiveRows:
        """Takes the next block, which may be empty."""
        if len(block) and not self._blocks and self._are_all_ready():
            rows = self._estimator.process(block)
            return LiveRows(rows, rows[-1], rows[:0])
        if len(block):
            self._blocks.append(block)
        has_caught_up = False
        for f, results in zip(self._filters, self._results, strict=True):
            waiting = self._blocks[len(results) :]
            if waiting and self._is_ready(f.name):
                has_caught_up |= len(waiting) > 1
                results.extend(f.process(each) for each in waiting)
        caught_up = self._rows(0, len(self._blocks) if has_caught_up else 0)
        complete = self._take_complete()
        last = self._rows(len(self._blocks) - 1, len(self._blocks)) if self._blocks else complete
        return LiveRows(complete, last[-1] if len(block) else np.empty(0), caught_up)

    def _are_all_ready(self) -> bool:
        return self._is_ready(TEXT) and all(self._is_ready(f.name) for f in self._filters)

    def finish(self) -> Floats:
        """The rows that were not complete yet. All filters must be ready, or are compiled now."""
        self._is_ready = lambda _: True
        return self.process(Measurements.from_imu(np.empty(0), np.empty((0, 3)), np.empty((0, 3)))).complete

    def _take_complete(self) -> Floats:
        """The rows that all filters have processed; they are kept no longer."""
        count = min((len(results) for results in self._results), default=0)
        if not count or not self._is_ready(TEXT):
            return self._rows(0, 0)
        rows, first = self._rows(0, count), 0
        for block in self._blocks[:count]:
            self._estimator.count_excluded(block, rows[first : first + len(block)])
            first += len(block)
        del self._blocks[:count]
        for results in self._results:
            del results[:count]
        return rows

    def _rows(self, start: int, end: int) -> Floats:
        """Rows (N, columns) of the blocks from `start` to `end`, with NaN for filters that have not processed them."""
        rows = [
            side_by_side(
                block.time_s,
                [
                    results[at] if at < len(results) else np.full((len(block), width), np.nan)
                    for width, results in zip(self._width, self._results, strict=True)
                ],
            )
            for at, block in enumerate(self._blocks[start:end], start)
        ]
        if len(rows) == 1:
            return rows[0]
        return np.concatenate(rows) if rows else np.empty((0, 1 + sum(self._width)))
