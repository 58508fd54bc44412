"""The Kalman updates of the inertial core: one for a vector of three, one for a single state.

Source: any textbook; the factored form K S Kᵀ = Cᵀ C with C = Lᵀ H P and S⁻¹ = L Lᵀ is symmetric to the last bit.
"""

from __future__ import annotations

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._vector import Sym, Vec
from linkpose.filters.inertial.state import BG, PSI, SIZE, Floats, Record, Z

SMALL_RAD2 = 0.01  # variance of Z (all axes) below which its error lies across it (rad²),
_NONE_RAD2 = 1e-6  # with no more than this along it


@inner
def multiply_row(factors: Floats, p: Floats, out: Floats) -> None:
    """out ← factors P: a row of 34, mostly zeros, times the covariance, by three of its rows at a time."""
    for j in range(SIZE):
        out[j] = 0.0
    for k in range(0, PSI, 3):
        a, b, c = factors[k], factors[k + 1], factors[k + 2]
        if a != 0.0 or b != 0.0 or c != 0.0:
            for j in range(SIZE):
                out[j] = out[j] + a * p[k, j] + b * p[k + 1, j] + c * p[k + 2, j]
    a = factors[PSI]
    if a != 0.0:
        for j in range(SIZE):
            out[j] += a * p[PSI, j]


@inner
def project(s: Record) -> Sym:
    """H P into `work` (three rows), and H P Hᵀ, with H in `jacobian`."""
    h, p, w = s.jacobian, s.covariance, s.work
    for i in range(3):
        multiply_row(h[i], p, w[i])
    xx = xy = xz = yy = yz = zz = 0.0
    for k in range(SIZE):
        xx += w[0, k] * h[0, k]
        xy += w[0, k] * h[1, k]
        xz += w[0, k] * h[2, k]
        yy += w[1, k] * h[1, k]
        yz += w[1, k] * h[2, k]
        zz += w[2, k] * h[2, k]
    return xx, xy, xz, yy, yz, zz


@inner
def update_vector(s: Record, innovation: Vec, inverse: Sym) -> None:
    """Kalman update by an innovation of three, after `project`; `inverse` is that of the innovation's covariance S."""
    w, p = s.work, s.covariance
    l00, l10, l20, l11, l21, l22 = vec.cholesky(inverse)
    y0 = l00 * innovation[0] + l10 * innovation[1] + l20 * innovation[2]
    y1 = l11 * innovation[1] + l21 * innovation[2]
    y2 = l22 * innovation[2]
    for j in range(SIZE):
        w[0, j] = l00 * w[0, j] + l10 * w[1, j] + l20 * w[2, j]
        w[1, j] = l11 * w[1, j] + l21 * w[2, j]
        w[2, j] = l22 * w[2, j]
    for j in range(SIZE):
        s.nominal[j] += y0 * w[0, j] + y1 * w[1, j] + y2 * w[2, j]
    for i in range(SIZE):
        c0, c1, c2 = w[0, i], w[1, i], w[2, i]
        for j in range(SIZE):
            p[i, j] -= c0 * w[0, j] + c1 * w[1, j] + c2 * w[2, j]
    constrain_attitude(s)


@inner
def update_scalar(s: Record, k: int, innovation: float, variance: float) -> None:
    """Kalman update by a measurement of state k, of that variance. The caller constrains the attitude."""
    p, w = s.covariance, s.work
    scale = 1.0 / (p[k, k] + variance)
    for j in range(SIZE):
        w[0, j] = p[k, j]
    for i in range(SIZE):
        gain = w[0, i] * scale
        s.nominal[i] += gain * innovation
        for j in range(SIZE):
            p[i, j] -= gain * w[0, j]
    for j in range(SIZE):  # the measured state's own row, without a subtraction
        p[k, j] = p[j, k] = w[0, j] * variance * scale


@inner
def constrain_attitude(s: Record) -> None:
    """After an update: ‖Z‖ = 1, X turned by ψ and across Z; and ‖Z‖ = 1 into the covariance of a well-known Z."""
    p, tilt, north = s.covariance, vec.unit(vec.load(s.tilt)), vec.load(s.north)
    north = vec.axpy(-s.nominal[PSI], vec.cross(tilt, north), north)
    s.nominal[PSI] = 0.0
    vec.store(s.tilt, tilt)
    vec.store(s.north, vec.unit(vec.axpy(-vec.dot(north, tilt), tilt, north)))
    block = sub_covariance(p, Z)
    if vec.quadratic(block, tilt) <= _NONE_RAD2 or vec.trace(block) >= SMALL_RAD2:
        return
    for _ in range(2):  # rows, then by the transposed matrix columns
        for j in range(SIZE):
            along = tilt[0] * p[0, j] + tilt[1] * p[1, j] + tilt[2] * p[2, j]
            for i in range(3):
                p[i, j] -= along * tilt[i]
        for i in range(SIZE):
            for j in range(i):
                p[i, j], p[j, i] = p[j, i], p[i, j]


@inner
def start_parameters(s: Record) -> None:
    """Set the sensor errors and J2S, and their covariance, to those before the first sample."""
    for i in range(BG, PSI):
        s.nominal[i] = s.start_mean[i]
        for j in range(SIZE):
            s.covariance[i, j] = s.covariance[j, i] = s.start_covariance[i, j]


@inner
def sub_covariance(p: Floats, k: int) -> Sym:
    """Covariance of three states from k on."""
    return (p[k, k], p[k, k + 1], p[k, k + 2], p[k + 1, k + 1], p[k + 1, k + 2], p[k + 2, k + 2])
