"""Tracks a robot by its laser scans: searches the whole map at the start, and again after a kidnap."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from linkpose.localization.events import Scan
from linkpose.localization.grid import GridMap
from linkpose.localization.hypotheses import INCUMBENT, Contest, Hypothesis
from linkpose.localization.kalman import KalmanFilter
from linkpose.localization.linalg import Floats
from linkpose.localization.range_scale import RangeScale
from linkpose.localization.scan_matching import FEWEST_BEAMS, MOST_BEAMS, Fit, ScanMatcher, beams_of
from linkpose.localization.self_calibration import SelfCalibration
from linkpose.localization.track import Rivals

# The errors of a map do not average out over scans; they are added to the reported covariance. GRID_ERROR (m, m, rad)
# is the part that no beam shows: the reference paths of two public buildings differ by so much. The rest is the error
# of walls, whose deviation (m) is the usual misfit of the scans in this map, at least LEAST_WALL_STD_M and what the
# thickness of the walls suggests. SHARED_BEAMS neighbouring beams of a full scan end in one piece of wall and share its
# error, and all walls may be nearer by as much, as smeared ones are. Where the walls do not bind a direction, the error
# is at most UNBOUND (m, m, rad). Twice SHARED_BEAMS widens the stated deviations by 1.4.
#
# In a drawn map, the noise of single beams is no error of the walls: the filter's covariance has it already. There only
# the part of the misfit counts that neighbouring beams share, at least LEAST_DRAWN_STD_M. A face between the borders of
# two cells moves the path by up to half a cell and shows in no misfit; GRID_ERROR has it. With a third of
# LEAST_DRAWN_STD_M, an odometry that is 10 % too long takes the share within 2σ in the simulated office to 86 %.
GRID_ERROR = np.array([0.02, 0.02, 0.012])
SHARED_BEAMS, LEAST_WALL_STD_M, LEAST_DRAWN_STD_M = 18.0, 0.025, 0.015
UNBOUND = np.array([0.5, 0.5, 0.2])
CANDIDATES = 60  # poses of a global search that compete
CANDIDATE_STD = np.array([0.2, 0.2, 0.1])  # of a pose that the search found (m, m, rad)
# What this map and robot usually reach: the log-likelihood of a scan, and how far it falls below.
# It follows better scans within RISE of them and worse ones within FALL: a lost robot must not become the usual. The
# usual misfit follows within RISE.
RISE, FALL = 20.0, 200.0
# A scan that is SUSPECT (BAD) usual falls, and at least LEAST_FALL, below the usual is suspect (bad). A suspect scan is
# fitted again as after a slip; BAD_SCANS bad ones in a row make the pose suspect.
SUSPECT, BAD, LEAST_FALL = 1.5, 2.5, 1.0
# So does a scan of which fewer than FEW_HITS of the beams hit a wall: where a robot was carried, most beams end in free
# space, as at people. Among 6 people in simulated buildings the share is 0.7, at the wrong place 0.3 to 0.4.
FEW_HITS = 0.4
# The usual log-likelihood of the beams that do not end in free space, from which on a map is right: -0.1 in simulated
# buildings, with people, too; below -1 in an old map.
RIGHT_MAP = -0.5
BAD_SCANS, MOST_BAD_SCANS = 3, 100  # a search that finds nothing better doubles the wait for the next one
# A pose elsewhere must explain the scan by this much more (log-likelihood, see hypotheses.LEAD) to start a contest.
BETTER = 2.5


@dataclass(frozen=True, slots=True)
class Result:
    """The tracker's filter after a scan, whether its pose is known, and counts of beams that hit a wall."""

    filter: KalmanFilter
    known: bool
    hits: int = 0
    beams: int = 0
    relocated: int = 0
    fit: Fit | None = None


