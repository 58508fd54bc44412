"""Allan deviation of a sensor at rest, and the noise coefficients that explain it.

A reading at rest is white noise of density N, flicker (bias instability B) and a random walk K of the bias. Its Allan
variance over intervals τ is

    σ²(τ) = N² / τ + (2 ln 2 / π) B² + K² τ / 3

Sources: [IEEE-952], annex C, for the model and for B = min σ / √(2 ln 2 / π); [SP1065] for the overlapping estimator
and its equivalent degrees of freedom.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

FLICKER = math.sqrt(2 * math.log(2) / math.pi)  # 0.664: least Allan deviation of flicker noise over B
_PER_OCTAVE = 6  # averaging times in the table
# Longest interval, as a share of the record. At 1/9 the deviation has a relative standard deviation of 20 %; doubling
# it would add points that scatter by 35 %.
_LONGEST_SHARE = 1 / 9
_FEWEST_AVERAGED = 4  # samples: over fewer, quantisation and the low-pass filter distort the deviation
# Deviations at τ and 2τ share samples: the coefficients' variances are this many times those of independent ones. From
# 240 simulated records, in which (found − true) / σ then has a standard deviation of 0.8 to 1.
_CORRELATED = 2.0
_PASSES = 5  # of the weighted fit, whose weights follow from the fitted curve


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Coefficients of one axis, in its unit u (rad/s or m/s²)."""

    density: float  # N, u/√Hz
    density_std: float
    instability: float  # B, u: least Allan deviation / 0.664
    instability_at_s: float  # τ of the least deviation
    instability_is_bound: bool  # the deviation still falls at the longest τ: B is this or less
    walk: float | None  # K, u/√s; None where the record does not show it
    walk_std: float


def averaging_counts(size: int, rate_hz: float) -> Integers:
    """Numbers of samples to average over, in equal ratios and with 1 s among them, for `size` samples: (K,)."""
    most = max(int(size * _LONGEST_SHARE), 1)
    steps = np.arange(0, _PER_OCTAVE * math.log2(most) + 1)
    counts = np.rint(2 ** (steps / _PER_OCTAVE)).astype(np.int64)
    second = round(rate_hz)
    return np.unique(np.append(counts, second if second <= most else 1))


def allan_deviation(values: Floats, counts: Integers) -> Floats:
    """Overlapping Allan deviation of equally spaced readings (N,) over `counts` samples (K,): (K,), their unit."""
    sums = np.concatenate([[0.0], np.cumsum(values - values.mean())])
    deviations = np.empty(len(counts))
    for at, m in enumerate(counts.tolist()):
        second = sums[2 * m :] - 2 * sums[m:-m] + sums[: -2 * m]
        deviations[at] = math.sqrt(float(np.mean(second**2)) / 2) / m
    return deviations


def fit_noise(values: Floats, rate_hz: float, least_tau_s: float) -> NoiseModel:
    """Coefficients of the readings (N,) of one axis, from intervals of `least_tau_s` on.

    The fit uses intervals that double, which are nearly independent, weighted by their degrees of freedom.
    """
    least = max(_FEWEST_AVERAGED, math.ceil(least_tau_s * rate_hz))
    longest = int(len(values) * _LONGEST_SHARE)
    counts = least * 2 ** np.arange(0, max(int(math.log2(max(longest / least, 1.0))), 2) + 1)
    tau = counts / rate_hz
    variance = allan_deviation(values, counts) ** 2
    terms = np.column_stack([1 / tau, np.full(len(tau), FLICKER**2), tau / 3])
    relative = np.sqrt(2 / _degrees_of_freedom(len(values), counts))
    squares, spread = _non_negative(terms, variance, relative)
    density = math.sqrt(max(squares[0], 1e-30))
    walk = math.sqrt(squares[2])
    walk_std = math.sqrt(spread[2]) / (2 * max(walk, math.sqrt(math.sqrt(spread[2]))))
    table = averaging_counts(len(values), rate_hz)
    table = table[table >= least]
    deviation = allan_deviation(values, table)
    at = int(np.argmin(deviation))
    return NoiseModel(
        density,
        math.sqrt(spread[0]) / (2 * density),
        float(deviation[at]) / FLICKER,
        float(table[at]) / rate_hz,
        bool(table[at] > table[-1] / 2),
        walk if squares[2] > 2 * math.sqrt(spread[2]) else None,
        walk_std,
    )


def _degrees_of_freedom(size: int, counts: Integers) -> Floats:
    """Equivalent degrees of freedom for a random walk, the fewest of all noise types. Source: [SP1065], table 5."""
    phases, m = size + 1, counts.astype(np.float64)
    edf = (phases - 2) / m * ((phases - 1) ** 2 - 3 * m * (phases - 1) + 4 * m**2) / (phases - 3) ** 2
    return np.maximum(edf, 1.0)


def _non_negative(terms: Floats, variance: Floats, relative: Floats) -> tuple[Floats, Floats]:
    """Least squares with coefficients ≥ 0 (3,) and their variances (3,); the first is always in the fit.

    Each variance is known to `relative` times the fitted one. Of all subsets of terms, the best whose coefficients are
    positive counts; the spread is that of the full set, so that an absent term has the σ with which it is excluded.
    """
    weight = 1 / (relative * variance)
    best = np.zeros(3)
    for _ in range(_PASSES):
        least = math.inf
        for others in itertools.product([False, True], repeat=2):
            use = np.array([True, *others])
            scaled = terms[:, use] * weight[:, None]
            solved = np.linalg.lstsq(scaled, variance * weight, rcond=None)[0]
            cost = float(np.sum((scaled @ solved - variance * weight) ** 2))
            if (solved > 0).all() and cost < least:
                least, best = cost, np.zeros(3)
                best[use] = solved
        weight = 1 / (relative * np.maximum(terms @ best, 1e-30))
    scaled = terms * weight[:, None]
    return best, _CORRELATED * np.diag(np.linalg.pinv(scaled.T @ scaled))
