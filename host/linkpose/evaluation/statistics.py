"""Statistics of errors and of the standard deviations (σ) that belong to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from linkpose.sensors.measurements import Floats

# A verdict on σ: shares of errors within 2σ between which σ is right. A normal error has 95.4 %.
HONEST_SHARE = (0.90, 0.99)
_NORMAL_95 = 1.96  # 95 % of normal errors are within so many σ


@dataclass(frozen=True, slots=True)
class Statistics:
    """Of N errors, in their unit."""

    rows: int
    rmse: float
    mean: float  # with sign: the bias
    worst: float  # largest magnitude
    p95: float  # magnitude that 95 % of the errors stay below
    nees: float | None = None  # normalised estimation error squared: mean of (error/σ)², 1 where σ is right
    within_2sigma: float | None = None  # share of errors within ±2σ
    sigma_ratio: float | None = None  # actual 95 % magnitude of error/σ over a normal error's: 2 where σ is half

    @staticmethod
    def of(error: Floats, std: Floats | None = None, least_std: float = 0.0) -> Statistics:
        """Of the finite errors (N,) and their σ (N,), NaN where unknown.

        `least_std` is the resolution of σ in its file: a smaller one was rounded.
        """
        known = np.isfinite(error)
        errors = error[known]
        size = np.abs(errors)
        moments = (float(np.sqrt(np.mean(errors**2))), float(errors.mean()), float(size.max()))
        base = Statistics(len(errors), *moments, float(np.quantile(size, 0.95)))
        if std is None:
            return base
        paired = known & np.isfinite(std)
        sigma = np.maximum(std[paired], least_std)
        if not paired.any() or not (sigma > 0).all():
            return base
        normalised = np.abs(error[paired]) / sigma
        return Statistics(
            base.rows,
            *moments,
            base.p95,
            nees=float(np.mean(normalised**2)),
            within_2sigma=float(np.mean(normalised <= 2.0)),
            sigma_ratio=float(np.quantile(normalised, 0.95)) / _NORMAL_95,
        )

    def verdict(self) -> str | None:
        """One sentence on σ; None where there is no σ."""
        if self.within_2sigma is None or self.sigma_ratio is None:
            return None
        low, high = HONEST_SHARE
        share = f"{100 * self.within_2sigma:.0f} % of the errors are within ±2σ (95 % expected)"
        if self.within_2sigma < low:
            return f"σ is {self.sigma_ratio:.1f} times too small: {share}."
        if self.within_2sigma > high:
            return f"σ is {1 / max(self.sigma_ratio, 0.01):.1f} times too large: {share}."
        return f"σ is right: {share}."
