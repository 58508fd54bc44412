"""Statistics of errors and of the standard deviations (σ) that belong to them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from linkpose.sensors.measurements import Floats

_HIGH = 0.95  # the quantile of the magnitudes
# The largest magnitudes are selected when their number exceeds the needed one by this factor. Doubling it doubles that
# memory, and halves the number of selections.
_SURPLUS = 1.25
# A verdict on σ: shares of errors within 2σ between which σ is right. A normal error has 95.4 %.
HONEST_SHARE = (0.90, 0.99)
# NEES beyond which some errors are far outside although the share is not too low. σ of the least such share, 1.2 times
# too small, has 1.5 with normal errors. Doubled, an error of 20σ in 100 is still named.
_FAR_NEES = 2.0
# Errors so many σ large are far outside: one normal error in 16 000. A constant error of 1.5σ has a NEES of 2.3, too.
_FAR_RATIO = 4.0
_ROUNDING = 1.001  # that two rounded files differ by, in units of the last digit, with some for binary fractions
_NORMAL_95 = 1.96  # 95 % of normal errors are within this many σ
# The same for the length of a normal error with three equal components, where σ² is the sum of their variances:
# √(7.815 / 3), χ² with three degrees of freedom. 99.3 % of such errors are within 2σ.
_NORMAL_95_OF_THREE = 1.614


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
    worst_ratio: float | None = None  # largest magnitude of error/σ

    @staticmethod
    def of(error: Floats, std: Floats | None = None, least_std: float = 0.0) -> Statistics:
        """Of the finite errors (N,), at least one, and their σ (N,), NaN where unknown.

        `least_std` is the resolution of σ in its file: a smaller one was rounded and counts as `least_std`. A row with
        such a σ whose error is within the rounding, too, has no part in NEES and shares: its quantity is fixed by
        definition, as the yaw of the first row.
        """
        collected = Collector(len(error), least_std)
        collected.add(error, std)
        return collected.statistics()

    def verdict(self, *, of_three: bool = False) -> str | None:
        """One sentence on σ; None where there is no σ.

        `of_three`: the error is the length of a vector with three components, and σ² the sum of their variances, as of
        a rotation. With a right σ, 95 % (all in one component) to 99 % (equal components) of such errors are within 2σ.
        """
        if self.within_2sigma is None or self.sigma_ratio is None or self.nees is None:
            return None
        low, high = HONEST_SHARE
        expected = "95 to 99" if of_three else "95"
        share = f"{100 * self.within_2sigma:.0f} % of the errors are within ±2σ ({expected} % expected)"
        if self.within_2sigma < low:
            return f"σ is {self.sigma_ratio:.1f} times too small: {share}."
        times = (_NORMAL_95_OF_THREE / _NORMAL_95 if of_three else 1.0) / max(self.sigma_ratio, 0.01)
        found = f"{times:.1f} times too large" if self.within_2sigma > high and times >= 1.05 else "right"
        if self.nees > _FAR_NEES and self.worst_ratio is not None and self.worst_ratio > _FAR_RATIO:
            far = f"single errors are far outside, up to {self.worst_ratio:.3g}σ"
            return f"σ is {found} for most errors: {share}, but {far}."
        return f"σ is {found}: {share}."


def normalised_errors(error: Floats, std: Floats, least_std: float) -> Floats:
    """error/σ of the rows (N,) that have both, without those fixed by definition: see `Statistics.of`."""
    is_rounded = (std < least_std) | (std == 0)
    is_fixed = is_rounded & (np.abs(error) <= _ROUNDING * least_std)
    paired = np.isfinite(error) & np.isfinite(std) & ~is_fixed
    sigma = np.maximum(std[paired], least_std)
    with np.errstate(divide="ignore"):
        return np.where(sigma > 0, error[paired] / sigma, np.inf)


class Collector:
    """Collects errors block by block; its memory does not depend on the length of a block."""

    def __init__(self, most: int, least_std: float = 0.0) -> None:
        """Of at most `most` errors in all; `least_std` as for `Statistics.of`."""
        self.rows = 0  # finite errors so far
        self._least_std = least_std
        self._sum = self._squares = 0.0
        self._size = _Largest(most)
        self._paired = self._within = 0
        self._normalised_squares = 0.0
        self._normalised = _Largest(most)
        self._is_positive = True  # each σ

    def add(self, error: Floats, std: Floats | None = None) -> None:
        """The next errors (N,), and their σ (N,)."""
        known = np.isfinite(error)
        errors = error[known]
        self.rows += len(errors)
        self._sum += float(errors.sum())
        self._squares += float((errors**2).sum())
        self._size.add(np.abs(errors))
        if std is None or not self._is_positive:
            return
        normalised = np.abs(normalised_errors(error, std, self._least_std))
        self._is_positive = bool(np.isfinite(normalised).all())
        if self._is_positive:
            self._paired += len(normalised)
            self._within += int(np.count_nonzero(normalised <= 2.0))
            self._normalised_squares += float((normalised**2).sum())
            self._normalised.add(normalised)

    def statistics(self) -> Statistics:
        """Of all errors so far, at least one."""
        n, paired = self.rows, self._paired
        base = Statistics(
            n, float(np.sqrt(self._squares / n)), self._sum / n, self._size.largest, self._size.quantile()
        )
        if not paired or not self._is_positive:
            return base
        return replace(
            base,
            nees=self._normalised_squares / paired,
            within_2sigma=self._within / paired,
            sigma_ratio=self._normalised.quantile() / _NORMAL_95,
            worst_ratio=self._normalised.largest,
        )


class _Largest:
    """The largest of many values: enough of them for the quantile _HIGH."""

    def __init__(self, most: int) -> None:
        """Of at most `most` values in all."""
        self._needed = max(1, most - int(_HIGH * max(0, most - 1)))
        self._held: Floats = np.empty(int(_SURPLUS * self._needed) + 1)  # one piece of memory for a whole run
        self._size = self._count = 0
        self._least = -np.inf  # smaller values are not among the largest

    def add(self, values: Floats) -> None:
        """The next values."""
        self._count += len(values)
        values = values[values > self._least]
        while len(values):
            taken = values[: len(self._held) - self._size]
            self._held[self._size : self._size + len(taken)] = taken
            self._size += len(taken)
            values = values[len(taken) :]
            if self._size == len(self._held):
                self._sort_out()
                values = values[values > self._least]

    @property
    def largest(self) -> float:
        """Of all values."""
        return float(self._held[: self._size].max())

    def quantile(self) -> float:
        """The quantile _HIGH of all values, linear between two of them."""
        values = np.sort(self._held[: self._size])
        place = _HIGH * (self._count - 1) - (self._count - len(values))
        low = int(place)
        high = min(low + 1, len(values) - 1)
        return float(values[low] + (place - low) * (values[high] - values[low]))

    def _sort_out(self) -> None:
        """Keeps the largest values only."""
        surplus = self._size - self._needed
        self._held.partition(surplus)
        self._held[: self._needed] = self._held[surplus:].copy()
        self._size, self._least = self._needed, float(self._held[: self._needed].min())
