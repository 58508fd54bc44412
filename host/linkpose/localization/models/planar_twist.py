"""Motion of a planar robot by its own velocity: state (x, y, θ, v_x, v_y, ω, b), driven by nothing but noise.

    (x, y, θ) as in `se2`,  v' = v + a T,  ω' = ω + α T,  b' = b + ḃ T

b is the bias of the rate gyro (rad/s). The noise is the body acceleration (a_x, a_y), the angular acceleration α and
the drift ḃ.
"""

from __future__ import annotations

import numpy as np

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats
from linkpose.localization.models.se2 import move, slopes

ID = 2


@compiled
def propagate(state: Floats, control: Floats, noise: Floats, interval: float, out: Floats) -> None:
    """noise (a_x, a_y m/s², α rad/s², ḃ rad/s²); `control` is not used; interval in s."""
    move(state, state[3], state[4], state[5], interval, out)
    for i in range(4):
        out[3 + i] += noise[i] * interval


@compiled
def jacobians(state: Floats, control: Floats, interval: float, by_state: Floats, by_noise: Floats) -> None:
    """Fills ∂out/∂state and ∂out/∂noise at zero noise."""
    by_twist = np.empty((3, 3))
    slopes(state[2], state[3], state[4], state[5], interval, by_state, by_twist)
    for i in range(3):
        for j in range(3):
            by_state[i, 3 + j] += by_twist[i, j]
    for i in range(4):
        by_noise[3 + i, i] = interval
