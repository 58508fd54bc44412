"""Reads and writes the grid maps of ROS map_server: a YAML file that names an image.

Source of the format: the documentation of ROS map_server and of ROS 2 nav2_map_server (keys image, resolution, origin,
negate, occupied_thresh, free_thresh, mode).
"""

from __future__ import annotations

import math
import stat
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import LinkposeError
from linkpose.inputs import open_binary
from linkpose.localization.grid import FREE, OCCUPIED, UNKNOWN, GridMap
from linkpose.outputs import new_file

if TYPE_CHECKING:
    from PIL.Image import Image

Mode = Literal["trinary", "scale", "raw"]
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196  # map_server's defaults
# The largest image that is decoded (bytes), which bounds the memory that a small compressed file can demand: a map of
# 2 km x 2 km at 0.1 m with 8 bits a cell.
MAX_IMAGE_BYTES = 400_000_000
MAX_YAML_BYTES = 65536  # a map file has about 150
BAND_ROWS = 256  # rows that are converted at a time, so that a large image needs no second copy
RESOLUTION_M = (1e-4, 100.0)
FARTHEST_ORIGIN_M = 1e8
IMAGE_FORMATS = ("PPM", "PNG", "BMP", "JPEG", "TIFF", "GIF")
TRUE_WORDS, FALSE_WORDS = ("1", "true", "yes", "on"), ("0", "false", "no", "off")


@dataclass(frozen=True, slots=True)
class _Keys:
    """What a map file holds, checked."""

    image: Path
    resolution_m: float
    origin: tuple[float, float, float]
    negate: bool
    occupied: float
    free: float
    mode: Mode


def load_map(path: Path) -> GridMap:
    """Reads a map_server YAML file and its image (PGM, PNG, BMP, JPEG, TIFF or GIF; 1, 8 or 16 bits; with alpha).

    A cell is occupied where its occupancy is at least `occupied_thresh`, free where it is below `free_thresh`, and
    unknown in between, where the image is transparent, and, in the mode `raw`, where the value is above 100. Raises
    LinkposeError that names file, key and cure, also for a map without a free cell or without a wall.
    """
    keys = _checked(path, _read_yaml(path))
    blocked = _cells(path, keys)
    if not (blocked == FREE).any():
        raise LinkposeError(f"{path}: no cell of the map is free; check negate and free_thresh")
    if not (blocked == OCCUPIED).any():
        raise LinkposeError(f"{path}: no cell of the map is a wall; check negate and occupied_thresh")
    return GridMap(blocked, np.array([keys.resolution_m, *keys.origin]))


def save_map(
    path: Path, occupied: NDArray[np.bool_], resolution: float, origin: tuple[float, float], force: bool = False
) -> None:
    """Writes a map_server YAML file and a PGM image beside it. `occupied` is (rows, columns), row 0 the lowest y.

    Raises FileExists (unless `force`) and CannotWrite.
    """
    from PIL import Image

    image = path.with_suffix(".pgm")
    keys = (
        f"image: {image.name}\nresolution: {resolution}\norigin: [{origin[0]}, {origin[1]}, 0.0]\n"
        f"negate: 0\noccupied_thresh: {OCCUPIED_THRESHOLD}\nfree_thresh: {FREE_THRESHOLD}\n"
    )
    with new_file(image, force) as file:
        Image.fromarray(np.where(occupied[::-1], 0, 254).astype(np.uint8)).save(file, format="PPM")
    with new_file(path, force) as file:
        file.write(keys.encode())


_DEEPEST = 20  # levels of a map's YAML; a map file has two


def _read_yaml(path: Path) -> dict[str, Any]:
    """The keys of a map file. YAML aliases are refused: nested ones expand to any size."""
    import yaml

    class Loader(yaml.SafeLoader):
        depth = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise LinkposeError(f"{path} uses YAML aliases (*name); write each value out")
            self.depth += 1
            if self.depth > _DEEPEST:  # the scanner's time grows with the square of the depth
                raise RecursionError
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node

    try:
        with open_binary(path, "the map") as file:
            data = file.read(MAX_YAML_BYTES + 1)
        if len(data) > MAX_YAML_BYTES:
            raise LinkposeError(
                f"{path} is larger than {MAX_YAML_BYTES} bytes, so it is no map file; "
                "give the map's .yaml file, not its image"
            )
        keys = yaml.load(data.decode("utf-8-sig"), Loader)  # a SafeLoader
    except OSError as error:
        raise LinkposeError(f"cannot read the map {path}: {error.strerror}") from error
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError) as error:
        where = getattr(error, "problem_mark", None)
        line = f" line {where.line + 1}" if where else ""
        raise LinkposeError(f"{path}{line} is not YAML; give the map's .yaml file, not its image") from error
    if not isinstance(keys, dict) or not isinstance(keys.get("image"), str):
        raise LinkposeError(f"{path} names no image; a map file has image, resolution and origin")
    return cast("dict[str, Any]", keys)


def _checked(path: Path, keys: dict[str, Any]) -> _Keys:
    resolution = _number(path, keys, "resolution", None)
    if not RESOLUTION_M[0] <= resolution <= RESOLUTION_M[1]:
        raise LinkposeError(f"{path}: resolution is {resolution:g}; give the size of a cell in metres, such as 0.05")
    occupied = _number(path, keys, "occupied_thresh", OCCUPIED_THRESHOLD)
    free = _number(path, keys, "free_thresh", FREE_THRESHOLD)
    if not 0.0 <= free < occupied <= 1.0:
        raise LinkposeError(
            f"{path}: free_thresh {free:g} must be below occupied_thresh {occupied:g}, both within 0 to 1"
        )
    mode = str(keys.get("mode", "trinary")).lower()
    if mode not in ("trinary", "scale", "raw"):
        raise LinkposeError(f"{path}: mode is {_shown(keys['mode'])}; it must be trinary, scale or raw")
    image = path.parent / keys["image"]
    return _Keys(image, resolution, _origin(path, keys), _negate(path, keys), occupied, free, cast(Mode, mode))


