"""Finds a robot among beacons again after it was carried: a batch fit of the measurements that contradict its pose.

The filter's gate rejects a range or a bearing that its pose does not explain. When most of the latest measurements are
rejected, the pose is wrong, not the sensors. Then the pose is fitted to the latest measurements alone, from starts all
over the beacons' area, by Gauss-Newton with Huber weights. The fit replaces the filter's pose when it explains the
measurements, the filter's pose does not, and no other place explains them nearly as well.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from linkpose.localization import models
from linkpose.localization.events import Event
from linkpose.localization.gate import chi_square_quantile
from linkpose.localization.kalman import (
    CONSTANT_VELOCITY,
    SUBMERSIBLE,
    SUBMERSIBLE_IN_CURRENT,
    KalmanFilter,
    MotionModel,
)
from linkpose.localization.linalg import Floats
from linkpose.localization.measuring import MeasurementBuilder
from linkpose.rotations import wrapped

# Of the LATEST measurements, this many must contradict the pose: fewer are outliers, more delay the recovery.
LATEST, CONTRADICTIONS = 4, 3
CONTRADICTS = 0.997  # probability below which the χ² test calls an innovation possible
EXPLAINS = 0.95  # the same for the sum of squares of a fit: it replaces a pose only if it is good
# Most sightings of one fit, and the longest time (s) that they span. Dead reckoning links them, so that a longer window
# adds its errors; a shorter one does not determine the heading.
MOST_SIGHTINGS, WINDOW_S = 16, 20.0
WAY_ERROR = 0.05  # of the way between two sightings: the error of dead reckoning in the fit (m/m)
# The fit replaces the pose when its cost (χ², half of −2 ln likelihood) is lower by LEAD than the pose's, and by
# UNIQUE than any other place's. Odds of e^12 and e^4.5; doubling them delays the recovery by some seconds.
LEAD, UNIQUE = 24.0, 9.0
DIVES = (SUBMERSIBLE.model, SUBMERSIBLE_IN_CURRENT.model)  # whose heading an attitude sensor reads
SURPLUS = 1  # rows beyond the number of unknowns
HEADING_KNOWN_RAD = 0.2  # standard deviation of the heading below which the filter continues from a fit
HUBER = 2.5  # standard deviations beyond which a residual counts linearly
STEPS, PLACES, HEADINGS = 20, 5, 6  # iterations; starts along x and y, and headings of each
SAME_PLACE_M = 0.5  # minima nearer than this, or than three standard deviations, are one
# Standard deviations of the prior of a fit: nothing is assumed of the place, and a walk of the velocity (m, rad, m/s).
PRIOR = {"x_m": 1000.0, "y_m": 1000.0, "heading_rad": 1.8, "x_rate_m_s": 2.0, "y_rate_m_s": 2.0}


@dataclass(frozen=True, slots=True)
class _Sighting:
    """A range, or range and bearing, of a beacon, in units of its standard deviations.

    `travel` is the pose (x m, y m, θ rad) of dead reckoning then, `beacon` its place (m) with the height relative to
    the robot, `bearing_rad` NaN where there is none.
    """

    time_s: float
    travel: Floats
    beacon: tuple[float, float, float]
    name: str
    range_m: float
    bearing_rad: float
    range_std_m: float
    bearing_std_rad: float
    contradicts: bool


@dataclass(frozen=True, slots=True)
class Relocation:
    """A fitted pose: values and covariance of the filter's states `at`; `is_certain` when it replaces the pose."""

    at: NDArray[np.intp]
    values: Floats
    covariance: Floats
    is_certain: bool


