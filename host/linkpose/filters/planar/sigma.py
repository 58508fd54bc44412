"""The unscented Kalman filter's moments: 2n sigma points √n standard deviations out ([Thesis], equations (6)-(17))."""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters.mice.plane import scaled, turned, turned_mean, unit
from linkpose.filters.mice.state import Record, Records
from linkpose.filters.planar.measure import compare, predict
from linkpose.filters.planar.state import HEADING


@inner
def spread(state: Record, sigma: Record) -> bool:
    """The 2n sigma points of the state. False where the covariance is not positive definite."""
    n, p, root, far = state.size, state.covariance, sigma.root, math.sqrt(float(state.size))
    for j in range(n):  # Cholesky factor
        for i in range(j, n):
            total = p[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            if i > j:
                root[i, j] = total / root[j, j]
            elif total > 0.0:
                root[j, j] = math.sqrt(total)
            else:
                return False
    for j in range(n):
        up, down = sigma.points[j], sigma.points[n + j]
        for i in range(n):
            off = far * root[i, j] if i >= j else 0.0
            up[i] = state.mean[i] + off
            down[i] = state.mean[i] - off
    return True


@inner
def moments(state: Record, sigma: Record, rig: Records, rate: float) -> bool:
    """Innovation, S and C by the sigma points. False where the covariance is not positive definite."""
    if not spread(state, sigma):
        return False
    n, m, share = state.size, state.rows, 0.5 / state.size
    mean, z = state.predicted, sigma.shown
    for row in range(m):
        mean[row] = 0.0
    for j in range(2 * n):
        predict(state, rig, sigma.at[j], z[j])
        for row in range(m):
            mean[row] += share * z[j, row]
    compare(state, rate)
    for row in range(m):
        cross, s = state.cross[row], state.innovation[row]
        for i in range(n):
            cross[i] = 0.0
        for j in range(2 * n):
            off = share * (z[j, row] - mean[row])
            for i in range(n):
                cross[i] += off * (sigma.points[j, i] - state.mean[i])
            for other in range(m):
                s[other] += off * (z[j, other] - mean[other])
    return True


@inner
def advance(state: Record, sigma: Record, dt: float) -> bool:
    """Pose and covariance after `dt` (s), by the sigma points. False where the covariance is not positive definite."""
    if not spread(state, sigma):
        return False
    n, share, moved, pose = state.size, 0.5 / state.size, sigma.moved, state.predicted
    for r in range(3):
        pose[r] = 0.0
    for j in range(2 * n):
        at, later = sigma.at[j], moved[j]
        turn = at.wz * dt
        way = scaled(dt, turned(turned(unit(at.heading), turned_mean(turn)), complex(at.vx, at.vy)))
        later[0], later[1], later[2] = at.x + way.real, at.y + way.imag, at.heading + turn
        for r in range(3):
            pose[r] += share * later[r]
    for r in range(3):
        fresh = state.cross[r]
        for k in range(n):
            fresh[k] = 0.0
        for j in range(2 * n):
            off = share * (moved[j, r] - pose[r])
            for k in range(n):
                fresh[k] += off * (moved[j, k] - pose[k] if k <= HEADING else sigma.points[j, k] - state.mean[k])
    for r in range(3):
        state.mean[r] = pose[r]
        for k in range(n):
            state.covariance[r, k] = state.covariance[k, r] = state.cross[r, k]
    return True
