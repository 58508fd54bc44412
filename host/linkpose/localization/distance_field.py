"""The distance from every point of a grid map to the nearest wall, as a field that a laser scan is fitted to.

The exact Euclidean distance transform takes two passes over the grid: Felzenszwalb and Huttenlocher, "Distance
Transforms of Sampled Functions", Theory of Computing 8 (2012), pages 415-428. Between the cells' centres the distance
is interpolated bilinearly.

Two kinds of map need two zeros. In a map that was made of scans, the echoes of a wall scatter about the centre of its
cells. In a map that was drawn, walls are thick and beams end at their faces; there the field is signed, with the zero
at the face and negative distances inside. A map counts as drawn where nearly all wall cells have another one behind.
A wall has two faces, in a map of scans with unknown cells between them. A beam may end nearer to the one that its laser
cannot see, because of its noise or of a pose that is off by half the wall's thickness; `seen_distance` returns the
distance from the other one. For this, the distances between two faces are negative in a map of scans, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled
from linkpose.localization.grid import FREE, OCCUPIED, UNKNOWN, GridMap
from linkpose.localization.linalg import Floats

Field = NDArray[np.int16]
Cells = NDArray[np.uint8]
# Distances are cut off here (m). A beam that ends farther from any wall than this meets something that the map does not
# have; where it ends no longer matters. Doubling it lets a global search start from twice as far, on a coarser field.
FARTHEST_M = 3.0
# One count of the field (m): 3 m in 16 bits. A map of 2 km x 2 km then takes 0.8 GB.
COUNT_M = FARTHEST_M / 32767
# The faces of one wall in a map of scans are at most so far apart (m), seen along a beam. Doubling it takes more time
# for beams that end at nothing that the map has.
HOLLOW_M = 0.6
# The distance changes by at most 1.4 m/m along a cell's diagonal. A steeper change is where cells behind a face border
# on other unknown ones.
STEEPEST = 3.0
# A place between four cells has a negative distance only if one of them has. Each of the four is within √2 cells of it,
# at both ends of a way.
BETWEEN_CELLS = 3
# Share of the wall cells beside free ones that have a wall cell behind, from which on a map counts as drawn: 1.0 in the
# simulated office, 0.58 and 0.62 in two buildings mapped by GMapping, 0.90 in an old map with smeared walls.
DRAWN_SHARE = 0.97
# Upper bound on the uncertainty of where a beam ends (m). Thicker blocks are filled rooms, not walls, and do not count.
THICKEST_STD_M = 0.25


@dataclass(frozen=True, slots=True)
class DistanceField:
    """The field of one map: `counts[row, column]` times COUNT_M is the distance (m) of a cell's centre from a wall.

    `geometry` is the map's: cell size m, x and y of the lower left corner m, rotation rad. `wall_std_m` is how
    uncertain the map is about where a beam ends in a wall: smeared walls are thicker than real ones. `is_drawn` states
    that the zero is at the faces of the walls. `clear` (rows, columns) is how many cells around each have no negative
    distance, at most 255: no beam has entered a wall there.
    """

    counts: Field
    clear: Cells
    geometry: Floats
    wall_std_m: float
    is_drawn: bool

    @staticmethod
    def of(grid: GridMap) -> DistanceField:
        """Builds the field of a map's walls. Unknown cells are no walls: nobody has measured an echo there."""
        counts = np.empty(grid.blocked.shape, np.int16)
        cell = float(grid.geometry[0])
        fill_distances(grid.blocked, cell, False, counts)
        wall, half = grid.blocked == OCCUPIED, round(0.5 * cell / COUNT_M)
        inside = np.empty(grid.blocked.shape, np.int16)
        fill_distances(grid.blocked, cell, True, inside)
        # A wall of thickness t has a mean depth of t/4, and a place drawn evenly from it a deviation of t/√12.
        smeared = wall & ~_blocks(wall, inside, cell)
        depth = float(inside[smeared].mean() - half) * COUNT_M if smeared.any() else 0.0
        wall_std_m = min(4.0 * depth / math.sqrt(12.0), THICKEST_STD_M)
        is_drawn = thick_share(grid.blocked) > DRAWN_SHARE
        if is_drawn:
            wall_std_m = 0.0
            counts = np.where(wall, half - inside, counts - half).astype(np.int16)
        else:
            np.negative(counts, out=counts, where=_behind_faces(grid, counts))
        return DistanceField(counts, _clear_cells(counts, cell), grid.geometry, wall_std_m, is_drawn)

    @property
    def reach_m(self) -> float:
        """How far a beam is followed back to the face that it sees."""
        return FARTHEST_M if self.is_drawn else HOLLOW_M

    @property
    def inside_m(self) -> float:
        """The distance below which a point is in a wall: half a cell on either side of the centres of its cells."""
        return 0.0 if self.is_drawn else 0.6 * float(self.geometry[0])


