"""Strapdown integration of both sensors, and the propagation of their covariance between two updates.

Over a step the rotation is the trapezoid of the rates with the coning term ω₀ × ω₁ h²/12, and the velocity is the
trapezoid of the forces in n. Source: P. G. Savage, "Strapdown inertial navigation integration algorithm design",
J. Guidance, Control, and Dynamics 21(1), 1998.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters._imu import GRAVITY, LONGEST_STEP_S
from linkpose.filters.chain.rotation import rotate, to_matrix, turn
from linkpose.filters.chain.state import BA, BG, OF_SENSOR, Floats, R, Record, V

GYRO_MISFIT_S, _ACCEL_MISFIT_S = 0.1, 0.05  # correlation times of the misfits
# Over a step longer than any sampling interval, rate and force between two readings are partly a guess.
_JERK_RAD_S3, _JERK_M_S3 = 50.0, 100.0


@inner
def integrate(
    s: Record, k: int, before: Record, gyro: Floats, accel: Floats, h: float, q: Record, noise: Floats
) -> None:
    """Sensor k over a step of h (s), from the readings in `before` to these; accumulates what the covariance needs.

    `noise`: variances of one reading of gyro and accelerometer.
    """
    m, bg, ba = s.rotation[k], s.gyro_bias[k], s.accel_bias[k]
    force, mean, turned = s.a, s.b, s.turned[k]
    for i in range(3):
        force[i] = before.accel[k, i] - ba[i]
    rotate(m, force, mean)
    ax, ay, az = before.gyro[k, 0] - bg[0], before.gyro[k, 1] - bg[1], before.gyro[k, 2] - bg[2]
    bx, by, bz = gyro[k, 0] - bg[0], gyro[k, 1] - bg[1], gyro[k, 2] - bg[2]
    for i in range(3):
        for j in range(3):
            turned[i, j] += 0.5 * h * m[i, j]
    c = h * h / 12
    turn(
        s.attitude[k],
        0.5 * h * (ax + bx) + c * (ay * bz - az * by),
        0.5 * h * (ay + by) + c * (az * bx - ax * bz),
        0.5 * h * (az + bz) + c * (ax * by - ay * bx),
        -1.0,
    )
    to_matrix(s.attitude[k], m)
    for i in range(3):
        force[i] = accel[k, i] - ba[i]
    fx, fy, fz = force[0], force[1], force[2]
    rotate(m, force, s.c)
    square = 0.0
    for i in range(3):
        for j in range(3):
            turned[i, j] += 0.5 * h * m[i, j]
        own = 0.5 * (mean[i] + s.c[i])
        s.impulse[k, i] += own * h
        if i == 2:
            own -= GRAVITY
        s.velocity[k, i] += own * h
        square += own * own
        s.swing[k, i] = s.swing[k, i] * (1 - min(h / q.swing_s, 1.0)) + own * h
    guess = h * h / 12 if h > LONGEST_STEP_S else 0.0
    rate_square = bx * bx + by * by + bz * bz
    turning = (by * fz - bz * fy) ** 2 + (bz * fx - bx * fz) ** 2 + (bx * fy - by * fx) ** 2
    gyro_misfit, accel_misfit = s.level * q.gyro_misfit**2, s.level * q.accel_misfit**2
    misfit_square = rate_square + (slowness(s, k, q) - 1.0) * turning / GRAVITY**2
    s.rotation_variance[k] += h * (h * noise[0] + gyro_misfit * misfit_square * GYRO_MISFIT_S)
    s.rotation_variance[k] += (h * guess * _JERK_RAD_S3) ** 2
    s.path_square[k] += h * misfit_square
    s.velocity_variance[k] += h * (h * noise[1] * s.widening + accel_misfit * s.accel_square[k] * _ACCEL_MISFIT_S)
    s.velocity_variance[k] += (h * guess * _JERK_M_S3) ** 2
    s.force_rate_square[k] += min(h / q.accel_scale_s, 1.0) * (turning - s.force_rate_square[k])
    _follow_speed(s, k, square, h, q)


@inner
def slowness(s: Record, k: int, q: Record) -> float:
    """Time over which gravity turns to and fro in the axes of sensor k, in multiples of `turning_s`; at least 1.

    Scale and cross-axis errors are constant, so that what they add to the rate and to the force lasts as long as the
    turn. White noise with the same sum has a density that is proportional to this time.
    """
    slow = GRAVITY * math.sqrt(s.up_square[k]) / (q.turning_s * math.sqrt(s.force_rate_square[k]) + 1e-9)
    return float(max(slow, 1.0))


@inner
def _follow_speed(s: Record, k: int, accel_square: float, h: float, q: Record) -> None:
    """Measure the mean squares of velocity and acceleration, less the share of the tilt's own uncertainty."""
    p, o = s.covariance, OF_SENSOR * k
    own = (p[o, o] + p[o + 1, o + 1]) * (GRAVITY * q.swing_s) ** 2
    square = max(s.swing[k, 0] ** 2 + s.swing[k, 1] ** 2 + s.swing[k, 2] ** 2 - own, 0.0) / 3
    keep = min(h / q.speed_memory_s, 1.0)
    s.speed_square[k] += keep * (square - s.speed_square[k])
    keep_up = min(h / q.swing_memory_s, 1.0)
    off = changing = apart_square = 0.0
    for i in range(3):
        s.swing_mean[k, i] += keep_up * (s.swing[k, i] - s.swing_mean[k, i])
        changing += (s.swing[k, i] - s.swing_mean[k, i]) ** 2
        apart = s.rotation[k, 2, i] - s.up[k, i]
        s.up[k, i] += keep_up * apart
        apart_square += apart * apart
        s.up_swing[k, i] += h * apart - min(h / q.swing_s, 1.0) * s.up_swing[k, i]
        off += s.up_swing[k, i] ** 2
    s.up_spread[k] += keep * (off - s.up_spread[k])
    s.up_square[k] += keep * (apart_square - s.up_square[k])
    s.shared_square[k] += keep * (changing / 3 - s.shared_square[k])
    s.accel_square[k] += keep * (accel_square / 3 - s.accel_square[k])


