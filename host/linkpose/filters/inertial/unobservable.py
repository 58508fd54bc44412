"""The directions of the state that the joint's constraint can never observe.

Let the sensor's axes be turned by a small φ, against those that the housing marks. Z, v, b_a, X and J2S then turn with
them, and both sensors have the misalignment M = −[φ×]. Every innovation stays: the readings do not determine φ. What is
known of φ is in the priors of M and of J2S. Where J2S is known, only a φ about J2S is undetermined, because it leaves
J2S as it is; where J2S is unknown, each φ is. Mean and variance of φ are those of the priors for ever. Each update is
linear at another estimate, though, and the small differences between these lines move φ and shrink its variance, by a
factor of three in a minute. Both are set back here.

Source: G. Huang, A. Mourikis, S. Roumeliotis, "Observability-based rules for designing consistent EKF SLAM estimators",
Int. J. Robotics Research 29(5), 2010, describe the effect; there the lines are chosen, here the result is corrected.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._vector import Sym, Vec
from linkpose.filters.inertial.state import BA, MA, MG, PSI, SIZE, D, Floats, Record, V, Z
from linkpose.filters.inertial.update import constrain_attitude

_ALONG = 0.7  # an axis with a larger share of the sensor's x axis is not crossed with it


@inner
def restore_unobservable(s: Record) -> None:
    """Set φ about J2S, and about two axes across it, back to its prior."""
    d = vec.load(s.j2s)
    length = math.sqrt(vec.dot(d, d))
    along = vec.scale(1.0 / length, d) if length > 0.0 else (0.0, 0.0, 1.0)
    across = vec.unit(vec.cross(along, (1.0, 0.0, 0.0) if abs(along[0]) < _ALONG else (0.0, 1.0, 0.0)))
    turn = _turn_covariance(s)
    _restore(s, along, turn)
    _restore(s, across, turn)
    _restore(s, vec.cross(along, across), turn)


@inner
def _restore(s: Record, axis: Vec, covariance: Sym) -> None:
    """Set φ about `axis` back: the mean of the state along this direction, and the variance where it lacks.

    `covariance` of φ (rad²) may be that before other axes, across this one, were set back: their part is zero here. The
    inverse variances of the misalignment and of J2S add up; their means are weighted with them.
    """
    p, u, prior = s.covariance, s.direction, s.prior
    fill_direction(s, axis)
    of_sensors = 1.0 / _misalignment_variance(prior, axis)
    of_lever, turn = 0.0, 0.0
    for i in range(D, PSI):
        of_lever += u[i] * u[i] / prior[i]
        turn += u[i] * (s.nominal[i] - s.start_mean[i]) / prior[i]
    for i in range(MA, D):
        turn += 0.25 * of_sensors * u[i] * (s.nominal[i] - s.start_mean[i])
    variance = 1.0 / (of_sensors + of_lever)
    for i in range(SIZE):
        s.nominal[i] -= variance * turn * u[i]
    constrain_attitude(s)
    lacking = variance - vec.quadratic(covariance, axis)
    if lacking <= 0.0:
        return
    for i in range(SIZE):
        for j in range(SIZE):
            p[i, j] += lacking * u[i] * u[j]


@inner
def fill_direction(s: Record, axis: Vec) -> None:
    """Change of the state with φ about `axis`: of Z, v, b_a, M_a, M_g, J2S and ψ."""
    u = s.direction
    for i in range(SIZE):
        u[i] = 0.0
    z, v = vec.cross(axis, vec.load(s.tilt)), vec.cross(axis, vec.load(s.velocity))
    b, d = vec.cross(axis, vec.load(s.accel_bias)), vec.cross(axis, vec.load(s.j2s))
    for i in range(3):
        u[Z + i], u[V + i], u[BA + i], u[D + i] = z[i], v[i], b[i], d[i]
        j, k = (i + 1) % 3, (i + 2) % 3
        u[MA + 3 * j + k] = u[MG + 3 * j + k] = axis[i]
        u[MA + 3 * k + j] = u[MG + 3 * k + j] = -axis[i]
    u[PSI] = -vec.dot(axis, vec.load(s.tilt))


@inner
def _misalignment_variance(prior: Floats, axis: Vec) -> float:
    """Prior variance of φ: the mean, over both sensors, of the antisymmetric part of M about `axis` (rad²)."""
    total = 0.0
    for i in range(3):
        at = 3 * ((i + 1) % 3) + (i + 2) % 3
        mirrored = 3 * ((i + 2) % 3) + (i + 1) % 3
        cross = prior[MA + at] + prior[MA + mirrored] + prior[MG + at] + prior[MG + mirrored]
        total += axis[i] * axis[i] * cross / 16.0
    return total


@inner
def _turn_covariance(s: Record) -> Sym:
    """Covariance of φ (rad²): the mean, over both sensors, of the antisymmetric part of M, about each axis."""
    p = s.covariance
    return (
        _turn_part(p, 0, 0), _turn_part(p, 0, 1), _turn_part(p, 0, 2),
        _turn_part(p, 1, 1), _turn_part(p, 1, 2), _turn_part(p, 2, 2),
    )  # fmt: skip


@inner
def _turn_part(p: Floats, first: int, second: int) -> float:
    """Element (first, second) of it: of four signed elements of M_a and M_g with the four others."""
    up, down = 3 * ((first + 1) % 3) + (first + 2) % 3, 3 * ((first + 2) % 3) + (first + 1) % 3
    right, left = 3 * ((second + 1) % 3) + (second + 2) % 3, 3 * ((second + 2) % 3) + (second + 1) % 3
    total = 0.0
    for sensor in (MA, MG):
        for other in (MA, MG):
            total += p[sensor + up, other + right] - p[sensor + up, other + left]
            total += p[sensor + down, other + left] - p[sensor + down, other + right]
    return total / 16.0
