"""The extended Kalman filter's compiled step, for any motion and measurement model."""

from __future__ import annotations

import numpy as np

from linkpose.compiling import compiled
from linkpose.localization.gate import gate_blocks
from linkpose.localization.grid import GridMap
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
from linkpose.localization.steps import Correction, Gaussian, Prediction


@compiled
def ekf_predict(estimate: Gaussian, prediction: Prediction) -> None:
    """x ← f(x, u), P ← F P Fᵀ + G Q Gᵀ, in place."""
    mean, covariance = estimate
    model, control, noise_root, interval_s = prediction
    n, q = mean.shape[0], noise_root.shape[0]
    by_state, by_noise, out = np.zeros((n, n)), np.zeros((n, q)), np.empty(n)
    motion_jacobians(model, mean, control, interval_s, by_state, by_noise)
    propagate(model, mean, control, np.zeros(q), interval_s, out)
    spread = product(by_noise, noise_root)
    carried = product_transposed(product(by_state, covariance), by_state)
    added = product_transposed(spread, spread)
    for i in range(n):
        mean[i] = out[i]
        for j in range(n):
            covariance[i, j] = carried[i, j] + added[i, j]
    symmetrise(covariance)


@compiled
def ekf_step(estimate: Gaussian, prediction: Prediction, correction: Correction, grid: GridMap) -> bool:
    """Predicts, then corrects `estimate` in place. False when the covariance has ceased to be positive definite."""
    mean, covariance = estimate
    measured, noise, is_angle, d2 = correction.values, correction.covariance, correction.is_angle, correction.d2
    n, m = mean.shape[0], measured.shape[0]
    if prediction.interval_s > 0.0:
        ekf_predict(estimate, prediction)
    if m == 0:
        return True
    innovation, slopes = np.empty(m), np.zeros((m, n))
    predict(correction.model, mean, correction.parameters, grid, innovation)
    jacobian(correction.model, mean, correction.parameters, grid, slopes)
    subtract_from(measured, innovation, is_angle, n)
    cross = product_transposed(covariance, slopes)
    spread = product(slopes, cross)
    add_to(spread, noise)
    keep = gate_blocks(innovation, spread, m // d2.shape[0], correction.threshold, d2)
    if keep.shape[0] == 0:
        return True
    every = np.arange(n)
    lower = np.empty((keep.shape[0], keep.shape[0]))
    if not lower_cholesky(taken(spread, keep, keep), lower):
        return False
    gain = right_divide(taken(cross, every, keep), lower)
    shift(mean, gain, innovation, keep, is_angle)
    _joseph(covariance, gain, taken(slopes, keep, every), taken(noise, keep, keep))
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
