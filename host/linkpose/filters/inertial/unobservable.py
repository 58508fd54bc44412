"""The direction of the state that the joint's constraint can never observe.

Let the sensor's axes be turned by a small φ about J2S, against those that the housing marks. Z, v, b_a and X then turn
with them, and both sensors have the misalignment M = −[φ×]. J2S stays, and so does every innovation: the readings do
not determine φ, and its mean and variance are those of the prior for ever. Each update is linear at another estimate,
though, and the small differences between these lines move φ and shrink its variance, by a factor of three in a minute.
Both are set back here.

Source: G. Huang, A. Mourikis, S. Roumeliotis, "Observability-based rules for designing consistent EKF SLAM estimators",
Int. J. Robotics Research 29(5), 2010, describe the effect; there the lines are chosen, here the result is corrected.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._vector import Vec
from linkpose.filters.inertial.state import BA, MA, MG, PSI, SIZE, Floats, Record, V, Z
from linkpose.filters.inertial.update import constrain_attitude


@inner
def restore_unobservable(s: Record) -> None:
    """Set φ back to its prior: the mean along the unobservable direction, and the variance where it lacks."""
    d = vec.load(s.j2s)
    length = math.sqrt(vec.dot(d, d))
    if length == 0.0:
        return
    axis = vec.scale(1.0 / length, d)
    p, u = s.covariance, s.direction
    fill_direction(s, axis)
    _set_mean_back(s)
    lacking = _misalignment_variance(s.prior, axis) - _turn_variance(s)
    if lacking <= 0.0:
        return
    for i in range(SIZE):
        for j in range(SIZE):
            p[i, j] += lacking * u[i] * u[j]


@inner
def _set_mean_back(s: Record) -> None:
    u, turn = s.direction, 0.0
    for i in range(MA, MG + 9):
        turn += 0.25 * u[i] * (s.nominal[i] - s.start_mean[i])
    for i in range(SIZE):
        s.nominal[i] -= turn * u[i]
    constrain_attitude(s)


@inner
def fill_direction(s: Record, axis: Vec) -> None:
    """Change of the state with φ about `axis`: of Z, v, b_a, M_a, M_g and ψ."""
    u = s.direction
    for i in range(SIZE):
        u[i] = 0.0
    z, v = vec.cross(axis, vec.load(s.tilt)), vec.cross(axis, vec.load(s.velocity))
    b = vec.cross(axis, vec.load(s.accel_bias))
    for i in range(3):
        u[Z + i], u[V + i], u[BA + i] = z[i], v[i], b[i]
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
def _turn_variance(s: Record) -> float:
    """Variance of φ in the covariance: φ is a quarter of the product of M_a, M_g with the direction's own part."""
    p, u, total = s.covariance, s.direction, 0.0
    for i in range(MA, MG + 9):
        for j in range(MA, MG + 9):
            total += u[i] * p[i, j] * u[j]
    return total / 16.0
