"""Frozen sensors: readings that repeat to the last bit for longer than any live sensor does.

A live MPU-6050 has noise of several counts on every axis. A burst that repeats in all axes for 0.2 s comes from a
sensor that has stopped converting, or from a logger that repeats a stale buffer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.measurements import Floats

FROZEN_S = 0.2  # twice the longest hold of a logger over a slow sensor (0.1 s)


class FrozenDetector:
    """Marks frozen rows of a stream. The result does not depend on how the stream is cut into blocks."""

    def __init__(self) -> None:
        self._last: Floats | None = None
        self._since_s = np.nan

    def frozen(self, time_s: Floats, readings: Floats) -> NDArray[np.bool_]:
        """(N,) True where the readings (N, K) have repeated for FROZEN_S or more, at times (N,) s. NaN is not a repeat.

        The first FROZEN_S of a freeze cannot be distinguished from a slow logger and are not marked.
        """
        n = len(time_s)
        if n == 0:
            return np.zeros(0, dtype=np.bool_)
        before = np.full((1, readings.shape[1]), np.nan) if self._last is None else self._last[None]
        repeats = (np.concatenate([before, readings[:-1]]) == readings).all(axis=1)
        began = np.where(repeats, np.nan, time_s)
        if np.isnan(began[0]):
            began[0] = self._since_s
        last_change = np.maximum.accumulate(np.where(repeats, 0, np.arange(n)))
        since = began[last_change]
        self._last, self._since_s = readings[-1].copy(), float(since[-1])
        with np.errstate(invalid="ignore"):  # a stamp may be infinite
            return np.asarray(repeats & (time_s - since >= FROZEN_S), dtype=np.bool_)
