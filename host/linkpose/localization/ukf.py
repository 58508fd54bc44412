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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled
from linkpose.errors import LinkposeError
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
    taken,
    wrap_angle,
)
from linkpose.localization.models import predict, propagate
from linkpose.localization.steps import Correction, Gaussian, Prediction


class Transform(NamedTuple):
    """The unscented transform: κ places the sigma points √(n_a + κ) standard deviations out. α and β scale it; 1 and 0
    leave it plain.
    """

    alpha: float = 1.0
    beta: float = 0.0
    kappa: float = 0.0

    def check(self) -> None:
        """Raises LinkposeError for a transform without sigma points or with a covariance that can turn indefinite."""
        if self.kappa < 0:
            raise LinkposeError(
                f"κ {self.kappa:g} gives the centre point a negative weight, and P may cease to be positive definite; "
                "use 0 or more"
            )
        if not 0 < self.alpha <= 1:
            raise LinkposeError(f"α {self.alpha:g} is not within 0 to 1; try 0.1")
        if self.beta < 0:
            raise LinkposeError(f"β {self.beta:g} is below 0; 2 is best for Gaussian errors")


@compiled
def _points(mean: Floats, root: Floats, prediction: Prediction, reach: float) -> Floats:
    """(1) and (2): the propagated sigma points (1 + 2 (n + q), n); row 0 is the centre."""
    model, control, noise_root, interval_s = prediction
    n, q = mean.shape[0], noise_root.shape[0]
    points, start, noise = np.empty((1 + 2 * (n + q), n)), np.empty(n), np.empty(q)
    for point in range(points.shape[0]):
        column = (point - 1) // 2
        side = 0.0 if point == 0 else reach if point % 2 else -reach
        for i in range(n):
            start[i] = mean[i] + (side * root[i, column] if 0 <= column < n else 0.0)
        for i in range(q):
            noise[i] = side * noise_root[i, column - n] if column >= n else 0.0
        if interval_s > 0.0:
            propagate(model, start, control, noise, interval_s, points[point])
        else:
            for i in range(n):
                points[point, i] = start[i]
    return points


@compiled
def _deviations(values: Floats, weight: float, is_angle: NDArray[np.bool_], first: int, mean: Floats) -> None:
    """(3) and (7): fills the weighted mean of the rows, and turns `values` into their deviations from it.

    As the weights sum to 1, the mean is the centre plus the weighted differences from it. Taken so, it keeps its digits
    under the huge weights of a scaled transform, and angles on both sides of ±π have their mean between them.
    `is_angle` is read from index `first` on.
    """
    for j in range(values.shape[1]):
        angle = is_angle[first + j]
        total = 0.0
        for i in range(1, values.shape[0]):
            difference = values[i, j] - values[0, j]
            total += wrap_angle(difference) if angle else difference
        mean[j] = values[0, j] + weight * total
        if angle:
            mean[j] = wrap_angle(mean[j])
        for i in range(values.shape[0]):
            difference = values[i, j] - mean[j]
            values[i, j] = wrap_angle(difference) if angle else difference


@compiled
def _moment(a: Floats, b: Floats, centre_weight: float, weight: float) -> Floats:
    """(4), (8), (9): Σ w_i a_i b_iᵀ over the rows."""
    out = np.zeros((a.shape[1], b.shape[1]))
    for i in range(a.shape[0]):
        w = centre_weight if i == 0 else weight
        for j in range(a.shape[1]):
            for k in range(b.shape[1]):
                out[j, k] += w * a[i, j] * b[i, k]
    return out


@compiled
def _assign(target: Floats, source: Floats) -> None:
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@compiled
def ukf_step(
    estimate: Gaussian, prediction: Prediction, correction: Correction, grid: GridMap, transform: Transform
) -> bool:
    """Predicts, then corrects `estimate` in place. False when the covariance has ceased to be positive definite.

    λ = α² (n_a + κ) − n_a; α = 1 and β = 0 make it the plain unscented transform. (12) is taken as Σ w (δx − K δz)(δx −
    K δz)ᵀ + K R Kᵀ, equal to P̄ − K S Kᵀ but a sum of squares.
    """
    mean, covariance = estimate
    measured, noise, is_angle, d2 = correction.values, correction.covariance, correction.is_angle, correction.d2
    alpha, beta, kappa = transform
    n, m = mean.shape[0], measured.shape[0]
    augmented = n + prediction.noise_root.shape[0] + m
    scale = alpha * alpha * (augmented + kappa)
    weight = 0.5 / scale
    centre = 1.0 - augmented / scale + 2.0 * m * weight  # with the points that move only the measurement noise
    centre_squares = centre + 1.0 - alpha * alpha + beta
    root = np.zeros((n, n))
    if not lower_cholesky(covariance, root):
        return False
    points = _points(mean, root, prediction, math.sqrt(scale))
    images, innovation = np.empty((points.shape[0], m)), np.empty(m)
    for i in range(points.shape[0] if m else 0):
        predict(correction.model, points[i], correction.parameters, grid, images[i])
    _deviations(points, weight, is_angle, 0, mean)
    _assign(covariance, _moment(points, points, centre_squares, weight))
    if m == 0:
        return True
    _deviations(images, weight, is_angle, n, innovation)
    subtract_from(measured, innovation, is_angle, n)
    spread = _moment(images, images, centre_squares, weight)
    add_to(spread, noise)
    keep = gate_blocks(innovation, spread, m // d2.shape[0], correction.threshold, d2)
    if keep.shape[0] == 0:
        return True
    lower = np.empty((keep.shape[0], keep.shape[0]))
    if not lower_cholesky(taken(spread, keep, keep), lower):
        return False
    kept_images = taken(images, np.arange(images.shape[0]), keep)
    gain = right_divide(_moment(points, kept_images, centre_squares, weight), lower)
    shift(mean, gain, innovation, keep, is_angle)
    rest = _rest(points, kept_images, gain)
    _assign(covariance, _moment(rest, rest, centre_squares, weight))
    add_to(covariance, product_transposed(product(gain, taken(noise, keep, keep)), gain))
    return keep_positive_definite(covariance)


@compiled
def _rest(points: Floats, images: Floats, gain: Floats) -> Floats:
    """δx − K δz, row by row: what the measurement leaves of each point's deviation."""
    out = product_transposed(images, gain)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = points[i, j] - out[i, j]
    return out
