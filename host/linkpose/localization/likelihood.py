"""One pass of the extended Kalman filter over a whole log, for the likelihood of its noises: compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled
from linkpose.localization.ekf import ekf_predict, ekf_step
from linkpose.localization.linalg import Floats, product, product_transposed, subtract_from
from linkpose.localization.models import jacobian, predict


@compiled
def run_filter(
    motion: int,
    state: Floats,
    covariance: Floats,
    intervals: Floats,
    controls: Floats,
    holds: Floats,
    noise_root: Floats,
    model: NDArray[np.int64],
    rows: NDArray[np.int64],
    values: Floats,
    variances: Floats,
    tables: Floats,
    is_angle: NDArray[np.bool_],
    counts: NDArray[np.bool_],
    is_direct: NDArray[np.bool_],
    thresholds: Floats,
    tails: float,
    blocked: NDArray[np.uint8],
    geometry: Floats,
    innovations: Floats,
) -> float:
    """Returns −ln likelihood of the measurements that count, with Student's t of `tails` degrees of freedom; infinite
    where a covariance ceases to be positive definite. Fills `innovations` (N, 2) with ν_i / √S_ii.

    Row k: `intervals` (s) since the row before under `controls` (c,), whose noises hold for `holds` (q,) s; then a
    measurement of `rows` rows with `values`, diagonal `variances`, parameters `tables`. `state` and `covariance` are
    changed.
    """
    n, q = state.shape[0], noise_root.shape[0]
    root, d2, total = np.empty((q, q)), np.empty(1), 0.0
    for k in range(intervals.shape[0]):
        if intervals[k] > 0.0:
            for i in range(q):
                for j in range(q):
                    root[i, j] = noise_root[i, j] * math.sqrt(holds[k, i] / intervals[k])
            ekf_predict(motion, state, covariance, controls[k], root, intervals[k])
        m = rows[k]
        if m == 0:
            continue
        measured, table, spread = values[k][:m].copy(), tables[k][:m].copy(), np.zeros((m, m))
        if counts[k]:
            if not is_direct[k]:
                table = tables[k][:1].copy()
            residual, slopes = np.empty(m), np.zeros((m, n))
            predict(model[k], state, table, blocked, geometry, residual)
            jacobian(model[k], state, table, blocked, geometry, slopes)
            subtract_from(measured, residual, is_angle[k], n)
            spread = product(slopes, product_transposed(covariance, slopes))
            total += _student(residual, spread, variances[k], tails)
            for i in range(m):
                innovations[k, i] = residual[i] / math.sqrt(spread[i, i] + variances[k, i])
        noise = np.zeros((m, m))
        for i in range(m):
            noise[i, i] = variances[k, i]
        sound = ekf_step(
            motion, state, covariance, controls[k], root, 0.0, model[k], measured, noise, table, is_angle[k],
            thresholds[m - 1], d2, blocked, geometry,
        )  # fmt: skip
        if not sound or not math.isfinite(state[0]):
            return math.inf
    return total


@compiled
def _student(residual: Floats, spread: Floats, variances: Floats, tails: float) -> float:
    """−ln density, but for a constant, of one or two rows with the scale matrix `spread` + diag(`variances`)."""
    a = spread[0, 0] + variances[0]
    if residual.shape[0] == 1:
        determinant, d2, size = a, residual[0] * residual[0] / a, 1.0
    else:
        b, c = spread[0, 1], spread[1, 1] + variances[1]
        determinant, size = a * c - b * b, 2.0
        d2 = (
            c * residual[0] * residual[0] - 2.0 * b * residual[0] * residual[1] + a * residual[1] * residual[1]
        ) / determinant
    return 0.5 * (tails + size) * math.log1p(d2 / tails) + 0.5 * math.log(determinant)
