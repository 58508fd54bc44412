"""Rotations and shapes of the page's scene. Vectors are columns in metres, quaternions are (w, x, y, z)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.measurements import Floats

_HALF = math.radians(0.5)  # half an angle in radians, of one in degrees
_SEGMENTS = 48  # of a circle
_WIDEST_RAD = math.radians(80.0)  # half the opening of a cone: wider ones cannot be drawn


def attitude(roll_deg: float, pitch_deg: float, yaw_deg: float) -> list[float]:
    """The quaternion (4 numbers) that turns the sensor's axes into n (z upwards): Rz(yaw)·Ry(pitch)·Rx(roll).

    NaN where roll or pitch is NaN; an unknown yaw is drawn as 0.
    """
    yaw = yaw_deg if math.isfinite(yaw_deg) else 0.0
    roll, pitch, yaw = _HALF * roll_deg, _HALF * pitch_deg, _HALF * yaw
    cr, sr, cp, sp, cy, sy = (
        math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch), math.cos(yaw), math.sin(yaw)
    )  # fmt: skip
    return [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]


def turned(q: Floats, vector: Floats) -> Floats:
    """A vector (3,) after the rotation by the quaternion q (4,)."""
    across = 2 * np.cross(q[1:], vector)
    return np.asarray(vector + q[0] * across + np.cross(q[1:], across))


def turn_z_to(direction: Floats) -> Floats:
    """The quaternion (4,) of the shortest turn from the z axis to `direction` (3,), which is not 0."""
    x, y, z = direction / np.linalg.norm(direction)
    if z < -1.0 + 1e-12:
        return np.array([0.0, 1.0, 0.0, 0.0])
    turn: Floats = np.array([1.0 + z, -y, x, 0.0]) / math.sqrt(2.0 + 2.0 * z)
    return turn


def cone_radius(length_m: float, std_deg: float) -> float:
    """Radius (m) of a cone of ±2σ about an axis of this length; 0 where σ is not known."""
    if not math.isfinite(std_deg):
        return 0.0
    return length_m * math.tan(min(math.radians(2 * std_deg), _WIDEST_RAD))


def cone() -> tuple[Floats, NDArray[np.uint32]]:
    """Vertices (N, 3) and faces of an open cone with its tip at the origin, up to a circle of radius 1 at z = 1."""
    angles = np.linspace(0.0, 2 * np.pi, _SEGMENTS, endpoint=False)
    circle = np.column_stack([np.cos(angles), np.sin(angles), np.ones(_SEGMENTS)])
    at = np.arange(_SEGMENTS)
    faces = np.column_stack([np.zeros(_SEGMENTS), 1 + at, 1 + (at + 1) % _SEGMENTS])
    return np.vstack([np.zeros(3), circle]), faces.astype(np.uint32)


def polyline(points: Floats) -> Floats:
    """Points (N, 3) of a path as segments (M, 2, 3). A point that is not finite is a gap: no segment crosses it."""
    segments = np.stack([points[:-1], points[1:]], axis=1)
    return segments[np.isfinite(segments).all(axis=(1, 2))]


def ellipse(place: Floats, z: float) -> Floats:
    """The ellipse of 2σ about a place, as segments (N, 2, 3) at height z (m).

    `place` is x, y, any, σ of x and of y (m), covariance of x and y (m²).
    """
    x, y, _, std_x, std_y, covariance = place[:6].tolist()
    matrix = np.array([[std_x**2, covariance], [covariance, std_y**2]])
    variances, axes = np.linalg.eigh(matrix)
    angles = np.linspace(0.0, 2 * np.pi, _SEGMENTS + 1)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    points = 2.0 * axes @ (np.sqrt(np.maximum(variances, 0.0))[:, np.newaxis] * circle)
    return polyline(np.column_stack([x + points[0], y + points[1], np.full(_SEGMENTS + 1, z)]))
