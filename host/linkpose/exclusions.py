"""The mice that filters leave out: their counts for the summary of a run, and their times for live views."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from linkpose import quantities
from linkpose.sensors.health import LEFT_OUT

if TYPE_CHECKING:
    from linkpose.sensors.measurements import Floats, Measurements


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

    def lines(self, faulty: Collection[str] = ()) -> list[str]:
        """One line for each mouse that is left out although it answers; `faulty` are those that do not: mouse1, ..."""
        return [
            f"mouse {mouse} LEFT OUT since {since:.1f} s (disagrees)"
            for mouse, since in sorted(self._since_s.items())
            if f"mouse{mouse}" not in faulty
        ]


_LONGEST_STEP_S = 0.1  # the longest time that one sample counts for, where others were lost


class ExcludedMice:
    """The mice whose valid counts a filter excluded.

    For each: samples, time of the first one and total time (s), and whether it is excluded at the last sample.
    """

    def __init__(self, estimator_columns: Sequence[str] = ()) -> None:
        """`estimator_columns` are those of the estimates that `count` takes."""
        self.columns = [
            at for at, name in enumerate(estimator_columns) if name.endswith(f"_{quantities.EXCLUDED.name}")
        ]
        self.samples: dict[str, int] = {}  # "mouse1", ... -> samples
        self.first_s: dict[str, float] = {}
        self.total_s: dict[str, float] = {}
        self.now: set[str] = set()
        self._last_s = math.nan

    def count(self, block: Measurements, estimates: Floats) -> None:
        """Count the exclusions in the estimates (N, columns) of a block of N samples."""
        if self.columns:
            masks = np.nan_to_num(estimates[:, self.columns]).astype(np.int64)
            self.add(block, np.bitwise_or.reduce(masks, axis=1))

    def add(self, block: Measurements, masks: NDArray[np.int64]) -> None:
        """Count the exclusions in bit masks (N,) of the samples of a block; bit 0 is mouse 1."""
        if not len(block):
            return
        last_s, self._last_s = self._last_s, float(block.time_s[-1])
        self.now = set()
        if not masks.any():
            return
        step_s = np.clip(np.nan_to_num(np.diff(block.time_s, prepend=last_s)), 0.0, _LONGEST_STEP_S)
        valid = np.isfinite(block.mice_counts).all(axis=2)
        excluded = valid & (masks[:, None] >> np.arange(valid.shape[1]) & 1 != 0)
        for port in np.flatnonzero(excluded.any(axis=0)).tolist():
            name = f"mouse{port + 1}"
            self.samples[name] = self.samples.get(name, 0) + int(excluded[:, port].sum())
            self.total_s[name] = self.total_s.get(name, 0.0) + float(step_s[excluded[:, port]].sum())
            self.first_s.setdefault(name, float(block.time_s[np.argmax(excluded[:, port])]))
            if excluded[-1, port]:
                self.now.add(name)

    def added_to(self, sensors: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        """Health of sensors with the number of excluded samples; the state is "left out" while a mouse is excluded."""
        merged = dict(sensors)
        for name, samples in self.samples.items():
            if name in merged:
                of = merged[name] | {"left_out": merged[name].get("left_out", 0) + samples}
                merged[name] = of | {"state": LEFT_OUT} if name in self.now and of["state"] == "ok" else of
        return merged
