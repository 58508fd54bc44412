"""The axis of a hinge as a measurement, and the hinge angle.

    0 = R_1 j_1 − R_2 j_2 + e

e is the play of the hinge, whose mean square is measured. Unknown axes begin as the direction of the relative rate,
the first principal axis of ∫ω_rel ω_relᵀ dt; both constraints then refine them.

Source: T. Seel, J. Raisch, T. Schauer, "IMU-based joint angle measurement for gait analysis", Sensors 14(4), 2014, 3.2.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters.chain.level import floor_level, follow_innovation
from linkpose.filters.chain.rotation import between, rotate, rotate_back, square, to_matrix
from linkpose.filters.chain.state import OF_SENSOR, START, Floats, Record
from linkpose.filters.chain.update import clear_row, expected_square, update

# The sense of an axis is arbitrary: that of j_2 lies on this side, so that all hypotheses agree.
_SIDE = (1.0, 0.77, 0.61)
# Square of the axis's horizontal part over its variance below which it gives no heading (errors in variables).
_CLEAR_AXIS = 9.0
_HEADING_FREE = 0.01  # share of the horizontal part of the smaller rate in the relative rate, both squared
_POWER_STEPS = 30  # of the power iteration: a second eigenvalue of 0.25 the first is down by 1e-18


@inner
def follow_axis(s: Record, size: int, hinge: int, spread: int, gyro: Floats, h: float, q: Record) -> None:
    """Accumulate the relative rate in sensor 1's axes until it gives the axis.

    While the relative heading is unknown (`spread` 0), only rates that do not depend on it count: one of them vertical.
    """
    rate, m, moments = s.a, s.c, s.relative_spread
    for i in range(3):
        rate[i] = gyro[1, i] - s.gyro_bias[1, i]
    rotate(s.rotation[1], rate, s.b)
    rotate_back(s.rotation[0], s.b, m)
    across = s.b[0] ** 2 + s.b[1] ** 2
    for i in range(3):
        rate[i] = gyro[0, i] - s.gyro_bias[0, i]
    rotate(s.rotation[0], rate, s.b)
    across = min(across, s.b[0] ** 2 + s.b[1] ** 2)
    for i in range(3):
        rate[i] = m[i] - rate[i]
    if not spread and across > _HEADING_FREE * square(rate):
        return
    for i in range(3):
        for j in range(3):
            moments[i, j] += h * rate[i] * rate[j] - h / q.axis_memory_s * moments[i, j]
    total = moments[0, 0] + moments[1, 1] + moments[2, 2]
    if total > q.axis_rotation and _principal_axis(moments, s.axis[0], s.b) > q.axis_share * total:
        _begin_axes(s, size, hinge, q)


@inner
def _principal_axis(spread: Floats, axis: Floats, product: Floats) -> float:
    """The unit eigenvector of the largest eigenvalue, by power iteration, and this eigenvalue."""
    axis[0], axis[1], axis[2] = _SIDE
    value = 0.0
    for _ in range(_POWER_STEPS):
        rotate(spread, axis, product)
        value = math.sqrt(square(product)) + 1e-30
        for i in range(3):
            axis[i] = product[i] / value
    return value


@inner
def _begin_axes(s: Record, size: int, hinge: int, q: Record) -> None:
    """j_2 from j_1 and the present attitudes; wide variances across both."""
    p = s.covariance
    rotate(s.rotation[0], s.axis[0], s.a)
    rotate_back(s.rotation[1], s.a, s.axis[1])
    if s.axis[1, 0] * _SIDE[0] + s.axis[1, 1] * _SIDE[1] + s.axis[1, 2] * _SIDE[2] < 0:
        for k in range(2):
            for i in range(3):
                s.axis[k, i] = -s.axis[k, i]
    for k in range(2):
        o, axis = hinge + 3 * k, s.axis[k]
        for i in range(3):
            for j in range(size):
                p[o + i, j] = p[j, o + i] = 0.0
        for i in range(3):
            for j in range(3):
                p[o + i, o + j] = q.axis_std_rad**2 * ((1.0 if i == j else 0.0) - axis[i] * axis[j])
    s.has_axis = 1.0


@inner
def _horizontal_variance(s: Record, size: int, hinge: int) -> float:
    """Variance of the horizontal part of R_2 j_2 (in `b`) by the errors of tilt and axis: of X and Y together."""
    z, total = s.b[2], 1e-12
    for row in range(2):
        clear_row(s)
        s.row[OF_SENSOR + 1 - row] = z if row == 0 else -z  # δ(R j) = δθ × R j
        for c in range(3):
            s.row[hinge + 3 + c] = s.rotation[1, row, c]
        total += max(expected_square(s, size), 0.0)
    return total


@inner
def update_axis(s: Record, size: int, hinge: int, h: float, q: Record) -> float:
    """Apply the constraint, `h` (s) after the last time. Returns its log likelihood, at most 0."""
    rotate(s.rotation[0], s.axis[0], s.a)
    rotate(s.rotation[1], s.axis[1], s.b)
    variance = q.play_correlation * max(s.play_square, floor_level(s, q) * q.least_play_rad**2)
    uncertain = _horizontal_variance(s, size, hinge)
    across = s.b[0] ** 2 + s.b[1] ** 2
    heading_share = min(max(across / (_CLEAR_AXIS * uncertain) - 1, 0.0), 1.0)
    # A hypothesis without an axis yet has no such term, so it is relative to the density of a fit to `first_play_rad`.
    density = 0.5 * math.log(q.play_correlation * q.first_play_rad**2)
    likelihood = found = expected = 0.0
    for row in range(3):
        clear_row(s)
        i, j = (row + 1) % 3, (row + 2) % 3
        s.row[i] = s.a[j]  # δ(R j) = δθ × R j
        s.row[j] = -s.a[i]
        s.row[OF_SENSOR + i] = -s.b[j]
        s.row[OF_SENSOR + j] = s.b[i]
        s.row[2] *= heading_share
        s.row[OF_SENSOR + 2] *= heading_share
        for c in range(3):
            s.row[hinge + c] = s.rotation[0, row, c]
            s.row[hinge + 3 + c] = -s.rotation[1, row, c]
        value = s.a[row] - s.b[row]
        found += value * value
        fit, share = update(s, size, -value, variance, q.huber)
        follow_innovation(s, 1, row, value, share + variance, h, q)
        likelihood += min(fit + density, 0.0)
        expected += share
    s.play_square += min(h / q.play_s, 1.0) * (max(found - expected, 0.0) / 2 - s.play_square)
    return likelihood


@inner
def hinge_angle(s: Record) -> float:
    """Angle (rad, ±π) about j_2 since the first sample: the twist of S_2ᵀ S_1 R_1ᵀ R_2."""
    between(s.attitude[0], s.attitude[1], s.relative)
    between(s.start[0], s.start[1], s.first)
    q, r, axis = s.first, s.relative, s.axis[1]
    w = q[0] * r[0] + q[1] * r[1] + q[2] * r[2] + q[3] * r[3]
    x = q[0] * r[1] - q[1] * r[0] - (q[2] * r[3] - q[3] * r[2])
    y = q[0] * r[2] - q[2] * r[0] - (q[3] * r[1] - q[1] * r[3])
    z = q[0] * r[3] - q[3] * r[0] - (q[1] * r[2] - q[2] * r[1])
    return vec.wrapped(2 * math.atan2(x * axis[0] + y * axis[1] + z * axis[2], w))


@inner
def hinge_angle_std(s: Record, size: int, hinge: int) -> float:
    """σ of that angle (rad): of the rotations now and at the start about the axis; H of the angle in `row`."""
    to_matrix(s.start[1], s.m)
    rotate(s.m, s.axis[1], s.b)  # the axis in n at the first sample
    to_matrix(s.start[0], s.m)
    rotate_back(s.m, s.b, s.a)
    rotate(s.rotation[0], s.a, s.c)  # and now
    clear_row(s)
    for i in range(3):
        s.row[i], s.row[OF_SENSOR + i] = -s.c[i], s.c[i]
        s.row[START + i], s.row[START + 3 + i] = s.b[i], -s.b[i]
    return math.sqrt(max(expected_square(s, size), 0.0))
