"""The motion of the sensor, or of the robot, that a filter has estimated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from linkpose.errors import LinkposeError, UnknownFilter
from linkpose.quantities import by_filter, split
from linkpose.recording.table import Table
from linkpose.sensors.measurements import Floats

PLATE_M = 0.1  # from the sensor to its two other markers, as on a small marker plate; no estimate depends on it
_LONGEST_STEPS = 2.5  # of the grid: longer gaps stay empty. One lost sample is interpolated; doubled, four are
_MOST_EMPTY = 100  # frames for each pose; a clock that jumped would fill the memory with empty frames


@dataclass(frozen=True, slots=True)
class Motion:
    """Poses of the sensor. World: Z up, x and y horizontal, in m. NaN where the filter has no estimate."""

    label: str
    time_s: Floats  # (N,)
    position_m: Floats  # (N, 3)
    quaternion: Floats  # (N, 4): w, x, y, z; turns the sensor's axes into the world's
    remarks: tuple[str, ...]

    @property
    def rate_hz(self) -> float:
        """The usual rate of the poses."""
        steps = np.diff(self.time_s)
        steps = steps[steps > 0]
        return float(np.round(1 / np.median(steps), 3)) if len(steps) else 1.0

    def known(self) -> Motion:
        """The motion without the poses that are not estimated."""
        rows = np.isfinite(self.position_m).all(axis=1) & np.isfinite(self.quaternion).all(axis=1)
        return replace(
            self, time_s=self.time_s[rows], position_m=self.position_m[rows], quaternion=self.quaternion[rows]
        )

    def markers(self) -> Floats:
        """Three markers (N, 3 markers, 3) in m: at the sensor, along its x axis, along its y axis."""
        w, x, y, z = self.quaternion.T
        along_x = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
        along_y = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1)
        origin = self.position_m
        return np.stack([origin, origin + PLATE_M * along_x, origin + PLATE_M * along_y], axis=1)

    def marker_names(self) -> list[str]:
        """The names of the three markers."""
        return [f"{self.label}_{end}" for end in ("O", "X", "Y")]

    def on_grid(self) -> tuple[float, float, Floats]:
        """Start (s), rate (Hz) and markers (M, 3, 3) at equal intervals, interpolated; NaN in gaps."""
        known, rate = self.known(), self.rate_hz
        start = float(known.time_s[0])
        count = round((known.time_s[-1] - start) * rate) + 1
        if count > _MOST_EMPTY * len(known.time_s):
            raise LinkposeError(
                f"{self.label}: {count} frames at {rate:g} Hz would hold {len(known.time_s)} poses only: "
                "cut the file at its longest gap"
            )
        grid = start + np.arange(count) / rate
        flat = known.markers().reshape(-1, 9)
        values = np.column_stack([np.interp(grid, known.time_s, column) for column in flat.T])
        after = np.clip(np.searchsorted(known.time_s, grid), 1, max(len(known.time_s) - 1, 1))
        if len(known.time_s) > 1:
            gap = known.time_s[after] - known.time_s[after - 1]
            exact = np.abs(known.time_s[after] - grid) * rate < 0.5
            exact |= np.abs(known.time_s[after - 1] - grid) * rate < 0.5
            values[(gap * rate > _LONGEST_STEPS) & ~exact] = np.nan
        return start, rate, values.reshape(-1, 3, 3)


def only_filter(table: Table, wanted: str) -> Table:
    """The table with time_s and this filter's columns; raises UnknownFilter where it has none."""
    prefix = _prefix(table, wanted)
    names = [name for name in table.columns if name == "time_s" or _prefix_of(name) == prefix]
    return replace(table, columns={name: table.columns[name] for name in names})


