"""An occupancy grid, and ray casting through it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats

# What a cell of a grid holds. A beam passes only through free cells.
FREE, OCCUPIED, UNKNOWN = 0, 1, 2


class GridMap(NamedTuple):
    """A map of free, occupied and unknown cells.

    `blocked[row, column]` is FREE (0) where a beam passes, OCCUPIED where it meets a wall, and UNKNOWN where nobody has
    measured; a beam ends in an unknown cell, too. Row 0 is the lowest y. `geometry` is (cell size m, x and y of the
    lower left corner m, rotation rad) in the map's frame.
    """

    blocked: NDArray[np.uint8]
    geometry: Floats

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height (m)."""
        rows, columns = self.blocked.shape
        return columns * float(self.geometry[0]), rows * float(self.geometry[0])


def no_map() -> GridMap:
    """One free cell, for a filter without laser scans."""
    return GridMap(np.zeros((1, 1), np.uint8), np.array([1.0, 0.0, 0.0, 0.0]))


@compiled
def cast_ray(blocked: NDArray[np.uint8], geometry: Floats, x: float, y: float, angle: float, max_range: float) -> float:
    """Distance (m) from (x, y) along `angle` (rad) to the face of the first blocked cell, at most `max_range`.

    The distance is exact to the cell's face: the ray steps from one grid line to the next (Amanatides and Woo, "A Fast
    Voxel Traversal Algorithm for Ray Tracing", Eurographics 1987). The map's edge ends a ray like a wall; from inside a
    blocked cell the distance is 0.
    """
    cell: float = geometry[0]
    yaw: float = geometry[3]
    along_x, along_y = x - geometry[1], y - geometry[2]
    grid_x = (math.cos(yaw) * along_x + math.sin(yaw) * along_y) / cell
    grid_y = (math.cos(yaw) * along_y - math.sin(yaw) * along_x) / cell
    dx, dy = math.cos(angle - yaw), math.sin(angle - yaw)
    rows, columns = blocked.shape
    column, row = math.floor(grid_x), math.floor(grid_y)
    step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    per_column = abs(1.0 / dx) if dx != 0.0 else np.inf
    per_row = abs(1.0 / dy) if dy != 0.0 else np.inf
    next_x = (column + (step_x > 0) - grid_x) / dx if dx != 0.0 else np.inf
    next_y = (row + (step_y > 0) - grid_y) / dy if dy != 0.0 else np.inf
    reach: float = 0.0
    limit = max_range / cell
    while reach < limit:
        if column < 0 or row < 0 or column >= columns or row >= rows or blocked[row, column]:
            return reach * cell
        if next_x < next_y:
            reach, next_x, column = next_x, next_x + per_column, column + step_x
        else:
            reach, next_y, row = next_y, next_y + per_row, row + step_y
    return max_range
