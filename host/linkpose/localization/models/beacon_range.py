"""Ranges to beacons at known places: h = (1 + s) ‖p − b‖ + β + β_b, with the sensor's scale error s, its bias β and
the drifting error β_b of this beacon where the state has them.

A row of parameters is (beacon x, y, z m, index of the state's z, of s, of β, of β_b); -1 where the state has none.
"""

from __future__ import annotations

import math

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats

ID = 1
COLUMNS = 7  # of parameters


@compiled
def predict(state: Floats, parameters: Floats, out: Floats) -> None:
    """The ranges (m)."""
    for i in range(out.shape[0]):
        height, scale, bias = int(parameters[i, 3]), int(parameters[i, 4]), int(parameters[i, 5])
        z = state[height] if height >= 0 else 0.0
        dx, dy, dz = state[0] - parameters[i, 0], state[1] - parameters[i, 1], z - parameters[i, 2]
        out[i] = math.sqrt(dx * dx + dy * dy + dz * dz)
        if scale >= 0:
            out[i] *= 1.0 + state[scale]
        if bias >= 0:
            out[i] += state[bias]
        if parameters[i, 6] >= 0.0:
            out[i] += state[int(parameters[i, 6])]


@compiled
def jacobian(state: Floats, parameters: Floats, out: Floats) -> None:
    """Fills ∂h/∂state. On the beacon itself the direction is undefined and the slope is 0."""
    for i in range(out.shape[0]):
        height, scale, bias = int(parameters[i, 3]), int(parameters[i, 4]), int(parameters[i, 5])
        z = state[height] if height >= 0 else 0.0
        dx, dy, dz = state[0] - parameters[i, 0], state[1] - parameters[i, 1], z - parameters[i, 2]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        slope = (1.0 + state[scale] if scale >= 0 else 1.0) / distance if distance > 0.0 else 0.0
        out[i, 0], out[i, 1] = slope * dx, slope * dy
        if height >= 0:
            out[i, height] = slope * dz
        if scale >= 0:
            out[i, scale] = distance
        if bias >= 0:
            out[i, bias] = 1.0
        if parameters[i, 6] >= 0.0:
            out[i, int(parameters[i, 6])] = 1.0
