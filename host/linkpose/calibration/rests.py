"""Stretches of a recording in which the sensor lies still."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.measurements import Floats, Measurements

_WINDOW_S = 0.5
_SHORTEST_S = 1.0
# Largest standard deviations within a window at rest: a few times the noise of a poor part.
_GYRO_STD_RAD_S = 0.01
_ACCEL_STD_M_S2 = 0.15


def find_rests(block: Measurements) -> list[slice]:
    """The rests of a second or more, without a window at either end, in which a hand may still touch the sensor."""
    step = np.median(np.diff(block.time_s)) if len(block) > 1 else 0.0
    width = round(float(_WINDOW_S / step)) if step > 0 else 0
    if width < 5 or len(block) < 3 * width:
        return []
    still = _scatter(block.gyro_rad_s, width) < _GYRO_STD_RAD_S
    still &= _scatter(block.accel_m_s2, width) < _ACCEL_STD_M_S2
    edges = np.diff(np.concatenate([[0], still.astype(np.int8), [0]]))
    found = []
    for first, end in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        # Window k covers samples k … k + width − 1; the samples of the first and the last window are left out.
        rest = slice(int(first) + width, int(end) - 1)
        if rest.stop - rest.start >= _SHORTEST_S / step:
            found.append(rest)
    return found


def _scatter(values: Floats, width: int) -> Floats:
    """Largest standard deviation of the three axes in each window of `width` samples: (N − width + 1,); NaN is inf."""
    finite = values[np.isfinite(values).all(axis=1)]
    centred = values - (np.median(finite, axis=0) if len(finite) else 0.0)
    ones: NDArray[np.float64] = np.ones(width) / width
    worst = np.zeros(len(values) - width + 1)
    for axis in centred.T:
        mean, square = np.convolve(axis, ones, "valid"), np.convolve(axis**2, ones, "valid")
        worst = np.maximum(worst, np.sqrt(np.maximum(square - mean**2, 0.0)))
    return np.where(np.isfinite(worst), worst, np.inf)