@inner
def _advance_rows(p: Floats, size: int, o: int, turned: Floats, impulse: Floats, heading_share: float) -> None:
    """P becomes F P for the sensor whose errors begin at o.

    δθ grows by −∫R dt δb_g; δv by −[∫R f dt ×] of the mean δθ and by −∫R dt δb_a. Of the horizontal force,
    `heading_share` acts on the heading.
    """
    g, a, v = o + BG, o + BA, o + V
    x, y, z = impulse[0], impulse[1], impulse[2]
    for c in range(size):
        g0, g1, g2, a0, a1, a2 = p[g, c], p[g + 1, c], p[g + 2, c], p[a, c], p[a + 1, c], p[a + 2, c]
        d0 = -(turned[0, 0] * g0 + turned[0, 1] * g1 + turned[0, 2] * g2)
        d1 = -(turned[1, 0] * g0 + turned[1, 1] * g1 + turned[1, 2] * g2)
        d2 = -(turned[2, 0] * g0 + turned[2, 1] * g1 + turned[2, 2] * g2)
        m0, m1, m2 = p[o, c] + 0.5 * d0, p[o + 1, c] + 0.5 * d1, p[o + 2, c] + 0.5 * d2
        p[v, c] -= turned[0, 0] * a0 + turned[0, 1] * a1 + turned[0, 2] * a2 + y * m2 * heading_share - z * m1
        p[v + 1, c] -= turned[1, 0] * a0 + turned[1, 1] * a1 + turned[1, 2] * a2 + z * m0 - x * m2 * heading_share
        p[v + 2, c] -= turned[2, 0] * a0 + turned[2, 1] * a1 + turned[2, 2] * a2 + x * m1 - y * m0
        p[o, c] += d0
        p[o + 1, c] += d1
        p[o + 2, c] += d2


@inner
def _transpose(p: Floats, size: int) -> None:
    for i in range(size):
        for j in range(i):
            p[i, j], p[j, i] = p[j, i], p[i, j]


@inner
def _decay_bias(s: Record, size: int, k: int, walk: float, q: Record) -> None:
    """Let the accelerometer bias of sensor k return to its prior, so that `walk` (m²/s⁴) keeps the prior's variance.

    Scale and cross-axis errors are bounded, and so is the bias that stands for them.
    """
    bound = q.accel_bias_m_s2**2 + s.level * (q.accel_scale * GRAVITY) ** 2
    p, keep, first = s.covariance, math.exp(-0.5 * walk / bound), OF_SENSOR * k + BA
    for at in range(first, first + 3):
        s.accel_bias[k, at - first] *= keep
        for j in range(size):
            p[at, j] *= keep
        for j in range(size):
            p[j, at] *= keep


@inner
def propagate_covariance(s: Record, size: int, q: Record) -> None:
    """P over the span since the last update: F P Fᵀ + Q."""
    p, span = s.covariance, s.span
    s.heading_share = 1.0
    for k in range(2):
        apparent = q.heading_speed_m_s**2 + (q.heading_scale * GRAVITY) ** 2 * s.up_spread[k]
        s.heading_share = min(s.heading_share, max(s.shared_square[k] / apparent - 1, 0.0))
    for _ in range(2):  # P Fᵀ is the transpose of F Pᵀ
        for k in range(2):
            _advance_rows(p, size, OF_SENSOR * k, s.turned[k], s.impulse[k], s.heading_share)
        _transpose(p, size)
    for k in range(2):
        o, turned, impulse = OF_SENSOR * k, s.turned[k], s.impulse[k]
        scale_walk = s.level * q.accel_scale**2 * s.force_rate_square[k] * slowness(s, k, q)
        walk = s.widening * (q.accel_walk_m_s2_sqrts**2 + scale_walk) * span
        gyro_walk = (min(s.level, 1.0) if s.is_narrow[k] else 1.0) * q.gyro_walk_rad_s_sqrts**2 * span
        _decay_bias(s, size, k, walk, q)
        for i in range(3):
            p[o + i, o + i] += s.rotation_variance[k]
            p[o + V + i, o + V + i] += s.velocity_variance[k]
            p[o + BG + i, o + BG + i] += gyro_walk
            p[o + BA + i, o + BA + i] += walk
            p[o + R + i, o + R + i] += q.lever_walk_m_sqrts**2 * span
            impulse[i] = 0.0
            for j in range(3):
                turned[i, j] = 0.0
        s.rotation_variance[k] = s.velocity_variance[k] = 0.0
    s.span = 0.0
