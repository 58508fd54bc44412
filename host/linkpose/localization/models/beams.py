"""Laser ranges against a grid map: h_i = the distance along beam i from the sensor's pose to the first wall.

A row of parameters is (beam angle rad, sensor x m, y m, θ rad on the robot, longest range m).
"""

from __future__ import annotations

import math

import numpy as np

from linkpose.compiling import compiled
from linkpose.localization.grid import GridMap, cast_ray
from linkpose.localization.linalg import Floats

ID = 0
COLUMNS = 5  # of parameters
# Of the difference quotients; in x and y it is one cell, since less would see only a stair's face.
TURN_STEP = math.radians(0.5)
# Where the slopes ahead and behind differ by more than this (m/m, m/rad), the beam crosses an edge between them, such
# as a door frame. Then the gentler one is the slope of the wall that the beam hits, and the other one would throw the
# estimate.
EDGE = 20.0


@compiled
def predict(state: Floats, parameters: Floats, grid: GridMap, out: Floats) -> None:
    """The ranges (m) from the pose (x, y, θ) that `state` starts with."""
    c, s = math.cos(state[2]), math.sin(state[2])
    for i in range(out.shape[0]):
        x = state[0] + c * parameters[i, 1] - s * parameters[i, 2]
        y = state[1] + s * parameters[i, 1] + c * parameters[i, 2]
        angle = state[2] + parameters[i, 3] + parameters[i, 0]
        out[i] = cast_ray(grid.blocked, grid.geometry, x, y, angle, parameters[i, 4])


@compiled
def jacobian(state: Floats, parameters: Floats, grid: GridMap, out: Floats) -> None:
    """Fills ∂h/∂state by central differences, since a map has no formula; at an edge by the difference on one side."""
    above, below, centre = np.empty(out.shape[0]), np.empty(out.shape[0]), np.empty(out.shape[0])
    predict(state, parameters, grid, centre)
    moved = np.empty(state.shape[0])
    for j in range(state.shape[0]):
        moved[j] = state[j]
    for j in range(3):
        step = TURN_STEP if j == 2 else grid.geometry[0]
        moved[j] = state[j] + step
        predict(moved, parameters, grid, above)
        moved[j] = state[j] - step
        predict(moved, parameters, grid, below)
        moved[j] = state[j]
        for i in range(out.shape[0]):
            forward, backward = above[i] - centre[i], centre[i] - below[i]
            if abs(forward - backward) < EDGE * step:
                out[i, j] = 0.5 * (forward + backward) / step
            else:
                out[i, j] = (forward if abs(forward) < abs(backward) else backward) / step
