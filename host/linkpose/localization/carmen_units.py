"""Recognises a CARMEN log in other units than metres and radians.

A laser checks itself: no scanner measures kilometres, and no beam points beyond a turn.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.localization.linalg import Floats

# No median range of a scanner is longer (m): the farthest of FLASER's scanners report 82 m where there is no echo. A
# room in centimetres has 200 to 1000, in millimetres 1000 to 10000.
LONGEST_MEDIAN_M = 100.0
TURN_RAD = 2.0 * np.pi + 0.01


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
