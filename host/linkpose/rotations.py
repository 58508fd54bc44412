"""Angles and rotations as arrays. A quaternion is w, x, y, z along the last axis and has unit length."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Angle = TypeVar("Angle", float, Floats)


def wrapped(angle: Angle) -> Angle:
    """The same direction (rad) in [−π, π)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def product(a: Floats, b: Floats) -> Floats:
    """The quaternions (..., 4) a b: first the rotation b, then a."""
    (aw, ax, ay, az), (bw, bx, by, bz) = (np.moveaxis(q, -1, 0) for q in (a, b))
    parts = [
        aw * bw - (ax * bx + ay * by + az * bz),
        aw * bx + bw * ax + (ay * bz - az * by),
        aw * by + bw * ay + (az * bx - ax * bz),
        aw * bz + bw * az + (ax * by - ay * bx),
    ]
    return np.stack(parts, axis=-1)


def rotation_vectors(q: Floats) -> Floats:
    """Rotation vectors (N, 3) in rad, of at most a half turn, of quaternions (N, 4)."""
    q = q * np.where(q[:, :1] < 0, -1.0, 1.0)
    size = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    per_size = 2 * np.arctan2(size, q[:, :1]) / np.maximum(size, 1e-12)
    return np.asarray(q[:, 1:] * np.where(size > 1e-12, per_size, 2.0))


def of_vectors(vectors: Floats) -> Floats:
    """Quaternions (N, 4) of rotation vectors (N, 3) in rad."""
    angle = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.hstack([np.cos(angle / 2), vectors * 0.5 * np.sinc(angle / (2 * math.pi))])


def matrices(q: Floats) -> Floats:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4)."""
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def swing_twist(q: Floats) -> Floats:
    """Quaternions (N, 4) as swing · twist, the twist about z: the two components (rad) of the swing's rotation vector,
    which lies in the xy plane, and the angle of the twist (rad), (N, 3).

    Source: [Baerlocher2001], 3.
    """
    norm = np.hypot(q[:, 0], q[:, 3])
    safe = np.where(norm > 1e-12, norm, 1.0)
    twist = np.column_stack([np.where(norm > 1e-12, q[:, 0] / safe, 1.0), np.zeros((len(q), 2)), q[:, 3] / safe])
    swing = product(q, twist * [1.0, 1.0, 1.0, -1.0])
    angle = wrapped(2 * np.arctan2(twist[:, 3], twist[:, 0]))
    return np.column_stack([rotation_vectors(swing)[:, :2], angle])


def of_matrices(rotation: Floats) -> Floats:
    """Quaternions (N, 4) of rotation matrices (N, 3, 3); w is not negative.

    The largest of the four numbers follows from the diagonal, the others from it (S. W. Shepperd, 1978).
    """
    r = np.moveaxis(rotation, 0, 2)
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    wx, wy, wz = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    xx, yy, zz = (1 + 2 * r[i, i] - trace for i in range(3))
    rows = np.array([[1 + trace, wx, wy, wz], [wx, xx, xy, xz], [wy, xy, yy, yz], [wz, xz, yz, zz]])
    q = rows[np.argmax([1 + trace, xx, yy, zz], axis=0), :, np.arange(len(rotation))]
    q *= np.where(q[:, :1] < 0, -1.0, 1.0) / np.linalg.norm(q, axis=1, keepdims=True)
    return np.asarray(q)