class Relocator:
    """Collects the latest sightings of beacons and compares the filter's pose with the best fit of them."""

    def __init__(self, motion: MotionModel, sensors: MeasurementBuilder) -> None:
        self.motion, self.sensors = motion, sensors
        free = ("x_m", "y_m") if motion.model in DIVES else tuple(PRIOR)
        self.at = np.array([i for i, name in enumerate(motion.states) if name in free])
        self.turns = "heading_rad" in motion.states and motion.model not in DIVES
        self.moves = motion.model == CONSTANT_VELOCITY.model
        self.prior = np.array([PRIOR[motion.states[i]] for i in self.at])
        self.travel = np.zeros(len(motion.states))
        self.sightings: deque[_Sighting] = deque(maxlen=MOST_SIGHTINGS)
        self.settling_s: float | None = None  # time of the first sighting of a fit that is repeated

    def move(self, run: KalmanFilter, interval_s: float, control: Floats) -> None:
        """Adds a motion to the way since the start, before the filter makes it."""
        if interval_s <= 0.0 or self.moves:
            return
        if not self.turns:
            self.travel[3:] = run.state[3:]
        before = self.travel.copy()
        models.propagate(self.motion.model, before, control, np.zeros(self.motion.noises), interval_s, self.travel)

    def see(self, run: KalmanFilter, events: Sequence[Event]) -> Relocation | None:
        """Adds the sightings that the filter has just tested; returns a fit when they contradict its pose.

        The fit is repeated with further sightings until the heading is known, for the filter's linear model is not
        valid before.
        """
        for event, d2 in zip(events, run.d2, strict=True):
            self.sightings.append(self._sighting(run, event, float(d2)))
        if self.settling_s is not None:
            since = [sighting for sighting in self.sightings if sighting.time_s >= self.settling_s]
            fit = self._fit(run, since, True)
            if not fit.is_certain or self._is_settled(fit, len(since)):
                self._restart()
            return fit if fit.is_certain else None
        contradicting = self._contradicting()
        if not contradicting:
            return None
        fit = self._fit(run, contradicting, False)
        if fit.is_certain:
            self.settling_s = contradicting[0].time_s
            if self._is_settled(fit, len(contradicting)):
                self._restart()
        return fit

    def _is_settled(self, fit: Relocation, count: int) -> bool:
        return not self.turns or fit.covariance[2, 2] < HEADING_KNOWN_RAD**2 or count >= MOST_SIGHTINGS

    def _restart(self) -> None:
        """Forgets the sightings, which the new pose explains."""
        self.settling_s = None
        self.sightings.clear()

    def _sighting(self, run: KalmanFilter, event: Event, d2: float) -> _Sighting:
        distance, bearing = event.values if event.kind == "bearing_range" else (event.values[0], np.nan)
        scale, bias = self.sensors.constants(event.beacon, run.state)
        x, y, z = self.sensors.beacons[event.beacon]
        height = run.state[self.sensors.height] if self.sensors.height >= 0 else 0.0
        level = event.kind == "bearing_range"
        repeats = math.sqrt(self.sensors.repetition(event, self._last_s(event.beacon)))
        return _Sighting(
            event.time_s,
            self.travel[[0, 1, 2]].copy(),
            (x, y, 0.0 if level else z - height),
            event.beacon,
            (distance - bias) / (1.0 + scale),
            bearing,
            self.sensors.range_std(distance) * repeats,
            self.sensors.settings.bearing_std_rad * repeats,
            d2 > chi_square_quantile(CONTRADICTS, 2 if level else 1),
        )

    def _last_s(self, beacon: str) -> float:
        """Time of the last sighting of a beacon."""
        return max((sighting.time_s for sighting in self.sightings if sighting.name == beacon), default=-math.inf)

    def _contradicting(self) -> list[_Sighting]:
        """The sightings since the first that contradicts the pose, when most of the latest do; else none."""
        now = self.sightings[-1].time_s
        recent = [sighting for sighting in self.sightings if sighting.time_s > now - WINDOW_S]
        if sum(sighting.contradicts for sighting in recent[-LATEST:]) < CONTRADICTIONS:
            return []
        first = next(i for i, sighting in enumerate(recent) if sighting.contradicts)
        # Accepted sightings before the robot was carried do not count: those of the run that most rejections form.
        while first < len(recent) - LATEST and not all(s.contradicts for s in recent[first : first + 2]):
            first += 1
        names = {sighting.name for sighting in self.sightings}
        seen = recent[first:]
        # One beacon that all others contradict has a fault of its own.
        return seen if len({sighting.name for sighting in seen if sighting.contradicts}) >= min(2, len(names)) else []

    def _fit(self, run: KalmanFilter, sightings: list[_Sighting], settling: bool) -> Relocation:
        """The best fit; it is certain when it explains the sightings, the filter's pose does not, and no other place
        does. While `settling`, the filter's pose comes from such a fit, so that only the first condition remains.
        """
        problem = _Problem(sightings, self.travel, self.turns, self.moves)
        found, costs = problem.minimise(self._starts(sightings), self.prior)
        best = int(np.argmin(costs))
        covariance = problem.covariance(found[best], self.prior)
        spread = float(np.sqrt(covariance[0, 0] + covariance[1, 1]))
        far = np.hypot(*(found[:, :2] - found[best, :2]).T) > max(SAME_PLACE_M, 3.0 * spread)
        rival = float(np.min(costs[far], initial=np.inf))
        surplus = problem.rows - len(self.at)
        explains = surplus < SURPLUS or costs[best] < chi_square_quantile(EXPLAINS, surplus)
        wins = rival > costs[best] + UNIQUE and problem.cost(run.state[self.at][np.newaxis])[0] > costs[best] + LEAD
        certain = explains and (settling or (wins and surplus >= SURPLUS))
        return Relocation(self.at, found[best], covariance, bool(certain))

    def _starts(self, sightings: list[_Sighting]) -> Floats:
        """A grid over the beacons and as far around them as the ranges reach, with headings all around."""
        places = np.array([sighting.beacon[:2] for sighting in sightings])
        reach = max(sighting.range_m for sighting in sightings)
        axes = [np.linspace(p.min() - 0.7 * reach, p.max() + 0.7 * reach, PLACES) for p in places.T]
        angles = np.arange(HEADINGS) * (2.0 * np.pi / HEADINGS) if self.turns else np.zeros(1)
        grid = np.array([(x, y, angle) for x in axes[0] for y in axes[1] for angle in angles])
        starts = np.zeros((len(grid), len(self.at)))
        starts[:, :2] = grid[:, :2]
        if self.turns:
            starts[:, 2] = grid[:, 2]
        return starts


