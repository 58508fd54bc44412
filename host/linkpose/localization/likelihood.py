"""One pass of the extended Kalman filter over a whole log, for the likelihood of its noises: compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled
from linkpose.localization.drift import drift
from linkpose.localization.ekf import ekf_predict, ekf_step
from linkpose.localization.gaussian_sum import (
    MOST_IN_SEARCH,
    RangeRow,
    collapse,
    correct_sum,
    expected,
    is_bent,
    predict_sum,
    single,
)
from linkpose.localization.grid import GridMap
from linkpose.localization.linalg import (
    Floats,
    add_to,
    keep_positive_definite,
    product,
    product_transposed,
    subtract_from,
)
from linkpose.localization.models import CONSTANT_VELOCITY, jacobian, predict
from linkpose.localization.steps import Correction, Gaussian, Prediction

# Degrees of freedom of Student's t: 5 gives outliers of six standard deviations a fifth of their normal weight. 3
# underestimates the noise of normal errors by a tenth, 30 follows the outliers.
TAILS = 5.0
# ln of the largest density of Student's t, which `_student` leaves out.
STUDENT_PEAK = -(math.lgamma(0.5 * (TAILS + 1.0)) - math.lgamma(0.5 * TAILS) - 0.5 * math.log(TAILS * math.pi))


class Rows(NamedTuple):
    """A log as arrays; row k moves the state for `intervals_s[k]` and then corrects it with a measurement or nothing.

    `controls` (N, c) act over the interval and their noises hold for `holds_s` (N, q). `sizes` (N,) counts the rows of
    each measurement, 0 to 3, whose `values` are (N, 3) and whose model's `parameters` are (N, 3, 7). `is_angle`
    (N, n + 3) is as in `Correction`. Rows with `is_direct` read states; rows with `counts` enter the likelihood.
    """

    intervals_s: Floats
    controls: Floats
    holds_s: Floats
    models: NDArray[np.int64]
    sizes: NDArray[np.int64]
    values: Floats
    parameters: Floats
    is_angle: NDArray[np.bool_]
    is_direct: NDArray[np.bool_]
    counts: NDArray[np.bool_]


@compiled
def run_filter(
    estimate: Gaussian,
    motion: int,
    noise_root: Floats,
    rows: Rows,
    variances: Floats,
    drifts: Floats,
    thresholds: Floats,
    outliers: float,
    grid: GridMap,
    innovations: Floats,
) -> float:
    """Returns −ln likelihood of the measurements that count, with Student's t of TAILS degrees of freedom; infinite
    where the covariance ceases to be positive definite.

    Changes `estimate` and fills `innovations` (N, 2) with ν_i / √S_ii. `motion` is the motion model's number,
    `noise_root` (q, q) the lower Cholesky factor of Q, `variances` (N, 3) the diagonal of R, `drifts` (n, 2) as in
    `drift`, and `thresholds` (3,) the gate for a measurement of one, two and three rows. A tag without odometry is a
    sum of Gaussians where a range is no line within one; `outliers` is the density (1/m) of its outliers.
    """
    q = noise_root.shape[0]
    root, d2, total = np.empty((q, q)), np.empty(1), 0.0
    mixture = single(estimate.mean, estimate.covariance)
    for k in range(rows.intervals_s.shape[0]):
        interval = rows.intervals_s[k]
        if interval > 0.0:
            for i in range(q):
                for j in range(q):
                    root[i, j] = noise_root[i, j] * math.sqrt(rows.holds_s[k, i] / interval)
            moves = Prediction(motion, rows.controls[k], root, interval)
            if mixture.weights.shape[0] > 1:
                mixture = predict_sum(mixture, moves, drifts)
                collapse(mixture, estimate.mean, estimate.covariance)
            else:
                ekf_predict(estimate, moves)
                drift(estimate, interval, drifts)
        m = rows.sizes[k]
        if m == 0:
            continue
        if motion == CONSTANT_VELOCITY and not rows.is_direct[k]:
            row = RangeRow(rows.values[k, 0], variances[k, 0], rows.parameters[k, 0], outliers)
            is_many = mixture.weights.shape[0] > 1
            if is_many or is_bent(estimate.mean, estimate.covariance, row):
                if not is_many:
                    mixture = single(estimate.mean, estimate.covariance)
                off, spread = expected(mixture, row)
                innovations[k, 0] = off / math.sqrt(spread)
                mixture, density, _ = correct_sum(mixture, row, MOST_IN_SEARCH)
                total -= density + STUDENT_PEAK
                collapse(mixture, estimate.mean, estimate.covariance)
                if not keep_positive_definite(estimate.covariance) or not math.isfinite(estimate.mean[0]):
                    return math.inf
                continue
        noise = np.zeros((m, m))
        for i in range(m):
            noise[i, i] = variances[k, i]
        size = m if rows.is_direct[k] else 1  # rows of the model's table
        correction = Correction(
            rows.models[k], rows.values[k][:m].copy(), noise, rows.parameters[k][:size].copy(), rows.is_angle[k],
            thresholds[m - 1], d2,
        )  # fmt: skip
        if rows.counts[k]:
            total += _cost(estimate, correction, grid, innovations[k])
        mixture = single(estimate.mean, estimate.covariance)  # other sensors are linear
        still = Prediction(motion, rows.controls[k], root, 0.0)
        if not ekf_step(estimate, still, correction, grid) or not math.isfinite(estimate.mean[0]):
            return math.inf
    return total


@compiled
def _cost(estimate: Gaussian, correction: Correction, grid: GridMap, innovations: Floats) -> float:
    """−ln density of a measurement before it corrects; fills `innovations` (2,)."""
    n, m = estimate.mean.shape[0], correction.values.shape[0]
    residual, slopes = np.empty(m), np.zeros((m, n))
    predict(correction.model, estimate.mean, correction.parameters, grid, residual)
    jacobian(correction.model, estimate.mean, correction.parameters, grid, slopes)
    subtract_from(correction.values, residual, correction.is_angle, n)
    spread = product(slopes, product_transposed(estimate.covariance, slopes))
    add_to(spread, correction.covariance)
    for i in range(m):
        innovations[i] = residual[i] / math.sqrt(spread[i, i])
    return _student(residual, spread)


@compiled
def _student(residual: Floats, spread: Floats) -> float:
    """−ln density, but for a constant, of one or two rows with this scale matrix."""
    a = spread[0, 0]
    if residual.shape[0] == 1:
        determinant, d2, size = a, residual[0] * residual[0] / a, 1.0
    else:
        b, c = spread[0, 1], spread[1, 1]
        determinant, size = a * c - b * b, 2.0
        d2 = (
            c * residual[0] * residual[0] - 2.0 * b * residual[0] * residual[1] + a * residual[1] * residual[1]
        ) / determinant
    return 0.5 * (TAILS + size) * math.log1p(d2 / TAILS) + 0.5 * math.log(determinant)
