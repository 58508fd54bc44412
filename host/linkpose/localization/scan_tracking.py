"""Follows a robot by its laser scans: finds it in the whole map at first, and again when it has been carried."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from linkpose.localization.events import Scan
from linkpose.localization.grid import GridMap
from linkpose.localization.hypotheses import INCUMBENT, Contest, Hypothesis
from linkpose.localization.kalman import KalmanFilter
from linkpose.localization.linalg import Floats
from linkpose.localization.scan_matching import FEWEST_BEAMS, Fit, ScanMatcher, beam_ends

# What a map gets wrong does not average out over scans (m, m, rad): it is added to the reported covariance. The fitted
# paths of both buildings in tests/bench differ from the reference by 0.02 m on each axis.
MAP_ERROR = np.array([0.025, 0.025, 0.012])
CANDIDATES = 60  # poses of a global search that compete
CANDIDATE_STD = np.array([0.2, 0.2, 0.1])  # of a pose that the search found (m, m, rad)
# What this map and robot usually reach: the log-likelihood of a scan, and how far it falls below.
# It follows better scans within RISE of them and worse ones within FALL: a lost robot must not become the usual.
RISE, FALL = 20.0, 200.0
# A scan that is so many usual falls (and at least so much) below the usual is doubtful, and bad. A doubtful one is
# fitted again as after a slip; so many bad ones in a row make the pose doubtful.
DOUBTFUL, BAD, LEAST_FALL = 1.5, 2.5, 1.0
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

    def __init__(self, grid: GridMap) -> None:
        self.matcher = ScanMatcher(grid)
        self.contest: Contest | None = None
        self.bad = 0
        self.was_known = False
        self.wait = BAD_SCANS
        self.usual, self.fall = -2.0, 2.0  # before the first scan: an old map

    def _below(self, falls: float) -> float:
        """The log-likelihood so many falls below the usual."""
        return self.usual - falls * max(self.fall, LEAST_FALL)

    def predict(self, interval_s: float, control: Floats, hold_s: Floats) -> None:
        """Moves all hypotheses on."""
        assert self.contest is not None
        for hypothesis in self.contest.hypotheses:
            hypothesis.filter.step(interval_s, control, hold_s)
        if interval_s > 0.0:
            self.contest.moved(control[0] * interval_s, control[-1] * interval_s)

    def correct(self, run: KalmanFilter, scan: Scan, known: bool) -> Result:
        """Corrects with a scan. Until the pose is known, hypotheses from a search of the whole map compete."""
        points = beam_ends(scan)
        if len(points) < FEWEST_BEAMS:
            return Result(run, known)
        if self.contest is not None:
            return self._continue(run, points)
        if not known:
            return self._open(run, points, [])
        fit = self.matcher.correct(run, points, self._below(DOUBTFUL))
        self.was_known = True
        self.bad = self.bad + 1 if fit.log_likelihood < self._below(BAD) else 0
        if self.bad >= self.wait:
            found = self.matcher.search(points, CANDIDATES)
            if found and self.matcher.compare(points, found[0])[1] > fit.log_likelihood + BETTER:
                return self._open(run, points, [run.copy()], found)
            self.bad, self.wait = 0, min(2 * self.wait, MOST_BAD_SCANS)
        self._adapt(fit.log_likelihood)
        return Result(run, True, round(fit.share * fit.beams), fit.beams, 0, fit)

    def _adapt(self, log_likelihood: float) -> None:
        if log_likelihood > self.usual:
            self.usual += (log_likelihood - self.usual) / RISE
        else:
            self.fall += (self.usual - log_likelihood - self.fall) / FALL
            self.usual += (log_likelihood - self.usual) / FALL

    def add_map_error(self, run: KalmanFilter, covariance: Floats) -> None:
        """Adds the map's own errors to a covariance, in place."""
        at = run.pose_indices
        covariance[at, at] += MAP_ERROR**2

    def _open(
        self, run: KalmanFilter, points: Floats, others: list[KalmanFilter], found: list[Floats] | None = None
    ) -> Result:
        """Starts a contest of the poses that a search of the whole map finds, and of `others`."""
        candidates = list(others)
        for pose in self.matcher.search(points, CANDIDATES) if found is None else found:
            candidate = run.copy()
            candidate.place(pose, CANDIDATE_STD)
            self.matcher.correct(candidate, points)
            candidates.append(candidate)
        scores = [INCUMBENT] * len(others) + [0.0] * len(candidates[len(others) :])
        self.contest = Contest([Hypothesis(c, score) for c, score in zip(candidates, scores, strict=True)])
        self.contest.judge([self.matcher.compare(points, c.state[c.pose_indices])[1] for c in candidates])
        return Result(run, False, 0, len(points))

    def _continue(self, run: KalmanFilter, points: Floats) -> Result:
        assert self.contest is not None
        fits = [
            self.matcher.correct(hypothesis.filter, points, self._below(DOUBTFUL)).log_likelihood
            for hypothesis in self.contest.hypotheses
        ]
        best = max(fits)
        winner = self.contest.judge(fits)
        if winner is not None:
            self.contest, self.bad, self.wait = None, 0, BAD_SCANS
            relocated, self.was_known = int(self.was_known), True
            share, _ = self.matcher.compare(points, winner.state[winner.pose_indices])
            return Result(winner, True, round(share * len(points)), len(points), relocated)
        self.bad = self.bad + 1 if best < self._below(BAD) else 0
        if self.bad >= BAD_SCANS:  # none of the hypotheses is right: the robot was carried meanwhile
            self.bad = 0
            return self._open(run, points, [])
        return Result(run, False, 0, len(points))
