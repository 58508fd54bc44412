"""The extended Kalman filter's compiled step, for any motion and measurement model."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from linkpose.localization.gate import gate_blocks
from linkpose.localization.linalg import (
    Floats,
    keep_positive_definite,
    lower_cholesky,
    product,
    product_transposed,
    right_divide,
    symmetrise,
    wrap_where,
)
from linkpose.localization.models import jacobian, motion_jacobians, predict, propagate


@njit(cache=True)
def ekf_predict(
    motion: int, state: Floats, covariance: Floats, control: Floats, noise_root: Floats, interval: float
) -> None:
    """x ← f(x, u), P ← F P Fᵀ + G Q Gᵀ with Q = `noise_root` `noise_root`ᵀ, in place."""
    n, q = state.shape[0], noise_root.shape[0]
    by_state, by_noise, out = np.zeros((n, n)), np.zeros((n, q)), np.empty(n)
    motion_jacobians(motion, state, control, interval, by_state, by_noise)
    propagate(motion, state, control, np.zeros(q), interval, out)
    spread = product(by_noise, noise_root)
    state[:] = out
    covariance[:, :] = product_transposed(product(by_state, covariance), by_state) + product_transposed(spread, spread)
    symmetrise(covariance)


@njit(cache=True)
def ekf_step(
    motion: int,
    state: Floats,
    covariance: Floats,
    control: Floats,
    noise_root: Floats,
    interval: float,
    model: int,
    measured: Floats,
    measurement_covariance: Floats,
    parameters: Floats,
    is_angle: NDArray[np.bool_],
    threshold: float,
    d2: Floats,
    blocked: NDArray[np.uint8],
    geometry: Floats,
) -> bool:
    """Propagates over `interval`, then corrects with the measurement, both in place. False when P has ceased to be
    positive definite.

    The covariance takes Joseph's form (I − KH) P (I − KH)ᵀ + K R Kᵀ, a sum of squares whatever the rounding of K. `d2`
    (one element for each block of equal size) receives νᵀ S⁻¹ ν; a block above `threshold` is left out. No measurement:
    m = 0.
    """
    n, m = state.shape[0], measured.shape[0]
    if interval > 0.0:
        ekf_predict(motion, state, covariance, control, noise_root, interval)
    if m == 0:
        return True
    expected, slopes = np.empty(m), np.zeros((m, n))
    predict(model, state, parameters, blocked, geometry, expected)
    jacobian(model, state, parameters, blocked, geometry, slopes)
    innovation = measured - expected
    wrap_where(innovation, is_angle[n:])
    cross = product_transposed(covariance, slopes)
    spread = product(slopes, cross) + measurement_covariance
    keep = gate_blocks(innovation, spread, m // d2.shape[0], threshold, d2)
    k = keep.shape[0]
    if k == 0:
        return True
    part, noise, lower = np.empty((k, k)), np.empty((k, k)), np.empty((k, k))
    for i in range(k):
        for j in range(k):
            part[i, j] = spread[keep[i], keep[j]]
            noise[i, j] = measurement_covariance[keep[i], keep[j]]
    if not lower_cholesky(part, lower):
        return False
    gain = right_divide(np.ascontiguousarray(cross[:, keep]), lower)
    shrink = np.eye(n) - product(gain, slopes[keep])
    for i in range(n):
        for j in range(k):
            state[i] += gain[i, j] * innovation[keep[j]]
    wrap_where(state, is_angle[:n])
    covariance[:, :] = product_transposed(product(shrink, covariance), shrink) + product_transposed(
        product(gain, noise), gain
    )
    return keep_positive_definite(covariance)
