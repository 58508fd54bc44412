"""Dead reckoning on a plane, which the models of planar robots share: the exact arc of a constant velocity in the
robot's axes.

(x', y') = (x, y) + R(θ + ω T/2) sinc(ω T/2) (v_x, v_y) T,  θ' = θ + ω T
"""

from __future__ import annotations

import math

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats, wrap_angle


@compiled
def sinc(angle: float) -> float:
    """sin(angle)/angle."""
    return math.sin(angle) / angle if abs(angle) > 1e-4 else 1.0 - angle * angle / 6.0


@compiled
def sinc_slope(angle: float) -> float:
    """The derivative of `sinc`."""
    return (math.cos(angle) - sinc(angle)) / angle if abs(angle) > 1e-4 else -angle / 3.0


@compiled
def move(state: Floats, forward: float, left: float, rate: float, interval: float, out: Floats) -> None:
    """Fills `out` with `state`, its first three elements (x, y, θ) moved by m/s and rad/s over an interval in s."""
    for i in range(state.shape[0]):
        out[i] = state[i]
    turn = rate * interval
    reach = interval * sinc(0.5 * turn)
    c, s = math.cos(state[2] + 0.5 * turn), math.sin(state[2] + 0.5 * turn)
    out[0] += reach * (c * forward - s * left)
    out[1] += reach * (s * forward + c * left)
    out[2] = wrap_angle(state[2] + turn)


@compiled
def slopes(
    heading: float, forward: float, left: float, rate: float, interval: float, by_state: Floats, by_twist: Floats
) -> None:
    """Fills ∂(x', y', θ')/∂state into zeroed (n, n), and ∂(x', y', θ')/∂(v_x, v_y, ω) into (3, 3)."""
    turn = rate * interval
    reach = interval * sinc(0.5 * turn)
    bend = 0.5 * interval * interval * sinc_slope(0.5 * turn)
    c, s = math.cos(heading + 0.5 * turn), math.sin(heading + 0.5 * turn)
    ahead_x, ahead_y = c * forward - s * left, s * forward + c * left
    for i in range(by_state.shape[0]):
        by_state[i, i] = 1.0
    by_state[0, 2], by_state[1, 2] = -reach * ahead_y, reach * ahead_x
    by_twist[0, 0], by_twist[0, 1], by_twist[0, 2] = (
        reach * c,
        -reach * s,
        bend * ahead_x - 0.5 * interval * reach * ahead_y,
    )
    by_twist[1, 0], by_twist[1, 1], by_twist[1, 2] = (
        reach * s,
        reach * c,
        bend * ahead_y + 0.5 * interval * reach * ahead_x,
    )
    by_twist[2, 0], by_twist[2, 1], by_twist[2, 2] = 0.0, 0.0, interval
