"""Occupancy grids, as ROS map_server writes them, and ray casting through them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled
from linkpose.errors import LinkposeError
from linkpose.localization.linalg import Floats

OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196  # map_server's defaults
MAX_CELLS = 400_000_000  # a map of 2 km x 2 km at 0.1 m


@dataclass(frozen=True, slots=True)
class GridMap:
    """A grid that stops beams.

    `blocked[row, column]` is 1 where a beam ends: in an occupied cell, and in one that nobody has seen. Row 0 is the
    lowest y. `geometry` is (cell size m, x and y of the lower left corner m, rotation rad) in the map's frame.
    """

    blocked: NDArray[np.uint8]
    geometry: Floats

    @property
    def size_m(self) -> tuple[float, float]:
        rows, columns = self.blocked.shape
        return columns * float(self.geometry[0]), rows * float(self.geometry[0])


def no_map() -> GridMap:
    """What a filter without beams is given."""
    return GridMap(np.zeros((1, 1), np.uint8), np.array([1.0, 0.0, 0.0, 0.0]))


def load_map(path: Path) -> GridMap:
    """Reads a map_server YAML file and its image (PGM, PNG or what Pillow reads).

    Raises LinkposeError that names the file, the key and the cure.
    """
    import yaml

    try:
        keys = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise LinkposeError(f"cannot read the map {path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        where = getattr(error, "problem_mark", None)
        line = f" line {where.line + 1}" if where else ""
        raise LinkposeError(f"{path}{line} is not YAML; give the map's .yaml file, not its image") from error
    if not isinstance(keys, dict) or "image" not in keys:
        raise LinkposeError(f"{path} names no image; a map file has image, resolution and origin")
    resolution = _number(path, keys, "resolution", None)
    if resolution <= 0:
        raise LinkposeError(f"{path}: resolution is {resolution:g}; give the size of a cell in metres, as 0.1")
    origin = keys.get("origin")
    if not isinstance(origin, list) or len(origin) not in (2, 3) or not all(_is_finite(v) for v in origin):
        raise LinkposeError(f"{path}: origin is {origin!r}; it must be [x, y, yaw] of the lower left corner")
    occupancy = _occupancy(path, path.parent / str(keys["image"]), bool(keys.get("negate", 0)))
    occupied = _number(path, keys, "occupied_thresh", OCCUPIED_THRESHOLD)
    free = _number(path, keys, "free_thresh", FREE_THRESHOLD)
    if not 0.0 <= free < occupied <= 1.0:
        raise LinkposeError(
            f"{path}: free_thresh {free:g} must be below occupied_thresh {occupied:g}, both within 0 to 1"
        )
    blocked = np.ascontiguousarray(occupancy[::-1] >= free, dtype=np.uint8)
    if blocked.all():
        raise LinkposeError(f"{path}: no cell of the map is free; check negate and free_thresh")
    yaw = float(origin[2]) if len(origin) == 3 else 0.0
    return GridMap(blocked, np.array([resolution, float(origin[0]), float(origin[1]), yaw]))


def _occupancy(path: Path, image: Path, negate: bool) -> Floats:
    """Probability of occupancy (rows, columns), first row on top: a dark pixel is a wall."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(image) as opened:
            if opened.width * opened.height > MAX_CELLS:
                raise LinkposeError(
                    f"{image} has {opened.width} x {opened.height} cells; cut the map to the part that is driven in"
                )
            grey = np.asarray(opened.convert("L"), dtype=np.float64)
    except UnidentifiedImageError as error:
        raise LinkposeError(f"{image} is no image that can be read; {path} must name a PGM or PNG file") from error
    except (OSError, SyntaxError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is damaged or cut short"
        raise LinkposeError(f"cannot read the map's image {image}, named in {path}: {reason}") from error
    return grey / 255.0 if negate else (255.0 - grey) / 255.0


def save_map(path: Path, occupied: NDArray[np.bool_], resolution: float, origin: tuple[float, float]) -> None:
    """Writes a map_server YAML file and a PGM image beside it. `occupied` is (rows, columns), row 0 the lowest y."""
    from PIL import Image

    image = path.with_suffix(".pgm")
    try:
        Image.fromarray(np.where(occupied[::-1], 0, 254).astype(np.uint8)).save(image)
        path.write_text(
            f"image: {image.name}\nresolution: {resolution}\norigin: [{origin[0]}, {origin[1]}, 0.0]\n"
            f"negate: 0\noccupied_thresh: {OCCUPIED_THRESHOLD}\nfree_thresh: {FREE_THRESHOLD}\n",
            encoding="utf-8",
        )
    except OSError as error:
        raise LinkposeError(f"cannot write the map {path}: {error.strerror}; choose another place") from error


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(path: Path, keys: dict[str, Any], key: str, default: float | None) -> float:
    value: Any = keys.get(key, default)
    if value is None or not _is_finite(value):
        raise LinkposeError(f"{path}: {key} is {value!r}; it must be a number")
    return float(value)


@compiled
def cast_ray(blocked: NDArray[np.uint8], geometry: Floats, x: float, y: float, angle: float, max_range: float) -> float:
    """Distance (m) from (x, y) along `angle` (rad) to the face of the first blocked cell, at most `max_range`.

    Exact to the cell's face: the ray steps from one grid line to the next (Amanatides and Woo, A Fast Voxel Traversal
    Algorithm, Eurographics 1987). The map's edge ends a ray like a wall; from inside a blocked cell the distance is 0.
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
