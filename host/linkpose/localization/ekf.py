"""The extended Kalman filter's compiled step, for any motion and measurement model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled
from linkpose.localization.gate import gate_blocks
from linkpose.localization.linalg import (
    Floats,
    add_to,
    keep_positive_definite,
    lower_cholesky,
    product,
    product_transposed,
    right_divide,
    shift,
    subtract_from,
    symmetrise,
    taken,
)
from linkpose.localization.models import jacobian, motion_jacobians, predict, propagate


@compiled
def ekf_predict(
    motion: int, state: Floats, covariance: Floats, control: Floats, noise_root: Floats, interval: float
) -> None:
    """x ← f(x, u), P ← F P Fᵀ + G Q Gᵀ with Q = `noise_root` `noise_root`ᵀ, in place."""
    n, q = state.shape[0], noise_root.shape[0]
    by_state, by_noise, out = np.zeros((n, n)), np.zeros((n, q)), np.empty(n)
    motion_jacobians(motion, state, control, interval, by_state, by_noise)
    propagate(motion, state, control, np.zeros(q), interval, out)
    spread = product(by_noise, noise_root)
    carried = product_transposed(product(by_state, covariance), by_state)
    added = product_transposed(spread, spread)
    for i in range(n):
        state[i] = out[i]
        for j in range(n):
            covariance[i, j] = carried[i, j] + added[i, j]
    symmetrise(covariance)


@compiled
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
    """Propagates over `interval`, then corrects with the measurement, both in place.

    `is_angle` (n + m,) tells which states and which rows of the measurement are angles. `d2` (one element for each
    block of equal size) receives νᵀ S⁻¹ ν; a block above `threshold` is left out. No measurement: m = 0. False when P
    has ceased to be positive definite.
    """
    n, m = state.shape[0], measured.shape[0]
    if interval > 0.0:
        ekf_predict(motion, state, covariance, control, noise_root, interval)
    if m == 0:
        return True
    innovation, slopes = np.empty(m), np.zeros((m, n))
    predict(model, state, parameters, blocked, geometry, innovation)
    jacobian(model, state, parameters, blocked, geometry, slopes)
    subtract_from(measured, innovation, is_angle, n)
    cross = product_transposed(covariance, slopes)
    spread = product(slopes, cross)
    add_to(spread, measurement_covariance)
    keep = gate_blocks(innovation, spread, m // d2.shape[0], threshold, d2)
    if keep.shape[0] == 0:
        return True
    every = np.arange(n)
    lower = np.empty((keep.shape[0], keep.shape[0]))
    if not lower_cholesky(taken(spread, keep, keep), lower):
        return False
    gain = right_divide(taken(cross, every, keep), lower)
    shift(state, gain, innovation, keep, is_angle)
    _joseph(covariance, gain, taken(slopes, keep, every), taken(measurement_covariance, keep, keep))
    return keep_positive_definite(covariance)


@compiled
def _joseph(covariance: Floats, gain: Floats, slopes: Floats, noise: Floats) -> None:
    """P ← (I − KH) P (I − KH)ᵀ + K R Kᵀ, a sum of squares whatever the rounding of K, in place."""
    shrink = product(gain, slopes)
    for i in range(shrink.shape[0]):
        for j in range(shrink.shape[1]):
            shrink[i, j] = (1.0 if i == j else 0.0) - shrink[i, j]
    rest = product_transposed(product(shrink, covariance), shrink)
    added = product_transposed(product(gain, noise), gain)
    for i in range(covariance.shape[0]):
        for j in range(covariance.shape[1]):
            covariance[i, j] = rest[i, j] + added[i, j]
