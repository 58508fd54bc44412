"""The unscented Kalman filter's compiled step, for any motion and measurement model: equations (1) to (12) of the
thesis.

The augmented state is [x, 0, 0] with P_a = diag(P, Q, R), n_a = n + q + m, and its sigma points are x̄ and x̄ ± √(n_a +
λ) L_i, where L_i are the columns of the lower Cholesky factor of P_a (1). The 2 m points that only move the measurement
noise all have the state of the centre point, and h is the same for them. What they add to the sums is known in closed
form, exactly: the centre's weight grows by the 2 m of theirs, and S gains R. So 49 points with 19 beams need 11
ray-cast poses.
"""

from __future__ import annotations

import math

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
    wrap_where,
)
from linkpose.localization.models import predict, propagate


@njit(cache=True)
def _points(
    motion: int, state: Floats, root: Floats, control: Floats, noise_root: Floats, interval: float, reach: float
) -> Floats:
    """(1) and (2): the propagated sigma points (1 + 2 (n + q), n); row 0 is the centre."""
    n, q = state.shape[0], noise_root.shape[0]
    points, start, noise = np.empty((1 + 2 * (n + q), n)), np.empty(n), np.zeros(q)
    for i in range(points.shape[0]):
        start[:] = state
        noise[:] = 0.0
        side = reach if i % 2 else -reach
        column = (i - 1) // 2
        if 0 < i <= 2 * n:
            start += side * root[:, column]
        elif i > 2 * n:
            noise += side * noise_root[:, column - n]
        if interval > 0.0:
            propagate(motion, start, control, noise, interval, points[i])
        else:
            points[i] = start
    return points


@njit(cache=True)
def _deviations(values: Floats, weight: float, is_angle: NDArray[np.bool_]) -> Floats:
    """(3) and (7): the weighted mean of the rows. Turns `values` into their deviations from it.

    As the weights sum to 1, the mean is the centre plus the weighted differences from it. Taken so, it keeps its digits
    under the huge weights of a scaled transform, and angles on both sides of ±π have their mean between them.
    """
    mean: Floats = values[0].copy()
    difference = np.empty(values.shape[1])
    for i in range(1, values.shape[0]):
        difference[:] = values[i] - values[0]
        wrap_where(difference, is_angle)
        mean += weight * difference
    wrap_where(mean, is_angle)
    for i in range(values.shape[0]):
        values[i] -= mean
        wrap_where(values[i], is_angle)
    return mean


@njit(cache=True)
def _moment(a: Floats, b: Floats, centre_weight: float, weight: float) -> Floats:
    """(4), (8), (9): Σ w_i a_i b_iᵀ over the rows."""
    out = np.zeros((a.shape[1], b.shape[1]))
    for i in range(a.shape[0]):
        w = centre_weight if i == 0 else weight
        for j in range(a.shape[1]):
            for k in range(b.shape[1]):
                out[j, k] += w * a[i, j] * b[i, k]
    return out


@njit(cache=True)
def ukf_step(
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
    alpha: float,
    beta: float,
    kappa: float,
) -> bool:
    """Propagates over `interval` and corrects with the measurement, both in place. False when P has ceased to be
    positive definite.

    λ = α² (n_a + κ) − n_a; α = 1 and β = 0 make it the plain unscented transform. (12) is taken as Σ w (δx − K δz)(δx −
    K δz)ᵀ + K R Kᵀ, equal to P̄ − K S Kᵀ but a sum of squares. `d2` and `threshold` as in `ekf_step`. No measurement: m
    = 0.
    """
    n, m = state.shape[0], measured.shape[0]
    augmented = n + noise_root.shape[0] + m
    scale = alpha * alpha * (augmented + kappa)
    weight = 0.5 / scale
    centre = 1.0 - augmented / scale + 2.0 * m * weight  # with the points that move only the measurement noise
    centre_squares = centre + 1.0 - alpha * alpha + beta
    root = np.zeros((n, n))
    if not lower_cholesky(covariance, root):
        return False
    points = _points(motion, state, root, control, noise_root, interval, math.sqrt(scale))
    images = np.empty((points.shape[0], m))
    for i in range(points.shape[0] if m else 0):
        predict(model, points[i], parameters, blocked, geometry, images[i])
    state[:] = _deviations(points, weight, is_angle[:n])
    covariance[:, :] = _moment(points, points, centre_squares, weight)
    if m == 0:
        return True
    innovation = measured - _deviations(images, weight, is_angle[n:])
    wrap_where(innovation, is_angle[n:])
    spread = _moment(images, images, centre_squares, weight) + measurement_covariance
    keep = gate_blocks(innovation, spread, m // d2.shape[0], threshold, d2)
    if keep.shape[0] == 0:
        return True
    return _correct(
        state,
        covariance,
        points,
        images[:, keep],
        innovation[keep],
        spread,
        measurement_covariance,
        keep,
        is_angle,
        centre_squares,
        weight,
    )


@njit(cache=True)
def _correct(
    state: Floats,
    covariance: Floats,
    points: Floats,
    images: Floats,
    innovation: Floats,
    spread: Floats,
    measurement_covariance: Floats,
    keep: NDArray[np.int64],
    is_angle: NDArray[np.bool_],
    centre_squares: float,
    weight: float,
) -> bool:
    """(9) to (12) with the rows that passed the gate."""
    n, k = state.shape[0], keep.shape[0]
    part, noise, lower = np.empty((k, k)), np.empty((k, k)), np.empty((k, k))
    for i in range(k):
        for j in range(k):
            part[i, j] = spread[keep[i], keep[j]]
            noise[i, j] = measurement_covariance[keep[i], keep[j]]
    if not lower_cholesky(part, lower):
        return False
    gain = right_divide(_moment(points, images, centre_squares, weight), lower)
    for i in range(n):
        for j in range(k):
            state[i] += gain[i, j] * innovation[j]
    wrap_where(state, is_angle[:n])
    rest = points - product_transposed(images, gain)
    covariance[:, :] = _moment(rest, rest, centre_squares, weight) + product_transposed(product(gain, noise), gain)
    return keep_positive_definite(covariance)
