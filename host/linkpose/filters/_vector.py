"""Vectors and symmetric 3 × 3 matrices as tuples, which the compiler keeps in registers.

A vector is (x, y, z); a symmetric matrix is (xx, xy, xz, yy, yz, zz).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import inner

Floats = NDArray[np.float64]
Vec = tuple[float, float, float]
Sym = tuple[float, float, float, float, float, float]
# Of the rotation r: r (rad), and the factors of [r×] and [r×]² in exp(−[r×]) = I − sine [r×] + cosine [r×]².
Turn = tuple[Vec, float, float]


@inner
def cross(a: Vec, b: Vec) -> Vec:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inner
def dot(a: Vec, b: Vec) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner
def minus(a: Vec, b: Vec) -> Vec:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@inner
def axpy(scale: float, b: Vec, a: Vec) -> Vec:
    """scale · b + a"""
    return (a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2])


@inner
def scale(factor: float, a: Vec) -> Vec:
    return (factor * a[0], factor * a[1], factor * a[2])


@inner
def unit(a: Vec) -> Vec:
    inverse = 1.0 / math.sqrt(dot(a, a))
    return (a[0] * inverse, a[1] * inverse, a[2] * inverse)


@inner
def apply(s: Sym, v: Vec) -> Vec:
    """s v"""
    return (
        s[0] * v[0] + s[1] * v[1] + s[2] * v[2],
        s[1] * v[0] + s[3] * v[1] + s[4] * v[2],
        s[2] * v[0] + s[4] * v[1] + s[5] * v[2],
    )


@inner
def plus_diagonal(s: Sym, value: float) -> Sym:
    """s + value · I"""
    return (s[0] + value, s[1], s[2], s[3] + value, s[4], s[5] + value)


@inner
def add_diagonal(s: Sym, v: Vec) -> Sym:
    """S + diag(v)"""
    return s[0] + v[0], s[1], s[2], s[3] + v[1], s[4], s[5] + v[2]


@inner
def add(a: Sym, scale: float, b: Sym) -> Sym:
    """a + scale · b"""
    return (
        a[0] + scale * b[0],
        a[1] + scale * b[1],
        a[2] + scale * b[2],
        a[3] + scale * b[3],
        a[4] + scale * b[4],
        a[5] + scale * b[5],
    )


@inner
def scaled(scale: float, s: Sym) -> Sym:
    """scale · s"""
    return (scale * s[0], scale * s[1], scale * s[2], scale * s[3], scale * s[4], scale * s[5])


@inner
def trace(s: Sym) -> float:
    return s[0] + s[3] + s[5]


@inner
def cholesky(s: Sym) -> Sym:
    """L of s = L Lᵀ, s positive definite: (l00, l10, l20, l11, l21, l22)."""
    l00 = math.sqrt(s[0])
    l10, l20 = s[1] / l00, s[2] / l00
    l11 = math.sqrt(s[3] - l10 * l10)
    l21 = (s[4] - l20 * l10) / l11
    return l00, l10, l20, l11, l21, math.sqrt(s[5] - l20 * l20 - l21 * l21)


@inner
def inverse(s: Sym) -> Sym:
    """Inverse of a positive definite matrix, by cofactors."""
    c00 = s[3] * s[5] - s[4] * s[4]
    c01 = s[2] * s[4] - s[1] * s[5]
    c02 = s[1] * s[4] - s[2] * s[3]
    scale = 1.0 / (s[0] * c00 + s[1] * c01 + s[2] * c02)
    return (
        c00 * scale,
        c01 * scale,
        c02 * scale,
        (s[0] * s[5] - s[2] * s[2]) * scale,
        (s[1] * s[2] - s[0] * s[4]) * scale,
        (s[0] * s[3] - s[1] * s[1]) * scale,
    )


@inner
def quadratic(s: Sym, v: Vec) -> float:
    """vᵀ s v"""
    return dot(v, apply(s, v))


@inner
def load(a: Floats) -> Vec:
    """The first three elements of an array."""
    return (a[0], a[1], a[2])


@inner
def row(a: Floats, i: int) -> Vec:
    """Row i of an (N, 3) array."""
    return (a[i, 0], a[i, 1], a[i, 2])


@inner
def store(a: Floats, value: Vec) -> None:
    """Store a vector in the first three elements of an array."""
    a[0], a[1], a[2] = value


@inner
def load_sym(a: Floats) -> Sym:
    """The symmetric matrix stored in an array of six."""
    return (a[0], a[1], a[2], a[3], a[4], a[5])


@inner
def cross_square(v: Vec, scale: float) -> Sym:
    """scale · [v×][v×]ᵀ = scale · (‖v‖² I − v vᵀ)"""
    xx, yy, zz = v[0] * v[0], v[1] * v[1], v[2] * v[2]
    return (
        scale * (yy + zz),
        -scale * v[0] * v[1],
        -scale * v[0] * v[2],
        scale * (xx + zz),
        -scale * v[1] * v[2],
        scale * (xx + yy),
    )


@inner
def outer(v: Vec) -> Sym:
    """v vᵀ"""
    return (v[0] * v[0], v[0] * v[1], v[0] * v[2], v[1] * v[1], v[1] * v[2], v[2] * v[2])


@inner
def parallel(a: Sym, b: Sym, a_plus_b_inverse: Sym) -> Sym:
    """a (a + b)⁻¹ b, symmetric and positive where a and b are: a Kalman-updated covariance without a subtraction."""
    i = a_plus_b_inverse
    c0 = apply(i, (b[0], b[1], b[2]))
    c1 = apply(i, (b[1], b[3], b[4]))
    c2 = apply(i, (b[2], b[4], b[5]))
    r0, r1, r2 = (a[0], a[1], a[2]), (a[1], a[3], a[4]), (a[2], a[4], a[5])
    return (
        dot(r0, c0),
        0.5 * (dot(r0, c1) + dot(r1, c0)),
        0.5 * (dot(r0, c2) + dot(r2, c0)),
        dot(r1, c1),
        0.5 * (dot(r1, c2) + dot(r2, c1)),
        dot(r2, c2),
    )


@inner
def turn_of(rotation: Vec) -> Turn:
    """The coefficients of exp(−[rotation×]), computed once for all that turns by this rotation (rad)."""
    square = dot(rotation, rotation)
    if square < 0.01:  # series: relative error below 1e-10
        sine = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
        cosine = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0))
    else:
        angle = math.sqrt(square)
        sine = math.sin(angle) / angle
        cosine = (1.0 - math.cos(angle)) / square
    return rotation, sine, cosine


@inner
def turn_back(turn: Turn, v: Vec) -> Vec:
    """exp(−[rotation×]) v: a fixed vector, expressed in a frame that has turned by the rotation."""
    rotation, sine, cosine = turn
    first = cross(rotation, v)
    second = cross(rotation, first)
    return (
        v[0] - sine * first[0] + cosine * second[0],
        v[1] - sine * first[1] + cosine * second[1],
        v[2] - sine * first[2] + cosine * second[2],
    )


@inner
def turn_back_sym(r: Vec, s: Sym) -> Sym:
    """(I − [r×]) s (I − [r×])ᵀ: a covariance after a small turn r (rad), to first order, and still positive."""
    m00, m01, m02 = s[0] + r[2] * s[1] - r[1] * s[2], s[1] + r[2] * s[3] - r[1] * s[4], s[2] + r[2] * s[4] - r[1] * s[5]
    m10, m11, m12 = s[1] - r[2] * s[0] + r[0] * s[2], s[3] - r[2] * s[1] + r[0] * s[4], s[4] - r[2] * s[2] + r[0] * s[5]
    m20, m21, m22 = s[2] + r[1] * s[0] - r[0] * s[1], s[4] + r[1] * s[1] - r[0] * s[3], s[5] + r[1] * s[2] - r[0] * s[4]
    return (
        m00 + r[2] * m01 - r[1] * m02,
        m01 - r[2] * m00 + r[0] * m02,
        m02 + r[1] * m00 - r[0] * m01,
        m11 - r[2] * m10 + r[0] * m12,
        m12 + r[1] * m10 - r[0] * m11,
        m22 + r[1] * m20 - r[0] * m21,
    )


@inner
def wrapped(angle: float) -> float:
    """The angle (rad) in [−π, π)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@inner
