"""Velocities of optical mice under a planar robot with the state of `planar_twist`: h_i = (v_x − ω p_y, v_y + ω p_x).

A row of parameters is the mouse's place on the robot (p_x, p_y m), and two rows of h (m/s) belong to it.
Source: the velocity equations of the redundant mice, v_ix = v_bx − ω_b p_iy, v_iy = v_by + ω_b p_ix.
"""

from __future__ import annotations

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats

ID = 4


@compiled
def predict(state: Floats, parameters: Floats, out: Floats) -> None:
    """The velocities (m/s) in the robot's axes, mouse by mouse."""
    for i in range(parameters.shape[0]):
        out[2 * i] = state[3] - state[5] * parameters[i, 1]
        out[2 * i + 1] = state[4] + state[5] * parameters[i, 0]


@compiled
def jacobian(state: Floats, parameters: Floats, out: Floats) -> None:
    """Fills ∂h/∂state."""
    for i in range(parameters.shape[0]):
        out[2 * i, 3], out[2 * i, 5] = 1.0, -parameters[i, 1]
        out[2 * i + 1, 4], out[2 * i + 1, 5] = 1.0, parameters[i, 0]
