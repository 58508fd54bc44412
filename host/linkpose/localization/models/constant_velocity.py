"""Motion of a tag without odometry: a velocity in the map's frame that changes at random (white acceleration).

State (x, y, v_x, v_y): x' = x + v_x T + a_x T²/2, v_x' = v_x + a_x T, and y alike. The noise is the acceleration
(a_x, a_y m/s²). States after the fourth are constants, as in `unicycle`. Source: Bar-Shalom, Li and Kirubarajan,
Estimation with Applications to Tracking and Navigation, Wiley 2001, section 6.3.2 (piecewise constant acceleration).
"""

from __future__ import annotations

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats

ID = 2


@compiled
def propagate(state: Floats, control: Floats, noise: Floats, interval: float, out: Floats) -> None:
    """noise (a_x, a_y m/s²); `control` is not used; interval in s."""
    for i in range(state.shape[0]):
        out[i] = state[i]
    for i in range(2):
        out[i] += interval * state[2 + i] + 0.5 * interval * interval * noise[i]
        out[2 + i] += interval * noise[i]


@compiled
def jacobians(state: Floats, control: Floats, interval: float, by_state: Floats, by_noise: Floats) -> None:
    """Fills ∂out/∂state and ∂out/∂noise at zero noise."""
    for i in range(state.shape[0]):
        by_state[i, i] = 1.0
    for i in range(2):
        by_state[i, 2 + i] = interval
        by_noise[i, i], by_noise[2 + i, i] = 0.5 * interval * interval, interval
