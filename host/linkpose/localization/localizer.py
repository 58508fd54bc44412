"""Runs a log of asynchronous measurements through a filter: each at its own time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import (
    AmbiguousStart,
    LinkposeError,
    MissingBeacons,
    MissingMap,
    MissingStart,
    NeedsScans,
    NothingToEstimate,
)
from linkpose.localization.consistency import Consistency
from linkpose.localization.events import NAMED, Event, Log, Scan
from linkpose.localization.grid import FREE, OCCUPIED, GridMap, no_map
from linkpose.localization.kalman import CONSTANT_VELOCITY, SUBMERSIBLE_IN_CURRENT, UNICYCLE, FilterName, KalmanFilter
from linkpose.localization.linalg import Floats
from linkpose.localization.measuring import MeasurementBuilder, constant_states, drift_states, thesis_beams
from linkpose.localization.noise import check_correlation
from linkpose.localization.relocation import Relocator
from linkpose.localization.settings import DRIFT, Pose, Settings
from linkpose.localization.smoother import FilterPass
from linkpose.localization.sum_filter import GaussianSumFilter, outlier_density
from linkpose.localization.tables import Beacons
from linkpose.localization.track import Track
from linkpose.localization.vehicle import (
    CONTROLS,
    DIVING,
    area_of,
    at_their_height,
    control_holds,
    drifts_of,
    first_control,
    first_place,
    first_pose,
    kinds_of,
    noise_root,
    places_from_ranges,
    start_state,
    vehicle_of,
)

if TYPE_CHECKING:
    from linkpose.localization.scan_tracking import ScanTracker

Method = Literal["scan-match", "ekf", "ukf", "mcl"]
# When most of this many measurements of a kind were rejected, the pose is assumed to be wrong, not the sensor.
PATIENCE = 10
WIDENING = 3.0  # factor on the pose's standard deviations then

# Standard deviation (rad/s) of a vehicle's turn rate at one instant around the mean rate that attitudes show: waves and
# thrusters turn it unevenly. Value of the simulated commands of Table 2.2. Doubling it doubles the stated σ of wz.
UNEVEN_TURN_RAD_S = 0.01

# An unscented filter predicts longer intervals (s) by linearisation: the headings of its sigma points spread around the
# circle then, and have no mean. Sensors of the thesis measure at least every 0.2 s.
LONGEST_UKF_S = 0.5


class Row(NamedTuple):
    """The estimate after the measurements of one instant: state (n,) and covariance (n, n), NaN while not known."""

    time_s: float
    state: Floats
    covariance: Floats


def estimate_track(
    log: Log,
    name: Method,
    settings: Settings,
    grid: GridMap | None = None,
    beacons: Beacons | None = None,
    origin: str = "the log",
) -> Track:
    """Estimates the path of a robot from its log, which the messages call `origin`.

    Raises LinkposeError when map, beacons, start or noise do not fit the log, or a covariance is no longer one.
    """
    check(log, name, settings, grid, beacons or {}, origin)
    if name == "mcl":
        from linkpose.localization.mcl import localize_mcl

        return localize_mcl(log, settings, grid or no_map())
    run = Localizer(log, name, settings, grid, beacons or {})
    holds = control_holds(log, run.control_kind)
    rows: list[Row] = []
    instants: list[float] = []
    for first, last in batches(log):
        row = run.feed(log[first:last], holds.get(first))
        instants.append(row.time_s)
        if rows and row.time_s == rows[-1].time_s:
            rows[-1] = row
        else:
            rows.append(row)
    if run.history is not None:
        smoothed = run.history.smooth(run.filter.motion.is_angle)
        last_of = {time: i for i, time in enumerate(instants)}  # the smoothed state after the last event of an instant
        rows = [run.finished(row.time_s, *smoothed[last_of[row.time_s]]) for row in rows]
    return run.track(rows)


def batches(log: Log) -> Iterator[tuple[int, int]]:
    """The first and last + 1 index of each set of events that are one measurement: ranges of one instant."""
    i = 0
    while i < len(log):
        j = i + 1
        while j < len(log) and log[i].kind == log[j].kind == "range" and log[j].time_s == log[i].time_s:
            j += 1
        yield i, j
        i = j


def warm_up(names: Iterable[Method]) -> None:
    """Compiles the filters, or loads them compiled."""
    at_one_place: Log = [Event(0.0, "pose", (0.0, 0.0, 0.0)), Event(0.1, "pose", (0.0, 0.0, 0.0))]
    angles = np.linspace(-np.pi, np.pi, 37)
    in_a_round_room: Log = [*at_one_place, Scan(0.2, np.ones(37), angles, (0.0, 0.0, 0.0), 5.0)]
    for name in names:
        if name in ("mcl", "scan-match"):
            estimate_track(in_a_round_room, name, Settings(), _round_room())
        else:
            estimate_track(at_one_place, name, Settings())
        if name == "scan-match":  # without a start, it searches the map
            estimate_track(in_a_round_room[2:], name, Settings(), _round_room())


def _round_room() -> GridMap:
    """A map of 4 m by 4 m, free within 1 m of its middle, the origin."""
    cell_m, cells = 0.1, 40
    middle_m = (np.arange(cells) + 0.5) * cell_m - 2.0
    blocked = np.hypot(middle_m[:, None], middle_m) > 1.0
    return GridMap(np.where(blocked, OCCUPIED, FREE).astype(np.uint8), np.array([cell_m, -2.0, -2.0, 0.0]))


class Localizer:
    """One pass of a log through a filter, measurement by measurement.

    `head` is the log or its beginning, from which the motion model and the start follow.
    """

    def __init__(self, head: Log, name: Method, settings: Settings, grid: GridMap | None, beacons: Beacons) -> None:
        self.settings = settings
        kinds = kinds_of(head)
        self.vehicle = vehicle_of(kinds)
        if self.vehicle is CONSTANT_VELOCITY:
            beacons = at_their_height(beacons)
        self.control_kind = CONTROLS.get(self.vehicle.model, "")
        names = list(beacons)
        constants = constant_states(settings.estimate, names)
        vehicle = SUBMERSIBLE_IN_CURRENT if settings.current_std_m_s else self.vehicle
        motion = vehicle.extended((*constants, *drift_states(settings, names)))
        self.prior = first_pose(head) if settings.start is None else None
        start = settings.start if self.prior is None else _pose_of(self.prior)
        spread_m = 0.0
        if start is None and self.vehicle is CONSTANT_VELOCITY:
            start, spread_m = first_place(head, beacons)
        depth = next((event.values[0] for event in head if isinstance(event, Event) and event.kind == "depth"), 0.0)
        state, std = start_state(start or (0.0, 0.0, 0.0), depth, settings, motion)
        std[:2] = np.hypot(std[:2], spread_m)
        kalman: FilterName = "ukf" if name == "ukf" else "ekf"
        arguments = (
            kalman,
            motion,
            state,
            np.diag(std**2),
            noise_root(settings, self.vehicle),
            settings.gate,
            settings.transform,
            grid or no_map(),
            drifts_of(settings, motion),
        )
        if self.vehicle is CONSTANT_VELOCITY:
            self.filter: KalmanFilter = GaussianSumFilter(*arguments, outlier_density(beacons))
        else:
            self.filter = KalmanFilter(*arguments)
        # Of a row: all but the drifts of the ranges, which come last.
        self.states = tuple(name for name in motion.states if not name.startswith(DRIFT))
        self.sensors = MeasurementBuilder(settings, motion, beacons)
        self.control, self.hold = first_control(settings, self.vehicle), np.ones(motion.noises)
        self.now = head[0].time_s
        self.last_control_s: float | None = None
        self.lately_rejected: dict[str, deque[bool]] = {}
        self.applied = self.rejected = self.widened = self.relocated = 0
        self.rejected_sightings: set[tuple[float, str]] = set()
        self.consistency = Consistency()
        self.relocator = Relocator(motion, self.sensors) if beacons else None
        self.is_replaced = False  # by the last measurement
        self.rivalry: Floats | None = None  # what a better pose adds to the covariance until it replaces this one
        self.known = start is not None
        self.history = FilterPass() if settings.smooth else None
        self.laser: ScanTracker | None = None
        if name == "scan-match" and "scan" in kinds and grid is not None:
            from linkpose.localization.scan_tracking import ScanTracker

            self.laser = ScanTracker(grid, settings.beam_growth)

    def feed(self, events: Sequence[Event | Scan], hold_s: float | None = None) -> Row:
        """Moves on to the events' time and applies them; all are one measurement. `hold_s` is how long a control holds,
        by default as long as the one before.
        """
        event = events[0]
        interval = event.time_s - self.now
        measurement = None
        if event is not self.prior and not (isinstance(event, Scan) and self.laser):
            measurement = self.sensors.measurement(events)
        if self.laser:
            self.laser.predict(self.filter, interval, self.control, self.hold)
        if self.relocator:
            self.relocator.move(self.filter, interval, self.control)
        self.is_replaced = False
        if self.history is not None:
            self.history.predict(self.filter, interval, self.control, self.hold)
            interval = 0.0
        if self.filter.name == "ukf" and interval > LONGEST_UKF_S and self.laser is None:
            self.filter.predict_linearised(interval, self.control, self.hold)
            interval = 0.0
        passed = self.filter.step(interval, self.control, self.hold, measurement if self.known else None)
        self.now = event.time_s
        if isinstance(event, Scan) and self.laser:
            self._match(self.laser, event)
        elif measurement is not None and self.known:
            self._count(events, passed)
            self._relocate(events)
        for one in events:
            if isinstance(one, Event) and one.kind in NAMED:
                self.sensors.note(one)
            elif isinstance(one, Event):
                self.steer(one, hold_s)
        if self.history is not None:
            self.history.correct(self.filter, self.known, self.is_replaced)
        return self._row()

    def use(self, settings: Settings) -> None:
        """Continues with other noises. Adds states for errors of the ranges that drift where there were none yet."""
        has_drifts = bool(self.settings.drift_std_m)
        if has_drifts:  # their states are in the filter
            settings = replace(settings, drift_is_shared=self.settings.drift_is_shared)
        self.settings = self.sensors.settings = settings
        self.filter.noise_root = noise_root(settings, self.vehicle)
        if self.vehicle is CONSTANT_VELOCITY:
            self.control = first_control(settings, self.vehicle)
        if settings.drift_std_m and not has_drifts:
            self._add_drifts()
        self.filter.drifts = drifts_of(settings, self.filter.motion)

    def _add_drifts(self) -> None:
        """Adds the states of the ranges' drifting errors.

        The pose so far assumed no drift, so its variance grows by that of the drift.
        """
        before, beacons = self.filter, self.sensors.beacons
        motion = before.motion.extended(drift_states(self.settings, list(beacons)))
        n, size = len(before.state), len(motion.states)
        covariance = np.eye(size) * self.settings.drift_std_m**2
        covariance[:n, :n] = before.covariance
        covariance[[0, 1], [0, 1]] += self.settings.drift_std_m**2
        state = np.concatenate((before.state, np.zeros(size - n)))
        self.filter = replace(before, motion=motion, state=state, covariance=covariance)
        self.sensors = MeasurementBuilder(self.settings, motion, beacons, self.sensors)
        self.relocator = Relocator(motion, self.sensors)

    def track(self, rows: Sequence[Row]) -> Track:
        """The path of all rows, with the counts so far. Raises LinkposeError for an estimate that is infinite."""
        state = np.array([row.state for row in rows])
        time = np.array([row.time_s for row in rows])
        lost = np.flatnonzero(np.isinf(state).any(axis=1))
        if len(lost):
            raise LinkposeError(
                f"the estimate left all numbers at {time[lost[0]]:.6g} s of the log; "
                "correct the odometry or velocity before it"
            )
        return Track(
            self.states,
            time,
            state,
            np.array([row.covariance for row in rows]),
            self.applied,
            self.rejected,
            frozenset(self.rejected_sightings),
            self.widened,
            self.relocated,
            self.consistency,
            self.laser.rivals() if self.laser else None,
            1.0 + self.laser.ranges.share if self.laser else 1.0,
            self.laser.calibration.found() if self.laser and self.vehicle is UNICYCLE else None,
        )

    def _row(self) -> Row:
        state, covariance = self.filter.state, self.filter.covariance
        if self.rivalry is not None:
            covariance = covariance + self.rivalry
        if not self.known:
            state, covariance = np.full_like(state, np.nan), np.full_like(covariance, np.nan)
        return self.finished(self.now, state, covariance)

    def finished(self, time_s: float, state: Floats, covariance: Floats) -> Row:
        """The row with the errors that no measurement reduces, and without the states of the ranges' drifts."""
        size = len(self.states)
        state, covariance = state[:size].copy(), covariance[:size, :size].copy()
        if np.isnan(state).any():
            return Row(time_s, np.full_like(state, np.nan), np.full_like(covariance, np.nan))
        if not np.isfinite(state).all():
            state[:] = np.inf
            return Row(time_s, state, covariance)
        if self.laser:
            self.laser.add_map_error(self.filter, covariance)
        if self.filter.drifts is not None and not self.settings.drift_is_shared:
            covariance[[0, 1], [0, 1]] += self.settings.drift_std_m**2
        if "wz_rad_s" in self.states:
            at = self.states.index("wz_rad_s")
            covariance[at, at] += UNEVEN_TURN_RAD_S**2
        return Row(time_s, state, covariance)

    def steer(self, event: Event, hold_s: float | None) -> None:
        """A control holds from its own time on."""
        if event.kind == self.control_kind:
            self.control[: len(event.values)] = event.values
            if hold_s is None and self.last_control_s is not None and event.time_s > self.last_control_s:
                hold_s = event.time_s - self.last_control_s
            self.last_control_s = event.time_s
            if hold_s is not None:
                self.hold[: len(event.values)] = hold_s
        elif event.kind == "attitude":
            self.control[3:5] = event.values[:2]

    def _match(self, laser: ScanTracker, scan: Scan) -> None:
        """Corrects with a whole scan, and continues with the filter that the tracker returns."""
        result = laser.correct(self.filter, scan, self.known)
        self.applied += result.hits
        self.rejected += result.beams - result.hits
        self.relocated += result.relocated
        if result.fit is not None:
            self.consistency.add("scan", 3, result.fit.d2)
        self.filter, self.known = result.filter, result.known

    def _relocate(self, events: Sequence[Event | Scan]) -> None:
        """Replaces the pose by a fit of the latest measurements, when they contradict the pose and agree on another."""
        if self.relocator is None or events[0].kind not in NAMED:
            return
        self.rivalry = None
        settling = self.relocator.settling_s is not None
        found = self.relocator.see(self.filter, [event for event in events if isinstance(event, Event)])
        if found is None:
            return
        if found.is_certain:
            self.filter.place(found.at, found.values, found.covariance)
            self.relocated += not settling
            self.is_replaced = True
            self.lately_rejected.clear()
        else:
            off = np.zeros(len(self.filter.state))
            off[found.at] = found.values - self.filter.state[found.at]
            off[self.filter.motion.is_angle] = 0.0
            self.rivalry = np.outer(off, off)

    def _count(self, events: Sequence[Event | Scan], passed: NDArray[np.bool_]) -> None:
        kind, good = events[0].kind, int(passed.sum())
        self.applied += good
        self.rejected += len(passed) - good
        block = {"bearing_range": 2, "pose": 3}.get(kind, 1)
        for i, d2 in enumerate(self.filter.d2):
            event = events[min(i, len(events) - 1)]
            if not self.sensors.is_independent(event):
                continue
            if isinstance(event, Event) and event.beacon:  # as if its variance had not been raised
                d2 *= self.sensors.repetition(event)
            self.consistency.add(kind, block, float(d2))
            if isinstance(event, Event) and event.beacon:
                self.consistency.add(f"{kind}:{event.beacon}", block, float(d2))
        if kind in NAMED:
            rejected = [event for event, fits in zip(events, passed, strict=True) if not fits]
            self.rejected_sightings.update(
                (event.time_s, event.beacon) for event in rejected if isinstance(event, Event)
            )
        lately = self.lately_rejected.setdefault(kind, deque(maxlen=PATIENCE))
        lately.append(2 * good <= len(passed))
        if len(lately) == PATIENCE and 2 * sum(lately) > PATIENCE:
            self.filter.widen(WIDENING)
            self.widened += 1
            lately.clear()


