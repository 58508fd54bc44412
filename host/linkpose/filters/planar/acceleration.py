"""The accelerometer against the mice: a change of speed that only one of them shows.

On a straight, the gyro cannot show that all mice slip or are at their speed limit. The accelerometer can: it measures
the change of the velocity. The comparison is a check and no measurement, because the floor may tilt, and because the
rig file states neither the offset of the accelerometer nor its place and angle on the robot:

- The reference is the mean specific force over 0.3 s in which the mice show a constant velocity. It includes the offset
  and the tilt at this heading.
- Δv is compared over the next 0.4 s, by its magnitude only. The angle of the accelerometer about the vertical drops
  out. The heading may change by 0.3 rad.
- The limit includes the noise of the accelerometer, a tilt of 2°, and a distance of 0.1 m from the robot's centre.

Where the mice show too small an increase at their largest speed so far, this is their speed limit, as in `limit`.
Other contradictions are unconfirmed changes of the velocity, as in `process`. Both increase σ of the position.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters.mice.plane import scaled, square, turned, unit
from linkpose.filters.mice.state import Record, Records
from linkpose.filters.planar.limit import LIMITED_SHARE, accept_limit, are_at_limit
from linkpose.filters.planar.state import SLOTS

# The last 0.7 s in slots of _SLOT_S (s). The first _REFERENCE of them are the reference; the window begins with the
# last one of these. Doubled: an increase of speed that takes longer than the window is compared in part.
_SLOT_S, _REFERENCE = 0.05, 6
# In the reference the velocity changes by no more than this (m/s); from its start to the end of the window, the heading
# by no more than this (rad). Doubled: more changes are compared, and the limit grows by the tilt.
_STEADY_M_S, _STRAIGHT_RAD = 0.03, 0.3
# The limit: m/s for rounding, share of Δv for the accelerometer's scale, tilt (2°, m/s²), distance from the centre (m),
# σ of the noise, and a margin. Doubled margin: only speeds that the mice show too low by 0.4 m/s and more are found.
_BASE_M_S, _SHARE, _TILT_M_S2, _ARM_M, _NOISE_Z, _LIMIT = 0.05, 0.08, 0.34, 0.1, 2.0, 1.3
_NOISE_S = 0.3  # over which the noise is averaged (s)
_DEAD_REPEATS = 20  # readings of one value: the accelerometer is dead, or its data are made up


@inner
def watch_acceleration(state: Record, m: Record, mice: Records, accel: complex) -> None:
    """Compare the change of velocity by the mice with that by the accelerometer; `accel` (m/s²) is its latest value."""
    seen = state.acceleration
    change2 = square(accel - seen.last)
    seen.repeats = seen.repeats + 1 if change2 == 0.0 else 0
    seen.last = accel
    is_known = m.step > 0.0 and m.missed == 0.0 and math.isfinite(m.mean_rate) and m.used != 0 and m.excluded == 0
    if not (is_known and math.isfinite(change2)) or m.is_saturated or seen.repeats >= _DEAD_REPEATS:
        forget(seen)
        return
    rate = m.mean_rate - state.at.bias
    seen.turn += rate * m.step
    seen.noise += (0.5 * change2 - seen.noise) * min(1.0, m.step / _NOISE_S)
    slot, facing = seen.slots[SLOTS - 1], scaled(m.step, unit(seen.turn))
    slot.span += m.step
    slot.force += scaled(m.step, accel)
    slot.way += scaled(m.step, m.velocity)
    slot.facing += facing
    slot.force_n += turned(facing, accel)
    slot.way_n += turned(facing, m.velocity)
    slot.turn, slot.rate = seen.turn, max(slot.rate, abs(rate))
    if slot.span >= _SLOT_S - 1e-9:
        seen.filled = min(seen.filled + 1, SLOTS)
        if seen.filled == SLOTS:
            _compare(state, m, mice)
        _shift(seen)


@inner
def forget(seen: Record) -> None:
    """Restart: no slot is filled."""
    seen.filled = 0
    _empty(seen.slots[SLOTS - 1])


@inner
def _empty(slot: Record) -> None:
    slot.span = slot.rate = 0.0
    slot.force = slot.way = slot.facing = slot.force_n = slot.way_n = 0j


@inner
def _shift(seen: Record) -> None:
    """Drop the oldest slot, and begin the newest one."""
    for k in range(1, SLOTS):
        to, slot = seen.slots[k - 1], seen.slots[k]
        to.span, to.turn, to.rate = slot.span, slot.turn, slot.rate
        to.force, to.way, to.facing = slot.force, slot.way, slot.facing
        to.force_n, to.way_n = slot.force_n, slot.way_n
    _empty(seen.slots[SLOTS - 1])


@inner
def _compare(state: Record, m: Record, mice: Records) -> None:
    """Compare Δv from the middle of the last reference slot to the middle of the newest slot."""
    seen = state.acceleration
    first, start, end = seen.slots[0], seen.slots[_REFERENCE - 1], seen.slots[SLOTS - 1]
    steady = scaled(1.0 / start.span, start.way) - scaled(1.0 / first.span, first.way)
    if square(steady) > _STEADY_M_S**2 or abs(end.turn - first.turn) > _STRAIGHT_RAD:
        return
    by_mice = scaled(1.0 / end.span, end.way_n) - scaled(1.0 / start.span, start.way_n)
    by_force, limit = _change_by_force(seen, m.step)
    shown, measured = math.sqrt(square(by_mice)), math.sqrt(square(by_force))
    off = measured - shown
    if abs(off) < _LIMIT * (limit + _SHARE * max(shown, measured)):
        return
    if off > 0.0 and are_at_limit(state, m, mice):
        accept_limit(state, m, max(LIMITED_SHARE, off / state.fastest))
    elif shown > _STEADY_M_S:
        change = turned(by_mice, unit(-seen.turn))
        _unconfirm(state, m, change, scaled(off / shown, change))
    forget(seen)


@inner
def _unconfirm(state: Record, m: Record, change: complex, missing: complex) -> None:
    """The change of the velocity by the mice (m/s) lacks `missing`: unconfirmed, until they return to the velocity."""
    if not state.unconfirmed_s > 0.0:
        state.held, state.unconfirmed_s, state.unconfirmed_turn = m.velocity + missing, m.step, 0.0
        state.unconfirmed_m, state.unconfirmed_way = 0.0, 0j
    elif square(state.held - m.velocity) < 0.25 * square(state.held - m.velocity + change):
        state.unconfirmed_s = 0.0


@inner
def _change_by_force(seen: Record, step: float) -> tuple[complex, float]:
    """Δv (m/s) by the accelerometer, in the axes in which the turn was 0, and the limit of its error (m/s).

    `step` (s) is the time from one value to the next.
    """
    force, span, rate = 0j, 0.0, 0.0
    for k in range(_REFERENCE):
        slot = seen.slots[k]
        force += slot.force
        span += slot.span
        rate = max(rate, slot.rate)
    force = scaled(1.0 / span, force)
    change, window = 0j, 0.0
    for k in range(_REFERENCE - 1, SLOTS):
        slot = seen.slots[k]
        share = 0.5 if k == _REFERENCE - 1 or k == SLOTS - 1 else 1.0
        change += scaled(share, slot.force_n - turned(slot.facing, force))
        window += share * slot.span
        rate = max(rate, slot.rate)
    noise2 = seen.noise * step * (window + window * window / span)
    turn = abs(seen.slots[SLOTS - 1].turn - seen.slots[0].turn)
    limit = _BASE_M_S + _TILT_M_S2 * turn * window + _ARM_M * rate + _NOISE_Z * math.sqrt(noise2)
    return change, limit
