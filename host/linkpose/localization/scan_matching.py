"""Corrects a Kalman filter with a whole laser scan: the default laser update of `localize --map`.

The scan is fitted to the map's distance field (`scan_fit`) from a few poses around the prediction. The fit's Hessian,
with the errors of the map in it, is the information that the scan adds to the filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled
from linkpose.localization.distance_field import DistanceField, Field, distance_at
from linkpose.localization.events import Scan
from linkpose.localization.global_search import likely_poses, nearby_poses
from linkpose.localization.grid import GridMap
from linkpose.localization.kalman import KalmanFilter
from linkpose.localization.linalg import Floats, wrap_angle
from linkpose.localization.scan_fit import (
    Prior,
    Walls,
    Weighted,
    beam_weights,
    bounded_cost,
    drop_short,
    fit_scan,
    misfit,
)

# Deviation of a beam's end from the wall that the map shows (m), at least: half a cell of 5 cm, and a scanner's 3 cm.
# Doubling it makes the filter follow its odometry more; the error in two public buildings grows by a fifth. A map with
# smeared walls has a larger one (DistanceField.wall_std_m).
BEAM_STD_M = 0.05
# Scale of the Cauchy loss in units of that deviation: beams that end farther from a wall count less than half. From 1.5
# to 6 the errors in two public buildings with good maps differ by less than 10 %; below 2 an old map does worse.
LOSS_SCALE = 3.0
# Scale of the first fit of a start that is not the prediction (m), which draws a scan in from farther.
WIDE_SCALE_M = 0.5
MOST_BEAMS = 180  # of one scan that are fitted; the rest is left out evenly
FEWEST_BEAMS = 5  # fewer ends do not determine a pose
# A beam that ends nearer than this (m) to a wall has hit it.
HIT_M = 0.2
# A beam that ends in free space, farther from all walls than this (m), has met a person or what else the map does not
# have, and is left out; the fit is repeated from the pose of each value. In simulations with 10 people around a
# robot, the error is 0.02 to 0.04 m; with the loss alone, and with the wide fit of the prediction, it was 0.09 m.
BESIDE_M = (0.3, 0.3, 0.2)
# The beams that are left judge the pose if they are such a share of all: with 14 people in view, a third is left.
LEAST_SEEN = 0.2
# A prediction that is uncertain by more than this (m, rad) has local minima around it: the fit starts at several poses.
CERTAIN_M, CERTAIN_RAD = 0.15, 0.1
# A slip of the wheels since the last scan (m, m, rad), added to the prediction where the fit has failed, and how much
# better (log-likelihood) the scan must then fit, the length of the slip counted against it. Twice the slip lets people
# in a corridor of an old map pull the pose to a place that looks alike.
SLIP, SLIP_LEAD = (0.3, 0.3, 0.3), 1.0
NEARBY = 12  # starts of that fit
# Weight of one scan when hypotheses are compared: its beams count as this many independent ones. Too many, and two
# the map's errors decide between corridors that look alike.
COMPARED_BEAMS = 10.0
NEXT_TO_NOTHING = np.diag([1e-3, 1e-3, 1e-2])  # information of a pose that only the scan decides (1/m², 1/rad²)
NO_WALL = 0.1  # probability that a beam meets what the map does not have


@dataclass(frozen=True, slots=True)
class Fit:
    """How a scan fitted: `share` of its beams that hit a wall, log-likelihood, and the test statistic of the shift.

    `seen_likelihood` is the log-likelihood without the beams that end in free space: people are no fault of the pose.
    `d2` is νᵀ S⁻¹ ν of the equivalent measurement of the pose, with 3 degrees of freedom. `walls` (3, 3) is Σ v J Jᵀ at
    the fitted pose, the information of walls whose places are uncertain by 1 m, and `pull` (3,) the effect of an error
    that all of them share. `misfit_m2` is the mean square of how far beams end from the walls that they hit (m²), in a
    drawn map only the part that neighbouring beams share. `alone` (3,) is the pose at which the scan would fit best
    without the prediction, to first order.
    """

    share: float
    log_likelihood: float
    seen_likelihood: float
    d2: float
    beams: int
    walls: Floats
    pull: Floats
    misfit_m2: float
    alone: Floats


def beams_of(scan: Scan) -> Floats:
    """The beams (n, 5) with an echo, at most MOST_BEAMS, as `scan_fit` describes them."""
    echo = np.flatnonzero(np.isfinite(scan.ranges_m))
    if len(echo) > MOST_BEAMS:
        echo = echo[np.linspace(0, len(echo) - 1, MOST_BEAMS).round().astype(int)]
    angles = scan.angles_rad[echo] + scan.mount[2]
    ranges, ahead, left = scan.ranges_m[echo], np.cos(angles), np.sin(angles)
    return np.column_stack((scan.mount[0] + ranges * ahead, scan.mount[1] + ranges * left, ahead, left, ranges))


class ScanMatcher:
    """Laser scans against one map. The state of the filters that it corrects starts with x, y, heading."""

    def __init__(self, grid: GridMap, growth: float) -> None:
        """`growth` is that of a range's standard deviation with the range (m/m)."""
        self.grid, self.growth = grid, growth
        self.field = DistanceField.of(grid)
        field = self.field
        self.walls = Walls(field.counts, field.clear, field.geometry, field.reach_m, field.inside_m)
        self.beam_std_m = max(BEAM_STD_M, self.field.wall_std_m)

    def correct(self, run: KalmanFilter, beams: Floats, expected: float = -math.inf) -> Fit:
        """Corrects the filter, in place, with a scan (n, 5).

        A fit whose log-likelihood is below `expected` is not trusted: the wheels may have slipped. Then the fit also
        starts from the poses nearby that explain the scan best, with a prediction that is SLIP times as uncertain.
        """
        at = run.pose_indices
        mean, covariance = run.state[at], run.covariance[np.ix_(at, at)]
        prior: Floats = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        std = np.sqrt(np.diag(covariance))
        best, hessians, cost = self._fit(beams, mean, prior, mean, is_near=True)
        if max(std[0], std[1]) > CERTAIN_M or std[2] > CERTAIN_RAD:
            for start in _around(mean, std):
                other = self._fit(beams, mean, prior, start)
                if other[2] < cost:
                    best, hessians, cost = other
        share, log_likelihood = self.compare(beams, best)
        seen_likelihood = self._seen(beams, best, log_likelihood)
        if seen_likelihood < expected:
            loose: Floats = np.asarray(np.linalg.inv(covariance + np.diag(np.square(SLIP))), dtype=np.float64)
            lead = log_likelihood + SLIP_LEAD
            for start in nearby_poses(self.field.geometry, self.field.counts, beams, mean, NEARBY):
                pose, other_hessians, _ = self._fit(beams, mean, loose, start)
                other_share, other_likelihood = self.compare(beams, pose)
                slipped = other_likelihood - _half_square(pose - mean, loose)
                if slipped > lead:
                    best, hessians, prior, lead = pose, other_hessians, loose, slipped
                    share, log_likelihood = other_share, other_likelihood
            covariance = np.asarray(np.linalg.inv(prior), dtype=np.float64)
            seen_likelihood = self._seen(beams, best, log_likelihood)
        # The beams count as independent here: the errors of the map that they share are in `scan_tracking.map_error`.
        scanned = hessians[0] / self.beam_std_m**2
        off = best - mean
        off[2] = wrap_angle(float(off[2]))
        alone = best + np.linalg.solve(scanned + NEXT_TO_NOTHING, prior @ off)
        d2 = _condition(run, at, best, covariance, prior + scanned)
        pull = np.empty(3)
        weighted = self.weighted(beams, best)
        off_m2 = misfit(self.walls, weighted, best, int(self.field.is_drawn), pull)
        return Fit(share, log_likelihood, seen_likelihood, d2, len(beams), hessians[1], pull, off_m2, alone)

    def compare(self, beams: Floats, pose: Floats) -> tuple[float, float]:
        """Share of the beams that hit a wall from `pose`, and the log-likelihood of the scan there."""
        return hits(self.field.counts, self.field.geometry, beams, pose)

    def search(self, beams: Floats, most: int) -> list[Floats]:
        """Poses (3,) of the whole map from which the scan fits, refined, best first."""
        found: list[tuple[float, Floats]] = []
        for start in likely_poses(self.grid, self.field.counts, beams, 4 * most):
            pose, _, _ = self._fit(beams, start, NEXT_TO_NOTHING, start)
            found.append((-self.compare(beams, pose)[1], pose))
        found.sort(key=lambda item: item[0])
        return [pose for _, pose in found[:most]]

    def _fit(
        self, beams: Floats, mean: Floats, prior: Floats, start: Floats, is_near: bool = False
    ) -> tuple[Floats, Floats, float]:
        """The pose that `start` leads to, its Hessians, and its cost.

        A start that `is_near` needs no wide fit, in which people and short echoes pull as much as walls do.
        """
        pose, hessians = start.copy(), np.empty((2, 3, 3))
        narrow = LOSS_SCALE * self.beam_std_m
        if not is_near:
            for scale in (max(WIDE_SCALE_M, narrow), narrow):
                fit_scan(self.walls, self.weighted(beams, pose, scale), Prior(mean, prior), pose, hessians)
        for beside in BESIDE_M:
            seen = self.weighted(beams, pose)
            drop_short(self.walls, beams, pose, beside, seen.weights)
            fit_scan(self.walls, seen, Prior(mean, prior), pose, hessians)
        seen = self.weighted(beams, pose)
        return pose, hessians, bounded_cost(self.walls, seen, Prior(mean, prior), pose)

    def _seen(self, beams: Floats, pose: Floats, log_likelihood: float) -> float:
        """The log-likelihood of the beams that do not end in free space; that of all, where these are too few."""
        weights = np.ones(len(beams))
        drop_short(self.walls, beams, pose, BESIDE_M[-1], weights)
        seen = beams[weights > 0.0]
        if len(seen) < max(FEWEST_BEAMS, LEAST_SEEN * len(beams)):
            return log_likelihood
        return self.compare(np.ascontiguousarray(seen), pose)[1]

    def weighted(self, beams: Floats, pose: Floats, scale: float | None = None) -> Weighted:
        """The scan with the weights that its beams have from `pose`, and the scale (m) of the loss."""
        if scale is None:
            scale = LOSS_SCALE * self.beam_std_m
        weights = np.empty(len(beams))
        beam_weights(self.walls, beams, pose, self.growth, self.beam_std_m, weights)
        return Weighted(beams, weights, 1.0 / self.beam_std_m**2, scale)