def _pose_of(event: Event) -> Pose:
    x, y, heading = event.values
    return x, y, heading


def check(
    log: Log, name: Method, settings: Settings, grid: GridMap | None, beacons: Beacons, origin: str = "the log"
) -> None:
    """Raises LinkposeError where map, beacons, start or settings do not fit the log."""
    kinds = kinds_of(log)
    if not log:
        raise LinkposeError(f"{origin} holds no measurements; record some first")
    if "scan" in kinds and grid is None:
        raise MissingMap(origin)
    if kinds & set(NAMED) and not beacons:
        raise MissingBeacons(origin)
    if kinds & {"odometry", "twist"} and kinds & DIVING:
        raise LinkposeError(
            f"{origin} mixes a robot's odometry with a vehicle's {' and '.join(sorted(kinds & DIVING))}; "
            "delete the rows of the one or of the other"
        )
    if settings.estimate and not kinds & set(NAMED):
        raise NothingToEstimate(origin)
    if name in ("mcl", "scan-match") and "scan" not in kinds:
        raise NeedsScans(origin, name)
    for event in log:
        if isinstance(event, Event) and event.kind in NAMED and event.beacon not in beacons:
            raise LinkposeError(
                f"{origin} line {event.line}: {event.kind} to beacon {event.beacon}, whose place is not known "
                f"(known are {', '.join(beacons)}); add it to the beacon file or delete the row"
            )
    _check_start(log, name, settings, beacons, kinds)
    if settings.ranges.correlation:
        check_correlation(settings.ranges.correlation, most_at_once(log), "the correlation of the ranges")
    check_correlation(
        settings.motion_correlation,
        2 if vehicle_of(kinds) is UNICYCLE else 3,
        "the correlation of the motion's noises",
    )


def _check_start(log: Log, name: Method, settings: Settings, beacons: Beacons, kinds: set[str]) -> None:
    """Raises MissingStart or AmbiguousStart where the start is not given and cannot be found."""
    if settings.start is not None or first_pose(log) is not None or (name == "scan-match" and "scan" in kinds):
        return
    is_tag = vehicle_of(kinds) is CONSTANT_VELOCITY
    places = places_from_ranges(log, beacons) if is_tag else []
    if not places and (not is_tag or area_of(log, beacons) is None):
        raise MissingStart
    if len(places) > 1:
        raise AmbiguousStart(places[0][:2], places[1][:2])


def most_at_once(log: Log) -> int:
    """The most ranges that one measurement has."""
    beams = max((len(thesis_beams(event)) for event in log if isinstance(event, Scan)), default=1)
    counts: dict[float, int] = {}
    for event in log:
        if event.kind == "range":
            counts[event.time_s] = counts.get(event.time_s, 0) + 1
    return max(beams, *counts.values()) if counts else beams
