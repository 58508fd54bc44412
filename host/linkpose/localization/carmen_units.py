"""Recognises a CARMEN log, and headings of a path, in other units or axes than metres, radians and x forward, y left.

Laser and odometry check themselves: no scanner measures kilometres, no beam points beyond a turn, and wheels drive
along their heading.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.localization.linalg import Floats
from linkpose.rotations import wrapped

# No median range of a scanner is longer (m): the farthest of FLASER's scanners report 82 m where there is no echo. A
# room in centimetres has 200 to 1000, in millimetres 1000 to 10000.
LONGEST_MEDIAN_M = 100.0
TURN_RAD = 2.0 * np.pi + 0.01
# Wheels drive along their heading: the mean |cos| of the angle between both is above ALONG, but for slips, and 0.64 at
# random. It is taken over FEWEST_STEPS of at least STEP_M (m), in which the resolution of a pose does not matter.
ALONG, NOT_ALONG, FEWEST_STEPS, STEP_M = 0.95, 0.85, 30, 0.05


def check_beam_angles(first: float, step: float, count: int, path: Path, line: int) -> None:
    """Raises LinkposeError for the angles of `count` beams that reach beyond a turn."""
    last = first + step * (count - 1)
    if max(abs(first), abs(last)) > TURN_RAD:
        raise LinkposeError(
            f"{path} line {line}: the beams reach from {first:.4g} to {last:.4g} rad, as if in degrees; "
            "multiply start angle, field of view and step by 0.0174533 to give radians"
        )


def check_ranges(scans: list[Floats], path: Path) -> None:
    """Raises LinkposeError where the ranges (m) are too long for a scanner.

    The longest are left out, as they may be the code of a beam without an echo.
    """
    values = np.concatenate([ranges[np.isfinite(ranges) & (ranges > 0.0)] for ranges in scans] or [np.empty(0)])
    measured = values[values < np.max(values, initial=0.0)]
    median = float(np.median(measured)) if len(measured) else 0.0
    if median > LONGEST_MEDIAN_M:
        raise LinkposeError(
            f"{path}: the ranges cannot be metres (median {median:.4g}); divide millimetres by 1000, "
            "or centimetres by 100"
        )


def check_headings(poses: Floats, path: Path, whose: str = "the odometry") -> None:
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
