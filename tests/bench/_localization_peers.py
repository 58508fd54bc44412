"""Peers of `linkpose localize` among beacons: filterpy's extended Kalman filter, and GTSAM's batch optimum.

Both get the log, the positions of the beacons and the noises that linkpose uses, and estimate scale and bias of the
ranges where linkpose does. A drift of the ranges, which linkpose estimates, is a part of their white noise in the
peers, and in a second batch optimum a Gauss-Markov process of each beacon, as in linkpose. The batch optimum has
Cauchy's loss against outliers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from linkpose.localization.events import NAMED, Event, Log
from linkpose.localization.linalg import Floats, wrap_angle
from linkpose.localization.settings import CONSTANTS, Settings
from linkpose.localization.tables import Beacons
from linkpose.localization.vehicle import first_pose, kinds_of, places_from_ranges

if TYPE_CHECKING:
    import gtsam

GATE = 3.0  # standard deviations: a usual choice of a user of filterpy
CAUCHY = 2.0  # standard deviations
ITERATIONS = 60
SMALLEST_DRIFT_M = 1e-6  # standard deviation of a step of a drift between two ranges of one instant
EXACT_M = 1e-4  # standard deviation of a place that is known


@dataclass
class Step:
    """An instant with ranges or bearings: dead reckoning (x, y m, θ rad) since the one before, and how long it took."""

    time_s: float
    interval_s: float
    way: Floats
    hold_s: float
    heading_rad: float | None
    sightings: list[Event] = field(default_factory=list)


def steps_of(log: Log) -> list[Step]:
    """The instants of a log of odometry, of a velocity with attitude, or of ranges alone."""
    steps: list[Step] = []
    way, control, hold, heading, last, begun = np.zeros(3), np.zeros(3), 0.1, None, log[0].time_s, log[0].time_s
    control_s = None
    for event in log:
        assert isinstance(event, Event)
        interval = event.time_s - last
        middle = way[2] + 0.5 * control[2] * interval + (heading or 0.0)
        c, s = math.cos(middle), math.sin(middle)
        way += interval * np.array((c * control[0] - s * control[1], s * control[0] + c * control[1], control[2]))
        last = event.time_s
        if event.kind in ("odometry", "velocity"):
            if control_s is not None and event.time_s > control_s:
                hold = event.time_s - control_s
            control_s = event.time_s
            ahead, second = event.values[:2]
            control = np.array((ahead, 0.0, second) if event.kind == "odometry" else (ahead, second, 0.0))
        elif event.kind == "attitude":
            heading = event.values[2]
        elif event.kind in NAMED:
            if not steps or event.time_s > steps[-1].time_s:
                steps.append(Step(event.time_s, event.time_s - begun, way, hold, heading))
                begun, way = event.time_s, np.zeros(3)
            steps[-1].sightings.append(event)
    return steps


@dataclass
class Problem:
    """What both peers share: the steps, the form of the state (x, y, θ) or (x, y, v_x, v_y), constants, and noises."""

    steps: list[Step]
    beacons: Beacons
    settings: Settings
    start: Floats
    start_std: Floats
    form: str  # "odometry", "velocity" or "none"
    constants: tuple[str, ...]

    def motion(self, step: Step, state: Floats) -> tuple[Floats, Floats, Floats]:
        """The predicted state (n,), its slopes F (n, n) and the noise's covariance Q (n, n)."""
        n, dt, settings = len(self.start), step.interval_s, self.settings
        slopes, noise = np.eye(n), np.zeros((n, n))
        if self.form == "none":
            slopes[0, 2] = slopes[1, 3] = dt
            spread = np.zeros((n, 2))
            spread[0, 0] = spread[1, 1] = 0.5 * dt * dt
            spread[2, 0] = spread[3, 1] = dt
            return slopes @ state, slopes, settings.acceleration_std_m_s2**2 * spread @ spread.T + 1e-9 * np.eye(n)
        c, s = (math.cos(state[2]), math.sin(state[2])) if self.form == "odometry" else (1.0, 0.0)
        dx, dy = c * step.way[0] - s * step.way[1], s * step.way[0] + c * step.way[1]
        moved = state.copy()
        moved[0] += dx
        moved[1] += dy
        turn, speed = settings.turn_std_rad_s, settings.speed_std_m_s
        if self.form == "odometry":
            moved[2] = wrap_angle(float(state[2] + step.way[2]))
            slopes[0, 2], slopes[1, 2] = -dy, dx
            noise[2, 2] = turn**2 * step.hold_s * dt
        else:
            speed = settings.velocity_std_m_s
        noise[0, 0] = noise[1, 1] = speed**2 * step.hold_s * dt
        return moved, slopes, noise + 1e-9 * np.eye(n)

    def sighting(self, event: Event, state: Floats, constants: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Residual (m,), slopes by state (m, n) and by constants (m, k), and standard deviations (m,)."""
        x, y, z = self.beacons[event.beacon]
        dx, dy = state[0] - x, state[1] - y
        flat = max(math.hypot(dx, dy), 1e-6)
        distance = flat if event.kind == "bearing_range" else math.sqrt(flat * flat + z * z)
        values = dict(zip(self.constants, constants, strict=True))
        scale = 1.0 + values.get("scale", 0.0)
        residual = [event.values[0] - scale * distance - values.get("bias", 0.0)]
        by_state = np.zeros((len(event.values), len(state)))
        by_state[0, :2] = scale * dx / distance, scale * dy / distance
        by_constants = np.zeros((len(event.values), len(constants)))
        by_constants[0] = [distance if name == "scale" else 1.0 for name in self.constants]
        variance = self.settings.ranges.variances(np.array([event.values[0]]), event.values[0])[0]
        std = [math.sqrt(variance + self.settings.drift_std_m**2)]
        if len(event.values) == 2:
            residual.append(wrap_angle(event.values[1] - math.atan2(-dy, -dx) + state[2]))
            by_state[1, :3] = -dy / flat**2, dx / flat**2, -1.0
            std.append(self.settings.bearing_std_rad)
        return np.array(residual), by_state, by_constants, np.array(std)


def problem_of(log: Log, beacons: Beacons, settings: Settings) -> Problem:
    """The problem of a log; its first pose, or a fit of its first ranges, is the start."""
    kinds = kinds_of(log)
    form = "odometry" if "odometry" in kinds else "velocity" if "velocity" in kinds else "none"
    if form == "none":
        mean = sum(place[2] for place in beacons.values()) / len(beacons)
        beacons = {name: (x, y, z - mean) for name, (x, y, z) in beacons.items()}
    prior = first_pose(log)
    pose = np.array(prior.values if prior else places_from_ranges(log, beacons)[0])
    far, turned = settings.start_std
    start, std = (pose, (far, far, turned)) if form == "odometry" else (pose[:2], (far, far))
    if form == "none":
        start, std = np.array((*pose[:2], 0.0, 0.0)), (far, far, 2.0, 2.0)
    return Problem(steps_of(log), beacons, settings, start, np.array(std), form, settings.estimate)


def filterpy_path(problem: Problem) -> tuple[Floats, Floats]:
    """Times (N,) and positions (N, 2) of filterpy's extended Kalman filter with a gate of 3 σ."""
    from filterpy.kalman import ExtendedKalmanFilter

    n, k = len(problem.start), len(problem.constants)
    run = ExtendedKalmanFilter(n + k, 1)
    run.x = np.append(problem.start, np.zeros(k))
    run.P = np.diag(np.append(problem.start_std, [CONSTANTS[name][2] for name in problem.constants]) ** 2)
    path = []
    for step in problem.steps:
        moved, slopes, noise = problem.motion(step, run.x[:n])
        run.x = np.append(moved, run.x[n:])
        whole, added = np.eye(n + k), np.zeros((n + k, n + k))
        whole[:n, :n], added[:n, :n] = slopes, noise
        run.P = whole @ run.P @ whole.T + added
        for event in step.sightings:
            residual, by_state, by_constants, std = problem.sighting(event, run.x[:n], run.x[n:])
            matrix = np.hstack((by_state, by_constants))
            spread = matrix @ run.P @ matrix.T + np.diag(std**2)
            if residual @ np.linalg.solve(spread, residual) > GATE**2 * len(residual):
                continue
            run.dim_z = len(residual)
            run._I = np.eye(n + k)
            run.update(residual, lambda x, m=matrix: m, lambda x, r=residual: np.zeros_like(r), np.diag(std**2))
        path.append(run.x[:2].copy())
    return np.array([step.time_s for step in problem.steps]), np.array(path)


def gtsam_path(problem: Problem, guess: Floats, with_drift: bool = False) -> tuple[Floats, Floats]:
    """Times (N,) and positions (N, 2) of the batch optimum (Levenberg-Marquardt), from states `guess` (N, n).

    With `with_drift`, the drift of the ranges is estimated, and no part of their white noise.
    """
    drifts: _Drifts | None = None
    if with_drift:
        drifts = _Drifts(problem.settings)
        problem = replace(problem, settings=replace(problem.settings, drift_std_m=0.0))
    elif problem.form == "odometry" and not problem.constants:
        return _gtsam_native(problem, guess)
    import gtsam

    k = len(problem.constants)
    graph, values, shared = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.symbol("c", 0)
    keys = [gtsam.symbol("x", i) for i in range(len(problem.steps))]
    for key, state in zip(keys, guess, strict=True):
        values.insert(key, state)
    if k:
        values.insert(shared, np.zeros(k))
        prior = gtsam.noiseModel.Diagonal.Sigmas(np.array([CONSTANTS[name][2] for name in problem.constants]))
        graph.add(gtsam.PriorFactorVector(shared, np.zeros(k), prior))
    graph.add(gtsam.PriorFactorVector(keys[0], problem.start, gtsam.noiseModel.Diagonal.Sigmas(problem.start_std)))
    for i, step in enumerate(problem.steps):
        if i:
            noise = gtsam.noiseModel.Gaussian.Covariance(problem.motion(step, guess[i - 1])[2])
            graph.add(gtsam.CustomFactor(noise, [keys[i - 1], keys[i]], _motion_error(problem, step)))
        for event in step.sightings:
            std = problem.sighting(event, guess[i], np.zeros(k))[3]
            robust = gtsam.noiseModel.Robust.Create(
                gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY), gtsam.noiseModel.Diagonal.Sigmas(std)
            )
            seen = [keys[i], *([shared] if k else []), *([drifts.of(event, graph, values)] if drifts else [])]
            graph.add(gtsam.CustomFactor(robust, seen, _range_error(problem, event)))
    best = _optimum(graph, values)
    return np.array([step.time_s for step in problem.steps]), np.array([best.atVector(key)[:2] for key in keys])


