"""The lowest and highest height of a run, and the RMS of its standard deviation, as the run goes on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from linkpose import quantities

if TYPE_CHECKING:
    from linkpose.sensors.measurements import Floats

BLOCKS = 250  # of estimates whose extremes are found at once


class Extremes:
    """Lowest and highest height and the RMS of σ of each filter, over all blocks."""

    def __init__(self, columns: Sequence[str]) -> None:
        at = {column: index for index, column in enumerate(columns)}
        self._of = {
            name: (at[found[quantities.HEIGHT]], at.get(quantities.std_column(found[quantities.HEIGHT]) or "", -1))
            for name, found in quantities.by_filter(columns).items()
            if quantities.HEIGHT in found
        }
        self._low = dict.fromkeys(self._of, math.inf)
        self._high = dict.fromkeys(self._of, -math.inf)
        self._squares = dict.fromkeys(self._of, 0.0)
        self._count = dict.fromkeys(self._of, 0)
        self._waiting: list[Floats] = []  # blocks not yet in these

    def add(self, estimates: Floats) -> None:
        """Adds a block of estimates (N, columns)."""
        self._waiting.append(estimates)
        if len(self._waiting) >= BLOCKS:
            self._fold()

    def _fold(self) -> None:
        """Adds the waiting blocks at once: NumPy takes 0.3 ms for one row as for a thousand."""
        estimates = np.concatenate(self._waiting)
        self._waiting.clear()
        for name, (value_at, std_at) in self._of.items():
            known = np.isfinite(estimates[:, value_at])
            if not known.any():
                continue
            self._low[name] = min(self._low[name], float(estimates[known, value_at].min()))
            self._high[name] = max(self._high[name], float(estimates[known, value_at].max()))
            if std_at >= 0:
                self._squares[name] += float(np.nansum(estimates[known, std_at] ** 2))
                self._count[name] += int(known.sum())

    def summary(self) -> dict[str, tuple[float, float, float]]:
        """Filter -> (lowest, highest, RMS of σ), of filters that estimated a height."""
        if self._waiting:
            self._fold()
        return {
            name: (
                low,
                self._high[name],
                math.sqrt(self._squares[name] / self._count[name]) if self._count[name] else math.nan,
            )
            for name, low in self._low.items()
            if math.isfinite(low)
        }
