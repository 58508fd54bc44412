"""Alignment to gravity: tilt from one reading of the accelerometer, where nothing better is known."""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY
from linkpose.filters._vector import Vec
from linkpose.filters.inertial.propagate import specific_force
from linkpose.filters.inertial.state import BA, BG, MA, PSI, SIZE, Floats, Record, V, Z
from linkpose.filters.inertial.update import SMALL_RAD2

_NEARLY_VERTICAL = 0.01  # square of the horizontal part of an axis that is too short to give a heading


@inner
def _pointer(tilt: Vec) -> Vec:
    """The sensor's x axis; its z axis where x is nearly vertical."""
    return (0.0, 0.0, 1.0) if 1.0 - tilt[0] * tilt[0] < _NEARLY_VERTICAL else (1.0, 0.0, 0.0)


@inner
def heading_axis(tilt: Vec) -> Vec:
    """X: the sensor's pointer seen from above."""
    axis = _pointer(tilt)
    return vec.unit(vec.axpy(-vec.dot(axis, tilt), tilt, axis))


@inner
def relate_heading(s: Record) -> None:
    """Covariance of ψ with the other errors where X is `heading_axis` of an uncertain tilt.

    Seen from above, the pointer a turns with Z: ψ = (a·Z) / √(1 − (a·Z)²) YᵀδZ, with Y = Z × X. A later correction of
    the tilt then corrects the heading since the start.
    """
    p, tilt = s.covariance, vec.load(s.tilt)
    west, along = vec.cross(tilt, vec.load(s.north)), vec.dot(_pointer(tilt), tilt)
    west = vec.scale(along / math.sqrt(max(1.0 - along * along, _NEARLY_VERTICAL)), west)
    for j in range(PSI):
        p[PSI, j] = p[j, PSI] = west[0] * p[Z, j] + west[1] * p[Z + 1, j] + west[2] * p[Z + 2, j]
    p[PSI, PSI] += west[0] * p[PSI, Z] + west[1] * p[PSI, Z + 1] + west[2] * p[PSI, Z + 2]


@inner
def align_to_gravity(s: Record, reading: Vec, accel_variance: float, velocity: Vec, speed_variance: float) -> None:
    """Tilt from a reading of the accelerometer; heading as it was; velocity as given (m/s).

    `accel_variance` (m²/s⁴) and `speed_variance` (m²/s²) are of the acceleration in the reading and of the velocity, on
    each axis.
    """
    p = s.covariance
    force = specific_force(s, reading)
    tilt = vec.unit(force) if vec.dot(force, force) > 0.0 else (0.0, 0.0, 1.0)
    north = vec.load(s.north)
    north = vec.axpy(-vec.dot(north, tilt), tilt, north)
    vec.store(s.tilt, tilt)
    vec.store(s.north, vec.unit(north) if vec.dot(north, north) > _NEARLY_VERTICAL else heading_axis(tilt))
    vec.store(s.velocity, velocity)
    for i in range(6):
        for j in range(SIZE):
            p[i, j] = p[j, i] = 0.0
    # An error of the accelerometer leans the tilt: δZ = (I − ZZᵀ) δf / g.
    for j in range(BG, SIZE):
        _lean(p, tilt, reading, j)
    for j in range(3):
        _lean(p, tilt, reading, j)
    variance = min(accel_variance / GRAVITY**2, 1.0)
    # Along itself a Z that is turned by large angles falls short: its mean is cos < 1.
    along = 0.5 * max(variance - SMALL_RAD2, 0.0) ** 2
    for i in range(3):
        for j in range(3):
            p[i, j] += (along - variance) * tilt[i] * tilt[j]
        p[i, i] += variance
        p[V + i, V + i] = speed_variance


@inner
def _lean(p: Floats, tilt: Vec, reading: Vec, j: int) -> None:
    """Covariance of δZ with error j, through the accelerometer's errors: δf = −δb_a − δM_a s_A."""
    error = (
        -p[BA, j] - p[MA, j] * reading[0] - p[MA + 1, j] * reading[1] - p[MA + 2, j] * reading[2],
        -p[BA + 1, j] - p[MA + 3, j] * reading[0] - p[MA + 4, j] * reading[1] - p[MA + 5, j] * reading[2],
        -p[BA + 2, j] - p[MA + 6, j] * reading[0] - p[MA + 7, j] * reading[1] - p[MA + 8, j] * reading[2],
    )
    lean = vec.scale(1.0 / GRAVITY, vec.axpy(-vec.dot(tilt, error), tilt, error))
    for i in range(3):
        p[Z + i, j] = lean[i]
        if j >= BG:
            p[j, Z + i] = lean[i]
