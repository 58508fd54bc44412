"""The lowest and highest values of a run, and the median of their standard deviation, as the run goes on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from linkpose import quantities

if TYPE_CHECKING:
    from linkpose.sensors.measurements import Floats

ROWS = 1000  # of estimates that wait until their extremes are found at once; live blocks have a few rows
_OF_A_ROBOT = (quantities.X, quantities.Y)  # a link's filter has them too, where its yaw is known to a constant alone
_LISTED = (
    quantities.HEIGHT,
    quantities.ANGLE,
    *quantities.BALL_ANGLES,
    quantities.HEIGHT1,
    quantities.HEIGHT2,
    *_OF_A_ROBOT,
    quantities.HEADING,
)

# Bounds of the bins in which standard deviations are counted, in the unit of the column: 40 a decade.
_STD_EDGES = np.logspace(-9, 6, 601)

# (filter, quantity) -> (lowest, highest, median of σ), in the unit of the quantity's column.
Summary = dict[tuple[str, quantities.Quantity], tuple[float, float, float]]


class Extremes:
    """Lowest and highest value and the median of σ of heights, joint angles and poses of each filter, over all blocks.

    The median, not the root mean square: the σ of the first second would hide that of all others. It is that of a
    histogram, within 3 %. A heading counts whole turns, from its first value on: −180° and +180° of a robot that turns
    would mean nothing.
    """

    def __init__(self, columns: Sequence[str]) -> None:
        at = {column: index for index, column in enumerate(columns)}
        self._of = {
            (name, quantity): (at[found[quantity]], at.get(quantities.std_column(found[quantity]) or "", -1))
            for name, found in quantities.by_filter(columns).items()
            for quantity in _LISTED
            if quantity in found and (quantity not in _OF_A_ROBOT or quantities.HEADING in found)
        }
        self._low = dict.fromkeys(self._of, math.inf)
        self._high = dict.fromkeys(self._of, -math.inf)
        self._std_counts = {key: np.zeros(len(_STD_EDGES) + 1, np.int64) for key in self._of}
        self._last = dict.fromkeys(self._of, math.nan)
        self._waiting: list[Floats] = []  # blocks not yet in these
        self._waiting_rows = 0

    def add(self, estimates: Floats) -> None:
        """Adds a block of estimates (N, columns)."""
        self._waiting.append(estimates)
        self._waiting_rows += len(estimates)
        if self._waiting_rows >= ROWS:
            self._fold()

    def _fold(self) -> None:
        """Adds the waiting blocks at once: NumPy takes 0.3 ms for one row as for a thousand."""
        estimates = np.concatenate(self._waiting)
        self._waiting.clear()
        self._waiting_rows = 0
        for key, (value_at, std_at) in self._of.items():
            known = np.isfinite(estimates[:, value_at])
            if not known.any():
                continue
            values = self._continued(key, estimates[known, value_at])
            self._low[key] = min(self._low[key], float(values.min()))
            self._high[key] = max(self._high[key], float(values.max()))
            if std_at >= 0:
                std = estimates[known, std_at]
                places = np.searchsorted(_STD_EDGES, std[np.isfinite(std)])
                self._std_counts[key] += np.bincount(places, minlength=len(_STD_EDGES) + 1)

    def _continued(self, key: tuple[str, quantities.Quantity], values: Floats) -> Floats:
        """The values (N ≥ 1,), those of a heading without jumps by a whole turn, from the last one before on."""
        period = key[1].period
        if key[1] != quantities.HEADING or period is None:
            return values
        before = values[:1] if math.isnan(self._last[key]) else np.array([self._last[key]])
        unwrapped: Floats = np.unwrap(np.concatenate([before, values]), period=period)[1:]
        self._last[key] = float(unwrapped[-1])
        return unwrapped

    def summary(self) -> Summary:
        """The extremes of the quantities that had a value."""
        if self._waiting:
            self._fold()
        return {
            key: (low, self._high[key], self._median_std(key)) for key, low in self._low.items() if math.isfinite(low)
        }

    def _median_std(self, key: tuple[str, quantities.Quantity]) -> float:
        """NaN without any σ."""
        total = np.cumsum(self._std_counts[key])
        if not total[-1]:
            return math.nan
        at = int(np.searchsorted(total, 0.5 * total[-1]))
        return float(np.sqrt(_STD_EDGES[max(at - 1, 0)] * _STD_EDGES[min(at, len(_STD_EDGES) - 1)]))