def _behind_faces(grid: GridMap, counts: Field) -> NDArray[np.bool_]:
    """The unknown cells that are behind a face: the nearest free cell is farther than the nearest wall, by a cell."""
    cell = float(grid.geometry[0])
    to_free = np.empty(counts.shape, np.int16)
    fill_distances(np.where(grid.blocked == FREE, OCCUPIED, FREE).astype(np.uint8), cell, False, to_free)
    return np.asarray((grid.blocked == UNKNOWN) & (to_free - round(0.5 * cell / COUNT_M) > counts))


def _clear_cells(counts: Field, cell: float) -> Cells:
    """How many cells around each have no negative distance, at most 255 and FARTHEST_M."""
    if counts.min() >= 0:
        return np.full(counts.shape, 255, np.uint8)
    distances = np.empty(counts.shape, np.int16)
    fill_distances(np.where(counts < 0, OCCUPIED, FREE).astype(np.uint8), cell, False, distances)
    return np.asarray(np.minimum(distances * (COUNT_M / cell), 255.0).astype(np.uint8))


def _blocks(wall: NDArray[np.bool_], inside: Field, cell: float) -> NDArray[np.bool_]:
    """The cells of blocks that are no walls: filled rooms, and what is filled around a building."""
    deepest = math.sqrt(12.0) * THICKEST_STD_M / 2.0
    core = np.where(wall & (inside > deepest / COUNT_M), OCCUPIED, FREE).astype(np.uint8)
    if not core.any():
        return np.zeros_like(wall)
    to_core = np.empty(wall.shape, np.int16)
    fill_distances(core, cell, False, to_core)
    return np.asarray(wall & (to_core <= (deepest + cell) / COUNT_M))


@compiled
def thick_share(blocked: NDArray[np.uint8]) -> float:
    """The share of the wall cells beside a free cell, in either axis, that have another wall cell behind them."""
    beside, thick = 0, 0
    for row in range(1, blocked.shape[0] - 1):
        for column in range(1, blocked.shape[1] - 1):
            if blocked[row, column] == OCCUPIED:
                for down, along in ((0, 1), (0, -1), (1, 0), (-1, 0)):
                    if blocked[row + down, column + along] == FREE:
                        beside += 1
                        thick += blocked[row - down, column - along] == OCCUPIED
    return thick / beside if beside else 0.0


@compiled
def fill_distances(blocked: NDArray[np.uint8], cell: float, inside: bool, counts: Field) -> None:
    """Fills `counts` with the distance to the nearest occupied cell, in units of COUNT_M, at most FARTHEST_M.

    With `inside`, it is the distance to the nearest cell that is not occupied.
    """
    rows, columns = blocked.shape
    limit = int(FARTHEST_M / cell) + 2  # in cells; farther ones are cut off anyway
    for column in range(columns):
        since = limit
        for row in range(rows):
            since = 0 if (blocked[row, column] == OCCUPIED) != inside else min(since + 1, limit)
            counts[row, column] = min(since, 32767)
        since = limit
        for row in range(rows - 1, -1, -1):
            since = 0 if (blocked[row, column] == OCCUPIED) != inside else min(since + 1, limit)
            counts[row, column] = min(counts[row, column], since)
    height, vertex, border = np.empty(columns), np.empty(columns, np.int64), np.empty(columns + 1)
    for row in range(rows):
        for column in range(columns):
            height[column] = float(counts[row, column]) ** 2
        _lower_envelope(height, vertex, border)
        k = 0
        for column in range(columns):
            while border[k + 1] < column:
                k += 1
            off = float(column - vertex[k])
            distance = cell * math.sqrt(off * off + height[vertex[k]])
            counts[row, column] = int(min(distance, FARTHEST_M) / COUNT_M + 0.5)