class _Problem:
    """Least squares of sightings over many poses (S, p) at once; a pose is (x, y), (x, y, θ) or (x, y, v_x, v_y)."""

    def __init__(self, sightings: list[_Sighting], now: Floats, turns: bool, moves: bool) -> None:
        self.turns, self.moves = turns, moves
        beacons = np.array([sighting.beacon for sighting in sightings])
        self.x, self.y, self.z2 = beacons[:, 0], beacons[:, 1], beacons[:, 2] ** 2
        self.since_s = np.array([sighting.time_s for sighting in sightings]) - sightings[-1].time_s
        # Travel relative to the pose now: in its axes for a robot that turns, in the map's otherwise.
        off = np.array([sighting.travel for sighting in sightings]) - now[:3]
        c, s = (np.cos(now[2]), np.sin(now[2])) if turns else (1.0, 0.0)
        self.ahead, self.left = c * off[:, 0] + s * off[:, 1], c * off[:, 1] - s * off[:, 0]
        self.turned = off[:, 2]
        way = WAY_ERROR * np.hypot(self.ahead, self.left)
        self.ranges = np.array([sighting.range_m for sighting in sightings])
        self.range_std = np.hypot([sighting.range_std_m for sighting in sightings], way)
        self.bearings = np.array([sighting.bearing_rad for sighting in sightings])
        self.bearing_std = np.array([sighting.bearing_std_rad for sighting in sightings])
        self.has_bearing = np.isfinite(self.bearings)
        self.rows = len(sightings) + int(self.has_bearing.sum())

    def _residuals(self, poses: Floats) -> tuple[Floats, Floats]:
        """Residuals (S, m) in standard deviations and slopes (S, m, p) of the predictions."""
        x, y = poses[:, :1], poses[:, 1:2]
        angle = poses[:, 2:3] if self.turns else np.zeros_like(x)
        c, s = np.cos(angle), np.sin(angle)
        way_x, way_y = c * self.ahead - s * self.left, s * self.ahead + c * self.left
        if self.moves:
            way_x, way_y = poses[:, 2:3] * self.since_s, poses[:, 3:4] * self.since_s
        dx, dy = x + way_x - self.x, y + way_y - self.y
        distance = np.maximum(np.sqrt(dx * dx + dy * dy + self.z2), 1e-6)
        slopes = np.zeros((*dx.shape, poses.shape[1]))
        slopes[..., 0], slopes[..., 1] = dx / distance, dy / distance
        self._inner(slopes, dx / distance, dy / distance, way_x, way_y)
        residuals = (self.ranges - distance) / self.range_std
        slopes /= self.range_std[:, np.newaxis]
        if not self.has_bearing.any():
            return residuals, slopes
        seen = self.has_bearing
        flat = np.maximum(dx * dx + dy * dy, 1e-6)[:, seen]
        off = self.bearings - (np.arctan2(-dy, -dx) - angle - self.turned)
        off = wrapped(off)[:, seen] / self.bearing_std[seen]
        turn = np.zeros((*flat.shape, poses.shape[1]))
        by_x, by_y = -dy[:, seen] / flat, dx[:, seen] / flat
        turn[..., 0], turn[..., 1] = by_x, by_y
        self._inner(turn, by_x, by_y, way_x[:, seen], way_y[:, seen])
        turn[..., 2] -= 1.0
        turn /= self.bearing_std[seen][:, np.newaxis]
        return np.concatenate((residuals, off), axis=1), np.concatenate((slopes, turn), axis=1)

    def _inner(self, slopes: Floats, by_x: Floats, by_y: Floats, way_x: Floats, way_y: Floats) -> None:
        """Slopes by the heading, or by the velocity, from those by the place."""
        if self.turns:
            slopes[..., 2] = by_y * way_x - by_x * way_y
        elif self.moves:
            slopes[..., 2], slopes[..., 3] = by_x * self.since_s, by_y * self.since_s

    def cost(self, poses: Floats) -> Floats:
        """Sum of Huber's loss (S,), in χ² units."""
        size = np.abs(self._residuals(poses)[0])
        return np.asarray(np.where(size <= HUBER, size**2, 2.0 * HUBER * size - HUBER**2).sum(axis=1))

    def minimise(self, poses: Floats, prior_std: Floats) -> tuple[Floats, Floats]:
        """The minima from all starts (S, p) by Levenberg-damped Gauss-Newton, and their costs (S,)."""
        costs = self.cost(poses)
        damping = np.full(len(poses), 1e-3)
        ridge = np.diag(prior_std**-2.0)
        for _ in range(STEPS):
            residuals, slopes = self._residuals(poses)
            weights = np.minimum(1.0, HUBER / np.maximum(np.abs(residuals), 1e-9))
            weighted = slopes * weights[..., np.newaxis]
            normal = np.einsum("smi,smj->sij", weighted, slopes) + ridge
            right = np.einsum("smi,sm->si", weighted, residuals)
            diagonal = np.einsum("sii->si", normal)
            damped = normal + (damping[:, np.newaxis] * diagonal)[:, :, np.newaxis] * np.eye(poses.shape[1])
            trial = poses + np.linalg.solve(damped, right[..., np.newaxis])[..., 0]
            trial_costs = self.cost(trial)
            better = trial_costs < costs
            poses = np.where(better[:, np.newaxis], trial, poses)
            costs = np.where(better, trial_costs, costs)
            damping = np.where(better, 0.3 * damping, 10.0 * damping)
        return poses, costs

    def covariance(self, pose: Floats, prior_std: Floats) -> Floats:
        """The inverse of the Hessian (p, p) at a pose (p,)."""
        slopes = self._residuals(pose[np.newaxis])[1][0]
        return np.asarray(np.linalg.inv(slopes.T @ slopes + np.diag(prior_std**-2.0)))
