"""The extended Kalman filter's moments: linearised at the mean ([Thesis], equations (1)-(5))."""

from __future__ import annotations

from linkpose.compiling import inner
from linkpose.filters.mice.plane import scaled, turned, turned_mean, unit
from linkpose.filters.mice.state import Record, Records
from linkpose.filters.planar.measure import arm, compare, gain, predict
from linkpose.filters.planar.state import ANGLE, BIAS, HEADING, MICE, OF_MOUSE, POSITION, SCALE, VX, VY, WZ, X, Y


@inner
def moments(state: Record, tangent: Record, rig: Records, rate: float) -> None:
    """Innovation, S and C by the Jacobian H: C = P Hᵀ, S = H C + R."""
    predict(state, rig, state.at, state.predicted)
    compare(state, rate)
    _differentiate(state, tangent, rig)
    n, p, s = state.size, state.covariance, state.innovation
    for row in range(state.rows):
        h, cross = tangent.jacobian[row], state.cross[row]
        for i in range(n):
            total = 0.0
            for k in range(n):
                total += p[i, k] * h[k]
            cross[i] = total
        for other in range(state.rows):
            h = tangent.jacobian[other]
            total = 0.0
            for k in range(n):
                total += h[k] * cross[k]
            s[row, other] += total


@inner
def _differentiate(state: Record, tangent: Record, rig: Records) -> None:
    """H at the mean."""
    at, h = state.at, tangent.jacobian
    for row in range(state.rows):
        for k in range(state.size):
            h[row, k] = 0.0
    if state.at_rest:
        h[0, VX] = h[1, VY] = h[2, WZ] = 1.0
        return
    row = state.always
    if row:
        h[0, WZ] = h[0, BIAS] = 1.0
    for i in range(len(rig)):
        if state.seen_by >> i & 1:
            mouse, k = at.mice[i], MICE + OF_MOUSE * i
            by_v, q = gain(mouse), arm(mouse, rig[i])
            by_w, by_place = turned(by_v, q), scaled(at.wz, by_v)
            shown = turned(by_v, complex(at.vx, at.vy) + scaled(at.wz, q))
            along, across = h[row], h[row + 1]
            along[VX], across[VX] = by_v.real, by_v.imag
            along[VY], across[VY] = -by_v.imag, by_v.real
            along[WZ], across[WZ] = by_w.real, by_w.imag
            along[k + SCALE], across[k + SCALE] = -shown.real, -shown.imag
            along[k + ANGLE], across[k + ANGLE] = shown.imag, -shown.real
            along[k + POSITION], across[k + POSITION] = -by_place.imag, by_place.real
            along[k + POSITION + 1], across[k + POSITION + 1] = -by_place.real, -by_place.imag
            row += 2


@inner
def advance(state: Record, dt: float) -> None:
    """Pose and covariance after `dt` (s), by the Jacobian F of the arc: F P Fᵀ."""
    n, at, p = state.size, state.at, state.covariance
    turn = at.wz * dt
    middle = unit(at.heading + 0.5 * turn)
    moved = scaled(dt, turned(turned(unit(at.heading), turned_mean(turn)), complex(at.vx, at.vy)))
    at.x += moved.real
    at.y += moved.imag
    at.heading += turn
    cos, sin = dt * middle.real, dt * middle.imag
    for _ in range(2):  # the rows of F P, then those of F (F P)ᵀ
        for k in range(n):
            turning, vx, vy = p[HEADING, k] + 0.5 * dt * p[WZ, k], p[VX, k], p[VY, k]
            p[X, k] += cos * vx - sin * vy - moved.imag * turning
            p[Y, k] += sin * vx + cos * vy + moved.real * turning
            p[HEADING, k] += dt * p[WZ, k]
        for i in range(n):
            for k in range(i):
                p[i, k], p[k, i] = p[k, i], p[i, k]
