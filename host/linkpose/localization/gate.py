"""The innovation gate: a measurement is refused when its d² = νᵀ S⁻¹ ν is above the χ² quantile of its own degrees of
freedom.
"""

from __future__ import annotations

import functools
import math
import sys

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats, lower_cholesky, mahalanobis_squared


@functools.cache
def chi_square_quantile(probability: float, degrees: int) -> float:
    """The value below which a χ² variable with `degrees` degrees of freedom stays with this probability. Raises
    ValueError outside (0, 1).
    """
    if not 0.0 < probability < 1.0 or degrees < 1:
        raise ValueError(f"no χ² quantile for probability {probability} and {degrees} degrees of freedom")
    low, high = 0.0, 1.0
    while _chi_square_cdf(high, degrees) < probability:
        high *= 2.0
    while high - low > max(1e-12 * high, sys.float_info.min):  # the quantile of 1e-300 is no number that a float can be
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _chi_square_cdf(middle, degrees) < probability else (low, middle)
    return high


def _chi_square_cdf(value: float, degrees: int) -> float:
    """The regularised lower incomplete gamma function P(k/2, value/2) by its power series, all of whose terms are
    positive.
    """
    if value <= 0.0:
        return 0.0
    half, x = 0.5 * degrees, 0.5 * value
    term = total = 1.0 / half
    n = half
    while term > 1e-17 * total:
        n += 1.0
        term *= x / n
        total += term
    return min(1.0, total * math.exp(half * math.log(x) - x - math.lgamma(half)))


@compiled
def gate_blocks(innovation: Floats, covariance: Floats, block: int, threshold: float, d2: Floats) -> NDArray[np.int64]:
    """Fills `d2` for each block of `block` rows; returns the indices of the rows whose block passes."""
    keep = np.empty(innovation.shape[0], np.int64)
    kept = 0
    part, lower, residual = np.empty((block, block)), np.empty((block, block)), np.empty(block)
    for b in range(d2.shape[0]):
        first = b * block
        for i in range(block):
            residual[i] = innovation[first + i]
            for j in range(block):
                part[i, j] = covariance[first + i, first + j]
        d2[b] = mahalanobis_squared(residual, lower) if lower_cholesky(part, lower) else np.inf
        if d2[b] <= threshold:
            for i in range(first, first + block):
                keep[kept] = i
                kept += 1
    return keep[:kept]