def _origin(path: Path, keys: dict[str, Any]) -> tuple[float, float, float]:
    given = keys.get("origin")
    numbers = [_as_number(value) for value in given] if isinstance(given, list) and len(given) in (2, 3) else [None]
    if any(number is None or abs(number) > FARTHEST_ORIGIN_M for number in numbers):
        raise LinkposeError(
            f"{path}: origin is {_shown(given)}; it must be [x, y, yaw] of the lower left corner (m, m, rad)"
        )
    x, y, yaw = cast("list[float]", [*numbers, 0.0][:3])
    if abs(yaw) > 2.0 * math.pi:
        raise LinkposeError(
            f"{path}: the yaw of origin is {yaw:g}, more than a turn in radians; "
            f"if it is in degrees, write {math.radians(yaw):.6g}"
        )
    return x, y, yaw


def _negate(path: Path, keys: dict[str, Any]) -> bool:
    word = str(keys.get("negate", 0)).strip().lower()
    if word in TRUE_WORDS or word in FALSE_WORDS:
        return word in TRUE_WORDS
    raise LinkposeError(f"{path}: negate is {_shown(keys['negate'])}; it must be 0 or 1")


def _cells(path: Path, keys: _Keys) -> NDArray[np.uint8]:
    """FREE, OCCUPIED or UNKNOWN (rows, columns), row 0 the lowest y."""
    from PIL import Image, UnidentifiedImageError

    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None  # Pillow's limit is below MAX_IMAGE_BYTES
    try:
        if not stat.S_ISREG(keys.image.stat().st_mode):
            raise LinkposeError(f"{keys.image}, named in {path}, is no regular file; name a PGM or PNG file")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what Pillow passes over is of no use to whoever drives in the map
            with Image.open(keys.image, formats=IMAGE_FORMATS) as image:
                return _convert(image, keys)
    except UnidentifiedImageError as error:
        raise LinkposeError(f"{keys.image} is no image that can be read; {path} must name a PGM or PNG file") from error
    except (OSError, SyntaxError, ValueError, EOFError, OverflowError, MemoryError) as error:
        reason = getattr(error, "strerror", None) or "it is damaged or cut short"
        raise LinkposeError(f"cannot read the map's image {keys.image}, named in {path}: {reason}") from error
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def _convert(image: Image, keys: _Keys) -> NDArray[np.uint8]:
    depth = 4 if image.mode in ("I", "F") else 2 if image.mode.startswith("I;16") else 1
    if image.width * image.height * depth * len(image.getbands()) > MAX_IMAGE_BYTES:
        raise LinkposeError(
            f"{keys.image} has {image.width} x {image.height} cells in the form {image.mode}, more than "
            f"{MAX_IMAGE_BYTES // 10**6} MB; cut the map to the part that is driven in, or save it with 8 bits a cell"
        )
    if image.mode == "F":
        raise LinkposeError(f"{keys.image} holds floating-point cells; save it with 8 or 16 bits a cell")
    blocked = np.empty((image.height, image.width), np.uint8)
    for top in range(0, image.height, BAND_ROWS):
        bottom = min(top + BAND_ROWS, image.height)
        band = image.crop((0, top, image.width, bottom))
        blocked[image.height - bottom : image.height - top] = _band(band, keys)[::-1]
    return blocked


def _band(band: Image, keys: _Keys) -> NDArray[np.uint8]:
    """Cells of some rows of the image, first row on top: a dark pixel is a wall unless `negate` is set."""
    transparent: NDArray[np.bool_] | None = None
    if band.mode.startswith("I"):
        lightness = np.asarray(band, dtype=np.float32) / np.float32(65535)
    else:
        if band.has_transparency_data:
            rgba = band.convert("RGBA")
            transparent = np.asarray(rgba.getchannel("A")) < 128
            band = rgba.convert("RGB")
        lightness = np.asarray(band.convert("L"), dtype=np.float32) / np.float32(255)
    if keys.mode == "raw":
        value = np.round(lightness * 255)
        occupancy: NDArray[Any] = value / np.float32(100)
        unknown = value > 100
    else:
        occupancy = lightness if keys.negate else np.float32(1) - lightness
        unknown = np.zeros(occupancy.shape, np.bool_)
    # A pixel of n/255 must compare with a threshold of n/255 in any precision.
    cells = np.where(occupancy >= keys.occupied - 1e-6, OCCUPIED, np.where(occupancy < keys.free, FREE, UNKNOWN))
    cells[unknown] = UNKNOWN
    if transparent is not None:
        cells[transparent] = UNKNOWN
    return cells.astype(np.uint8)


def _number(path: Path, keys: dict[str, Any], key: str, default: float | None) -> float:
    value = _as_number(keys.get(key, default))
    if value is None:
        raise LinkposeError(f"{path}: {key} is {_shown(keys.get(key))}; it must be a number")
    return value


def _as_number(value: object) -> float | None:
    """A finite number, or None. YAML 1.1 reads 1e-1 as text because it has no point; here it is a number, too."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _shown(value: object) -> str:
    """A value from a file as a message quotes it: bounded."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        return "a value too long to quote"
    return text if len(text) <= 60 else f"{text[:57]}..."
