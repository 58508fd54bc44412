"""The result of a localization: the estimated path, and how well the measurements fitted it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import NothingApplied
from linkpose.localization.consistency import Consistency
from linkpose.localization.linalg import Floats


@dataclass(frozen=True, slots=True)
class Track:
    """A row for each instant with a measurement.

    `state` (N, n) in the order of `names`, `covariance` (N, n, n); NaN while the pose is not known yet. `applied` and
    `rejected` count measurements: a range, a beam, a landmark, a depth, an attitude. `rejected_sightings` holds time
    and beacon of each range and each landmark outside the gate. `widened` counts how often the standard deviations of
    the pose were raised because most measurements were rejected, `relocated` how often the pose was found again.
    `consistency` holds the normalised innovations squared by sensor.
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

    def check_applied(self, origin: str, name: str) -> None:
        """Raises NothingApplied where the filter applied no measurement, so that its path is dead reckoning."""
        if self.applied == 0:
            raise NothingApplied(origin, name, self.rejected)

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
