"""A velocity that stays small as a measurement: 0 = v + e, where no joint gives the velocity.

A sensor that a hand, a robot or a pendulum moves returns to where it was. Its velocity has zero mean, variance σ² and a
short correlation time T. To an estimate slower than T that is white noise of the same density, R = σ² · 2T / h. A wrong
tilt integrates to a velocity that grows where e does not. σ² is measured: the acceleration of the last second,
integrated, less the share of the tilt's own uncertainty.

Source: the density of a first-order Gauss-Markov process at low frequencies is 2σ²T.
"""

from __future__ import annotations

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY
from linkpose.filters._vector import Vec
from linkpose.filters.inertial.propagate import specific_force
from linkpose.filters.inertial.state import SIZE, Record, V, Z
from linkpose.filters.inertial.update import project, sub_covariance, update_vector

# A squared velocity beyond this many times its expected mean square shows a covariance that is too small.
_SUSPECT = 6.0


@inner
def follow_speed(s: Record, turn: Vec, force: Vec, h: float, q: Record) -> None:
    """Measure σ² over a step that turned the sensor by `turn` (rad)."""
    swing = vec.turn_back(turn, vec.load(s.swing))
    accel = vec.axpy(-GRAVITY, vec.load(s.tilt), specific_force(s, force))
    swing = vec.axpy(h, accel, vec.scale(1.0 - min(h / q.swing_time_s, 1.0), swing))
    vec.store(s.swing, swing)
    own = vec.trace(sub_covariance(s.covariance, Z)) * (GRAVITY * q.swing_time_s) ** 2
    square = max(vec.dot(swing, swing) - own, 0.0) / 3.0
    square = s.speed_square + min(h / q.speed_memory_s, 1.0) * (square - s.speed_square)
    s.speed_square = min(max(square, q.least_speed_m_s**2), q.most_speed_m_s**2)


@inner
def update_free_velocity(s: Record, h: float, q: Record) -> None:
    """Apply 0 = v + e, `h` (s) after the last time."""
    for c in range(3):
        for j in range(SIZE):
            s.jacobian[c, j] = 0.0
        s.jacobian[c, V + c] = 1.0
    expected, velocity = project(s), vec.load(s.velocity)
    noise = s.speed_square * max(2.0 * q.correlation_s / h, 1.0)
    update_vector(s, vec.scale(-1.0, velocity), vec.inverse(vec.plus_diagonal(expected, noise)))
    # Tilt or bias were assumed known too early, as after a start in motion.
    if vec.dot(velocity, velocity) > _SUSPECT * (vec.trace(expected) + 3.0 * s.speed_square):
        grow = 1.0 + min(h / q.grow_s, 1.0)
        for i in range(SIZE):
            for j in range(SIZE):
                s.covariance[i, j] *= grow
