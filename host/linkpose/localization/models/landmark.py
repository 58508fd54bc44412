"""Range and bearing of landmarks at known places: h = ((1 + s) ‖b − p‖ + β, atan2(b_y − y, b_x − x) − θ).

The bearing is on the circle; s and β are the scale error and the bias of the range where the state has them. A row of
parameters is (landmark x, y m, index of s, of β in the state; −1 where the state has none); two rows of h belong to it.
"""

from __future__ import annotations

import math

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats, wrap_angle

ID = 2
COLUMNS = 4  # of parameters


@compiled
def predict(state: Floats, parameters: Floats, out: Floats) -> None:
    """Range (m) and bearing (rad), landmark by landmark."""
    for i in range(parameters.shape[0]):
        scale, bias = int(parameters[i, 2]), int(parameters[i, 3])
        dx, dy = parameters[i, 0] - state[0], parameters[i, 1] - state[1]
        out[2 * i] = math.hypot(dx, dy)
        if scale >= 0:
            out[2 * i] *= 1.0 + state[scale]
        if bias >= 0:
            out[2 * i] += state[bias]
        out[2 * i + 1] = wrap_angle(math.atan2(dy, dx) - state[2])


@compiled
def jacobian(state: Floats, parameters: Floats, out: Floats) -> None:
    """Fills ∂h/∂state. On the landmark itself the direction is undefined and the slopes in x and y are 0."""
    for i in range(parameters.shape[0]):
        scale, bias = int(parameters[i, 2]), int(parameters[i, 3])
        dx, dy = parameters[i, 0] - state[0], parameters[i, 1] - state[1]
        distance = math.hypot(dx, dy)
        if distance > 0.0:
            factor = 1.0 + state[scale] if scale >= 0 else 1.0
            out[2 * i, 0], out[2 * i, 1] = -factor * dx / distance, -factor * dy / distance
            out[2 * i + 1, 0], out[2 * i + 1, 1] = dy / distance**2, -dx / distance**2
        if scale >= 0:
            out[2 * i, scale] = distance
        if bias >= 0:
            out[2 * i, bias] = 1.0
        out[2 * i + 1, 2] = -1.0
