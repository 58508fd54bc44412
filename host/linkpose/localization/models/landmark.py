"""Range and bearing of landmarks at known places: h = (‖b − p‖, atan2(b_y − y, b_x − x) − θ), the bearing on the
circle.

A row of parameters is (landmark x, y m), and two rows of h belong to it.
"""

from __future__ import annotations

import math

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats, wrap_angle

ID = 2


@compiled
def predict(state: Floats, parameters: Floats, out: Floats) -> None:
    """Range (m) and bearing (rad), landmark by landmark."""
    for i in range(parameters.shape[0]):
        dx, dy = parameters[i, 0] - state[0], parameters[i, 1] - state[1]
        out[2 * i] = math.hypot(dx, dy)
        out[2 * i + 1] = wrap_angle(math.atan2(dy, dx) - state[2])


@compiled
def jacobian(state: Floats, parameters: Floats, out: Floats) -> None:
    """Fills ∂h/∂state. On the landmark itself the direction is undefined and the slopes in x and y are 0."""
    for i in range(parameters.shape[0]):
        dx, dy = parameters[i, 0] - state[0], parameters[i, 1] - state[1]
        distance = math.hypot(dx, dy)
        if distance > 0.0:
            out[2 * i, 0], out[2 * i, 1] = -dx / distance, -dy / distance
            out[2 * i + 1, 0], out[2 * i + 1, 1] = dy / distance**2, -dx / distance**2
        out[2 * i + 1, 2] = -1.0
