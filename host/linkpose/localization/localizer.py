"""Runs a log of asynchronous measurements through a filter: each at its own time."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.localization import models
from linkpose.localization.events import NAMED, Event, Log, Scan
from linkpose.localization.grid import GridMap, no_map
from linkpose.localization.kalman import (
    HOLONOMIC,
    SUBMERSIBLE,
    UNICYCLE,
    FilterName,
    KalmanFilter,
    Measurement,
    Motion,
    Transform,
    covariance_root,
)
from linkpose.localization.linalg import Floats
from linkpose.localization.noise import RangeNoise, check_correlation, equicorrelated
from linkpose.localization.tables import Beacons

Pose = tuple[float, float, float]
DIVING = {"velocity", "depth", "attitude"}  # kinds that only an underwater vehicle's log has
CONTROLS = {UNICYCLE.model: "odometry", HOLONOMIC.model: "twist", SUBMERSIBLE.model: "velocity"}  # the kind that drives
# When the gate has refused most of so many measurements of a kind, the pose is taken to be wrong, not the sensor.
PATIENCE = 10
WIDENING = 3.0  # of the pose's standard deviations, then
# What can be estimated -> the state's name and its standard deviation at the start.
CONSTANTS = {"scale": ("range_scale_error", 0.1), "bias": ("range_bias_m", 0.3)}


@dataclass(frozen=True, slots=True)
class Settings:
    """How good the sensors are (standard deviations) and how the filter treats them.

    `speed_std_m_s` and `turn_std_rad_s` are the errors of one odometry sample, `velocity_std_m_s` those of one velocity
    sample on each axis; each holds until the next sample. `start` is the pose at the log's start, with `start_std` (m,
    rad).
    """

    ranges: RangeNoise = field(default_factory=RangeNoise)
    bearing_std_rad: float = 0.05
    depth_std_m: float = 0.05
    attitude_std_rad: float = 0.01
    speed_std_m_s: float = 0.1
    turn_std_rad_s: float = 0.1
    motion_correlation: float = 0.0
    velocity_std_m_s: float = 0.1
    yaw_acceleration_std_rad_s2: float = 0.1
    gate: float | None = 0.997
    transform: Transform = field(default_factory=Transform)
    estimate: tuple[str, ...] = ()
    start: Pose | None = None
    start_std: tuple[float, float] = (0.5, 0.1)


@dataclass(frozen=True, slots=True)
class Track:
    """What a filter made of a log: a row for each instant with a measurement.

    `state` (N, n) in the order of `names`, `covariance` (N, n, n). `applied` and `rejected` count measurements: a
    range, a beam, a landmark, a depth, an attitude. `rejected_ranges` holds time and beacon of each range that the gate
    refused. `widened` counts how often the pose was opened again, since most was refused.
    """

    names: tuple[str, ...]
    time_s: Floats
    state: Floats
    covariance: Floats
    applied: int
    rejected: int
    rejected_ranges: frozenset[tuple[float, str]]
    widened: int

    @property
    def position_m(self) -> Floats:
        """(N, 2), or (N, 3) under water."""
        return self.state[:, : 3 if "z_m" in self.names else 2]

    @property
    def heading_rad(self) -> Floats:
        return self.state[:, self.names.index("heading_rad")]

    @property
    def std(self) -> Floats:
        """(N, n) standard deviations."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def localize(
    log: Log,
    name: FilterName,
    settings: Settings,
    grid: GridMap | None = None,
    beacons: Beacons | None = None,
    origin: str = "the log",
) -> Track:
    """Estimates the path of a robot from its log, which the messages call `origin`.

    Raises LinkposeError when map, beacons, start or noise do not fit the log, or a covariance ceases to be one.
    """
    _check(log, settings, grid, beacons or {}, origin)
    return _Run(log, name, settings, grid or no_map(), beacons or {}).track()