def roll_pitch(tilt: Vec) -> tuple[float, float]:
    """roll = atan2(Z_y, Z_z), pitch = atan2(−Z_x, ‖(Z_y, Z_z)‖), degrees."""
    roll, pitch = math.atan2(tilt[1], tilt[2]), math.atan2(-tilt[0], math.sqrt(tilt[1] * tilt[1] + tilt[2] * tilt[2]))
    return math.degrees(roll), math.degrees(pitch)


@inner
def squared(s: Sym) -> Sym:
    """s s"""
    return (
        s[0] * s[0] + s[1] * s[1] + s[2] * s[2],
        s[0] * s[1] + s[1] * s[3] + s[2] * s[4],
        s[0] * s[2] + s[1] * s[4] + s[2] * s[5],
        s[1] * s[1] + s[3] * s[3] + s[4] * s[4],
        s[1] * s[2] + s[3] * s[4] + s[4] * s[5],
        s[2] * s[2] + s[4] * s[4] + s[5] * s[5],
    )


@inner
def cross_product_covariance(v: Vec, s: Sym) -> Sym:
    """[v×] s [v×]ᵀ: covariance of v × e, e of covariance s."""
    c0 = cross(v, (s[0], s[1], s[2]))
    c1 = cross(v, (s[1], s[3], s[4]))
    c2 = cross(v, (s[2], s[4], s[5]))
    r0, r1, r2 = (c0[0], c1[0], c2[0]), (c0[1], c1[1], c2[1]), (c0[2], c1[2], c2[2])
    x, y, z = cross(v, r0), cross(v, r1), cross(v, r2)
    return x[0], x[1], x[2], y[1], y[2], z[2]
