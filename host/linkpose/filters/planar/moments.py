"""Extended and unscented Kalman filter over the planar state: the moments that differ, and the update that they share.

Both give the predicted measurement ẑ, its covariance S and the cross-covariance C with the state; the update is the
same. The extended filter linearises at the mean; the unscented one uses 2n sigma points √n standard deviations out
([Thesis], equations (1)-(17)).
"""

from __future__ import annotations

import math

import numpy as np

from linkpose.compiling import inner
from linkpose.filters.mice.state import Floats, Record
from linkpose.filters.planar.state import (
    ANGLE,
    BIAS,
    HEADING,
    MICE,
    OF_MOUSE,
    POSITION,
    SCALE,
    VX,
    VY,
    WZ,
)

# Kinds of rows: the gyro, a component of the state that is zero at rest, and, from MOUSE on, mouse by mouse x and y.
GYRO, ZERO_VX, ZERO_VY, ZERO_WZ, MOUSE = (np.int64(k) for k in range(5))


@inner
def add_row(state: Record, kind: np.int64, value: float, variance: float) -> None:
    """Append a row to the measurement of the step."""
    state.kind[state.rows] = kind
    state.value[state.rows] = value
    state.noise[state.rows] = variance
    state.rows += 1


@inner
def _predict(state: Record, place: Record, x: Floats, row: int) -> float:
    """The value of a row that state x predicts; a mouse's is e^−ε R(−α) (v + ω × p), (6) and (7) of [Mice]."""
    kind = state.kind[row]
    if kind == GYRO:
        return float(x[WZ] + x[BIAS])
    if kind < MOUSE:
        return float(x[VX + kind - ZERO_VX])
    i = (kind - MOUSE) // 2
    at = MICE + OF_MOUSE * i
    vx = x[VX] - x[WZ] * (place.position[i, 1] + x[at + POSITION + 1])
    vy = x[VY] + x[WZ] * (place.position[i, 0] + x[at + POSITION])
    gain, c, s = math.exp(-x[at + SCALE]), math.cos(x[at + ANGLE]), math.sin(x[at + ANGLE])
    return float(gain * (c * vx + s * vy) if (kind - MOUSE) % 2 == 0 else gain * (c * vy - s * vx))


@inner
def _differentiate(state: Record, place: Record, row: int) -> None:
    """Fill a row of the Jacobian at the mean."""
    x, h, kind = state.mean, state.jacobian[row], state.kind[row]
    for k in range(state.size):
        h[k] = 0.0
    if kind == GYRO:
        h[WZ] = h[BIAS] = 1.0
        return
    if kind < MOUSE:
        h[VX + kind - ZERO_VX] = 1.0
        return
    i, is_y = (kind - MOUSE) // 2, (kind - MOUSE) % 2
    at = MICE + OF_MOUSE * i
    px, py = place.position[i, 0] + x[at + POSITION], place.position[i, 1] + x[at + POSITION + 1]
    vx, vy = x[VX] - x[WZ] * py, x[VY] + x[WZ] * px
    gain, c, s = math.exp(-x[at + SCALE]), math.cos(x[at + ANGLE]), math.sin(x[at + ANGLE])
    a, b = (gain * c, gain * s) if is_y == 0 else (-gain * s, gain * c)
    h[VX], h[VY], h[WZ] = a, b, b * px - a * py
    h[at + SCALE] = -(a * vx + b * vy)
    h[at + ANGLE] = -gain * s * vx + gain * c * vy if is_y == 0 else -gain * c * vx - gain * s * vy
    h[at + POSITION], h[at + POSITION + 1] = b * x[WZ], -a * x[WZ]


@inner
def linear_moments(state: Record, place: Record) -> None:
    """ẑ, C and S by the Jacobian."""
    n, m = state.size, state.rows
    for r in range(m):
        state.predicted[r] = _predict(state, place, state.mean, r)
        _differentiate(state, place, r)
        for i in range(n):
            total = 0.0
            for k in range(n):
                total += state.covariance[i, k] * state.jacobian[r, k]
            state.cross[i, r] = total
    for r in range(m):
        for q in range(r + 1):
            total = state.noise[r] if r == q else 0.0
            for k in range(n):
                total += state.jacobian[r, k] * state.cross[k, q]
            state.innovation[r, q] = state.innovation[q, r] = total


@inner
def spread_points(state: Record) -> bool:
    """The 2n sigma points of the state. False where the covariance is not positive definite."""
    n = state.size
    if not factorise(state.covariance, state.root, n):
        return False
    far = math.sqrt(float(n))
    for j in range(n):
        for i in range(n):
            off = far * state.root[i, j] if i >= j else 0.0
            state.points[j, i] = state.mean[i] + off
            state.points[n + j, i] = state.mean[i] - off
    return True


@inner
def sigma_moments(state: Record, place: Record) -> None:
    """ẑ, C and S by the sigma points."""
    n, m = state.size, state.rows
    share = 0.5 / n
    for r in range(m):
        total = 0.0
        for j in range(2 * n):
            state.at_points[j, r] = _predict(state, place, state.points[j], r)
            total += state.at_points[j, r]
        state.predicted[r] = share * total
        for j in range(2 * n):
            state.at_points[j, r] -= state.predicted[r]
        for i in range(n):
            total = 0.0
            for j in range(2 * n):
                total += (state.points[j, i] - state.mean[i]) * state.at_points[j, r]
            state.cross[i, r] = share * total
    for r in range(m):
        for q in range(r + 1):
            total = 0.0
            for j in range(2 * n):
                total += state.at_points[j, r] * state.at_points[j, q]
            state.innovation[r, q] = state.innovation[q, r] = share * total + (state.noise[r] if r == q else 0.0)


