"""The mice that filters leave out, as live views show them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from linkpose import quantities

if TYPE_CHECKING:
    from linkpose.sensors.measurements import Floats


class Exclusions:
    """The mice that a filter leaves out, and since when."""

    def __init__(self, columns: Sequence[str]) -> None:
        """`columns` are those of the estimates."""
        of_filters = quantities.by_filter(columns).values()
        self._at = [columns.index(of[quantities.EXCLUDED]) for of in of_filters if quantities.EXCLUDED in of]
        self._since_s: dict[int, float] = {}

    def follow(self, rows: Floats) -> None:
        """Takes the next rows (N ≥ 1, columns)."""
        if not self._at:
            return
        masks = np.bitwise_or.reduce(np.nan_to_num(rows[:, self._at]).astype(np.int64), axis=1)
        since_s = {}
        for mouse in (mouse for mouse in range(1, 9) if masks[-1] >> (mouse - 1) & 1):
            included = np.flatnonzero((masks >> (mouse - 1) & 1) == 0)
            if len(included):
                since_s[mouse] = float(rows[included[-1] + 1, 0])
            else:
                since_s[mouse] = self._since_s.get(mouse, float(rows[0, 0]))
        self._since_s = since_s

    @property
    def names(self) -> set[str]:
        """The sensors that are left out: mouse1, ..."""
        return {f"mouse{mouse}" for mouse in self._since_s}

    def lines(self) -> list[str]:
        """One line for each mouse that is left out."""
        return [
            f"mouse {mouse} LEFT OUT since {since:.1f} s (disagrees)" for mouse, since in sorted(self._since_s.items())
        ]
