"""Turns the events of a log into measurements of a Kalman filter: values, covariance, and the model's table."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from linkpose.localization import models
from linkpose.localization.carmen import BEAM_ANGLES_RAD
from linkpose.localization.events import Event, Scan
from linkpose.localization.kalman import SUBMERSIBLE, Measurement, MotionModel
from linkpose.localization.linalg import Floats
from linkpose.localization.settings import CONSTANTS, DRIFT, ERROR_TIME_S, Settings
from linkpose.localization.tables import Beacons
from linkpose.localization.vehicle import vehicle_of

# With fewer beacons a bias looks like a shift of position. On three public recordings of radio ranges (tests/bench),
# both constants take the error from 4.7, 0.14 and 0.17 m to 0.44, 0.05 and 0.09 m.
BEACONS_FOR_CONSTANTS = 3
# A sighting that repeats the error of the one before counts as 1/MOST_REPEATS of an independent one at the least.
MOST_REPEATS = 500.0


_SHARED_DRIFT = f"{DRIFT}_m"


def default_constants(kinds: set[str], beacons: int) -> tuple[str, ...]:
    """The constants of ranges to estimate where the user names none, for a log with these kinds of measurement and
    ranges to that many beacons. Acoustic ranges under water have no common bias.
    """
    if beacons < BEACONS_FOR_CONSTANTS or vehicle_of(kinds) is SUBMERSIBLE:
        return ()
    return ("scale", "bias")


def constant_states(estimate: Sequence[str], beacons: Sequence[str]) -> tuple[str, ...]:
    """Names of the states that `--estimate` adds: one for all beacons, or one for each."""
    names: list[str] = []
    for word in estimate:
        quantity, _, each = word.partition(":")
        stem, unit, _ = CONSTANTS[quantity]
        names += [f"{stem}_{_safe(beacon)}{unit}" for beacon in beacons] if each else [f"{stem}{unit}"]
    return tuple(names)


def drift_states(settings: Settings, beacons: Sequence[str]) -> tuple[str, ...]:
    """Names of the states that hold the drifting errors of the ranges: one of each beacon, one of all, or none."""
    if settings.drift_std_m == 0.0:
        return ()
    return (_SHARED_DRIFT,) if settings.drift_is_shared else tuple(map(_drift_state, beacons))


def _drift_state(beacon: str) -> str:
    return f"{DRIFT}_{_safe(beacon)}_m"


def _safe(beacon: str) -> str:
    """A beacon's name as a part of a column's name."""
    return re.sub(r"\W", "_", beacon)


class MeasurementBuilder:
    """Builds measurements for one motion model, with the constants that are estimated."""

    def __init__(
        self, settings: Settings, motion: MotionModel, beacons: Beacons, before: MeasurementBuilder | None = None
    ) -> None:
        """`before` built the measurements so far, for a model with fewer states."""
        self.settings, self.beacons = settings, beacons
        self.states = motion.states
        self.height = self.states.index("z_m") if "z_m" in self.states else -1
        self.last_range: dict[str, float] = before.last_range if before else {}
        self.last_sighting_s: dict[str, float] = before.last_sighting_s if before else {}
        self.last_independent_s: dict[str, float] = before.last_independent_s if before else {}
        self._columns = {
            beacon: [self._constant("scale", beacon), self._constant("bias", beacon)] for beacon in beacons
        }

        shared = self._index(_SHARED_DRIFT)
        self._drifts = {name: self._index(_drift_state(name)) if shared < 0 else shared for name in beacons}

    def _index(self, state: str) -> int:
        """Index of a state, or −1."""
        return self.states.index(state) if state in self.states else -1

    def _constant(self, quantity: str, beacon: str) -> int:
        """Index of the state with this beacon's constant, or −1."""
        stem, unit, _ = CONSTANTS[quantity]
        for name in (f"{stem}_{_safe(beacon)}{unit}", f"{stem}{unit}"):
            if name in self.states:
                return self.states.index(name)
        return -1

    def constants(self, beacon: str, state: Floats) -> tuple[float, float]:
        """Scale error, and bias with drift (m), of a beacon's range in this state; 0 where they are not estimated."""
        scale, bias = self._columns[beacon]
        drift = self._drifts[beacon]
        offset = (float(state[bias]) if bias >= 0 else 0.0) + (float(state[drift]) if drift >= 0 else 0.0)
        return float(state[scale]) if scale >= 0 else 0.0, offset

    def range_std(self, range_m: float) -> float:
        """Standard deviation (m) of one range."""
        return float(np.sqrt(self.settings.ranges.variances(np.array([range_m]), range_m)[0]))

    def measurement(self, events: Sequence[Event | Scan]) -> Measurement | None:
        """The measurement of events of one kind and instant; None for what is no measurement."""
        event, settings = events[0], self.settings
        if isinstance(event, Scan):
            return self._beams(event)
        if event.kind == "range":
            return self._ranges([event for event in events if isinstance(event, Event)])
        if event.kind == "bearing_range":
            distance = np.array(event.values[:1])
            variance = settings.ranges.variances(distance, self._mean_range(event))[0]
            table = np.array([[*self.beacons[event.beacon][:2], *self._columns[event.beacon]]])
            covariance = np.diag([variance, settings.bearing_std_rad**2]) * self.repetition(event)
            return Measurement(models.LANDMARK, np.array(event.values), covariance, table, 2, (False, True))
        if event.kind == "depth":
            return _direct(event.values, (settings.depth_std_m,), ((2, -1.0),), (False,))
        if event.kind == "attitude":
            return _direct(event.values[2:], (settings.attitude_std_rad,), ((3, 1.0),), (True,))
        if event.kind == "pose":
            return self._pose(event)
        return None

    def _error_time_s(self, kind: str) -> float:
        given = self.settings.error_time_s
        return ERROR_TIME_S[kind] if given is None else given

    def repetition(self, event: Event, last_s: float | None = None) -> float:
        """Factor on the covariance of a sighting that repeats the error of the one at `last_s` of the same beacon, by
        default the last one noted: n sightings within the time that an error persists carry the information of one.
        """
        before = self.last_sighting_s.get(event.beacon, -np.inf) if last_s is None else last_s
        return min(max(1.0, self._error_time_s(event.kind) / max(event.time_s - before, 1e-3)), MOST_REPEATS)

    def is_independent(self, event: Event | Scan) -> bool:
        """Whether a sighting is so long after the last independent one of its beacon that its error is another."""
        if not isinstance(event, Event) or not event.beacon:
            return True
        apart = event.time_s - self.last_independent_s.get(event.beacon, -np.inf)
        if apart < self._error_time_s(event.kind):
            return False
        self.last_independent_s[event.beacon] = event.time_s
        return True

    def note(self, event: Event) -> None:
        """Stores a sighting, which the next one of the same beacon may repeat."""
        self.last_sighting_s[event.beacon] = event.time_s

    def _pose(self, event: Event) -> Measurement:
        far, turned = self.settings.start_std
        if "heading_rad" not in self.states:
            return _direct(event.values[:2], (far, far), ((0, 1.0), (1, 1.0)), (False, False))
        heading = self.states.index("heading_rad")
        return _direct(event.values, (far, far, turned), ((0, 1.0), (1, 1.0), (heading, 1.0)), (False, False, True))

    def _beams(self, scan: Scan) -> Measurement | None:
        """The thesis's 19 beams of a scan."""
        chosen = thesis_beams(scan)
        ranges = scan.ranges_m[chosen]
        chosen, ranges = chosen[np.isfinite(ranges)], ranges[np.isfinite(ranges)]
        if not len(ranges):
            return None
        table = np.empty((len(ranges), 5))
        table[:, 0], table[:, 1:4], table[:, 4] = scan.angles_rad[chosen], scan.mount, scan.max_range_m
        return Measurement(models.BEAMS, ranges, self.settings.ranges.covariance(ranges, float(ranges.mean())), table)

    def _ranges(self, events: list[Event]) -> Measurement:
        rows = [
            [*self.beacons[name], self.height, *self._columns[name], self._drifts[name]]
            for name in (event.beacon for event in events)
        ]
        table = np.array(rows, dtype=np.float64)
        ranges = np.array([event.values[0] for event in events])
        means = [self._mean_range(event) for event in events]
        covariance = self.settings.ranges.covariance(ranges, means[-1])
        repeats = np.sqrt([self.repetition(event) for event in events])
        return Measurement(models.BEACON_RANGE, ranges, covariance * np.outer(repeats, repeats), table)

    def _mean_range(self, event: Event) -> float:
        """r̄ of (14) for sensors that do not measure at one instant: the mean of each beacon's last range."""
        self.last_range[event.beacon] = event.values[0]
        return sum(self.last_range.values()) / len(self.last_range)


def thesis_beams(scan: Scan) -> NDArray[np.intp]:
    """Indices of the readings nearest to the 19 beams of the thesis that lie within the scanner's field of view."""
    angles = scan.angles_rad
    if not len(angles):
        return np.empty(0, np.intp)
    step = abs(float(angles[1] - angles[0])) if len(angles) > 1 else 0.0
    inside = (angles.min() - 1.5 * step < BEAM_ANGLES_RAD) & (angles.max() + 1.5 * step > BEAM_ANGLES_RAD)
    return np.array(sorted({int(np.argmin(np.abs(angles - angle))) for angle in BEAM_ANGLES_RAD[inside]}), np.intp)


def _direct(
    values: tuple[float, ...], std: tuple[float, ...], table: tuple[tuple[int, float], ...], angles: tuple[bool, ...]
) -> Measurement:
    return Measurement(models.DIRECT, np.array(values), np.diag(np.square(std)), np.array(table), len(values), angles)