class ScanTracker:
    """Corrects filters by scans in one map."""

    def __init__(self, grid: GridMap, growth: float) -> None:
        """`growth` is that of a range's standard deviation with the range (m/m)."""
        self.matcher = ScanMatcher(grid, growth)
        self.contest: Contest | None = None
        self.now_s = self.opened_s = 0.0  # the latest scan; the start of the latest contest
        self.last_beams: Floats = np.empty((0, 5))
        self.bad = 0
        self.was_known = False
        self.wait = BAD_SCANS
        self.usual, self.fall = -2.0, 2.0  # before the first scan: an old map
        self.least_std_m = LEAST_DRAWN_STD_M if self.matcher.field.is_drawn else LEAST_WALL_STD_M
        self.map_error = np.diag(GRID_ERROR**2)
        self.misfit2 = LEAST_WALL_STD_M**2  # the usual one (m²)
        self.ranges = RangeScale()
        self.calibration = SelfCalibration()

    def _below(self, falls: float) -> float:
        """The log-likelihood so many falls below the usual."""
        return self.usual - falls * max(self.fall, LEAST_FALL)

    def predict(self, run: KalmanFilter, interval_s: float, control: Floats, hold_s: Floats) -> None:
        """Predicts all hypotheses but `run`, which the caller predicts."""
        self.calibration.move(interval_s, float(control[0]), float(control[-1]))
        if self.contest is None:
            return
        for hypothesis in self.contest.hypotheses:
            if hypothesis.filter is not run:
                hypothesis.filter.step(interval_s, control, hold_s)
        if interval_s > 0.0:
            self.contest.moved(control[0] * interval_s, control[-1] * interval_s)

    def correct(self, run: KalmanFilter, scan: Scan, known: bool) -> Result:
        """Corrects with a scan. Until the pose is known, hypotheses from a search of the whole map compete."""
        beams = self.ranges.corrected(beams_of(scan))
        if len(beams) < FEWEST_BEAMS:
            return Result(run, known)
        self.now_s, self.last_beams = scan.time_s, beams
        if self.contest is not None:
            return self._continue(self.contest, run, beams)
        if not known:
            return self._open(run, beams, [])
        at = np.ix_(run.pose_indices, run.pose_indices)
        prediction: Floats = np.asarray(np.linalg.inv(run.covariance[at]), dtype=np.float64)
        fit = self.matcher.correct(run, beams, self._below(SUSPECT))
        self.was_known = True
        is_bad = fit.seen_likelihood < self._below(BAD) or fit.share < FEW_HITS
        self.bad = self.bad + 1 if is_bad else 0
        if self.bad >= self.wait:
            found = self.matcher.search(beams, CANDIDATES)
            if found and self.matcher.compare(beams, found[0])[1] > fit.log_likelihood + BETTER:
                return self._open(run, beams, [run.copy()], found)
            self.bad, self.wait = 0, min(2 * self.wait, MOST_BAD_SCANS)
        pose = _pose_of(run)
        self.ranges.learn(self.matcher.walls, self.matcher.weighted(beams, pose), pose, prediction)
        self.calibration.learn(fit.alone, self._bind(fit))
        self._adapt(fit.seen_likelihood)
        return Result(run, True, round(fit.share * fit.beams), fit.beams, 0, fit)

    def _adapt(self, log_likelihood: float) -> None:
        if log_likelihood > self.usual:
            self.usual += (log_likelihood - self.usual) / RISE
        else:
            self.fall += (self.usual - log_likelihood - self.fall) / FALL
            self.usual += (log_likelihood - self.usual) / FALL

    def add_map_error(self, run: KalmanFilter, covariance: Floats) -> None:
        """Adds the map's own errors, and the distance of a rival pose, to a covariance, in place."""
        at = np.ix_(run.pose_indices, run.pose_indices)
        covariance[at] += self.map_error
        if self.contest is not None:
            covariance[at] += self.contest.rivalry()

    def _bind(self, fit: Fit) -> Floats:
        """Estimates how the errors of the walls in this scan move the pose: the covariance of a fit to them alone.

        Returns the part of it that is not common to all walls.
        """
        self.misfit2 += (fit.misfit_m2 - self.misfit2) / RISE
        std = max(self.least_std_m, self.matcher.field.wall_std_m, math.sqrt(max(self.misfit2, 0.0)))
        shared = SHARED_BEAMS * fit.beams / MOST_BEAMS
        bound = fit.walls / (shared * std**2) + np.diag(1.0 / UNBOUND**2)
        error = np.asarray(np.linalg.inv(bound), dtype=np.float64)
        common = error @ fit.pull / (shared * std**2)  # what 1 m does that all walls are nearer
        self.map_error = error + np.outer(common, common) * std**2 + np.diag(GRID_ERROR**2)
        return error

    def rivals(self) -> Rivals | None:
        """The poses that explain the scans alike, if the pose was never known. None after a log without scans."""
        if self.contest is None or self.was_known:
            return None
        alike = self.contest.alike()
        share, _ = self.matcher.compare(self.last_beams, _pose_of(alike[0].filter))
        poses = [(float(x), float(y), float(heading)) for x, y, heading in (one.first for one in alike)]
        return Rivals(self.opened_s, poses, share, self.contest.scans < self.contest.required)

    def _open(
        self, run: KalmanFilter, beams: Floats, others: list[KalmanFilter], found: list[Floats] | None = None
    ) -> Result:
        """Starts a contest of the poses that a search of the whole map finds, and of `others`."""
        self.calibration.lose()
        candidates = list(others)
        for pose in self.matcher.search(beams, CANDIDATES) if found is None else found:
            candidate = run.copy()
            candidate.place(candidate.pose_indices, pose, np.diag(CANDIDATE_STD**2))
            self.matcher.correct(candidate, beams)
            candidates.append(candidate)
        self.opened_s = self.now_s
        self.contest = Contest(
            [Hypothesis(other, _pose_of(other), INCUMBENT, True) for other in others]
            + [Hypothesis(candidate, _pose_of(candidate)) for candidate in candidates[len(others) :]],
            self.was_known and self.usual > RIGHT_MAP,
        )
        likelihoods = [self.matcher.compare(beams, _pose_of(candidate))[1] for candidate in candidates]
        self.contest.judge(likelihoods, likelihoods)
        return self._undecided(run, beams)

    def _undecided(self, run: KalmanFilter, beams: Floats) -> Result:
        """The tracked pose while it competes; unknown afterwards."""
        incumbent = self.contest.incumbent if self.contest is not None else None
        return Result(incumbent or run, incumbent is not None, 0, len(beams))

    def _continue(self, contest: Contest, run: KalmanFilter, beams: Floats) -> Result:
        fits = [
            # Only the tracked pose may have slipped; the others are compared where they are.
            self.matcher.correct(h.filter, beams, self._below(SUSPECT) if h.is_incumbent else -math.inf)
            for h in contest.hypotheses
        ]
        likelihoods = [fit.log_likelihood for fit in fits]
        winner = contest.judge(likelihoods, [fit.seen_likelihood for fit in fits])
        if winner is not None:
            relocated = int(self.was_known and not winner.is_incumbent)
            # A search that found nothing better is not repeated soon.
            self.wait = min(2 * self.wait, MOST_BAD_SCANS) if winner.is_incumbent else BAD_SCANS
            self.contest, self.bad, self.was_known = None, 0, True
            share, _ = self.matcher.compare(beams, _pose_of(winner.filter))
            return Result(winner.filter, True, round(share * len(beams)), len(beams), relocated)
        self.bad = self.bad + 1 if max(fit.seen_likelihood for fit in fits) < self._below(BAD) else 0
        if self.bad >= BAD_SCANS:  # none of the hypotheses is right: the robot was carried meanwhile
            self.bad = 0
            return self._open(run, beams, [])
        return self._undecided(run, beams)


def _pose_of(run: KalmanFilter) -> Floats:
    """x, y, heading (3,) of a filter."""
    return np.asarray(run.state[run.pose_indices], dtype=np.float64)