def warm_up(names: Iterable[FilterName]) -> None:
    """Compiles the filters, or loads them compiled."""
    at_one_place: Log = [Event(0.0, "pose", (0.0, 0.0, 0.0)), Event(0.1, "pose", (0.0, 0.0, 0.0))]
    for name in names:
        localize(at_one_place, name, Settings())


class _Run:
    """One pass of a log through a filter."""

    def __init__(self, log: Log, name: FilterName, settings: Settings, grid: GridMap, beacons: Beacons) -> None:
        self.log, self.settings, self.beacons = log, settings, beacons
        vehicle = _vehicle(_kinds(log))
        motion = vehicle.extended(tuple(CONSTANTS[word][0] for word in settings.estimate))
        self.prior = _first_pose(log) if settings.start is None else None
        state, std = _start(log, settings, motion, self.prior)
        self.filter = KalmanFilter(
            name,
            motion,
            state,
            np.diag(std**2),
            _noise_root(settings, vehicle),
            settings.gate,
            settings.transform,
            grid,
        )
        self.control = np.zeros(motion.controls)
        self.hold = np.ones(motion.noises)
        self.control_kind = CONTROLS[vehicle.model]
        self.holds = _holds([event.time_s for event in log if event.kind == self.control_kind])
        self.now = log[0].time_s
        self.last_range: dict[str, float] = {}
        self.lately_refused: dict[str, deque[bool]] = {}
        self.applied = self.rejected = self.widened = 0
        self.rejected_ranges: set[tuple[float, str]] = set()

    def track(self) -> Track:
        n = len(self.filter.state)
        rows = len({event.time_s for event in self.log})
        time, state, covariance = np.empty(rows), np.empty((rows, n)), np.empty((rows, n, n))
        row, i = -1, 0
        while i < len(self.log):
            j = i + 1
            while j < len(self.log) and _one_measurement(self.log[i], self.log[j]):
                j += 1
            if i == 0 or self.log[i].time_s > time[row]:
                row += 1
            self._take(self.log[i:j])
            time[row], state[row], covariance[row] = self.now, self.filter.state, self.filter.covariance
            i = j
        lost = np.flatnonzero(~np.isfinite(state).all(axis=1))
        if len(lost):
            raise LinkposeError(
                f"the estimate left all numbers at {time[lost[0]]:.6g} s of the log; "
                "correct the odometry or velocity before it"
            )
        return Track(
            self.filter.motion.states,
            time,
            state,
            covariance,
            self.applied,
            self.rejected,
            frozenset(self.rejected_ranges),
            self.widened,
        )

    def _take(self, events: Sequence[Event | Scan]) -> None:
        event = events[0]
        measurement = self._measurement(events)
        passed = self.filter.step(event.time_s - self.now, self.control, self.hold, measurement)
        self.now = event.time_s
        if measurement is not None:
            self._count(events, passed)
        if isinstance(event, Event):
            self._steer(event)

    def _steer(self, event: Event) -> None:
        """A control holds from its own time on."""
        if event.kind == self.control_kind:
            self.control[: len(event.values)] = event.values
            self.hold[: len(event.values)] = next(self.holds)
        elif event.kind == "attitude":
            self.control[3:5] = event.values[:2]

    def _measurement(self, events: Sequence[Event | Scan]) -> Measurement | None:
        event, settings = events[0], self.settings
        if isinstance(event, Scan):
            return self._beams(event)
        if event.kind == "range":
            return self._ranges([event for event in events if isinstance(event, Event)])
        if event.kind == "bearing_range":
            distance = np.array(event.values[:1])
            variance = settings.ranges.variances(distance, self._mean_range(event))[0]
            place = np.array([self.beacons[event.beacon][:2]])
            covariance = np.diag([variance, settings.bearing_std_rad**2])
            return Measurement(models.LANDMARK, np.array(event.values), covariance, place, 2, (False, True))
        if event.kind == "depth":
            return _direct(event.values, (settings.depth_std_m,), ((2, -1.0),), (False,))
        if event.kind == "attitude":
            return _direct(event.values[2:], (settings.attitude_std_rad,), ((3, 1.0),), (True,))
        if event.kind == "pose" and event is not self.prior:
            heading = self.filter.motion.states.index("heading_rad")
            far, turned = settings.start_std
            return _direct(event.values, (far, far, turned), ((0, 1.0), (1, 1.0), (heading, 1.0)), (False, False, True))
        return None

    def _beams(self, scan: Scan) -> Measurement | None:
        echo = np.isfinite(scan.ranges_m)
        ranges = scan.ranges_m[echo]
        if not len(ranges):
            return None
        table = np.empty((len(ranges), 5))
        table[:, 0], table[:, 1:4], table[:, 4] = scan.angles_rad[echo], scan.mount, scan.max_range_m
        return Measurement(models.BEAMS, ranges, self.settings.ranges.covariance(ranges, float(ranges.mean())), table)

    def _ranges(self, events: list[Event]) -> Measurement:
        states = self.filter.motion.states
        columns = [
            states.index(name) if name in states else -1 for name in ("z_m", "range_scale_error", "range_bias_m")
        ]
        table = np.array([[*self.beacons[event.beacon], *columns] for event in events], dtype=np.float64)
        ranges = np.array([event.values[0] for event in events])
        means = [self._mean_range(event) for event in events]
        return Measurement(models.BEACON_RANGE, ranges, self.settings.ranges.covariance(ranges, means[-1]), table)

    def _mean_range(self, event: Event) -> float:
        """r̄ of (14) for sensors that do not measure at one instant: the mean of each beacon's last range."""
        self.last_range[event.beacon] = event.values[0]
        return sum(self.last_range.values()) / len(self.last_range)

    def _count(self, events: Sequence[Event | Scan], passed: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> None:
        kind, good = events[0].kind, int(passed.sum())
        self.applied += good
        self.rejected += len(passed) - good
        if kind == "range":
            refused = [event for event, fits in zip(events, passed, strict=True) if not fits]
            self.rejected_ranges.update((event.time_s, event.beacon) for event in refused if isinstance(event, Event))
        lately = self.lately_refused.setdefault(kind, deque(maxlen=PATIENCE))
        lately.append(2 * good <= len(passed))
        if len(lately) == PATIENCE and 2 * sum(lately) > PATIENCE:
            self.filter.widen(WIDENING)
            self.widened += 1
            lately.clear()


def _kinds(log: Log) -> set[str]:
    return {event.kind for event in log}


def _vehicle(kinds: set[str]) -> Motion:
    """The motion model that a log's kinds of measurement call for."""
    return SUBMERSIBLE if kinds & DIVING else HOLONOMIC if "twist" in kinds else UNICYCLE


def _one_measurement(first: Event | Scan, other: Event | Scan) -> bool:
    """Ranges of one instant belong together: their errors may correlate."""
    return first.kind == other.kind == "range" and other.time_s == first.time_s


def _direct(
    values: tuple[float, ...], std: tuple[float, ...], table: tuple[tuple[int, float], ...], angles: tuple[bool, ...]
) -> Measurement:
    return Measurement(models.DIRECT, np.array(values), np.diag(np.square(std)), np.array(table), len(values), angles)


def _holds(times: list[float]) -> Iterator[float]:
    """How long each control sample holds: until the next; the last as long as the one before."""
    steps = np.diff(times)
    steps = steps[steps > 0]
    usual = float(np.median(steps)) if len(steps) else 1.0
    for before, after in itertools.pairwise(times):
        yield after - before if after > before else usual
    yield usual


def _check(log: Log, settings: Settings, grid: GridMap | None, beacons: Beacons, origin: str) -> None:
    kinds = _kinds(log)
    if not log:
        raise LinkposeError(f"{origin} holds no measurements; record some first")
    if "scan" in kinds and grid is None:
        raise LinkposeError(f"{origin} holds laser scans, which need the map they were taken in; add --map MAP.yaml")
    if kinds & set(NAMED) and not beacons:
        raise LinkposeError(f"{origin} holds ranges to beacons, whose places must be known; add --beacons BEACONS.csv")
    if kinds & {"odometry", "twist"} and kinds & DIVING:
        raise LinkposeError(
            f"{origin} mixes a robot's odometry with a vehicle's {' and '.join(sorted(kinds & DIVING))}; "
            "delete the rows of the one or of the other"
        )
    if settings.estimate and "range" not in kinds:
        raise LinkposeError(f"{origin} holds no range rows from which a scale or bias follows; leave out --estimate")
    for event in log:
        if isinstance(event, Event) and event.kind in NAMED and event.beacon not in beacons:
            raise LinkposeError(
                f"{origin} line {event.line}: {event.kind} to beacon {event.beacon}, whose place is not known "
                f"(known are {', '.join(beacons)}); add it to the beacon file or delete the row"
            )
    check_correlation(settings.ranges.correlation, most_at_once(log), "the correlation of the ranges")
    check_correlation(
        settings.motion_correlation, 2 if _vehicle(kinds) is UNICYCLE else 3, "the correlation of the motion's noises"
    )


def most_at_once(log: Log) -> int:
    """The most ranges that one measurement has."""
    beams = max((len(event.ranges_m) for event in log if isinstance(event, Scan)), default=1)
    counts: dict[float, int] = {}
    for event in log:
        if event.kind == "range":
            counts[event.time_s] = counts.get(event.time_s, 0) + 1
    return max(beams, *counts.values()) if counts else beams


def _first_pose(log: Log) -> Event | None:
    """The pose that the log gives for its own first instant."""
    first = (event for event in log if isinstance(event, Event) and event.time_s == log[0].time_s)
    return next((event for event in first if event.kind == "pose"), None)


def _start(log: Log, settings: Settings, motion: Motion, prior_event: Event | None) -> tuple[Floats, Floats]:
    """State and standard deviations at the log's start."""
    pose = settings.start if prior_event is None else prior_event.values
    if pose is None:
        raise LinkposeError("the log does not say where the robot starts; add --start X,Y,HEADING (m, m, rad)")
    state, std = np.zeros(len(motion.states)), np.zeros(len(motion.states))
    far, turned = settings.start_std
    prior = {"x_m": (pose[0], far), "y_m": (pose[1], far), "heading_rad": (pose[2], turned)}
    depth = next((event.values[0] for event in log if isinstance(event, Event) and event.kind == "depth"), 0.0)
    prior |= {"z_m": (-depth, max(far, settings.depth_std_m)), "wz_rad_s": (0.0, 0.5)}
    prior |= {name: (0.0, spread) for name, spread in CONSTANTS.values()}
    for i, name in enumerate(motion.states):
        state[i], std[i] = prior[name]
    return state, std


def _noise_root(settings: Settings, vehicle: Motion) -> Floats:
    """The lower Cholesky factor of Q, (16): off-diagonal between the errors of speed and turn rate, or of a velocity's
    axes.
    """
    speed, turn, velocity = settings.speed_std_m_s, settings.turn_std_rad_s, settings.velocity_std_m_s
    std = {UNICYCLE: (speed, turn), HOLONOMIC: (speed, speed, turn), SUBMERSIBLE: (velocity, velocity, velocity)}[
        vehicle
    ]
    q = np.zeros((vehicle.noises, vehicle.noises))
    q[: len(std), : len(std)] = equicorrelated(np.array(std), settings.motion_correlation)
    if vehicle is SUBMERSIBLE:
        q[3, 3] = settings.yaw_acceleration_std_rad_s2**2
    return covariance_root(q, "Q, the covariance of the motion's noises,")