class _Drifts:
    """The drifts of the ranges in a graph: a variable for each range, a Gauss-Markov process for each beacon."""

    def __init__(self, settings: Settings) -> None:
        self.std_m, self.rate = settings.drift_std_m, 1.0 / settings.drift_time_s
        self.last: dict[str, tuple[int, float]] = {}
        self.count = 0

    def of(self, event: Event, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> int:
        """Adds the variable of this range, and returns its key."""
        import gtsam

        key = gtsam.symbol("d", self.count)
        self.count += 1
        values.insert(key, np.zeros(1))
        before = self.last.get(event.beacon)
        if before is None:
            graph.add(gtsam.PriorFactorVector(key, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, self.std_m)))
        else:
            left = math.exp(-self.rate * (event.time_s - before[1]))
            std = self.std_m * math.sqrt(1.0 - left * left) + SMALLEST_DRIFT_M
            noise = gtsam.noiseModel.Isotropic.Sigma(1, std)
            graph.add(gtsam.CustomFactor(noise, [before[0], key], _drift_error(left)))
        self.last[event.beacon] = key, event.time_s
        return int(key)


def _gtsam_native(problem: Problem, guess: Floats) -> tuple[Floats, Floats]:
    """As `gtsam_path`, for a robot with odometry and sensors without constants: GTSAM's own factors, which are fast."""
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    keys = [gtsam.symbol("x", i) for i in range(len(problem.steps))]
    for key, state in zip(keys, guess, strict=True):
        values.insert(key, gtsam.Pose2(*state))
    places = {name: gtsam.symbol("b", i) for i, name in enumerate(problem.beacons)}
    for name, key in places.items():
        place = np.array(problem.beacons[name][:2])
        values.insert(key, place)
        graph.add(gtsam.PriorFactorPoint2(key, place, gtsam.noiseModel.Isotropic.Sigma(2, EXACT_M)))
    start_noise = gtsam.noiseModel.Diagonal.Sigmas(problem.start_std)
    graph.add(gtsam.PriorFactorPose2(keys[0], gtsam.Pose2(*problem.start), start_noise))
    for i, step in enumerate(problem.steps):
        if i:
            noise = gtsam.noiseModel.Gaussian.Covariance(problem.motion(step, guess[i - 1])[2])
            graph.add(gtsam.BetweenFactorPose2(keys[i - 1], keys[i], gtsam.Pose2(*step.way), noise))
        for event in step.sightings:
            std = problem.sighting(event, guess[i], np.zeros(0))[3][::-1]  # GTSAM has the bearing first
            robust = gtsam.noiseModel.Robust.Create(
                gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY), gtsam.noiseModel.Diagonal.Sigmas(std)
            )
            pair = keys[i], places[event.beacon]
            if event.kind == "range":
                graph.add(gtsam.RangeFactor2D(*pair, event.values[0], robust))
            else:
                bearing = gtsam.Rot2(event.values[1])
                graph.add(gtsam.BearingRangeFactor2D(*pair, bearing, event.values[0], robust))
    best = _optimum(graph, values)
    return np.array([step.time_s for step in problem.steps]), np.array([best.atPose2(k).translation() for k in keys])


