"""Motion of a planar robot by its own velocity: state (x, y, θ, v_x, v_y, ω, b), driven by nothing but noise.

    (x', y') = (x, y) + R(θ + ω T/2) sinc(ω T/2) (v_x, v_y) T,  θ' = θ + ω T
    v' = v + a T,  ω' = ω + α T,  b' = b + ḃ T

b is the bias of the rate gyro (rad/s). The noise is the body acceleration (a_x, a_y), the angular acceleration α and
the drift ḃ.
"""

from __future__ import annotations

import math

from numba import njit

from linkpose.localization.linalg import Floats, wrap_angle
from linkpose.localization.models.unicycle import sinc, sinc_slope

ID = 2


@njit(cache=True)
def propagate(state: Floats, control: Floats, noise: Floats, interval: float, out: Floats) -> None:
    """noise (a_x, a_y m/s², α rad/s², ḃ rad/s²); `control` is not used; interval in s."""
    for i in range(state.shape[0]):
        out[i] = state[i]
    turn = state[5] * interval
    reach = interval * sinc(0.5 * turn)
    c, s = math.cos(state[2] + 0.5 * turn), math.sin(state[2] + 0.5 * turn)
    out[0] += reach * (c * state[3] - s * state[4])
    out[1] += reach * (s * state[3] + c * state[4])
    out[2] = wrap_angle(state[2] + turn)
    for i in range(4):
        out[3 + i] += noise[i] * interval


@njit(cache=True)
def jacobians(state: Floats, control: Floats, interval: float, by_state: Floats, by_noise: Floats) -> None:
    """Fills ∂out/∂state and ∂out/∂noise at zero noise."""
    turn = state[5] * interval
    reach = interval * sinc(0.5 * turn)
    bend = 0.5 * interval * interval * sinc_slope(0.5 * turn)
    c, s = math.cos(state[2] + 0.5 * turn), math.sin(state[2] + 0.5 * turn)
    ahead_x, ahead_y = c * state[3] - s * state[4], s * state[3] + c * state[4]
    for i in range(state.shape[0]):
        by_state[i, i] = 1.0
    by_state[0, 2], by_state[1, 2] = -reach * ahead_y, reach * ahead_x
    by_state[0, 3], by_state[0, 4], by_state[0, 5] = (
        reach * c,
        -reach * s,
        bend * ahead_x - 0.5 * interval * reach * ahead_y,
    )
    by_state[1, 3], by_state[1, 4], by_state[1, 5] = (
        reach * s,
        reach * c,
        bend * ahead_y + 0.5 * interval * reach * ahead_x,
    )
    by_state[2, 5] = interval
    for i in range(4):
        by_noise[3 + i, i] = interval
