"""CSV tables of numbers with named columns: beacons and true paths."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.inputs import read_bytes
from linkpose.localization.events import beacon_name, read_number
from linkpose.localization.headings import check_headings
from linkpose.localization.linalg import Floats, wrap_angle
from linkpose.localization.track import Track
from linkpose.recording.delimited import split_cells, to_utf8
from linkpose.recording.table import Table, read_table

Beacons = dict[str, tuple[float, float, float]]
LONGEST_TRUTH_GAP_S = 1.0  # between two true poses: an estimate inside a longer gap has nothing to be compared with


def read_beacons(path: Path) -> Beacons:
    """Reads `id,x_m,y_m[,z_m]` into name -> (x, y, z) in m, as a spreadsheet saves it too.

    Raises LinkposeError with file, line and cure.
    """
    cells = split_cells(path, to_utf8(read_bytes(path)))
    if sorted(cells.names) not in (["id", "x_m", "y_m"], ["id", "x_m", "y_m", "z_m"]):
        raise LinkposeError(
            f"{path} has the header {','.join(cells.names)[:60]!r}; a beacon file has id,x_m,y_m or id,x_m,y_m,z_m"
        )
    beacons: Beacons = {}
    for line, row in zip(cells.lines, cells.rows, strict=True):
        fields = dict(zip(cells.names, row, strict=True))
        name = beacon_name(fields.pop("id"))
        place = {axis: read_number(text.replace(",", "."), path, line) for axis, text in fields.items()}
        if not name:
            raise LinkposeError(f"{path} line {line}: the row has no id; complete or delete it")
        if name in beacons:
            raise LinkposeError(f"{path} line {line}: beacon {name} is listed twice; give each its own id")
        beacons[name] = (place["x_m"], place["y_m"], place.get("z_m", 0.0))
    return beacons


@dataclass(frozen=True, slots=True)
class Truth:
    """A true path: times (N,) and positions (N, 2 or 3) in m; headings (N,) in rad, unwrapped, or None where they are
    not known.
    """

    time_s: Floats
    position_m: Floats
    heading_rad: Floats | None

    def covers(self, time_s: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which times lie between two true poses that are near enough to interpolate."""
        after = np.searchsorted(self.time_s, time_s)
        inside = (time_s >= self.time_s[0]) & (time_s <= self.time_s[-1])
        gap = self.time_s[np.minimum(after, len(self.time_s) - 1)] - self.time_s[np.maximum(after - 1, 0)]
        return np.asarray(inside & (gap <= LONGEST_TRUTH_GAP_S))

    def position_at(self, time_s: Floats) -> Floats:
        """Positions (M, 2 or 3) by linear interpolation."""
        return np.column_stack([np.interp(time_s, self.time_s, axis) for axis in self.position_m.T])


def read_truth(path: Path) -> Truth:
    """Reads `time_s,x_m,y_m[,z_m][,heading_rad]` among other columns.

    Raises LinkposeError with file, line and cure, and where only a heading in degrees or of the other sign is along the
    path.
    """
    columns = _read_whole(path, "time_s", "x_m", "y_m").columns
    axes = [columns[name] for name in ("x_m", "y_m", "z_m") if name in columns]
    heading = None
    if "heading_rad" in columns:
        check_headings(np.column_stack((axes[0], axes[1], columns["heading_rad"])), path, "the true path")
        heading = np.unwrap(columns["heading_rad"])
    return Truth(columns["time_s"], np.column_stack(axes), heading)


def _read_whole(path: Path, *required: str) -> Table:
    """A table that has these columns, and a finite number in each field that matters."""
    table = read_table(path)
    table.require(*required)
    for name in (*required, "z_m", "heading_rad"):
        missing = np.flatnonzero(~np.isfinite(table.columns.get(name, np.zeros(1))))
        if len(missing):
            raise LinkposeError(
                f"{path}, line {table.first_line + int(missing[0])}: {name} is no finite number; "
                "complete or delete the row"
            )
    return table


@dataclass(frozen=True, slots=True)
class PathScore:
    """Errors of an estimated path against the truth. The heading's is None where either path has no heading.

    `rows` of `possible` were compared; `within_2_sigma` is the share of the errors in x and y within two standard
    deviations.
    """

    position_rmse_m: float
    position_max_m: float
    heading_rmse_rad: float | None
    rows: int = 0
    possible: int = 0
    within_2_sigma: float | None = None


def score_track(track: Track, truth: Truth) -> PathScore:
    """Compares a track with the truth; rows before the pose is known are left out."""
    known = track.known
    heading = None if track.heading_rad is None else track.heading_rad[known]
    std = track.std[known][:, [track.names.index("x_m"), track.names.index("y_m")]]
    return score(track.time_s[known], track.position_m[known], heading, truth, std)


def score(
    time_s: Floats, position_m: Floats, heading_rad: Floats | None, truth: Truth, std_m: Floats | None = None
) -> PathScore:
    """Compares estimates at times (N,), positions (N, 2 or 3), headings (N,) and deviations of x and y (N, 2).

    Estimates between two true poses at most LONGEST_TRUTH_GAP_S apart are compared at their own times. Where the truth
    is sparser than that, the estimate is interpolated at the true poses' times instead. Raises LinkposeError when the
    times do not meet, or when less than half of the possible rows can be compared.
    """
    if not len(time_s):
        raise LinkposeError("the pose was never known, so there is nothing to compare with the truth")
    sparse = len(truth.time_s) > 1 and float(np.median(np.diff(truth.time_s))) > LONGEST_TRUTH_GAP_S
    at = truth.time_s if sparse else time_s
    inside = (at >= max(time_s[0], truth.time_s[0])) & (at <= min(time_s[-1], truth.time_s[-1]))
    rows = inside if sparse else truth.covers(time_s)
    if not rows.any():
        raise LinkposeError(
            f"the true path ({truth.time_s[0]:.6g} to {truth.time_s[-1]:.6g} s) has no pose at the log's times "
            f"({time_s[0]:.6g} to {time_s[-1]:.6g} s); give the truth of this log"
        )
    used, possible = int(rows.sum()), int(inside.sum())
    if 2 * used < possible:
        raise LinkposeError(
            f"only {used} of {possible} estimates lie between true poses at most {LONGEST_TRUTH_GAP_S:g} s apart, "
            "too few for a score; give a truth with fewer gaps"
        )
    axes = min(position_m.shape[1], truth.position_m.shape[1])
    there = np.column_stack([np.interp(at[rows], time_s, axis) for axis in position_m.T[:axes]])
    error = there - truth.position_at(at[rows])[:, :axes]
    distance2 = np.sum(error * error, axis=1)
    within = None
    if std_m is not None:
        spread = np.column_stack([np.interp(at[rows], time_s, axis) for axis in std_m.T])
        within = float(np.mean(np.abs(error[:, :2]) <= 2.0 * spread))
    heading = None
    if truth.heading_rad is not None and heading_rad is not None:
        off = np.interp(at[rows], time_s, np.unwrap(heading_rad)) - np.interp(at[rows], truth.time_s, truth.heading_rad)
        heading = math.sqrt(float(np.mean([wrap_angle(value) ** 2 for value in off])))
    worst = math.sqrt(float(np.max(distance2)))
    return PathScore(math.sqrt(float(np.mean(distance2))), worst, heading, used, possible, within)
