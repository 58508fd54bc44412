"""The joint's constraint on the velocity as a measurement: 0 = v − ω × d + n_G × d + e.

The joint centre is fixed, so the angular rate gives the sensor's velocity. e is what the constraint leaves over (play,
bending, a joint that moves). Its mean square is measured on each axis, as a share of (‖ω‖ ‖d‖)² over the last seconds.
It follows the motion and has its correlation time T, so that updates at intervals h count as white noise of the
variance e² · 2T / h (`free_velocity` has the source); the least share, a sampling error, is white.

The same noise is in the reading s_G and in the innovation. A reading that may be noise alone would therefore be
"explained" by M_g, or by a shorter d (errors in variables). So M_g is updated by the components of the reading that
stand out of the noise, and d along the directions that the rotation excites: with S the mean of ω ωᵀ and τ a threshold,
ω_d = G ω with G = S² (S² + τ² I)⁻¹ replaces ω in front of δd, and the rest, (ω − ω_d) × δd, counts as noise.

Source: the constraint is (9) of [Link], integrated once.
"""

from __future__ import annotations

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import ImuCalibration
from linkpose.filters._vector import Sym, Vec
from linkpose.filters.inertial.propagate import angular_rate
from linkpose.filters.inertial.state import BG, MG, SIZE, D, Floats, Record, V
from linkpose.filters.inertial.update import project, sub_covariance, update_vector

# Square of a reading over its noise variance from which on it updates what multiplies it. At 30 the noise shrinks the
# estimate by 3 %; doubling it excludes slower motion.
CLEAR = 30.0
# χ² with 3 degrees of freedom: rejects one sound innovation in 65 000.
_GATE = 25.0
# Share of the strongest direction's mean square rotation that another direction must exceed to update J2S along it:
# (5 %)², twice what cross-axis sensitivity and misalignment of an uncalibrated sensor (2 %) leak into it.
_LEAK = 0.0025
FIRST_REACH_M2_S2 = 0.5  # mean square speed that the assumed share of the constraint's residual counts for
_SPREAD_S = 5.0  # over which ω ωᵀ is averaged (s): some swings of a hand


@inner
def share_clear(square: float, variance: float) -> float:
    """From 0 for a reading that may be noise alone to 1 for one that is clear of it."""
    return min(max(square / (CLEAR * variance) - 1.0, 0.0), 1.0)


@inner
def clear_part(reading: Vec, variance: float) -> Vec:
    """The components of a reading that stand out of the noise."""
    return (
        reading[0] * share_clear(reading[0] * reading[0], variance),
        reading[1] * share_clear(reading[1] * reading[1], variance),
        reading[2] * share_clear(reading[2] * reading[2], variance),
    )


@inner
def follow_spread(spread: Floats, rate: Vec, h: float) -> None:
    """Average ω ωᵀ over the last seconds."""
    keep = min(h / _SPREAD_S, 1.0)
    for i in range(3):
        for j in range(3):
            spread[i, j] += keep * (rate[i] * rate[j] - spread[i, j])


@inner
def excited_part(spread: Floats, rate: Vec, variance: float) -> Vec:
    """G ω: the rotation along directions that stand out of noise and of leakage."""
    xx, yy, zz = spread[0, 0], spread[1, 1], spread[2, 2]
    threshold = CLEAR * variance + _LEAK * (xx + yy + zz)
    s = vec.scaled(1.0 / threshold, (xx, spread[0, 1], spread[0, 2], yy, spread[1, 2], zz))
    inverse = vec.inverse(vec.plus_diagonal(vec.squared(s), 1.0))
    return vec.apply(s, vec.apply(s, vec.apply(inverse, rate)))


@inner
def fill_jacobian(h: Floats, rate: Vec, reading: Vec, d: Vec) -> None:
    """H of the innovation ω × d − v: δv + d × δω − ω × δd, with δω = −δb_g − δM_g s_G.

    `rate` multiplies δd and `reading` multiplies δM_g.
    """
    for c in range(3):
        for j in range(SIZE):
            h[c, j] = 0.0
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        h[c, V + c] = 1.0
        h[c, BG + b] = -d[a]
        h[c, BG + a] = d[b]
        h[c, D + b] = -rate[a]
        h[c, D + a] = rate[b]
        for k in range(3):
            h[c, MG + 3 * b + k] = -d[a] * reading[k]
            h[c, MG + 3 * a + k] = d[b] * reading[k]


