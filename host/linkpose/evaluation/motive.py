"""References from OptiTrack: the CSV that Motive exports, with three markers on the sensor's plate or its rigid body.

Marker 1 is at the sensor, marker 2 lies in the direction of its x axis and marker 3 on the side of its y axis, as on
the set square of [Link]. They define the sensor's axes, and with the upward direction the tilt Z. Marker 1 moves on a
sphere about the joint centre. The sphere is fitted, and the height is counted from its centre, wherever the origin is.

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
from linkpose.recording.delimited import to_utf8
from linkpose.recording.table import Table, check_times, read_bytes, read_table
from linkpose.sensors.measurements import Floats

_SIGNATURE = re.compile(rb'"?Format Version"?([,;\t])')
# The sensor's axes x, y, z (rows) in the axes of a rigid body that was created upright, by the axis that points up.
_SENSOR_IN_BODY = {
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "z": np.eye(3),
}
_METRES = {"meters": 1.0, "centimeters": 0.01, "millimeters": 0.001}
_WORST_SPHERE_M = 0.02  # rms distance from the sphere on which a link's marker moves
_WORST_HEIGHT_STD_M = 0.005  # of the joint; the estimates to be scored are better than a centimetre
_LEAST_NOISE_M = 5e-5  # of a camera system, however well a file fits
_QUATERNION_TOLERANCE = 0.01  # of its norm; Motive prints six decimals
_STILL = 10.0  # radius over noise: noise alone also fits a sphere, with a radius of about 2.5 times its deviation
_CLEARLY_WIDER_DEG = 15.0
_FARTHEST = 1e9  # in any unit
_LONGEST_LINK_M = 10.0
_MOST_STEPS = 50


def read_any(path: Path, up: str) -> Table:
    """A Motive export by `read_motive`, any other CSV by `read_table`, with their errors."""
    is_motive = _SIGNATURE.match(to_utf8(read_bytes(path)[:64]))
    return read_motive(path, up) if is_motive else read_table(path)


def read_motive(path: Path, up: str = "y") -> Table:
    """Time, height, roll and pitch of the plate as a reference; rows with a hidden marker or body are NaN.

    `up` is the axis of the room that points upwards: "y" unless Motive exports with Z up.
    Raises LinkposeError naming the file and what is missing in it.
    """
    take = _read_take(path, up)
    axis = "xyz".index(up)
    tilt = take.axes[:, :, axis]
    columns = {
        "time_s": take.time_s,
        "height_m": take.position_m[:, axis] - _joint_height(path, take, axis),
        "roll_deg": np.degrees(np.arctan2(tilt[:, 1], tilt[:, 2])),
        "pitch_deg": np.degrees(np.arctan2(-tilt[:, 0], np.hypot(tilt[:, 1], tilt[:, 2]))),
    }
    columns["height_m"][np.isnan(tilt[:, 0])] = np.nan
    return Table(path, "motive", columns, {}, None, take.first_line, tuple(take.remarks))


@dataclass(frozen=True, slots=True)
class _Take:
    """The plate over time, NaN where it is hidden."""

    time_s: Floats  # (N,)
    position_m: Floats  # (N, 3) of the sensor in the room
    axes: Floats  # (N, 3 axes, 3): the sensor's axes in the room
    what: str  # what is at the sensor
    first_line: int
    remarks: list[str]


def _read_take(path: Path, up: str) -> _Take:
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
    check_times(path, table[:, 0], first_line)
    has_markers, unit = len(starts) >= 3, _unit(path, rows[0])
    if not np.isfinite(table).all(axis=1).any():
        missing = "all three markers: fill their gaps" if has_markers else "the rigid body: reconstruct and solve it"
        raise LinkposeError(f"{path} has no frame with {missing} in Motive")
    if has_markers:
        markers = unit * table[:, 1:].reshape(-1, 3, 3)
        remarks += _order_remarks(path, markers)
        return _Take(table[:, 0], markers[:, 0], _axes_of_markers(markers), "marker 1", first_line, remarks)
    remarks.append(
        f"{path}: the rigid body {bodies[0].name} is the reference: its pivot must be at the sensor, and its axes were "
        "the room's when the sensor's x axis pointed along X and its z axis up"
    )
    if len(bodies) > 1:
        remarks.append(f"{path}: rigid bodies left out: {', '.join(body.name for body in bodies[1:])}")
    axes = _axes_of_body(path, table[:, 1:5], up)
    return _Take(table[:, 0], unit * table[:, 5:], axes, "the rigid body", first_line, remarks)


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
    x, y, z, w = (quaternion / size[:, None]).T
    body = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
            [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)],
            [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)  # the body's axes in the room
    return np.asarray(_SENSOR_IN_BODY[up] @ body)


def _unit(path: Path, head: list[str]) -> float:
    """Metres in a unit of the file, from the pairs of its first line."""
    pairs = dict(zip(head[::2], head[1::2], strict=False))
    name = pairs.get("Length Units", "Meters").strip().lower()
    if name not in _METRES:
        raise LinkposeError(f"{path}, line 1: unknown length unit {name!r}; export in {', '.join(_METRES)}")
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


def _order_remarks(path: Path, markers: Floats) -> list[str]:
    """A remark where the plate's corner seems to be at another marker than the first."""
    angles = []
    for corner in range(3):
        one, two = (markers[:, (corner + i) % 3] - markers[:, corner] for i in (1, 2))
        angle = np.arctan2(np.linalg.norm(np.cross(one, two), axis=1), (one * two).sum(axis=1))
        angles.append(float(np.degrees(np.nanmedian(angle))))
    widest = int(np.argmax(angles))
    if angles[widest] < angles[0] + _CLEARLY_WIDER_DEG:
        return []
    return [
        f"{path}: the markers' widest angle is at marker {widest + 1} ({angles[widest]:.0f}°) rather than marker 1 "
        f"({angles[0]:.0f}°), which must be at the sensor: order them in Motive, if it is not"
    ]


