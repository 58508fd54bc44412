"""Motion of a robot that may slide: dead reckoning of (x, y, θ) from a velocity (v_x, v_y, ω) in its own axes, as mice
measure it.

The noise adds to the velocity. States after the third are constants, as in `unicycle`.
"""

from __future__ import annotations

import numpy as np

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats
from linkpose.localization.models.se2 import move, slopes

ID = 3


@compiled
def propagate(state: Floats, control: Floats, noise: Floats, interval: float, out: Floats) -> None:
    """control (v_x, v_y m/s, ω rad/s), noise alike; interval in s."""
    move(state, control[0] + noise[0], control[1] + noise[1], control[2] + noise[2], interval, out)


@compiled
def jacobians(state: Floats, control: Floats, interval: float, by_state: Floats, by_noise: Floats) -> None:
    """Fills ∂out/∂state and ∂out/∂noise at zero noise."""
    by_twist = np.empty((3, 3))
    slopes(state[2], control[0], control[1], control[2], interval, by_state, by_twist)
    for i in range(3):
        for j in range(3):
            by_noise[i, j] = by_twist[i, j]
