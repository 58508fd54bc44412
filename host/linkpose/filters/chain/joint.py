"""The joint as a measurement: the velocity of its centre is the same seen from both sensors.

    0 = v_2 − R_2 (ω_2 × r_2) − v_1 + R_1 (ω_1 × r_1) + e

and for a first joint that is fixed 0 = v_1 − R_1 (ω_1 × r_0) + e. Nothing is differentiated. e is what the constraint
leaves over (play, soft parts, sampling): its mean square is measured as a share of (‖ω‖ ‖r‖)² over the last seconds.

Source: the constraint on the acceleration in M. Kok, K. Eckhoff, I. Weygers, T. Seel, "Observability of the relative
motion from inertial data in kinematic chains", Control Engineering Practice 125, 2022, (5), once integrated.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters.chain.level import floor_level, follow_innovation
from linkpose.filters.chain.rotation import cross, rotate, square
from linkpose.filters.chain.state import BG, OF_SENSOR, Floats, R, Record, V
from linkpose.filters.chain.update import clear_row, update

# Square of a rate over its noise variance from which on it updates the lever that it multiplies (errors in variables).
_CLEAR = 30.0
_ATTENUATION = 2.0 / 3.0  # mean of sin² between a rate and a lever
_MOST_RATIO = 10.0  # of one innovation to its expectation, as the mean counts it


@inner
def _rate(s: Record, k: int, gyro: Floats, out: Floats) -> None:
    for i in range(3):
        out[i] = gyro[k, i] - s.gyro_bias[k, i]


@inner
def _add_side(s: Record, k: int, row: int, sign: float, gyro: Floats, r: Floats, at: int, noise: Floats) -> float:
    """Add to H `sign` times component `row` of v_k − R_k (ω_k × r), whose error of r has index `at`; its value."""
    h, m, rate, lever, turned = s.row, s.rotation[k], s.a, s.b, s.c
    _rate(s, k, gyro, rate)
    cross(rate, r, lever)
    rotate(m, lever, turned)
    o = OF_SENSOR * k
    h[o + V + row] += sign
    i, j = (row + 1) % 3, (row + 2) % 3  # row of [u×]: −u_j at i, u_i at j
    h[o + i] -= sign * turned[j]
    h[o + j] += sign * turned[i]
    x, y, z = m[row, 0], m[row, 1], m[row, 2]
    if square(rate) > _CLEAR * noise[0]:
        h[at] -= sign * (y * rate[2] - z * rate[1])
        h[at + 1] -= sign * (z * rate[0] - x * rate[2])
        h[at + 2] -= sign * (x * rate[1] - y * rate[0])
    h[o + BG] -= sign * (y * r[2] - z * r[1])
    h[o + BG + 1] -= sign * (z * r[0] - x * r[2])
    h[o + BG + 2] -= sign * (x * r[1] - y * r[0])
    return float(sign * (s.velocity[k, row] - turned[row]))


@inner
def _side_variance(s: Record, k: int, gyro: Floats, r: Floats, at: int, noise: Floats) -> float:
    """Variance of each component of R_k (ω_k × r) that H does not hold: noise of ω, products of errors."""
    p, o = s.covariance, OF_SENSOR * k + BG
    _rate(s, k, gyro, s.a)
    bias = p[o, o] + p[o + 1, o + 1] + p[o + 2, o + 2]
    lever = p[at, at] + p[at + 1, at + 1] + p[at + 2, at + 2]
    rate_square = square(s.a)
    variance = noise[0] * (_ATTENUATION * square(r) + lever) + 0.5 * _ATTENUATION * bias * lever
    if rate_square <= _CLEAR * noise[0]:
        variance += _ATTENUATION * rate_square * lever
    return float(variance)


@inner
def update_joint(s: Record, size: int, first: int, gyro: Floats, h: float, q: Record, noise: Floats) -> float:
    """Apply the constraint, `h` (s) after the last time. Returns its log likelihood.

    `first` is the first row: 2, the vertical one, while the relative heading is unknown.
    """
    own = floor_level(s, q) * q.velocity_floor_m_s**2
    reach = 0.0
    for k in range(2):
        own += _side_variance(s, k, gyro, s.lever[k], OF_SENSOR * k + R, noise)
        reach += square(s.a) * square(s.lever[k])
    variance = own + s.residual_share * reach
    likelihood = found = expected = 0.0
    for row in range(first, 3):
        clear_row(s)
        value = 0.0
        for k in range(2):
            value += _add_side(s, k, row, 2.0 * k - 1.0, gyro, s.lever[k], OF_SENSOR * k + R, noise)
        found += value * value
        fit, share = update(s, size, -value, variance, q.huber)
        likelihood += fit
        expected += share
        follow_innovation(s, 0, row, value, share + variance, h, q)
    if first == 0:
        _follow_residual(s, found, expected, own, variance, reach, h, q)
    return likelihood


@inner
def _follow_residual(
    s: Record, found: float, expected: float, own: float, variance: float, reach: float, h: float, q: Record
) -> None:
    """Measure the residual's share, and how far innovations exceed their expectation."""
    keep = min(h / q.residual_s, 1.0)
    ratio = min(found / (expected + 3 * variance), _MOST_RATIO)
    s.innovation_ratio += keep * (ratio - s.innovation_ratio)
    grown = s.widening * math.exp(h * q.widening_rate * (s.innovation_ratio - 1.0))
    s.widening = min(max(grown, 1.0), q.most_widening)
    excess = min(max(found - expected - 3 * own, 0.0) / 3, 9 * variance)
    s.excess_square += keep * (excess - s.excess_square)
    s.reach_square += keep * (reach - s.reach_square)
    share = s.excess_square / max(s.reach_square, 1e-9)
    s.residual_share = max(share, floor_level(s, q) * q.least_residual**2)


@inner
def update_fixed_joint(s: Record, size: int, base: int, gyro: Floats, q: Record, noise: Floats) -> float:
    """Apply the constraint of a fixed first joint. Returns its log likelihood."""
    variance = q.velocity_floor_m_s**2 + _side_variance(s, 0, gyro, s.lever0, base, noise)
    variance += s.residual_share * square(s.a) * square(s.lever0)
    likelihood = 0.0
    for row in range(3):
        clear_row(s)
        value = _add_side(s, 0, row, 1.0, gyro, s.lever0, base, noise)
        likelihood += update(s, size, -value, variance, q.huber)[0]
    return likelihood
