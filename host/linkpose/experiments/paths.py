"""Estimated paths beside the true ones, for the figures of chapter 3 of [Thesis]."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from linkpose.localization.tables import Truth
from linkpose.localization.track import Track
from linkpose.rotations import wrapped
from linkpose.sensors.measurements import Floats


@dataclass(frozen=True, slots=True)
class ComparedPath:
    """An estimated path and its errors at the N instants of the estimate; x, y and with a depth z, D = 2 or 3."""

    filter: str
    label: str
    time_s: Floats  # (N,)
    way_m: Floats  # (N,) along the true path
    position_m: Floats  # (N, D)
    truth_m: Floats  # (N, D)
    error_m: Floats  # (N,) distance to the truth
    std_m: Floats  # (N,) root of the summed variances of the position
    heading_error_rad: Floats  # (N,)
    heading_std_rad: Floats  # (N,)
    rejected_s: Floats  # (M,) instants of rejected ranges

    @property
    def rms_m(self) -> float:
        """Root mean square of the position error."""
        return float(np.sqrt(np.mean(self.error_m**2)))


@dataclass(frozen=True, slots=True)
class WaySection:
    """A part of the way, from one distance along it to another (m)."""

    start_m: float
    end_m: float


def path_of(name: str, label: str, track: Track, truth: Truth, heading_rad: Floats) -> ComparedPath:
    """A track of a filter beside its truth, whose headings (N,) are unwrapped. Instants before the pose is known are
    left out.
    """
    known = track.known
    time, position = track.time_s[known], track.position_m[known]
    actual = truth.position_at(time)[:, : position.shape[1]]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(actual[:, :2], axis=0), axis=1))])
    axes = [track.names.index(axis) for axis in ("x_m", "y_m", "z_m") if axis in track.names]
    std = track.std[known]
    heading = track.names.index("heading_rad")
    turned = track.state[known][:, heading] - np.interp(time, truth.time_s, heading_rad)
    return ComparedPath(
        name,
        label,
        time,
        way,
        position,
        actual,
        np.linalg.norm(position - actual, axis=1),
        np.sqrt(np.sum(std[:, axes] ** 2, axis=1)),
        wrapped(turned),
        std[:, heading],
        np.array(sorted(time_s for time_s, _ in track.rejected_sightings)),
    )


def worst_sections(path: ComparedPath, count: int, length_m: float) -> list[WaySection]:
    """The stretches of `length_m` around the largest errors that do not overlap, in the order of the way."""
    left, found = path.error_m.copy(), []
    for _ in range(count):
        worst = int(np.argmax(left))
        if left[worst] == -math.inf:
            break
        middle = float(path.way_m[worst])
        found.append(WaySection(max(middle - length_m / 2, 0.0), min(middle + length_m / 2, float(path.way_m[-1]))))
        left[np.abs(path.way_m - middle) < length_m] = -math.inf
    return sorted(found, key=lambda section: section.start_m)


def rms_within(path: ComparedPath, section: WaySection) -> float:
    """Root mean square of the position error (m) within a section."""
    inside = (path.way_m >= section.start_m) & (path.way_m <= section.end_m)
    return float(np.sqrt(np.mean(path.error_m[inside] ** 2)))


def large(paths: Sequence[ComparedPath]) -> tuple[float, float]:
    """The error of position (m) and of heading (rad) that 99 % of the errors on each path do not exceed."""
    return (
        max(float(np.quantile(path.error_m, 0.99)) for path in paths),
        max(float(np.quantile(np.abs(path.heading_error_rad), 0.99)) for path in paths),
    )
