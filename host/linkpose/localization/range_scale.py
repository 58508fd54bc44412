"""The scale error of a laser's ranges, from how the scans fit the map along the path.

Each fit of a scan has two more unknowns, which the pose does not make up for: ranges that are too long by a share, and
by a constant, as smeared or thicker walls make them. Their normal equations, without the pose (the Schur complement),
add up along the path.
"""

from __future__ import annotations

import math

import numpy as np

from linkpose.localization.linalg import Floats, wrap_angle
from linkpose.localization.scan_fit import Walls, Weighted, range_equations

# Standard deviations of the two errors before the first scan (m/m, m): scanners are within 1 %, cells of 5 cm.
PRIOR_STD = np.array([0.01, 0.03])
# Beams that end in one piece of wall share its error: so many count as one, as in `scan_tracking`.
SHARED_BEAMS = 18.0
# A scan counts when the robot has moved (m) or turned (rad) by as much since the last one, and one that is as many
# counted scans ago counts 1/e: the first ones are fitted with ranges that are not corrected yet.
COUNTS_AFTER_M, COUNTS_AFTER_RAD, MEMORY = 0.2, 0.2, 50.0
# The estimate is 0.003 at the most in simulations of sound scanners, 0.005 with a third of short echoes, 0.001 in two
# public buildings, and 0.008 in an old map. Below LEAST the ranges stay as they are, from twice it on it is applied.
LEAST = 0.006


class RangeScale:
    """Estimates by which share ranges are too short, and corrects beams."""

    def __init__(self) -> None:
        self._prior = np.diag(PRIOR_STD**-2.0)
        self._information, self._slope = np.zeros((2, 2)), np.zeros(2)
        self._last = np.full(3, math.inf)
        self.share = 0.0

    def corrected(self, beams: Floats) -> Floats:
        """The beams (n, 5) with corrected ranges."""
        if self.share == 0.0:
            return beams
        changed = beams.copy()
        changed[:, :2] += self.share * beams[:, 4:] * beams[:, 2:4]
        changed[:, 4] *= 1.0 + self.share
        return changed

    def learn(self, walls: Walls, scan: Weighted, pose: Floats, prediction: Floats) -> None:
        """Adds a corrected scan that was fitted at `pose`; `prediction` (3, 3) is the information of the pose without
        it.
        """
        off = pose - self._last
        if math.hypot(off[0], off[1]) < COUNTS_AFTER_M and abs(wrap_angle(float(off[2]))) < COUNTS_AFTER_RAD:
            return
        self._last = pose.copy()
        hessian, slope = np.empty((5, 5)), np.empty(5)
        range_equations(walls, scan, pose, hessian, slope)
        hessian *= scan.information / SHARED_BEAMS
        slope *= scan.information / SHARED_BEAMS
        mixed = np.linalg.solve(hessian[:3, :3] + prediction / SHARED_BEAMS, hessian[:3, 3:])
        information = hessian[3:, 3:] - hessian[3:, :3] @ mixed
        # The fit has made the slope along the pose equal to that of the prediction. The scale counts from uncorrected
        # ranges on.
        found = information @ (self.share, 0.0) - slope[3:]
        keep = 1.0 - 1.0 / MEMORY
        self._information = keep * self._information + information
        self._slope = keep * self._slope + found
        estimate = float(np.linalg.solve(self._information + self._prior, self._slope)[0])
        self.share = math.copysign(min(max(0.0, 2.0 * (abs(estimate) - LEAST)), abs(estimate)), estimate)
