"""Mice that are exchanged, and a gyro that states the reverse, from where the turns show each mouse.

In a turn, mouse i moves by q_i ω beside the motion of the robot, (3) of [Mice]. The covariance of its counts with the
gyro's turn, divided by the variance of the turn, is therefore q_i plus a part common to all mice, whatever the gyro's
bias is. The counts fit the place and the angle of another mouse where two have been exchanged.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

# Sum of squared turns (rad²) of the steps for a verdict: at 100 Hz, a second at 1 rad/s, in which scatter and rounding
# leave 1 mm. Doubled: a verdict takes twice the turns.
_LEAST_RAD2 = 0.01
# A verdict needs places that fit to the first share of their extent, the second share of how the rig's fit, and fits as
# good as the best but for the third. Mice that slip, or sit 30 mm from their places, fit their own best.
_FITS, _BETTER, _TIE = 0.3, 0.5, 0.1


def remarks_on_places(state: Any, mice: Any, placed: Any) -> list[str]:
    """A sentence where the mice fit each other's places, or the reverse of the gyro's turns, and not their own.

    `state` and `mice` are the records of the filter, `placed` those of the rig as it is in the file.
    """
    count, steps, turns = int(state["count"]), float(state["turns"]), float(state["turns_sum"])
    variance = float(state["turns_squared"]) - turns**2 / max(steps, 1.0)
    if count < 2 or variance < _LEAST_RAD2:
        return []
    seen = (mice["way_by_turn"][:count] - turns / steps * mice["way"][:count]) / variance  # counts a radian
    own, *others = itertools.permutations(range(count))
    left = {order: _left(seen, placed, order) for order in others}
    order = min(left, key=lambda each: left[each])
    moved = [str(i + 1) for i, place in enumerate(order) if i != place]
    exchanged = (
        f"mice {', '.join(moved[:-1])} and {moved[-1]} are exchanged: in turns, each moves as at the place of another. "
        "Exchange their cables, or their [[mouse]] tables in the rig file"
    )
    reverse = "the gyro states the reverse of the turns that the mice show: its z axis must point up"
    found = {exchanged: left[order], reverse: _left(-seen, placed, own)}
    most = min(_FITS, _BETTER * _left(seen, placed, own), min(found.values()) + _TIE)
    texts = [text for text, distance in found.items() if distance < most]
    return ["; or ".join(texts)] if texts else []


def _left(seen: Any, placed: Any, order: Sequence[int]) -> float:
    """Distance of the places that the counts show from those of the rig in this order, as a share of their extent."""
    at = placed[list(order)]
    shown, expected = at["axis"] * seen, at["arm"] - at["arm"].mean()
    return float(np.linalg.norm(shown - shown.mean() - expected) / np.linalg.norm(expected))
