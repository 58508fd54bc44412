"""Small dense linear algebra for the compiled filters: plain loops, which compile faster than BLAS calls and link to
nothing.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled

Floats = NDArray[np.float64]


@compiled
def wrap_angle(angle: float) -> float:
    """The same direction in [-π, π)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@compiled
def subtract_from(measured: Floats, expected: Floats, is_angle: NDArray[np.bool_], first: int) -> None:
    """expected ← measured − expected, in place, on the circle where `is_angle` is set, which is read from index
    `first` on.
    """
    for i in range(expected.shape[0]):
        expected[i] = measured[i] - expected[i]
        if is_angle[first + i]:
            expected[i] = wrap_angle(expected[i])


@compiled
def shift(
    state: Floats, gain: Floats, innovation: Floats, keep: NDArray[np.int64], is_angle: NDArray[np.bool_]
) -> None:
    """x ← x + K ν, in place, with those rows of ν that `keep` names; angles stay on the circle."""
    for i in range(state.shape[0]):
        for j in range(keep.shape[0]):
            state[i] += gain[i, j] * innovation[keep[j]]
        if is_angle[i]:
            state[i] = wrap_angle(state[i])


@compiled
def taken(a: Floats, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Floats:
    """The rows and columns of a matrix that are named, as a new matrix."""
    out = np.empty((rows.shape[0], columns.shape[0]))
    for i in range(rows.shape[0]):
        for j in range(columns.shape[0]):
            out[i, j] = a[rows[i], columns[j]]
    return out


@compiled
def add_to(a: Floats, b: Floats) -> None:
    """a ← a + b, in place."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            a[i, j] += b[i, j]


@compiled
def product(a: Floats, b: Floats) -> Floats:
    """a b."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                out[i, j] += a[i, k] * b[k, j]
    return out


@compiled
def product_transposed(a: Floats, b: Floats) -> Floats:
    """a bᵀ."""
    out = np.zeros((a.shape[0], b.shape[0]))
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[j, k]
            out[i, j] = total
    return out


@compiled
def symmetrise(a: Floats) -> None:
    """(a + aᵀ)/2, in place: rounding must not make a covariance lopsided."""
    for i in range(a.shape[0]):
        for j in range(i):
            mean = 0.5 * (a[i, j] + a[j, i])
            a[i, j] = mean
            a[j, i] = mean


@compiled
def lower_cholesky(a: Floats, lower: Floats) -> bool:
    """Fills `lower` with L, L Lᵀ = a. False when a is not positive definite; a column whose variance is 0 is allowed
    and stays 0.
    """
    n = a.shape[0]
    for j in range(n):
        for i in range(j):
            lower[i, j] = 0.0
        pivot = a[j, j]
        for k in range(j):
            pivot -= lower[j, k] * lower[j, k]
        if not math.isfinite(pivot) or pivot < 0.0 or (pivot == 0.0 and a[j, j] != 0.0):
            return False
        root = math.sqrt(pivot)
        lower[j, j] = root
        for i in range(j + 1, n):
            total = a[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = total / root if root > 0.0 else 0.0
    return True


@compiled
def keep_positive_definite(a: Floats) -> bool:
    """Symmetrises a covariance and, where rounding has made it indefinite, raises its variances by the least that
    helps, in place.

    Rounding of a sum of squares is relative to the largest terms of the sum, so a measurement that is 10¹⁰ times better
    than what was known can leave an eigenvalue below 0. False when a hundred-thousandth does not help: then the cause
    is no rounding.
    """
    symmetrise(a)
    lower = np.zeros(a.shape)
    share = 1e-15
    while not lower_cholesky(a, lower):
        share *= 10.0
        if share > 1e-5:
            return False
        for i in range(a.shape[0]):
            a[i, i] *= 1.0 + share
    return True


@compiled
def right_divide(t: Floats, lower: Floats) -> Floats:
    """t S⁻¹ for S = L Lᵀ: the Kalman gain from the cross covariance t."""
    n = lower.shape[0]
    out = np.empty(t.shape)
    for row in range(t.shape[0]):
        for i in range(n):
            total = t[row, i]
            for k in range(i):
                total -= lower[i, k] * out[row, k]
            out[row, i] = total / lower[i, i]
        for i in range(n - 1, -1, -1):
            total = out[row, i]
            for k in range(i + 1, n):
                total -= lower[k, i] * out[row, k]
            out[row, i] = total / lower[i, i]
    return out


@compiled
def mahalanobis_squared(v: Floats, lower: Floats) -> float:
    """vᵀ S⁻¹ v for S = L Lᵀ."""
    n = v.shape[0]
    y = np.empty(n)
    d2 = 0.0
    for i in range(n):
        total = v[i]
        for k in range(i):
            total -= lower[i, k] * y[k]
        y[i] = total / lower[i, i]
        d2 += y[i] * y[i]
    return d2
