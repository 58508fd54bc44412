"""Errors of a robot's constants that its own motion shows: the laser's place and direction, and the odometry's scales.

Each scan alone tells where the laser is, and wheels drive along their heading. Between two scans, with the motion o of
the wheels and its turn φ, both seen from the heading half-way, and with a laser whose direction is off by δ and whose
place by e, the robot seems to move by

    R(-δ) (1 + s) o + 2 sin(φ/2) (-e_y, e_x)    and to turn by    (1 + t) φ + c |o|

where s and t are errors of scale, and c a drift along the way. All of them are observable from a drive with turns:
[Censi2013]. Here they follow from robust linear regression.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from linkpose.localization.events import Log, Scan
from linkpose.localization.linalg import Floats, wrap_angle

# A row of the regression is a motion of at least this (m, rad): well beyond the errors of a scan. A jump of more than
# a step in FARTHEST_M is no motion.
STEP_M, STEP_RAD, FARTHEST_M = 0.3, 0.3, 3.0
FEWEST_ROWS = 30
BLOCK = 8  # rows in a row whose errors may be related: they see the same walls
ROUNDS, CAUCHY = 8, 2.0  # of the robust fit; scale of its loss in deviations of the residuals
# Errors are applied from LEAST on, where they are SURE times their deviation: rad, m, m, and shares of way and turn. In
# eight simulated drives with a sound mount (seeds 1 and 2), the estimates are 0.002 rad, 0.008 m and 0.004 at the most,
# within 3 deviations; the public log of Freiburg has 0.007 rad, 0.02 m and 0.01, that of the Intel laboratory 0.036 of
# the way. Half of LEAST corrects these, too.
LEAST = np.array([0.0175, 0.03, 0.03, 0.05, 0.05])
SURE = 5.0
DOUBTED = 2.0  # an error that is not applied widens σ from so many of its deviations on
LARGEST = np.array([0.35, 0.6, 0.6, 0.4, 0.4])  # larger ones are mistakes of another kind, which `doubts` names
CORRECTIONS = 2  # of one log: what the first leaves of an error is small


class RobotErrors(NamedTuple):
    """What is wrong: the laser's direction (rad), its place ahead and to the left (m), and the shares by which way and
    turn of the odometry are too short. `std` is their deviations.
    """

    values: Floats
    std: Floats

    @property
    def certain(self) -> Floats:
        """The values (5,) that are large and beyond chance, 0 for the others."""
        size = np.abs(self.values)
        return np.where((size > LEAST) & (size > SURE * self.std) & (size < LARGEST), self.values, 0.0)

    @property
    def likely(self) -> Floats:
        """The values (5,) that are hardly chance, 0 for the others."""
        return np.where(np.abs(self.values) > DOUBTED * self.std, self.values, 0.0)


class SelfCalibration:
    """Gathers the motion between scans, as the wheels have it and as the scans have it."""

    def __init__(self) -> None:
        self._rows: list[Floats] = []
        self._from: tuple[Floats, Floats] | None = None
        self._driven = np.zeros(3)

    def move(self, interval_s: float, speed: float, turn_rate: float) -> None:
        """Adds a motion of the wheels."""
        middle = self._driven[2] + 0.5 * turn_rate * interval_s
        way = speed * interval_s
        self._driven += (way * math.cos(middle), way * math.sin(middle), turn_rate * interval_s)

    def lose(self) -> None:
        """The next scan is not compared with those before: the robot may have been carried."""
        self._from = None

    def learn(self, pose: Floats, covariance: Floats) -> None:
        """Adds a scan that alone fits best at `pose` (3,), with covariance (3, 3)."""
        x, y, turned = self._driven.tolist()
        if self._from is not None and math.hypot(x, y) < STEP_M and abs(turned) < STEP_RAD:
            return
        if self._from is not None:
            self._rows.append(_row(self._from, (pose, covariance), self._driven))
        self._from = pose, covariance
        self._driven = np.zeros(3)

    def found(self) -> RobotErrors | None:
        """The errors of all rows; None where these are too few."""
        rows = np.array([row for row in self._rows if np.abs(row[3:5]).max() < FARTHEST_M])
        if len(rows) < FEWEST_ROWS:
            return None
        ahead, left, turned = rows[:, :3].T
        across, none = 2.0 * np.sin(0.5 * rows[:, 5]), np.zeros(len(rows))
        slopes = np.stack(
            (np.column_stack((left, none, -across, ahead)), np.column_stack((-ahead, across, none, left))), axis=1
        )
        place, place_std = _regression(slopes, rows[:, 3:5] - rows[:, :2], rows[:, 6:8])
        place[0] /= 1.0 + place[3]  # its slope is the true way
        drift = np.column_stack((turned, np.hypot(ahead, left)))[:, np.newaxis]
        turn, turn_std = _regression(drift, rows[:, 5:6] - rows[:, 2:3], rows[:, 8:9])
        return RobotErrors(np.append(place, turn[0]), np.append(place_std, turn_std[0]))


def _row(before: tuple[Floats, Floats], after: tuple[Floats, Floats], driven: Floats) -> Floats:
    """Motion of the wheels (3) and of the scans (3), and variances of the latter (3), seen from half-way."""
    middle = 0.5 * driven[2]
    c, s = math.cos(middle), math.sin(middle)
    wheels = (c * driven[0] + s * driven[1], c * driven[1] - s * driven[0], driven[2])
    moved = after[0] - before[0]
    moved[2] = wrap_angle(float(moved[2] - driven[2])) + driven[2]
    heading = before[0][2] + 0.5 * moved[2]
    c, s = math.cos(heading), math.sin(heading)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    variances = np.diag(turn @ (before[1] + after[1]) @ turn.T)
    return np.concatenate((wheels, turn @ moved, variances))


def _regression(slopes: Floats, values: Floats, variances: Floats) -> tuple[Floats, Floats]:
    """The solution (p,) of slopes (n, m, p) x ≈ values (n, m), by iteratively reweighted least squares with the Cauchy
    loss, and its deviations, of which rows of a BLOCK may share their errors.
    """
    weights = 1.0 / variances
    solution = np.zeros(slopes.shape[2])
    for _ in range(ROUNDS):
        normal = np.einsum("nm,nmp,nmq->pq", weights, slopes, slopes) + 1e-9 * np.eye(len(solution))
        solution = np.linalg.solve(normal, np.einsum("nm,nmp,nm->p", weights, slopes, values))
        off = values - slopes @ solution
        spread = 1.4826 * np.median(np.abs(off) / np.sqrt(variances), axis=0) + 1e-9
        square = off**2 / (variances * spread**2)
        weights = 1.0 / (variances * spread**2 * (1.0 + square / CAUCHY**2))
    pulls = np.einsum("nm,nmp,nm->np", weights, slopes, off)
    pulls = np.add.reduceat(pulls, np.arange(0, len(pulls), BLOCK))
    inverse = np.linalg.inv(normal)
    single = np.diag(inverse)
    shared = np.diag(inverse @ (pulls.T @ pulls) @ inverse)
    return solution, np.sqrt(np.maximum(single, shared))


def states_place(log: Log) -> bool:
    """Whether the log distinguishes the place of the laser from that of the robot.

    One that does not states the path of the laser as that of the robot. To correct the place would move the path away
    from what is meant.
    """
    scan = next((event for event in log if isinstance(event, Scan)), None)
    return scan is not None and scan.mount[:2] != (0.0, 0.0)


def applicable(log: Log, errors: RobotErrors | None) -> Floats:
    """The errors (5,) that `corrected` may take out of a log."""
    if errors is None:
        return np.zeros(5)
    return errors.certain * (1.0 if states_place(log) else np.array([1.0, 0.0, 0.0, 1.0, 1.0]))


def together(one: Floats, other: Floats) -> Floats:
    """Two corrections (5,), one after the other."""
    return np.concatenate((one[:3] + other[:3], (1.0 + one[3:]) * (1.0 + other[3:]) - 1.0))


def corrected(log: Log, errors: Floats) -> Log:
    """The log with other mounts of the laser and scales of the odometry, by errors as in `RobotErrors.values`."""
    delta, ahead, left, way, turn = errors.tolist()
    c, s = math.cos(delta), math.sin(delta)
    changed: Log = []
    for event in log:
        if isinstance(event, Scan):
            x, y = event.mount[0] + ahead, event.mount[1] + left
            mount = (c * x - s * y, s * x + c * y, wrap_angle(event.mount[2] + delta))
            changed.append(replace(event, mount=mount))
        elif event.kind == "odometry":
            changed.append(replace(event, values=((1.0 + way) * event.values[0], (1.0 + turn) * event.values[1])))
        else:
            changed.append(event)
    return changed
