"""Several poses that explain the log so far, until one of them wins clearly.

Each hypothesis is a Kalman filter of its own. All of them receive every measurement; the log-likelihoods of the laser
scans add up to a score. Hypotheses that meet become one, hopeless ones are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from linkpose.localization.kalman import KalmanFilter
from linkpose.localization.linalg import Floats, wrap_angle

# Hypotheses nearer than this (m, rad) are one. It is wider than the spread of one fit, and below a door's width.
SAME_M, SAME_RAD = 0.5, 0.35
# A lead in log-likelihood that decides, with scans that count as ten independent beams each: odds of 10^5 to 1.
# Doubling it doubles the time to the first pose.
LEAD = 12.0
INCUMBENT = 10.0  # head start of the tracked pose: people around a robot are more frequent than kidnappers
HOPELESS = 25.0  # a hypothesis so far behind is dropped
# In an old map no pose explains the scans well, and the map's errors favour a wrong pose for many scans in a row. Both
# differences therefore grow with the best score itself, which is near 0 in a map that is right (overdispersion:
# McCullagh and Nelder, Generalized Linear Models, 2nd edition 1989, section 4.5). In the public map of Wean Hall, wrong
# poses led by 0.33 of it at the most. These shares delay the first pose there from 14 to 20 s; without them, the robot
# was lost silently from two of four starts within the log.
LEAD_SHARE, HOPELESS_SHARE = 0.5, 0.75
# Scans from one place repeat each other: a scan counts when the robot has moved this far (m) or turned (rad) since the
# last one that counted. SCANS must count before one decides: a single scan may fit two corridors alike.
COUNTS_AFTER_M, COUNTS_AFTER_RAD = 0.2, 0.2
# Against a tracked pose more are required: in an old map, a wrong place can fit better for two metres. Fewer do once
# the tracked pose is hopeless.
SCANS, SCANS_AGAINST_INCUMBENT, SCANS_WITHOUT_INCUMBENT = 4, 10, 6


@dataclass(slots=True)
class Hypothesis:
    """A filter and the log-likelihood of the scans that it has explained; `is_incumbent` if it was tracked before.

    `first` (3,) is the pose with which it entered the contest. `misfit` is the negative log-likelihood without the
    beams that end in free space.
    """

    filter: KalmanFilter
    first: Floats
    score: float = 0.0
    is_incumbent: bool = False
    misfit: float = 0.0

    def is_near(self, other: Hypothesis) -> bool:
        """Whether both are one pose."""
        at = self.filter.pose_indices
        off = self.filter.state[at] - other.filter.state[at]
        return bool(np.hypot(off[0], off[1]) < SAME_M and abs(wrap_angle(float(off[2]))) < SAME_RAD)


class Contest:
    """Hypotheses until one wins. In a map that `is_right`, as scans have shown, what does not fit the best of them is
    people: differences do not grow with these.
    """

    def __init__(self, hypotheses: list[Hypothesis], is_right: bool = False) -> None:
        self.hypotheses, self.is_right = hypotheses, is_right
        self.required = SCANS_AGAINST_INCUMBENT if self.incumbent else SCANS
        self.scans = 0
        self.moved_m = self.turned_rad = 0.0
        self.lead = LEAD

    @property
    def incumbent(self) -> KalmanFilter | None:
        """The filter of the tracked pose, while it competes."""
        return next((hypothesis.filter for hypothesis in self.hypotheses if hypothesis.is_incumbent), None)

    def rivalry(self) -> Floats:
        """Covariance (3, 3) that the best rival adds to the pose of the incumbent: both are equally likely."""
        incumbent = self.incumbent
        rivals = [hypothesis for hypothesis in self.hypotheses if not hypothesis.is_incumbent]
        if incumbent is None or not rivals:
            return np.zeros((3, 3))
        rival = max(rivals, key=lambda hypothesis: hypothesis.score).filter
        off = rival.state[rival.pose_indices] - incumbent.state[incumbent.pose_indices]
        off[2] = wrap_angle(float(off[2]))
        return 0.5 * np.outer(off, off)

    def alike(self) -> list[Hypothesis]:
        """Those that explain the log as well as the best one, best first."""
        best = self.hypotheses[0].score
        return [hypothesis for hypothesis in self.hypotheses if hypothesis.score >= best - self.lead]

    def moved(self, distance_m: float, turn_rad: float) -> None:
        """Adds a motion of the robot."""
        self.moved_m += abs(distance_m)
        self.turned_rad += abs(turn_rad)

    def judge(self, log_likelihoods: list[float], seen: list[float]) -> Hypothesis | None:
        """Scores, drops and merges hypotheses after a scan; returns the winner, if there is one.

        `seen` are the log-likelihoods without the beams that end in free space.
        """
        if self.scans == 0 or self.moved_m > COUNTS_AFTER_M or self.turned_rad > COUNTS_AFTER_RAD:
            self.scans, self.moved_m, self.turned_rad = self.scans + 1, 0.0, 0.0
            for hypothesis, log_likelihood, of_seen in zip(self.hypotheses, log_likelihoods, seen, strict=True):
                hypothesis.score += log_likelihood
                hypothesis.misfit -= of_seen
        ranked = sorted(self.hypotheses, key=lambda hypothesis: -hypothesis.score)
        misfit = max(0.0, ranked[0].misfit if self.is_right else -ranked[0].score)
        self.lead, hopeless = max(LEAD, LEAD_SHARE * misfit), max(HOPELESS, HOPELESS_SHARE * misfit)
        kept: list[Hypothesis] = []
        for hypothesis in ranked:
            same = next(filter(hypothesis.is_near, kept), None)
            if same is not None:
                same.is_incumbent |= hypothesis.is_incumbent
            elif hypothesis.score > ranked[0].score - hopeless:
                kept.append(hypothesis)
        self.hypotheses = kept
        if len(kept) == 1 and kept[0].is_incumbent:
            return kept[0]
        if self.incumbent is None:
            self.required = min(self.required, SCANS_WITHOUT_INCUMBENT)
        if self.scans >= self.required and (len(kept) == 1 or kept[0].score > kept[1].score + self.lead):
            return kept[0]
        return None
