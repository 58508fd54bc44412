"""Covariances of motion and of range measurement: adaptive, equations (13) to (15), and with off-diagonal elements,
(16) and (17).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.localization.linalg import Floats
from linkpose.localization.options import NoiseModel

NEAREST = (
    0.01  # of the mean range: an adaptive variance takes no range for shorter, as a variance of 0 is no covariance
)


@dataclass(frozen=True, slots=True)
class RangeNoise:
    """How the variance of a range r_i follows from the range, and how ranges taken at one instant correlate.

    fixed     σ_i² = σ²
    adaptive  σ_i² = η (r_i / r̄) σ², r̄ the mean of the measured ranges, (13) to (15)
    affine    σ_i² = σ² + (k r_i)², a rangefinder's data-sheet form
    """

    model: NoiseModel = "fixed"
    std_m: float = 0.1  # σ
    eta: float = 1.0
    growth: float = 0.02  # k, metres per metre
    correlation: float = 0.0  # ρ: R_ij = ρ σ_i σ_j, (17)

    def variances(self, ranges_m: Floats, mean_range_m: float) -> Floats:
        """σ_i² (m²) of ranges (m)."""
        if self.model == "adaptive":
            ratio = (
                np.maximum(ranges_m, NEAREST * mean_range_m) / mean_range_m
                if mean_range_m > 0
                else np.ones_like(ranges_m)
            )
            return np.asarray(self.eta * self.std_m**2 * ratio)
        if self.model == "affine":
            return np.asarray(self.std_m**2 + (self.growth * ranges_m) ** 2)
        return np.full(len(ranges_m), self.std_m**2)

    def covariance(self, ranges_m: Floats, mean_range_m: float) -> Floats:
        """R (m, m) of ranges (m) taken at one instant. The correlation has been checked by `check_correlation`."""
        return equicorrelated(np.sqrt(self.variances(ranges_m, mean_range_m)), self.correlation)


def equicorrelated(std: Floats, correlation: float) -> Floats:
    """The covariance with these standard deviations and one correlation between any two."""
    covariance = correlation * np.outer(std, std)
    np.fill_diagonal(covariance, std * std)
    return covariance


def check_correlation(correlation: float, size: int, name: str) -> None:
    """Raises LinkposeError where a matrix of this size with this correlation off its diagonal would not be positive
    definite.
    """
    size = max(size, 2)
    lowest = -1.0 / (size - 1)
    if not lowest < correlation < 1.0:
        raise LinkposeError(
            f"{name} {correlation:g} makes the {size} x {size} covariance not positive definite, "
            f"so it has no Cholesky factor; choose a value above {lowest:.3g} and below 1"
        )