def _optimum(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    """The minimum of a graph by Levenberg-Marquardt."""
    import gtsam

    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(ITERATIONS)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


Error = Callable[..., Floats]


def _motion_error(problem: Problem, step: Step) -> Error:
    def error(factor: object, values: object, slopes: list[Floats] | None) -> Floats:
        before, after = (values.atVector(key) for key in factor.keys())  # type: ignore[attr-defined]  # noqa: SIM118 (a list, not a mapping)
        moved, by_before, _ = problem.motion(step, before)
        if slopes is not None:
            slopes[0], slopes[1] = -by_before, np.eye(len(after))
        off = after - moved
        if problem.form == "odometry":
            off[2] = wrap_angle(float(off[2]))
        return np.asarray(off)

    return error


def _drift_error(left: float) -> Error:
    def error(factor: object, values: object, slopes: list[Floats] | None) -> Floats:
        before, after = (values.atVector(key) for key in factor.keys())  # type: ignore[attr-defined]  # noqa: SIM118 (a list, not a mapping)
        if slopes is not None:
            slopes[0], slopes[1] = np.array([[-left]]), np.eye(1)
        return np.asarray(after - left * before)

    return error


def _range_error(problem: Problem, event: Event) -> Error:
    """The error by the state, the constants where there are any, and the drift where it is estimated."""
    k = len(problem.constants)

    def error(factor: object, values: object, slopes: list[Floats] | None) -> Floats:
        state, *others = (values.atVector(key) for key in factor.keys())  # type: ignore[attr-defined]  # noqa: SIM118 (a list, not a mapping)
        constants = others.pop(0) if k else np.zeros(0)
        residual, by_state, by_constants, _ = problem.sighting(event, state, constants)
        if slopes is not None:
            found = [-by_state, *([-by_constants] if k else []), *(-np.eye(len(residual), 1) for _ in others)]
            for i, slope in enumerate(found):
                slopes[i] = slope
        for drift in others:
            residual[0] -= drift[0]
        return residual

    return error
