"""A rate gyro about the vertical with the state of `planar_twist`: h = ω + b (rad/s). It has no parameters."""

from __future__ import annotations

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats

ID = 5


@compiled
def predict(state: Floats, parameters: Floats, out: Floats) -> None:
    """The rate (rad/s)."""
    out[0] = state[5] + state[6]


@compiled
def jacobian(state: Floats, parameters: Floats, out: Floats) -> None:
    """Fills ∂h/∂state."""
    out[0, 5] = 1.0
    out[0, 6] = 1.0
