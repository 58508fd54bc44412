"""A motion-capture take of a link's sensor as a reference, whatever file it came from.

Marker 1 is at the sensor, marker 2 lies in the direction of its x axis and marker 3 on the side of its y axis, as on
the set square of [Link]. They define the sensor's axes, and with the upward direction the tilt Z. Marker 1 moves on a
sphere about the joint centre. The sphere is fitted, and the height is counted from its centre, wherever the origin is.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.recording.table import Table, check_times
from linkpose.sensors.measurements import Floats

MOTION_CAPTURE = "motion capture"  # kind of a table that comes from a take
_WORST_SPHERE_M = 0.02  # rms distance from the sphere on which a link's marker moves
_WORST_HEIGHT_STD_M = 0.005  # of the joint; the estimates to be scored are better than a centimetre
_LEAST_NOISE_M = 5e-5  # of a camera system, however well a file fits
_STILL = 10.0  # radius over noise: noise alone also fits a sphere, with a radius of about 2.5 times its deviation
_CLEARLY_WIDER_DEG = 15.0
_LONGEST_LINK_M = 10.0
_MOST_STEPS = 50


@dataclass(frozen=True, slots=True)
class Take:
    """The plate over time, NaN where it is hidden."""

    time_s: Floats  # (N,)
    position_m: Floats  # (N, 3) of the sensor in the room
    axes: Floats  # (N, 3 axes, 3): the sensor's axes in the room
    what: str  # what is at the sensor
    first_line: int
    remarks: list[str]


def take_of_markers(path: Path, time_s: Floats, markers_m: Floats, remarks: list[str], first_line: int = 1) -> Take:
    """The take of three markers (N, 3 markers, 3); rows with a hidden one are NaN. Raises LinkposeError."""
    check_times(path, time_s, first_line)
    if not np.isfinite(markers_m).all(axis=(1, 2)).any():
        raise LinkposeError(
            f"{path} has no frame with all three markers: fill their gaps in Motive or your own program"
        )
    remarks = [*remarks, *_order_remarks(path, markers_m)]
    return Take(time_s, markers_m[:, 0], _axes_of_markers(markers_m), "marker 1", first_line, remarks)


def reference_of(path: Path, take: Take, up: str) -> Table:
    """Time, height, roll and pitch; rows with a hidden marker or body are NaN.

    `up` is the axis of the room that points upwards, "y" or "z". Raises LinkposeError where no joint can be located.
    """
    axis = "xyz".index(up)
    tilt = take.axes[:, :, axis]
    columns = {
        "time_s": take.time_s,
        "height_m": take.position_m[:, axis] - _joint_height(path, take, axis),
        "roll_deg": np.degrees(np.arctan2(tilt[:, 1], tilt[:, 2])),
        "pitch_deg": np.degrees(np.arctan2(-tilt[:, 0], np.hypot(tilt[:, 1], tilt[:, 2]))),
    }
    columns["height_m"][np.isnan(tilt[:, 0])] = np.nan
    return Table(path, MOTION_CAPTURE, columns, {}, None, take.first_line, tuple(take.remarks))


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


def _joint_height(path: Path, take: Take, up: int) -> float:
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
