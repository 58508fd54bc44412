"""Vectors of the plane as complex numbers, x + jy, and angles."""

from __future__ import annotations

import math

from linkpose.compiling import inner


@inner
def scaled(factor: float, z: complex) -> complex:
    """A multiple of a vector of the plane; the compiler takes longer over its general product of complex numbers."""
    return complex(factor * z.real, factor * z.imag)


@inner
def turned(a: complex, b: complex) -> complex:
    """The product of two complex numbers, such as b turned by the angle of a."""
    return complex(a.real * b.real - a.imag * b.imag, a.real * b.imag + a.imag * b.real)


@inner
def square(z: complex) -> float:
    """‖z‖²."""
    return z.real * z.real + z.imag * z.imag


@inner
def dot(a: complex, b: complex) -> float:
    """Scalar product of two vectors of the plane."""
    return a.real * b.real + a.imag * b.imag


@inner
def unit(angle: float) -> complex:
    """e^{jx}."""
    return complex(math.cos(angle), math.sin(angle))


@inner
def turned_mean(angle: float) -> complex:
    """Mean of e^{jx} for x from 0 to `angle` (rad): the chord of an arc over its length."""
    half = 0.5 * angle
    share = math.sin(half) / half if abs(half) > 1e-6 else 1.0
    return scaled(share, unit(half))