@compiled
def hits(counts: Field, geometry: Floats, beams: Floats, pose: Floats) -> tuple[float, float]:
    """Share of beam ends within HIT_M of a wall, and COMPARED_BEAMS times the mean of ln((1 − ε) exp(−d²/2s²) + ε)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    at = np.empty(3)
    count, total = 0, 0.0
    for i in range(beams.shape[0]):
        px, py = beams[i, 0], beams[i, 1]
        distance_at(counts, geometry, pose[0] + c * px - s * py, pose[1] + s * px + c * py, at)
        count += abs(at[0]) < HIT_M
        ratio = at[0] / HIT_M
        total += math.log((1.0 - NO_WALL) * math.exp(-0.5 * ratio * ratio) + NO_WALL)
    n = max(beams.shape[0], 1)
    return count / n, COMPARED_BEAMS * total / n


def _half_square(off: Floats, information: Floats) -> float:
    """½ δᵀ P⁻¹ δ of a difference of poses."""
    off = np.array([off[0], off[1], wrap_angle(float(off[2]))])
    return 0.5 * float(off @ information @ off)


def _around(mean: Floats, std: Floats) -> list[Floats]:
    """Starts 1.5 σ from the prediction along each axis, and at least a door's width and 10 degrees."""
    reach = np.maximum(1.5 * std, (0.3, 0.3, 0.17))
    starts = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            start = mean.copy()
            start[axis] += side * reach[axis]
            starts.append(start)
    return starts


def _condition(run: KalmanFilter, at: NDArray[np.intp], pose: Floats, before: Floats, information: Floats) -> float:
    """Moves the filter's pose to `pose` with the given information; returns d² of the shift.

    The states that are correlated with the pose follow: x ← x + P_a P_aa⁻¹ δ, and P ← P − P_a P_aa⁻¹ (P_aa − P'_aa)
    P_aa⁻¹ P_aᵀ, where a are the states of the pose. This is the update by an equivalent measurement of the pose.
    `before` is the covariance of the prediction that the pose was fitted with, P_aa or a wider one.
    """
    after = np.linalg.inv(information)
    after = 0.5 * (after + after.T)
    own = run.covariance[np.ix_(at, at)]
    shift = pose - run.state[at]
    shift[2] = wrap_angle(float(shift[2]))
    gain = run.covariance[:, at] @ np.linalg.inv(own)
    run.state += gain @ shift
    run.state[at] = pose
    covariance = run.covariance - gain @ (own - after) @ gain.T
    covariance[np.ix_(at, at)] = after
    run.covariance[:] = 0.5 * (covariance + covariance.T)
    return float(shift @ np.linalg.pinv(before - after) @ shift)
