"""Motion of a wheeled robot: dead reckoning of (x, y, θ) from forward speed v and turn rate ω, the thesis's indoor
model.

The noise adds to (v, ω). States after the third are constants that the filter estimates beside the pose, such as the
scale error of a range sensor.
"""

from __future__ import annotations

import numpy as np

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats
from linkpose.localization.models.se2 import move, slopes

ID = 0


@compiled
def propagate(state: Floats, control: Floats, noise: Floats, interval: float, out: Floats) -> None:
    """control (v m/s, ω rad/s), noise alike; interval in s."""
    move(state, control[0] + noise[0], 0.0, control[1] + noise[1], interval, out)


@compiled
def jacobians(state: Floats, control: Floats, interval: float, by_state: Floats, by_noise: Floats) -> None:
    """Fills ∂out/∂state and ∂out/∂noise at zero noise."""
    by_twist = np.empty((3, 3))
    slopes(state[2], control[0], 0.0, control[1], interval, by_state, by_twist)
    for i in range(3):
        by_noise[i, 0], by_noise[i, 1] = by_twist[i, 0], by_twist[i, 2]
