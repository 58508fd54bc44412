"""End stops of a hinge as a measurement of its angle.

About a vertical hinge, nothing but the gyros measures the angle, and it drifts with their bias. Many hinges turn back
at the same two angles, e.g. a motor between its limits or a knee at full extension. Where successive turning points on
one side agree, the filter takes them as an end stop, and from then on the angle there as that of the first:

    0 = φ − φ_first + e

The standard deviation of φ_first stays in that of the angle. A stop is used only while the angle without it is less
certain than φ_first, so that a hinge whose angle gravity gives does not depend on stops.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters.chain.state import Record
from linkpose.filters.chain.update import update

_REVERSAL_RAD = 0.1  # by which the angle turns back until it has left a turning point: above play and vibration
_LEAST_SWEEP_RAD = 0.3  # between two turning points: smaller ones are no movement from stop to stop
# Largest difference of successive turning points at a stop; a bias of 0.3 °/s shifts those of a 6 s period by that.
_SAME_RAD = 0.035
_REPEATS = 4  # differences in a row that make a stop
_STOP_RAD = 0.01  # σ of e: play, sampling, and the filter's lag at a turn
_LESS_CERTAIN = 2.0  # ratio of standard deviations from which on a stop is used


@inner
def clear_stops(s: Record) -> None:
    """No turning points yet."""
    s.turn_angle = s.turn_farthest = 0.0
    s.turn_side, s.turn_std = 0, math.pi
    for side in range(2):
        s.turn_last[side] = math.nan
        s.stop_count[side] = s.stop_used[side] = 0


@inner
def shift_stops(s: Record, by: float) -> None:
    """The angle from which the others count has changed: all grow by the same (rad)."""
    s.turn_angle += by
    s.turn_farthest += by
    for side in range(2):
        s.turn_last[side] += by
        s.stop_angle[side] += by


@inner
def update_stop(s: Record, size: int, angle: float, q: Record) -> None:
    """Follow the angle (rad) and apply a stop that has just been left; H of the angle is in `row`.

    Each turning point is compared with the last one on its side.
    """
    step = vec.wrapped(angle - s.turn_angle)
    s.turn_angle += step
    outwards = 1.0 if s.turn_side == 1 else -1.0
    if outwards * (s.turn_angle - s.turn_farthest) >= 0.0:
        s.turn_farthest, s.turn_std = s.turn_angle, s.angle_std
        return
    if outwards * (s.turn_farthest - s.turn_angle) < _REVERSAL_RAD:
        return
    side, found = s.turn_side, s.turn_farthest
    is_sweep = abs(found - s.turn_last[1 - side]) > _LEAST_SWEEP_RAD
    s.turn_side, s.turn_farthest = 1 - side, s.turn_angle
    if is_sweep and abs(found - s.turn_last[side]) < _SAME_RAD:
        s.stop_count[side] += 1
    else:
        s.stop_count[side], s.stop_angle[side], s.stop_std[side], s.stop_used[side] = 0, found, s.turn_std, 0
    s.turn_last[side] = found
    if s.stop_count[side] < _REPEATS:
        return
    if s.angle_std > _LESS_CERTAIN * s.stop_std[side]:
        s.stop_used[side] = 1
    if s.stop_used[side]:
        update(s, size, s.stop_angle[side] - found, _STOP_RAD**2, q.huber)
        s.turn_last[side] = s.stop_angle[side]


@inner
def stop_variance(s: Record) -> float:
    """Variance of the angle by that of the stops in use."""
    variance = 0.0
    for side in range(2):
        if s.stop_used[side]:
            variance = max(variance, s.stop_std[side] ** 2)
    return variance