@inner
def update_joint_velocity(
    s: Record, jumped: bool, before: Vec, reading: Vec, h: float, imu: ImuCalibration, q: Record
) -> bool:
    """Apply the constraint. False where the gate rejects a reading that jumped.

    `before` is the reading before a jump, `h` the time since the last update (s).
    """
    d = vec.load(s.j2s)
    unbiased = vec.minus(reading, vec.load(s.gyro_bias))
    rate = angular_rate(s, reading)
    if not jumped:
        follow_spread(s.spread, rate, h)
    excited = excited_part(s.spread, rate, imu.gyro_variance)
    innovation = vec.minus(vec.cross(rate, d), vec.load(s.velocity))
    fill_jacobian(s.jacobian, excited, clear_part(unbiased, imu.gyro_variance), d)
    expected = project(s)
    # Not in H P Hᵀ: the product of two unknowns δb_g × δd, the play, the reading's noise, and δd where not excited.
    lever = sub_covariance(s.covariance, D)
    product = 0.5 * vec.trace(sub_covariance(s.covariance, BG)) * vec.trace(lever)
    expected = vec.plus_diagonal(expected, product + q.velocity_floor_m_s**2)
    expected = vec.add(expected, imu.gyro_variance, vec.cross_square(d, 1.0))
    expected = vec.add(expected, 1.0, vec.cross_product_covariance(vec.minus(rate, excited), lever))
    moved = vec.minus(before, vec.load(s.gyro_bias)) if jumped else rate  # a spike must not excuse itself
    reach = vec.dot(moved, moved) * vec.dot(d, d)
    excess = vec.scale(reach, _shares(s, 0.0, q))
    whole = vec.add_diagonal(expected, excess)
    distance = vec.quadratic(vec.inverse(whole), innovation)
    _follow_residual(s, innovation, expected, excess, reach, h, q)
    if jumped and not distance <= _GATE:
        return False
    lasting = max(2.0 * q.residual_correlation_s / h, 1.0) - 1.0
    x, y, z = measured_shares(s, q)
    least = q.least_residual**2
    inverse = vec.inverse(vec.add_diagonal(whole, vec.scale(lasting * reach, (x - least, y - least, z - least))))
    if not distance <= _GATE:
        inverse = vec.scaled(_GATE / distance, inverse)  # the state may be wrong: a cautious update
    update_vector(s, innovation, inverse)
    return True


@inner
def measured_shares(s: Record, q: Record) -> Vec:
    """Share of (‖ω‖ ‖d‖)² that the constraint leaves over on each axis, without what is assumed at the start."""
    return _shares(s, s.assumed * FIRST_REACH_M2_S2 * q.first_residual**2, q)


@inner
def _shares(s: Record, less: float, q: Record) -> Vec:
    """The same, less a mean square (m²/s²) that does not count."""
    least, r = q.least_residual**2, s.residual_square
    return (
        min(max((r[0] - less) / s.reach_square, least), 1.0),
        min(max((r[1] - less) / s.reach_square, least), 1.0),
        min(max((r[2] - less) / s.reach_square, least), 1.0),
    )


@inner
def _follow_residual(s: Record, innovation: Vec, expected: Sym, excess: Vec, reach: float, h: float, q: Record) -> None:
    """Measure the square that the constraint leaves over on each axis, and ‖ω‖² ‖d‖²."""
    known, keep = (expected[0], expected[3], expected[5]), min(h / q.residual_time_s, 1.0)
    for k in range(3):
        square = min(innovation[k] * innovation[k], _GATE * (known[k] + excess[k]))
        s.residual_square[k] += keep * (square - known[k] - s.residual_square[k])
    s.reach_square += keep * (reach - s.reach_square)
    s.assumed *= 1.0 - keep
