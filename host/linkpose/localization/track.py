"""The result of a localization: the estimated path, and how well the measurements fitted it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import NothingApplied, UndecidedStart
from linkpose.localization.consistency import Consistency
from linkpose.localization.linalg import Floats
from linkpose.localization.self_calibration import RobotErrors

# The best of several poses that fit alike must explain such a share of the beams; else the map is another one. With the
# map or the laser mirrored, the share is 0.03 to 0.25.
LEAST_SHARE = 0.5


class Rivals(NamedTuple):
    """Poses (x m, y m, heading rad) at `time_s` that explain the scans since alike, best first.

    `share` of the beams of the latest scan hit a wall from the best one. `is_still`: the robot moved too little for a
    decision.
    """

    time_s: float
    poses: list[tuple[float, float, float]]
    share: float
    is_still: bool


@dataclass(frozen=True, slots=True)
class Track:
    """A row for each instant with a measurement.

    `state` (N, n) in the order of `names`, `covariance` (N, n, n); NaN while the pose is not known yet. `applied` and
    `rejected` count measurements: a range, a beam, a landmark, a depth, an attitude. `rejected_sightings` holds time
    and beacon of each range and each landmark outside the gate. `widened` counts how often the standard deviations of
    the pose were raised because most measurements were rejected, `relocated` how often the pose was found again.
    `consistency` holds the normalised innovations squared by sensor, `rivals` what was left of a search of the map that
    never decided. `range_scale` is the factor by which the laser's ranges were corrected; `robot_errors` is what the
    motion shows of the laser's mount and of the odometry's scales.
    """

    names: tuple[str, ...]
    time_s: Floats
    state: Floats
    covariance: Floats
    applied: int
    rejected: int
    rejected_sightings: frozenset[tuple[float, str]]
    widened: int
    relocated: int = 0
    consistency: Consistency = field(default_factory=Consistency)
    rivals: Rivals | None = None
    range_scale: float = 1.0
    robot_errors: RobotErrors | None = None

    def check_applied(self, origin: str, name: str, remark: str = "") -> None:
        """Raises NothingApplied where the filter applied no measurement, so that its path is dead reckoning.

        `remark` states what is wrong with the map. Raises UndecidedStart where several places of the map fit alike.
        """
        if self.applied:
            return
        if self.rivals is not None and self.rivals.share >= LEAST_SHARE:
            raise UndecidedStart(origin, self.rivals.time_s, self.rivals.poses, self.rivals.is_still)
        raise NothingApplied(origin, name, self.rejected, remark)

    @property
    def position_m(self) -> Floats:
        """(N, 2), or (N, 3) where the height is a state."""
        return self.state[:, [self.names.index(name) for name in ("x_m", "y_m", "z_m") if name in self.names]]

    @property
    def heading_rad(self) -> Floats | None:
        """(N,), or None for a model without a heading."""
        return self.state[:, self.names.index("heading_rad")] if "heading_rad" in self.names else None

    @property
    def rejected_xy_m(self) -> Floats:
        """(M, 2) the estimated places at the times of rejected ranges and landmarks, where the pose is known."""
        times = np.array(sorted({time for time, _ in self.rejected_sightings}))
        places = self.position_m[np.searchsorted(self.time_s, times), :2] if len(times) else np.empty((0, 2))
        return places[np.isfinite(places).all(axis=1)]

    @property
    def known(self) -> NDArray[np.bool_]:
        """(N,) where the pose is known."""
        return np.asarray(np.isfinite(self.state).all(axis=1))

    @property
    def std(self) -> Floats:
        """(N, n) standard deviations."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