def motion_of(table: Table, wanted: str | None, label: str) -> Motion:
    """The motion that the filter `wanted`, or the first that has at least two poses, has estimated."""
    table.require("time_s")
    prefixes = dict.fromkeys(_prefix_of(name) for name in table.columns if split(name))
    choices = [prefix for prefix in prefixes if prefix is not None and _has_orientation(table, prefix)]
    candidates = [_prefix(table, wanted)] if wanted else choices
    if not candidates or candidates[0] not in choices:
        kind = f"the filter {wanted}" if wanted else "it"
        raise LinkposeError(
            f"{table.path}: {kind} has no orientation (roll_deg and pitch_deg, heading_rad, or qw to qz); "
            "a recording must be estimated before it has one"
        )
    for prefix in candidates:
        name = prefix.replace("_", "-")
        is_obvious = wanted or len(choices) < 2
        remarks = [] if is_obvious else [f"{table.path}: the motion is the one of the filter {name}"]
        motion = _poses(table, prefix, label, remarks)
        if len(motion.time_s) >= 2:
            return motion
    who = "any filter" if len(candidates) > 1 else name or str(table.path)
    raise LinkposeError(f"{table.path} has no two poses of {who}")


def _poses(table: Table, prefix: str, label: str, remarks: list[str]) -> Motion:
    """The poses that the filter with this prefix has estimated; `remarks` come before its own."""
    remarks = list(remarks)
    columns = {column.removeprefix(f"{prefix}_" if prefix else ""): values for column, values in table.columns.items()}
    who = prefix.replace("_", "-") or str(table.path)
    motion = Motion(
        label, table.columns["time_s"], _position(columns, who, remarks), _orientation(columns, who, remarks), ()
    )
    known = motion.known()
    if len(known.time_s) < len(motion.time_s):
        remarks.append(f"{table.path}: {len(motion.time_s) - len(known.time_s)} rows without an estimate left out")
    return replace(known, remarks=tuple(remarks))


def _prefix_of(column: str) -> str | None:
    part = split(column)
    return part.prefix if part else None


def _prefix(table: Table, wanted: str) -> str:
    known = list(by_filter(table.columns))
    prefix = wanted.replace("-", "_")
    if not any(_prefix_of(name) == prefix for name in table.columns):
        raise UnknownFilter(wanted, [name.replace("_", "-") for name in known])
    return prefix


def _has_orientation(table: Table, prefix: str) -> bool:
    start = f"{prefix}_" if prefix else ""
    sets = (("roll_deg", "pitch_deg"), ("heading_rad",), ("qw", "qx", "qy", "qz"))
    return any(all(start + name in table.columns for name in names) for names in sets)


def _position(columns: dict[str, Floats], who: str, remarks: list[str]) -> Floats:
    zero = np.zeros(len(columns["time_s"]))
    height = columns.get("height_m", columns.get("z_m", zero))
    missing = [name for name in ("x_m", "y_m") if name not in columns]
    if missing:
        remarks.append(f"{who} does not estimate x and y: they are 0 in the output")
    if height is zero and missing:
        remarks.append(f"{who} does not estimate the height: it is 0 in the output")
    return np.column_stack([columns.get("x_m", zero), columns.get("y_m", zero), height])


def _orientation(columns: dict[str, Floats], who: str, remarks: list[str]) -> Floats:
    """Quaternions (N, 4): w, x, y, z. Roll, pitch and yaw turn about x, then y, then z."""
    if "qw" in columns:
        return np.column_stack([columns[name] for name in ("qw", "qx", "qy", "qz")])
    zero = np.zeros(len(columns["time_s"]))
    heading = np.degrees(columns["heading_rad"]) if "heading_rad" in columns else None
    yaw = columns.get("yaw_deg", heading)
    if yaw is None:
        remarks.append(f"{who} does not estimate yaw: it is 0 in the output")
        yaw = zero
    half = [np.radians(angle) / 2 for angle in (columns.get("roll_deg", zero), columns.get("pitch_deg", zero), yaw)]
    (cr, cp, cy), (sr, sp, sy) = map(np.cos, half), map(np.sin, half)
    return np.column_stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )
