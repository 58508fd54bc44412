"""A velocity that stays small as a measurement: 0 = v + e, where no joint gives the velocity.

A sensor that a hand, a robot or a pendulum moves returns to where it was. Its velocity has zero mean, variance σ² and a
short correlation time T. To an estimate slower than T that is white noise of the same density, R = σ² · 2T / h. A wrong
tilt integrates to a velocity that grows where e does not. σ² is measured: the acceleration of the last second,
integrated, less the share of the tilt's own uncertainty. T is measured as the ratio of velocity and acceleration.

Source: the density of a first-order Gauss-Markov process at low frequencies is 2σ²T.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY
from linkpose.filters._vector import Vec
from linkpose.filters.inertial.rest import REST_S
from linkpose.filters.inertial.state import BA, SIZE, Record, V, Z
from linkpose.filters.inertial.update import project, sub_covariance, update_vector

# A square velocity beyond 1 / _RISE of the mean is no swing of the same motion but a faster one: the mean follows at
# once. At 1 a regular swing would count by its peaks: BROAD 3 % worse, a chain of links 6 % better.
_RISE = 1.0 / 3.0


@inner
def follow_speed(s: Record, turn: Vec, force: Vec, h: float, q: Record) -> None:
    """Measure σ² over a step that turned the sensor by `turn` (rad).

    The force is the reading, without the estimated errors: a filter that shrinks the force would shrink σ with it, and
    trust its error the more. The acceleration's mean square is measured beside it. A rest changes nothing: the next
    motion is assumed to be as fast as the last.
    """
    swing = vec.turn_back(vec.turn_of(turn), vec.load(s.swing))
    accel = vec.axpy(-GRAVITY, vec.load(s.tilt), force)
    swing = vec.axpy(h, accel, vec.scale(1.0 - min(h / q.swing_time_s, 1.0), swing))
    vec.store(s.swing, swing)
    own = vec.trace(sub_covariance(s.covariance, Z)) * (GRAVITY * q.swing_time_s) ** 2
    square = max(vec.dot(swing, swing) - own, 0.0) / 3.0
    if s.rest_s > REST_S:
        return
    keep = min(h / q.speed_memory_s, 1.0)
    square = max(_RISE * square, s.speed_square + keep * (square - s.speed_square))
    s.speed_square = min(max(square, q.least_speed_m_s**2), q.most_speed_m_s**2)
    s.accel_square += keep * (vec.dot(accel, accel) / 3.0 - s.accel_square)


@inner
def correlation_time(s: Record, q: Record) -> float:
    """T (s): a motion of angular frequency w has accelerations w times its velocities, and T = 1/w."""
    if q.has_joint > 0.0 or s.accel_square <= 0.0:
        return float(q.least_correlation_s)
    return float(min(max(math.sqrt(s.speed_square / s.accel_square), q.least_correlation_s), q.most_correlation_s))


@inner
def update_free_velocity(s: Record, h: float, q: Record) -> None:
    """Apply 0 = v + e, `h` (s) after the last time."""
    for c in range(3):
        for j in range(SIZE):
            s.jacobian[c, j] = 0.0
        s.jacobian[c, V + c] = 1.0
    expected, velocity = project(s), vec.load(s.velocity)
    noise = s.speed_square * max(2.0 * correlation_time(s, q) / h, 1.0)
    update_vector(s, vec.scale(-1.0, velocity), vec.inverse(vec.plus_diagonal(expected, noise)))
    if vec.dot(velocity, velocity) > q.suspect * (vec.trace(expected) + 3.0 * s.speed_square):
        _grow(s, 1.0 + 0.5 * min(h / q.grow_s, 1.0))


@inner
def _grow(s: Record, factor: float) -> None:
    """Widen σ of tilt, velocity and gyro bias by a factor: one of them was assumed known too early."""
    for i in range(BA):
        for j in range(SIZE):
            s.covariance[i, j] *= factor
        for j in range(SIZE):
            s.covariance[j, i] *= factor