@inner
def update_vector(state: Record, always: int, limit: float) -> bool:
    """x += C S⁻¹ (z − ẑ), P −= C S⁻¹ Cᵀ. False where S is not positive definite.

    Where the χ² of the innovation exceeds `limit`, only the first `always` rows count; `state.rows` is then set to it.
    """
    n, m = state.size, state.rows
    if not factorise(state.innovation, state.innovation, m):
        return False
    low = state.innovation
    state.chi2 = 0.0
    for r in range(m):
        residual = state.value[r] - state.predicted[r]
        for q in range(r):
            residual -= low[r, q] * state.predicted[q]
        state.predicted[r] = residual / low[r, r]  # L⁻¹ (z − ẑ)
        state.chi2 += state.predicted[r] ** 2
        for i in range(n):
            total = state.cross[i, r]
            for q in range(r):
                total -= low[r, q] * state.cross[i, q]
            state.cross[i, r] = total / low[r, r]  # C L⁻ᵀ
    if state.chi2 > limit:
        state.rows = m = always
    for i in range(n):
        for r in range(m):
            state.mean[i] += state.cross[i, r] * state.predicted[r]
        for j in range(i + 1):
            total = 0.0
            for r in range(m):
                total += state.cross[i, r] * state.cross[j, r]
            state.covariance[i, j] -= total
            state.covariance[j, i] = state.covariance[i, j]
    return True


@inner
def factorise(matrix: Floats, root: Floats, n: int) -> bool:
    """Lower Cholesky factor of the leading n rows, in the lower triangle of `root`, which may be `matrix`."""
    for j in range(n):
        for i in range(j, n):
            total = matrix[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if i > j:
                root[i, j] = total / root[j, j]
            elif total > 0.0:
                root[j, j] = math.sqrt(total)
            else:
                return False
    return True


@inner
def drive_on(x: Floats, dt: float, out: Floats) -> None:
    """Pose after `dt` (s) on the exact arc of the state's velocity: x, y (m), θ (rad)."""
    half = 0.5 * x[WZ] * dt
    reach = dt * (math.sin(half) / half if abs(half) > 1e-6 else 1.0)
    c, s = math.cos(x[HEADING] + half), math.sin(x[HEADING] + half)
    out[0] = x[0] + reach * (c * x[VX] - s * x[VY])
    out[1] = x[1] + reach * (s * x[VX] + c * x[VY])
    out[2] = x[HEADING] + 2.0 * half


@inner
def linear_advance(state: Record, dt: float) -> None:
    """Pose and its rows of the covariance after `dt` (s), by the Jacobian of the arc."""
    n, x, p, new = state.size, state.mean, state.covariance, state.fresh
    half = 0.5 * x[WZ] * dt
    c, s = math.cos(x[HEADING] + half), math.sin(x[HEADING] + half)
    drive_on(x, dt, state.point)
    ex, ey = state.point[0] - x[0], state.point[1] - x[1]
    for k in range(n):
        turn = p[HEADING, k] + 0.5 * dt * p[WZ, k]
        new[0, k] = p[0, k] - ey * turn + dt * (c * p[VX, k] - s * p[VY, k])
        new[1, k] = p[1, k] + ex * turn + dt * (s * p[VX, k] + c * p[VY, k])
        new[2, k] = p[HEADING, k] + dt * p[WZ, k]
    # F P, now times Fᵀ for the columns of the pose.
    for r in range(3):
        turn = new[r, HEADING] + 0.5 * dt * new[r, WZ]
        a = new[r, 0] - ey * turn + dt * (c * new[r, VX] - s * new[r, VY])
        b = new[r, 1] + ex * turn + dt * (s * new[r, VX] + c * new[r, VY])
        new[r, 0], new[r, 1], new[r, 2] = a, b, new[r, HEADING] + dt * new[r, WZ]
    _store_pose(state)


@inner
def sigma_advance(state: Record, dt: float) -> None:
    """Pose and its rows of the covariance after `dt` (s), by the sigma points."""
    n, new, share = state.size, state.fresh, 0.5 / state.size
    for r in range(3):
        state.point[r] = 0.0
    for j in range(2 * n):
        drive_on(state.points[j], dt, state.moved[j])
        for r in range(3):
            state.point[r] += share * state.moved[j, r]
    for r in range(3):
        for k in range(n):
            new[r, k] = 0.0
    for j in range(2 * n):
        for r in range(3):
            off = share * (state.moved[j, r] - state.point[r])
            for k in range(3):
                new[r, k] += off * (state.moved[j, k] - state.point[k])
            for k in range(3, n):
                new[r, k] += off * (state.points[j, k] - state.mean[k])
    _store_pose(state)


@inner
def _store_pose(state: Record) -> None:
    """Put `point` and `fresh` in place of the pose and its rows of the covariance."""
    for r in range(3):
        state.mean[r] = state.point[r]
        for k in range(state.size):
            value = state.fresh[r, k] if k > 2 else 0.5 * (state.fresh[r, k] + state.fresh[k, r])
            state.covariance[r, k] = state.covariance[k, r] = value
