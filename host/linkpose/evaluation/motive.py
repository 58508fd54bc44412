"""References from OptiTrack: the CSV that Motive exports, with three markers on the sensor's plate or its rigid body.

Marker 1 is at the sensor, marker 2 lies in the direction of its x axis and marker 3 on the side of its y axis.

A take without three markers is read by its rigid body: the pivot replaces marker 1, and the quaternion gives the axes.
Motive aligns the axes of a new rigid body with the room's. The body must therefore be created while the sensor's x axis
points along the room's X axis and its z axis upwards, or be turned to that orientation in Motive afterwards.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.evaluation.takes import Take, reference_of, take_of_markers
from linkpose.inputs import read_bytes
from linkpose.recording.delimited import to_utf8
from linkpose.recording.table import Table, check_times
from linkpose.rotations import matrices
from linkpose.sensors.measurements import Floats

_SIGNATURE = re.compile(rb'"?Format Version"?([,;\t])')
# The sensor's axes x, y, z (rows) in the axes of a rigid body that was created upright, by the axis that points up.
_SENSOR_IN_BODY = {
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "z": np.eye(3),
}
_METRES = {"meters": 1.0, "centimeters": 0.01, "millimeters": 0.001}
_QUATERNION_TOLERANCE = 0.01  # of its norm; Motive prints six decimals
_FARTHEST = 1e9  # in any unit


def is_motive(start: bytes) -> bool:
    """Whether a file begins as Motive's exports do."""
    return bool(_SIGNATURE.match(to_utf8(start)))


def read_motive(path: Path, up: str = "y") -> Table:
    """Time, height, roll and pitch of the plate as a reference; rows with a hidden marker or body are NaN.

    `up` is the axis of the room that points upwards: "y" unless Motive exports with Z up.
    Raises LinkposeError naming the file and what is missing in it.
    """
    return reference_of(path, _read_take(path, up), up)


def _read_take(path: Path, up: str) -> Take:
    rows = _read_rows(path)
    header = next((i for i, row in enumerate(rows) if row[:1] == ["Frame"] and _time_column(row)), None)
    if header is None:
        raise LinkposeError(f"{path} has no row that begins with Frame,Time (Seconds): export the take as CSV again")
    body, first_line = [row for row in rows[header + 1 :] if any(row)], header + 2
    if not body:
        raise LinkposeError(f"{path} has a header but no frame: export the take with its frames")
    starts, unlabeled = _marker_columns(rows[:header], rows[header])
    bodies = _body_columns(rows[:header], rows[header])
    if len(starts) < 3 and not bodies:
        cure = "label the plate's three in Motive" if unlabeled else "export Markers, or the rigid body as Quaternion"
        raise LinkposeError(f"{path} has {len(starts)} labeled markers with X, Y, Z; three are needed: {cure}")
    remarks = [f"{path}: markers left out as unlabeled: {unlabeled}"] if unlabeled else []
    fields = [start + axis for start in starts[:3] for axis in range(3)] if len(starts) >= 3 else bodies[0].columns
    used = [_time_column(rows[header]), *fields]
    table = np.array([[_number(path, row, j, first_line + i) for j in used] for i, row in enumerate(body)])
    unit = _unit(path, rows[0])
    if len(starts) >= 3:
        return take_of_markers(path, table[:, 0], unit * table[:, 1:].reshape(-1, 3, 3), remarks, first_line)
    check_times(path, table[:, 0], first_line)
    if not np.isfinite(table).all(axis=1).any():
        raise LinkposeError(f"{path} has no frame with the rigid body: reconstruct and solve it in Motive")
    remarks.append(
        f"{path}: the rigid body {bodies[0].name} is the reference: its pivot must be at the sensor, and its axes were "
        "the room's when the sensor's x axis pointed along X and its z axis up"
    )
    if len(bodies) > 1:
        remarks.append(f"{path}: rigid bodies left out: {', '.join(body.name for body in bodies[1:])}")
    axes = _axes_of_body(path, table[:, 1:5], up)
    return Take(table[:, 0], unit * table[:, 5:], axes, "the rigid body", first_line, remarks)