def _axes_of_markers(markers: Floats) -> Floats:
    """The sensor's axes (N, 3 axes, 3) in the room, from markers (N, 3 markers, 3)."""
    x = markers[:, 1] - markers[:, 0]
    z = np.cross(x, markers[:, 2] - markers[:, 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        x = x / np.linalg.norm(x, axis=1, keepdims=True)
        z = z / np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _joint_height(path: Path, take: _Take, up: int) -> float:
    """Height (m) of the centre of the sphere on which the sensor moves; raises LinkposeError unless it does."""
    positions, what = take.position_m, take.what
    seen = positions[np.isfinite(positions).all(axis=1)]
    if len(seen) < 10:
        raise LinkposeError(f"{path}: {what} is seen in {len(seen)} frames only; no joint can be fitted to that")
    middle = seen.mean(axis=0)
    centre, radius, noise, std = _fit_sphere(seen - middle)
    if radius < _STILL * noise:
        raise LinkposeError(
            f"{path}: {what} hardly moves, so the joint cannot be located: tilt the link to all sides in the take"
        )
    if noise > _WORST_SPHERE_M:
        raise LinkposeError(
            f"{path}: {what} is {100 * noise:.1f} cm rms off any sphere: is the joint fixed to the ground?"
        )
    if std[up] > _WORST_HEIGHT_STD_M:
        raise LinkposeError(
            f"{path}: the motion of {what} locates the joint's height to ±{100 * std[up]:.1f} cm only: "
            "tilt the link further; turning about the vertical does not help"
        )
    return float(middle[up] + centre[up])


def _fit_sphere(p: Floats) -> tuple[Floats, float, float, Floats]:
    """Centre (3,), radius, rms distance from the sphere, and the centre's standard deviations (3,), all in metres.

    Least squares of the distances by Gauss and Newton. |p|² = 2 p·c + (r² − |c|²), linear in both, is the start only:
    the markers' noise pulls its centre towards the positions, by decimetres where they cover a small cap.
    """
    design = np.column_stack([2 * p, np.ones(len(p))])
    centre = np.linalg.lstsq(design, (p**2).sum(axis=1), rcond=1e-6)[0][:3]
    state = np.append(centre, np.linalg.norm(p - centre, axis=1).mean())
    for _ in range(_MOST_STEPS):
        away = p - state[:3]
        distance = np.linalg.norm(away, axis=1)
        jacobian = np.column_stack([away / np.maximum(distance, 1e-9)[:, None], np.ones(len(p))])
        off = distance - state[3]
        information = jacobian.T @ jacobian
        step = _solve(information, jacobian.T @ off, 1e-12 * len(p))
        state = state + step / max(1.0, float(np.linalg.norm(step)))
        if np.linalg.norm(step) < 1e-6:
            break
    noise = max(float(np.sqrt(np.mean(off**2))), _LEAST_NOISE_M)
    radius = max(float(state[3]), noise)
    # Noise across the radius turns the rows of the Jacobian. That looks like motion, but holds no information.
    information[:3, :3] -= (noise / radius) ** 2 * (len(p) * np.eye(3) - information[:3, :3])
    covariance = noise**2 * _solve(information, np.eye(4), (noise / _LONGEST_LINK_M) ** 2)
    return state[:3], radius, noise, np.sqrt(np.diag(covariance))[:3]


def _solve(information: Floats, right: Floats, least: float) -> Floats:
    """information⁻¹ · right, with the eigenvalues of the information raised to at least `least`."""
    eigenvalues, directions = np.linalg.eigh(information)
    return np.asarray(directions / np.maximum(eigenvalues, least) @ (directions.T @ right))
