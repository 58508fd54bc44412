"""Stretches of a recording in which the sensor lies still."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.measurements import Floats, Measurements

_WINDOW_S = 0.5
_SHORTEST_S = 1.0
# Largest standard deviations within a window at rest: a few times the noise of a poor part.
_GYRO_STD_RAD_S = 0.01
_ACCEL_STD_M_S2 = 0.15


class Stillness(NamedTuple):
    """How still a recording is at the stillest: of windows of half a second, the one that is nearest to a rest."""

    accel_std_m_s2: float
    gyro_std_rad_s: float
    longest_s: float  # without a window that moves


def find_rests(block: Measurements) -> list[slice]:
    """The rests of a second or more, without a window at either end, in which a hand may still touch the sensor."""
    step, width = _window(block)
    if not width:
        return []
    found = []
    for first, end in _still_windows(_scatter(block.gyro_rad_s, width), _scatter(block.accel_m_s2, width)):
        # Window k covers samples k … k + width − 1; the samples of the first and the last window are left out.
        rest = slice(first + width, end - 1)
        if rest.stop - rest.start >= _SHORTEST_S / step:
            found.append(rest)
    return found


def stillness(block: Measurements) -> Stillness | None:
    """Of a recording without a rest; None where it is too short, or has no readings."""
    step, width = _window(block)
    if not width:
        return None
    gyro, accel = _scatter(block.gyro_rad_s, width), _scatter(block.accel_m_s2, width)
    at = int(np.argmin(np.maximum(gyro / _GYRO_STD_RAD_S, accel / _ACCEL_STD_M_S2)))
    if not np.isfinite(gyro[at] + accel[at]):
        return None
    longest = max((end - first + width - 1 for first, end in _still_windows(gyro, accel)), default=0)
    return Stillness(float(accel[at]), float(gyro[at]), float(longest * step))


def _window(block: Measurements) -> tuple[float, int]:
    """Time between samples (s), and the number of samples in a window; 0 where the block is too short for three."""
    step = float(np.median(np.diff(block.time_s))) if len(block) > 1 else 0.0
    width = round(_WINDOW_S / step) if step > 0 else 0
    return step, 0 if width < 5 or len(block) < 3 * width else width


def _still_windows(gyro: Floats, accel: Floats) -> list[tuple[int, int]]:
    """First and end of each run of windows at rest, by their scatter (N,)."""
    still = (gyro < _GYRO_STD_RAD_S) & (accel < _ACCEL_STD_M_S2)
    edges = np.diff(np.concatenate([[0], still.astype(np.int8), [0]]))
    return [(int(a), int(b)) for a, b in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True)]


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
