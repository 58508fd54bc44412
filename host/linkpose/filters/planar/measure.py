"""The measurement of one step: what the state predicts of it, and the Kalman update.

Both filters give the innovation z − ẑ, its covariance S and its covariances C with the state; the update is the same.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters.mice.plane import scaled, turned
from linkpose.filters.mice.state import Floats, Record, Records
from linkpose.filters.planar.state import BIAS, HEADING, VX, X

# Residual motion at rest: m/s and rad/s. Doubled: no visible change.
_REST_M_S, _REST_RAD_S = 1e-4, 1e-5


@inner
def arm(mouse: Record, place: Record) -> complex:
    """q_i with the estimated displacement of the mouse."""
    return complex(place.arm.real - mouse.dy, place.arm.imag + mouse.dx)


@inner
def gain(mouse: Record) -> complex:
    """e^{−ε − jα}: turns the velocity of a mouse's place into the velocity that the rig's calibration shows."""
    size = math.exp(-mouse.scale)
    return complex(size * math.cos(mouse.angle), -size * math.sin(mouse.angle))


@inner
def predict(state: Record, rig: Records, point: Record, out: Floats) -> None:
    """ẑ at a state; a mouse's part is e^{−ε − jα} (v + ω q), (3) of [Mice]."""
    if state.at_rest:
        out[0], out[1], out[2] = point.vx, point.vy, point.wz
        return
    row = state.always
    if row:
        out[0] = point.wz + point.bias
    for i in range(len(rig)):
        if state.seen_by >> i & 1:
            mouse = point.mice[i]
            velocity = complex(point.vx, point.vy) + scaled(point.wz, arm(mouse, rig[i]))
            shown = turned(gain(mouse), velocity)
            out[row], out[row + 1] = shown.real, shown.imag
            row += 2


@inner
def compare(state: Record, rate: float) -> None:
    """The innovation's residual, and its own noise on the diagonal of S, which is zero otherwise."""
    s, r = state.innovation, state.residual
    for row in range(state.rows):
        r[row] = -state.predicted[row]
        for column in range(state.rows):
            s[row, column] = 0.0
    if state.at_rest:
        s[0, 0] = s[1, 1] = _REST_M_S**2
        s[2, 2] = _REST_RAD_S**2
        return
    row = state.always
    if row:
        r[0] += rate
        s[0, 0] = state.rate_variance
    for i in range(len(state.seen)):
        if state.seen_by >> i & 1:
            seen = state.seen[i]
            r[row] += seen.velocity.real
            r[row + 1] += seen.velocity.imag
            s[row, row] = seen.variance + seen.across.real * seen.across.real
            s[row + 1, row + 1] = seen.variance + seen.across.imag * seen.across.imag
            s[row, row + 1] = s[row + 1, row] = seen.across.real * seen.across.imag
            row += 2


@inner
def update(state: Record, limit: float, plausible: float, is_calibrating: bool) -> bool:
    """x += C S⁻¹ (z − ẑ), P −= C S⁻¹ Cᵀ, by elimination row by row. False where S is not positive definite.

    Where the χ² of the innovation exceeds `limit`, only the first `state.always` rows count; `state.rows` is then set
    to their number. The velocity is always updated, the position if χ² is below `plausible`, bias, calibration and
    heading if it is and `is_calibrating`; the rest keeps its value and its covariance (a Schmidt-Kalman update). A lift
    or a slip is no error of the calibration, nor of the pose, which would follow the calibration by its covariance with
    it. After a time without mice, the position is updated in any case: the first velocity shows how far the robot went.
    """
    n, x, p = state.size, state.mean, state.covariance
    r, s, c = state.residual, state.innovation, state.cross
    state.chi2 = 0.0
    for row in range(state.rows):
        own, cross = s[row], c[row]
        if not own[row] > 0.0:
            return False
        weight = 1.0 / own[row]
        state.chi2 += weight * r[row] * r[row]
        for below in range(row + 1, state.rows):
            share = weight * own[below]
            r[below] -= share * r[row]
            for k in range(row + 1, state.rows):
                s[below, k] -= share * own[k]
            for k in range(n):
                c[below, k] -= share * cross[k]
    if state.chi2 > limit:
        state.rows = state.always
    first, end, held = VX, BIAS, HEADING
    if state.chi2 <= plausible:
        first, end = X, n if is_calibrating else BIAS
        held = n if is_calibrating else HEADING
    elif state.is_blind:
        first = X
    for row in range(state.rows):
        cross = c[row]
        weight = 1.0 / s[row, row]
        for i in range(n):
            share = weight * cross[i]
            is_learned = first <= i < end and i != held
            if is_learned:
                x[i] += share * r[row]
            for k in range(i + 1):
                if is_learned or (first <= k < end and k != held):
                    p[i, k] -= share * cross[k]
                    p[k, i] = p[i, k]
    state.is_blind = state.rows == state.always and not state.at_rest
    return True
