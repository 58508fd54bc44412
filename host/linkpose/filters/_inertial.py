"""What `joint-inertial` and `tilt-inertial` share: tilt and velocity integrated over a step, and their covariance.

Both have the tilt Z in rows 0 to 2 of their state and the velocity v in rows 3 to 5, in the sensor's frame:

    Ż = −ω × Z        v̇ = −ω × v + f − g Z

with the angular rate ω and the specific force f that each makes of what the sensors read.
"""

from __future__ import annotations

from linkpose.compiling import compiled, inlined
from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY, Floats
from linkpose.filters._vector import Vec

Z, V = 0, 3  # where each begins in the state
Rows = tuple[Vec, Vec, Vec]


@inlined
def predict_mean(x: Floats, turn: Vec, before: Vec, force: Vec, h: float) -> None:
    """Tilt and velocity after a step `h` that turns the frame by `turn` (rad), with f (m/s²) at both its ends.

    The rotation is exact, the velocity by the trapezoid.
    """
    tilt, v, half = vec.at(x, Z), vec.at(x, V), 0.5 * h
    v = (
        v[0] + half * (before[0] - GRAVITY * tilt[0]),
        v[1] + half * (before[1] - GRAVITY * tilt[1]),
        v[2] + half * (before[2] - GRAVITY * tilt[2]),
    )
    tilt, v = vec.unit(vec.turn_back(turn, tilt)), vec.turn_back(turn, v)
    vec.put(x, Z, tilt)
    x[V] = v[0] + half * (force[0] - GRAVITY * tilt[0])
    x[V + 1] = v[1] + half * (force[1] - GRAVITY * tilt[1])
    x[V + 2] = v[2] + half * (force[2] - GRAVITY * tilt[2])


@inlined
def rotation_rows(turn: Vec) -> Rows:
    """Rows of the matrix exp(−[turn×])."""
    back = (-turn[0], -turn[1], -turn[2])
    return (
        vec.turn_back(back, (1.0, 0.0, 0.0)),
        vec.turn_back(back, (0.0, 1.0, 0.0)),
        vec.turn_back(back, (0.0, 0.0, 1.0)),
    )


@inlined
def spread(z: Vec, v: Vec, w: Vec, f: Vec, rows: Rows, tilt: Vec, velocity: Vec, h: float) -> tuple[Vec, Vec]:
    """Errors of tilt and velocity after a step, from small ones before it and of ω (`w`) and f over it."""
    z = (vec.dot(rows[0], z), vec.dot(rows[1], z), vec.dot(rows[2], z))
    g, by_tilt, by_velocity = GRAVITY * h, vec.cross(tilt, w), vec.cross(velocity, w)
    v = (
        vec.dot(rows[0], v) - g * z[0] + h * (by_velocity[0] + f[0]),
        vec.dot(rows[1], v) - g * z[1] + h * (by_velocity[1] + f[1]),
        vec.dot(rows[2], v) - g * z[2] + h * (by_velocity[2] + f[2]),
    )
    return (z[0] + h * by_tilt[0], z[1] + h * by_tilt[1], z[2] + h * by_tilt[2]), v


@compiled
def add_noise(p: Floats, tilt: Vec, velocity: Vec, rotation: float, gained: float) -> None:
    """Noise of a step: variances, on each axis, of its rotation (rad²) and of the velocity gained (m²/s²)."""
    # The same wrong rotation turns tilt and velocity: [Z×][Z×]ᵀ, [v×][v×]ᵀ, and [Z×][v×]ᵀ = (Z·v) I − v Zᵀ.
    zz, vv, zv = vec.cross_square(tilt, rotation), vec.cross_square(velocity, rotation), vec.dot(tilt, velocity)
    k = 0
    for i in range(3):
        for j in range(i, 3):
            p[Z + i, Z + j] += zz[k]
            p[V + i, V + j] += vv[k]
            p[Z + j, Z + i], p[V + j, V + i] = p[Z + i, Z + j], p[V + i, V + j]
            k += 1
        p[V + i, V + i] += gained
        for j in range(3):
            p[Z + i, V + j] += rotation * ((zv if i == j else 0.0) - velocity[i] * tilt[j])
            p[V + j, Z + i] = p[Z + i, V + j]


@compiled
def take(x: Floats, p: Floats, c: int, innovation: float, noise: float) -> None:
    """The Kalman correction by a measurement of one component of the state, of that variance."""
    n = len(x)
    scale = 1.0 / (p[c, c] + noise)
    for i in range(n):
        x[i] += p[i, c] * scale * innovation
    for i in range(n):
        if i != c:
            k = p[i, c] * scale
            for j in range(i, n):
                if j != c:
                    p[i, j] -= k * p[j, c]
                    p[j, i] = p[i, j]
    for i in range(n):
        p[i, c] = p[c, i] = p[i, c] * noise * scale
