"""The Kalman update of the chain: one scalar measurement after another, and the correction of the nominal state.

Scalars with independent noise, applied in turn, equal the update by the vector. Source: any textbook, e.g. P. S.
Maybeck, Stochastic Models, Estimation, and Control, 1979, 7.4.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters.chain.rotation import square, to_matrix, turn
from linkpose.filters.chain.state import BA, BG, OF_SENSOR, START, R, Record, V


@inner
def clear_row(s: Record) -> None:
    """H = 0."""
    row = s.row
    for i in range(row.shape[0]):
        row[i] = 0.0


@inner
def expected_square(s: Record, size: int) -> float:
    """H P Hᵀ of the measurement in `row`; H P in `gain`."""
    p, h, w = s.covariance, s.row, s.gain
    for j in range(size):
        w[j] = 0.0
    for k in range(size):
        share = h[k]
        if share != 0.0:
            for j in range(size):
                w[j] += share * p[k, j]
    total = 0.0
    for k in range(size):
        total += h[k] * w[k]
    return total


@inner
def update(s: Record, size: int, innovation: float, variance: float, huber: float) -> tuple[float, float]:
    """Apply a measurement with H in `row`. Returns its log likelihood and H P Hᵀ.

    `innovation` is that of the nominal state; corrections that wait in `correction` are taken off. An innovation
    beyond `huber` σ counts as one of that size.
    """
    p, h, w, x = s.covariance, s.row, s.gain, s.correction
    expected = expected_square(s, size)
    for k in range(size):
        innovation -= h[k] * x[k]
    total = expected + variance
    distance = innovation * innovation / total
    limit = huber * huber
    likelihood = -0.5 * (min(distance, limit) + math.log(total))
    if distance > limit:
        total *= math.sqrt(distance) / huber
    scale = 1 / math.sqrt(total)
    innovation *= scale
    for j in range(size):
        w[j] *= scale
    for i in range(size):
        share = w[i]
        x[i] += share * innovation
        for j in range(size):
            p[i, j] -= share * w[j]
    return likelihood, expected


@inner
def apply_correction(s: Record, size: int, hinge: int, base: int) -> None:
    """Move the waiting correction into the nominal state."""
    x = s.correction
    s.moved_heading += x[OF_SENSOR + 2] - x[2]
    for k in range(2):
        o = OF_SENSOR * k
        turn(s.attitude[k], x[o], x[o + 1], x[o + 2], 1.0)
        to_matrix(s.attitude[k], s.rotation[k])
        for i in range(3):
            s.velocity[k, i] += x[o + V + i]
            s.gyro_bias[k, i] += x[o + BG + i]
            s.accel_bias[k, i] += x[o + BA + i]
            s.lever[k, i] += x[o + R + i]
        o = START + 3 * k
        turn(s.start[k], x[o], x[o + 1], x[o + 2], 1.0)
    if hinge >= 0:
        for k in range(2):
            axis, norm = s.axis[k], 1e-30
            for i in range(3):
                axis[i] += x[hinge + 3 * k + i]
                s.moved_axis[k, i] += x[hinge + 3 * k + i]
                norm += axis[i] * axis[i]
            for i in range(3):
                axis[i] /= math.sqrt(norm)
    if base >= 0:
        for i in range(3):
            s.lever0[i] += x[base + i]
    for i in range(size):
        x[i] = 0.0


@inner
def add_linearization_errors(s: Record, hinge: int, h: float, q: Record) -> None:
    """Add the errors of former Jacobians to P, as the corrections since then show them; `h` (s) after the last time."""
    p, keep = s.covariance, min(h / q.relinearized_s, 1.0)
    wider = keep * _of_move(s.moved_heading**2, q)
    o, start = OF_SENSOR + 2, START + 5  # the heading of link 2 at the first sample turns with the present one
    share = keep * q.relinearized_bias * s.moved_heading**2 / q.relinearized_rad**2
    for k in range(2):
        for i in range(OF_SENSOR * k + BG, OF_SENSOR * k + BA):
            unknown, missing = p[i, i] - q.gyro_bias_rad_s**2, q.first_gyro_bias_rad_s**2 - p[i, i]
            p[i, i] += max(min(share * unknown, missing), 0.0)
    p[o, o] += wider
    p[o, start] += wider
    p[start, o] += wider
    p[start, start] += wider
    if hinge >= 0:
        for k in range(2):
            axis, moved, at = s.axis[k], s.moved_axis[k], hinge + 3 * k
            wider = keep * _of_move(square(moved), q)
            for i in range(3):
                p[at + i, at + i] += wider
                for j in range(3):
                    p[at + i, at + j] -= wider * axis[i] * axis[j]
                moved[i] *= 1 - keep
    s.moved_heading *= 1 - keep


@inner
def _of_move(moved: float, q: Record) -> float:
    """Variance (rad²) to add after a move whose square is given (rad²)."""
    return float(q.relinearized_share * moved * min(moved / q.relinearized_rad**2, 1.0))
