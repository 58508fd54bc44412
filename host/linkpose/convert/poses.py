"""Poses of the sensor, or of the robot, from the columns that a filter has written."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.measurements import Floats

PLATE_M = 0.1  # from the sensor to its two other markers, as on a small marker plate; no estimate depends on it
Block = dict[str, Floats]  # consecutive rows of a table: columns by name, (N,) each


@dataclass(frozen=True, slots=True)
class Poses:
    """Consecutive poses. World: Z up, x and y horizontal, in m. NaN where the filter has no estimate."""

    time_s: Floats  # (N,)
    position_m: Floats  # (N, 3)
    quaternion: Floats  # (N, 4): w, x, y, z; turns the sensor's axes into the world's

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, rows: slice | NDArray[np.bool_]) -> Poses:
        return Poses(self.time_s[rows], self.position_m[rows], self.quaternion[rows])

    @property
    def is_known(self) -> NDArray[np.bool_]:
        """(N,): whether the filter has estimated the pose."""
        known = np.isfinite(self.position_m).all(axis=1) & np.isfinite(self.quaternion).all(axis=1)
        return np.asarray(known)

    def then(self, others: Poses) -> Poses:
        """These poses and later ones."""
        parts = zip(
            (self.time_s, self.position_m, self.quaternion),
            (others.time_s, others.position_m, others.quaternion),
            strict=True,
        )
        return Poses(*map(np.concatenate, parts))

    def markers(self) -> Floats:
        """Three markers (N, 3 markers, 3) in m: at the sensor, along its x axis, along its y axis."""
        w, x, y, z = self.quaternion.T
        along_x = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
        along_y = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1)
        origin = self.position_m
        return np.stack([origin, origin + PLATE_M * along_x, origin + PLATE_M * along_y], axis=1)


def has_orientation(names: Collection[str], prefix: str) -> bool:
    """Whether these columns hold an orientation of the filter with this prefix."""
    sets = (("roll_deg", "pitch_deg"), ("heading_rad",), ("qw", "qx", "qy", "qz"))
    return any(all(_name(prefix, name) in names for name in each) for each in sets)


def poses_of(block: Block, prefix: str) -> Poses:
    """The poses of the filter with this prefix. A coordinate that it does not estimate is 0; see `not_estimated`."""
    zero = np.zeros(len(block["time_s"]))

    def column(*names: str) -> Floats:
        return next((block[each] for name in names if (each := _name(prefix, name)) in block), zero)

    position = np.column_stack([column("x_m"), column("y_m"), column("height_m", "z_m")])
    if _name(prefix, "qw") in block:
        quaternion = np.column_stack([column(name) for name in ("qw", "qx", "qy", "qz")])
    else:
        yaw = column("yaw_deg") if _name(prefix, "yaw_deg") in block else np.degrees(column("heading_rad"))
        quaternion = _quaternions(column("roll_deg"), column("pitch_deg"), yaw)
    return Poses(block["time_s"], position, quaternion)


def not_estimated(names: Collection[str], prefix: str) -> list[str]:
    """What the filter with this prefix does not estimate of a pose."""
    missing = []
    if any(_name(prefix, name) not in names for name in ("x_m", "y_m")):
        missing.append("x and y: they are 0 in the output")
        if all(_name(prefix, name) not in names for name in ("height_m", "z_m")):
            missing.append("the height: it is 0 in the output")
    if all(_name(prefix, name) not in names for name in ("qw", "yaw_deg", "heading_rad")):
        missing.append("yaw: it is 0 in the output")
    return missing


def _name(prefix: str, quantity: str) -> str:
    return f"{prefix}_{quantity}" if prefix else quantity


def _quaternions(roll_deg: Floats, pitch_deg: Floats, yaw_deg: Floats) -> Floats:
    """Quaternions (N, 4): w, x, y, z. Roll, pitch and yaw turn about x, then y, then z."""
    half = [np.radians(angle) / 2 for angle in (roll_deg, pitch_deg, yaw_deg)]
    (cr, cp, cy), (sr, sp, sy) = map(np.cos, half), map(np.sin, half)
    return np.column_stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )
