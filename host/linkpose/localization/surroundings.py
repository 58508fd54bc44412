"""What stands around a robot: a map, beacons, and where measurements were rejected."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from linkpose.sensors.measurements import Floats

if TYPE_CHECKING:
    from linkpose.localization.grid import GridMap


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What plots, animations and the page draw around a path, in its map's frame."""

    grid: GridMap | None = None
    beacons: Mapping[str, Sequence[float]] = field(default_factory=dict)  # id -> x, y (m), perhaps z
    rejected_xy_m: Floats | None = None  # (N, 2) poses at which measurements were rejected

    @staticmethod
    def read(map_file: Path | None, beacon_file: Path | None) -> Surroundings:
        """From a map (YAML) and a table of beacons (CSV), each of which may be missing. Raises FileError."""
        from linkpose.localization.maps import load_map
        from linkpose.localization.tables import read_beacons

        grid = load_map(map_file) if map_file is not None else None
        return Surroundings(grid, read_beacons(beacon_file) if beacon_file is not None else {})

    def corners_m(self) -> Floats:
        """Points (N, 2) whose bounds are those of map and beacons."""
        found = [tuple(place[:2]) for place in self.beacons.values()]
        if self.grid is not None:
            found += map_corners(self.grid).tolist()
        return np.array(found, dtype=float).reshape(-1, 2)


def map_corners(grid: GridMap) -> Floats:
    """The corners (4, 2) of a map, m."""
    _, left, low, turn = grid.geometry.tolist()
    (wide, high), cos, sin = grid.size_m, math.cos(turn), math.sin(turn)
    flat = np.array([(0.0, 0.0), (wide, 0.0), (0.0, high), (wide, high)])
    corners: Floats = np.array([left, low]) + flat @ np.array([[cos, sin], [-sin, cos]])
    return corners