def _read_rows(path: Path) -> list[list[str]]:
    """The cells of the file, whatever separates them."""
    data = to_utf8(read_bytes(path))
    signature = _SIGNATURE.match(data)
    separator = signature[1].decode() if signature else ","
    try:
        rows = list(csv.reader(io.StringIO(data.decode("utf-8", "replace")), delimiter=separator))
    except csv.Error as error:
        raise LinkposeError(f"{path} is damaged: {error}; export the take as CSV again") from error
    return [[cell.strip() for cell in row] for row in rows]


@dataclass(frozen=True, slots=True)
class _Body:
    """A rigid body: the columns of its quaternion x, y, z, w and its position."""

    name: str
    columns: list[int]


def _body_columns(above: list[list[str]], header: list[str]) -> list[_Body]:
    """The rigid bodies with position and quaternion."""
    kinds = next((row for row in above if row[1:2] == ["Type"]), [])
    names = next((row for row in above if row[1:2] == ["Name"]), [])
    parts = next((row for row in above[::-1] if "Position" in row), [])
    found: dict[str, dict[str, int]] = {}
    for i, axis in enumerate(header):
        if i < min(len(kinds), len(names), len(parts)) and kinds[i].lower() == "rigid body":
            found.setdefault(names[i], {})[f"{parts[i]} {axis.upper()}"] = i
    wanted = [f"Rotation {axis}" for axis in "XYZW"] + [f"Position {axis}" for axis in "XYZ"]
    return [
        _Body(name, [columns[part] for part in wanted])
        for name, columns in found.items()
        if all(part in columns for part in wanted)
    ]


def _axes_of_body(path: Path, quaternion: Floats, up: str) -> Floats:
    """The sensor's axes (N, 3 axes, 3) in the room, from the body's quaternions (N, 4): x, y, z, w."""
    size = np.linalg.norm(quaternion, axis=1)
    if np.nanmax(np.abs(size - 1), initial=0) > _QUATERNION_TOLERANCE:
        raise LinkposeError(f"{path}: the rotation of the rigid body is no unit quaternion: export it as Quaternion")
    turned = matrices(np.roll(quaternion / size[:, None], 1, axis=1))
    body = turned.transpose(0, 2, 1)  # the body's axes in the room
    return np.asarray(_SENSOR_IN_BODY[up] @ body)


def _unit(path: Path, head: list[str]) -> float:
    """Metres in a unit of the file, from the pairs of its first line."""
    pairs = dict(zip(head[::2], head[1::2], strict=False))
    name = pairs.get("Length Units", "Meters").strip().lower()
    if name not in _METRES:
        raise LinkposeError(f"{path}, line 1: unknown length unit {name[:60]!r}; export in {', '.join(_METRES)}")
    return _METRES[name]


def _time_column(header: list[str]) -> int:
    """Where the header has the time in seconds; 0, which is the frame's, where it has none. A time code is another."""
    names = [name.strip().lower() for name in header]
    return next((i for i, name in enumerate(names) if name in ("time (seconds)", "time")), 0)


def _marker_columns(above: list[list[str]], header: list[str]) -> tuple[list[int], int]:
    """First column of each labeled marker's position, and the number of unlabeled ones.

    Rigid bodies, which also have a position, are not markers. An unlabeled marker may be anything that reflects.
    """
    kinds = next((row for row in above if row[1:2] == ["Type"]), [])
    names = next((row for row in above if row[1:2] == ["Name"]), [])
    found, unlabeled = [], 0
    for i in range(2, len(header) - 2):
        is_marker = "marker" in (kinds[i].lower() if i < len(kinds) else "marker")
        if is_marker and [name.strip().upper() for name in header[i : i + 3]] == ["X", "Y", "Z"]:
            if i < len(names) and "unlabeled" in names[i].lower():
                unlabeled += 1
            else:
                found.append(i)
    return found, unlabeled


def _number(path: Path, row: list[str], column: int, line: int) -> float:
    text = row[column].replace(",", ".") if column < len(row) else ""
    if not text:
        return float("nan")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < _FARTHEST:
        raise LinkposeError(f"{path}, line {line}: {text[:30]!r} is not a number that a camera system gives")
    return value
