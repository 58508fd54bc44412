"""Quaternions (w, x, y, z) and rotation matrices in small arrays."""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters.chain.state import Floats


@inner
def to_matrix(q: Floats, m: Floats) -> None:
    """The matrix (3, 3) of a unit quaternion."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    m[0, 0], m[0, 1], m[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    m[1, 0], m[1, 1], m[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    m[2, 0], m[2, 1], m[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@inner
def turn(q: Floats, x: float, y: float, z: float, side: float) -> None:
    """q becomes exp([v×]) q for `side` 1, q exp([v×]) for −1, with v = (x, y, z) rad; normalised."""
    square = x * x + y * y + z * z
    if square < 1e-6:  # series: relative error below 1e-14
        cosine, scale = 1 - square / 8, 0.5 - square / 48
    else:
        angle = math.sqrt(square)
        cosine, scale = math.cos(angle / 2), math.sin(angle / 2) / angle
    x, y, z = x * scale, y * scale, z * scale
    w0, x0, y0, z0 = q[0], q[1], q[2], q[3]
    w = cosine * w0 - x * x0 - y * y0 - z * z0
    a = cosine * x0 + x * w0 + side * (y * z0 - z * y0)
    b = cosine * y0 + y * w0 + side * (z * x0 - x * z0)
    c = cosine * z0 + z * w0 + side * (x * y0 - y * x0)
    norm = 1 / math.sqrt(w * w + a * a + b * b + c * c)
    q[0], q[1], q[2], q[3] = w * norm, a * norm, b * norm, c * norm


@inner
def between(a: Floats, b: Floats, out: Floats) -> None:
    """out = a⁻¹ b."""
    out[0] = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    out[1] = a[0] * b[1] - a[1] * b[0] - (a[2] * b[3] - a[3] * b[2])
    out[2] = a[0] * b[2] - a[2] * b[0] - (a[3] * b[1] - a[1] * b[3])
    out[3] = a[0] * b[3] - a[3] * b[0] - (a[1] * b[2] - a[2] * b[1])


@inner
def product(a: Floats, b: Floats, out: Floats) -> None:
    """out = a b; `out` is neither of them."""
    out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3]
    out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2]
    out[2] = a[0] * b[2] + a[2] * b[0] + a[3] * b[1] - a[1] * b[3]
    out[3] = a[0] * b[3] + a[3] * b[0] + a[1] * b[2] - a[2] * b[1]


@inner
def rotate(m: Floats, v: Floats, out: Floats) -> None:
    """out = m v."""
    x, y, z = v[0], v[1], v[2]
    for i in range(3):
        out[i] = m[i, 0] * x + m[i, 1] * y + m[i, 2] * z


@inner
def rotate_back(m: Floats, v: Floats, out: Floats) -> None:
    """out = mᵀ v."""
    x, y, z = v[0], v[1], v[2]
    for i in range(3):
        out[i] = m[0, i] * x + m[1, i] * y + m[2, i] * z


@inner
def cross(a: Floats, b: Floats, out: Floats) -> None:
    """out = a × b; `out` is neither of them."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@inner
def square(v: Floats) -> float:
    """‖v‖²."""
    return float(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
