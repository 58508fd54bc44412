"""Recognises headings of a path in other units or axes than radians, counterclockwise from x.

Odometry, poses and a true path check themselves: wheels drive along their heading.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.localization.linalg import Floats
from linkpose.rotations import wrapped

# Wheels drive along their heading: the mean |cos| of the angle between both is above ALONG, but for slips, and 0.64 at
# random. It is taken over FEWEST_STEPS of at least STEP_M (m), in which the resolution of a pose does not matter.
ALONG, NOT_ALONG, FEWEST_STEPS, STEP_M = 0.95, 0.85, 30, 0.05


def check_headings(poses: Floats, path: Path, whose: str) -> None:
    """Raises LinkposeError where the wheels drive along another heading than that of `poses` (n, 3: x m, y m, rad).

    `whose` poses they are is for the message. A vehicle that drives in any direction passes.
    """
    poses = _apart(poses)
    if len(poses) <= FEWEST_STEPS or _along(poses) > NOT_ALONG:
        return
    x, y, heading = poses.T
    for changed, text in (
        ((x, y, np.radians(heading)), "is in degrees: multiply it by 0.0174533 to give radians"),
        ((x, y, -heading), "has the other sign: angles are counterclockwise, x is forward and y left"),
        ((x, y, np.radians(-heading)), "is in degrees and has the other sign: multiply it by -0.0174533"),
        (
            (y, x, heading),
            "fits exchanged columns of x and y: exchange them, or subtract it from 1.570796 if it is clockwise from y",
        ),
        (
            (y, x, np.radians(heading)),
            "is that of a compass, in degrees clockwise from y: subtract it from 90, and multiply by 0.0174533",
        ),
    ):
        if _along(np.column_stack(changed)) > ALONG:
            raise LinkposeError(f"{path}: the heading of {whose} {text}")


def _apart(poses: Floats) -> Floats:
    """The poses that are at least STEP_M from the one before."""
    kept = [0]
    for i, (x, y) in enumerate(poses[:, :2].tolist()):
        if abs(x - poses[kept[-1], 0]) + abs(y - poses[kept[-1], 1]) >= STEP_M:
            kept.append(i)
    return poses[kept]


def _along(poses: Floats) -> float:
    """Mean |cos| of the angle between the motion and the heading half-way."""
    moved = np.diff(poses[:, :2], axis=0)
    middle = poses[:-1, 2] + 0.5 * wrapped(np.diff(poses[:, 2]))
    return float(np.mean(np.abs(np.cos(np.arctan2(moved[:, 1], moved[:, 0]) - middle))))