@compiled
def _lower_envelope(height: Floats, vertex: NDArray[np.int64], border: Floats) -> None:
    """The parabolas (q − vertex)² + height[vertex] that are lowest, each from its border to the next one's."""
    k = 0
    vertex[0], border[0], border[1] = 0, -np.inf, np.inf
    for q in range(1, height.shape[0]):
        while True:
            v = vertex[k]
            crossing = ((height[q] + q * q) - (height[v] + v * v)) / (2.0 * (q - v))
            if crossing > border[k]:
                break
            k -= 1
        k += 1
        vertex[k], border[k], border[k + 1] = q, crossing, np.inf


@compiled
def distance_at(counts: Field, geometry: Floats, x: float, y: float, out: Floats) -> None:
    """Fills `out` (3,) with the signed distance (m) at (x, y) in the map's frame and its slopes along x and y (m/m).

    Outside of the map the distance is FARTHEST_M and the slopes are 0.
    """
    cell: float = geometry[0]
    c, s = math.cos(geometry[3]), math.sin(geometry[3])
    along_x, along_y = x - geometry[1], y - geometry[2]
    u = (c * along_x + s * along_y) / cell - 0.5
    v = (c * along_y - s * along_x) / cell - 0.5
    rows, columns = counts.shape
    # Compared as floats: an estimate that has diverged may be beyond all integers.
    if not (u >= 0.0 and v >= 0.0 and u < columns - 1.0 and v < rows - 1.0):
        out[0], out[1], out[2] = FARTHEST_M, 0.0, 0.0
        return
    column, row = int(u), int(v)
    p, q = u - column, v - row
    d00, d01 = float(counts[row, column]), float(counts[row, column + 1])
    d10, d11 = float(counts[row + 1, column]), float(counts[row + 1, column + 1])
    low = min(d00, d01, d10, d11)
    if low < 0.0 and max(d00, d01, d10, d11) - low > STEEPEST * cell / COUNT_M:  # no face is between these cells
        d00, d01, d10, d11 = abs(d00), abs(d01), abs(d10), abs(d11)
    below, above = d00 + p * (d01 - d00), d10 + p * (d11 - d10)
    along_u = ((1.0 - q) * (d01 - d00) + q * (d11 - d10)) * COUNT_M / cell
    along_v = (above - below) * COUNT_M / cell
    out[0] = (below + q * (above - below)) * COUNT_M
    out[1] = c * along_u - s * along_v
    out[2] = s * along_u + c * along_v


@compiled
def seen_distance(
    counts: Field,
    clear: Cells,
    geometry: Floats,
    x: float,
    y: float,
    ahead_x: float,
    ahead_y: float,
    reach: float,
    out: Floats,
) -> None:
    """As `distance_at`, for a beam in direction (ahead_x, ahead_y) that ends at (x, y): from the face that it sees.

    Where the nearest face looks away from the beam, the beam is followed back for at most `reach` (m) to a face that it
    has entered. The distance is then the negative distance from the plane of that face. `clear` is that of the map's
    `DistanceField`: where no wall can have been entered, nothing is looked at.
    """
    distance_at(counts, geometry, x, y, out)
    if out[1] * ahead_x + out[2] * ahead_y < 0.0:
        return
    near = np.empty(3)
    step: float = 0.5 * geometry[0]
    is_inside, k = out[0] < 0.0, 0
    while k * step < reach:
        k += 1 if is_inside else 1 + _clear_steps(clear, geometry, x - k * step * ahead_x, y - k * step * ahead_y)
        if (k - 1) * step >= reach:
            return
        back = k * step
        distance_at(counts, geometry, x - back * ahead_x, y - back * ahead_y, near)
        slope = near[1] * ahead_x + near[2] * ahead_y
        if near[0] < 0.0:
            is_inside = True
        elif is_inside and slope < 0.0:
            out[0], out[1], out[2] = near[0] + back * slope, near[1], near[2]
            return
        else:
            is_inside = False


@compiled
def _clear_steps(clear: Cells, geometry: Floats, x: float, y: float) -> int:
    """How many steps of half a cell from (x, y), in any direction, lead past no negative distance for sure."""
    cell: float = geometry[0]
    c, s = math.cos(geometry[3]), math.sin(geometry[3])
    along_x, along_y = x - geometry[1], y - geometry[2]
    u = (c * along_x + s * along_y) / cell - 0.5
    v = (c * along_y - s * along_x) / cell - 0.5
    if not (u >= 0.0 and v >= 0.0 and u < clear.shape[1] - 1.0 and v < clear.shape[0] - 1.0):
        return 0
    return max(0, 2 * (int(clear[int(v), int(u)]) - BETWEEN_CELLS))
