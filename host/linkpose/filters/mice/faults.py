"""Which mice slip, are lifted or dead: the most probable set of faulty mice over a window or over one step.

Each set F of mice is a hypothesis: the mice outside F all moved with one motion X of the robot, the mice in F did not.
Its cost is the χ² of the best X plus a constant for each mouse in F. X must also agree with the gyro, and, where mice
are left out, with the velocity before, since a robot cannot stop or turn at once. The sound mice are therefore found
even where they are outvoted: two lifted mice agree with each other, but not with the gyro or the motion so far. F may
hold all mice: a robot that is lifted turns under a gyro that sees it.

A set becomes a fault when its hypothesis is decisively cheaper than every other for a short time. An excluded mouse
returns when it has agreed with the others over a time and a distance; at rest all mice agree.
"""

from __future__ import annotations

import math
from typing import cast

import numpy as np

from linkpose.compiling import compiled, inner
from linkpose.filters.mice.least_squares import ROUNDING, fit, misfit, squared_speed
from linkpose.filters.mice.plane import scaled, square
from linkpose.filters.mice.state import NOBODY, Record, Records

# Length of the window (s): a few counts at 5 cm/s. Doubled: faults are found later, at half the speed.
WINDOW_S = 0.05
# Standard normal quantile of the tests: one false alarm in a million. Doubled: faults of 10 % pass.
_FAULT_Z = 4.75
# Cost of each mouse in F: −2 log of its likelihood as noise of ±1 m/s at 5 mm/s resolution is about 16.
# Doubled: a fault needs a larger contradiction.
_EXCLUSION = 16.0
# χ² of the others, beyond which one mouse does not explain a contradiction to the gyro (95 % of four degrees of
# freedom). Doubled: a slip of all mice in a turn may pass for a fault of one of them.
_ALONE = 9.5
# A mouse without a count for this long (s) while others move is probably lifted; so much less does it cost in F.
_SILENT_S, _SILENT_BONUS = 0.04, 25.0
# How much cheaper than the second a hypothesis must be, or for how long (s) the best one may be undecided.
_DECISIVE, _UNDECIDED_S = 12.0, 0.1
# A PS/2 packet that must be repeated brings its counts within three samples (s): no fault.
_LATE_S = 0.035
# χ² of a mouse (two degrees of freedom, 99 %) below which it agrees, doubled because the others err as well.
_AGREES = 18.4
# Time (s) and distance (m) over which an excluded mouse has to agree. Doubled: it returns later.
_AGREED_S, _AGREED_M = 0.2, 0.01
# Change of a small robot's velocity in a second (1σ). Doubled: outvoted sound mice are found less often.
ACCEL_M_S2, ANGULAR_RAD_S2 = 2.0, 4.0
# Gyro and mice may differ by this share of the rate (1σ): another floor (5 %), scale of the gyro (3 %).
# Doubled: only lifted mice, not slipping ones, contradict the gyro.
_RATE_SHARE = 0.08
# Over what a test runs. The compiler would take Python constants for types of their own.
_STEP, _WINDOW = cast(bool, np.bool_(True)), cast(bool, np.bool_(False))


@compiled
def fault_limit(freedom: int) -> float:
    """χ² that sound mice exceed once in a million tests, or less (Wilson and Hilferty 1931)."""
    part = 2.0 / (9.0 * freedom)
    return float(freedom * (1.0 - part + _FAULT_Z * math.sqrt(part)) ** 3)


@inner
def _cost(state: Record, mice: Records, candidates: int, left_out: int, span: float, turn: float) -> float:
    """Cost of the hypothesis that the mice in `left_out` are at fault; `state.fit` is the X that fits best.

    `turn` (rad) is the gyro's over the time `span` (s), less its bias; NaN without a gyro.
    """
    by_gyro = before = before_turn = 0.0
    if math.isfinite(turn):
        by_gyro = 1.0 / ((state.bias_std * span) ** 2 + (_RATE_SHARE * turn) ** 2)
    else:
        turn = 0.0
    if left_out and state.has_reference:
        before = 1.0 / (ACCEL_M_S2 * WINDOW_S * span) ** 2
        before_turn = 1.0 / (ANGULAR_RAD_S2 * WINDOW_S * span) ** 2
    weak = 1.0 / (10.0 * span) ** 2  # nothing else holds X where all mice are left out
    motion, rotation = scaled(span, state.reference), state.reference_rate * span
    linear, angular = before + weak, before_turn + by_gyro + weak
    fit(
        state, mice, candidates & ~left_out, linear, scaled(before / linear, motion),
        angular, (before_turn * rotation + by_gyro * turn) / angular,
    )  # fmt: skip
    v, w = state.fit, state.fit_turn
    cost: float = before * square(v - motion) + before_turn * (w - rotation) ** 2 + by_gyro * (w - turn) ** 2
    for i in range(state.count):
        m = mice[i]
        if candidates & left_out & 1 << i:
            cost += _EXCLUSION - (_SILENT_BONUS if m.silent_s >= _SILENT_S else 0.0)
        elif candidates >> i & 1:
            cost += m.weight * misfit(m, v, w)
    return cost


@inner
def number(mask: int) -> int:
    """How many bits are set."""
    return (mask & 1) + (mask >> 1 & 1) + (mask >> 2 & 1) + (mask >> 3 & 1)


@inner
def trusted(state: Record) -> int:
    """Bit mask of the mice that have counts and are not excluded."""
    members: int = state.sound & ~state.excluded
    return members


@inner
def _find_fault(state: Record, mice: Records, candidates: int, span: float, turn: float) -> int:
    """The mice most probably at fault (0: none); `state.is_decisive`: every other set is decisively less probable.

    The mice's `sum` and `weight` hold the motions of the candidates over `span`.
    """
    state.is_decisive = True
    count, has_gyro = number(candidates), math.isfinite(turn)
    # One mouse and a gyro have as many unknowns as equations; of two mice one is at fault only if a gyro shows which.
    if count < 2 or (count == 2 and not has_gyro):
        return NOBODY
    least = _cost(state, mice, candidates, NOBODY, span, turn)
    if not least > fault_limit(2 * count - (2 if has_gyro else 3)):
        return NOBODY
    best, second, worst = math.inf, math.inf, NOBODY
    for left_out in range(1, 1 << state.count):
        if left_out & ~candidates or (left_out == candidates and not has_gyro):
            continue
        cost = _cost(state, mice, candidates, left_out, span, turn)
        if cost < best:
            best, second, worst = cost, best, left_out
        else:
            second = min(second, cost)
    # Three mice that agree with each other and not with the gyro share one cause, unless one mouse explains it: the
    # robot slips or is lifted.
    share_cause = count > 2 and not _cost(state, mice, candidates, NOBODY, span, math.nan) > fault_limit(2 * count - 3)
    if share_cause and not (number(worst) == 1 and best < _EXCLUSION + _ALONE):
        state.is_decisive = True
        return candidates
    state.is_decisive = second - best > _DECISIVE
    return worst


@inner
def _load(state: Record, mice: Records, is_step: bool, noise_m_s: float, mismatch: float) -> float:
    """Prepare the tests over the last step or over the window; returns the gyro's turn in it (rad), NaN without one."""
    span = state.step if is_step else state.window_s
    noise = noise_m_s * noise_m_s * (span * span if is_step else 0.5 * span * state.step)
    for i in range(state.count):
        m = mice[i]
        m.sum = m.moved if is_step else m.window
        lasting = mismatch * mismatch * span * span * squared_speed(m, state.reference, state.reference_rate)
        m.weight = 1.0 / (ROUNDING * m.metres_per_count * m.metres_per_count + lasting + noise)
    if not math.isfinite(state.mean_rate):
        return math.nan
    turn: float = state.mean_rate * span if is_step else state.window_turn
    turn -= state.bias * span
    return turn


@inner
def skip_late(state: Record, mice: Records, noise_m_s: float, mismatch: float) -> None:
    """Leave out, for this step, mice whose counts are impossible: a packet is late, and all counts come at once."""
    turn = _load(state, mice, _STEP, noise_m_s, mismatch)
    candidates = trusted(state)
    faulty = _find_fault(state, mice, candidates, state.step, turn)
    if state.is_decisive and faulty != candidates:
        state.used &= ~faulty


@inner
def exclude(state: Record, mice: Records, noise_m_s: float, mismatch: float) -> bool:
    """Exclude the mice that have been at fault in the window for long enough; whether there are any."""
    turn = _load(state, mice, _WINDOW, noise_m_s, mismatch)
    faulty = _find_fault(state, mice, trusted(state), state.window_s, turn)
    state.disagree_s = state.disagree_s + state.step if faulty else 0.0
    is_found = faulty != 0 and (state.is_decisive or state.disagree_s >= _UNDECIDED_S)
    state.suspected_s = state.suspected_s + state.step if is_found and faulty == state.suspects else state.step
    state.suspects = faulty if is_found else NOBODY
    if not (is_found and state.suspected_s >= _LATE_S):
        return False
    state.excluded |= faulty
    state.used &= ~faulty
    _forget_agreement(state, mice, faulty)
    state.disagree_s = 0.0
    state.suspects = NOBODY
    return True


@inner
def readmit(state: Record, mice: Records, noise_m_s: float, mismatch: float) -> None:
    """Update the reference from the mice that agree, and readmit excluded mice that have agreed for long enough."""
    turn, span = _load(state, mice, _WINDOW, noise_m_s, mismatch), state.window_s
    judges = trusted(state)
    has_trusted = judges != 0
    if (
        not has_trusted
    ):  # excluded mice that agree with each other and with the gyro are sound, and one that moves alone
        judges = state.sound & ~_find_fault(state, mice, state.sound, span, turn)
        for i in range(state.count):
            if judges == 1 << i and mice[i].silent_s > 0.0:
                judges = NOBODY
    if judges == 0:
        _forget_agreement(state, mice, state.excluded)
        return
    _cost(state, mice, judges, NOBODY, span, turn)
    v, w = state.fit, state.fit_turn
    if has_trusted:
        state.has_reference = True
        state.reference, state.reference_rate = scaled(1.0 / span, v), w / span
    for i in range(state.count):
        m = mice[i]
        if not state.excluded & state.sound & 1 << i:
            continue
        if m.weight * misfit(m, v, w) > _AGREES:
            m.agreed_s = m.agreed_m = 0.0
            continue
        m.agreed_s += state.step
        m.agreed_m += state.step * math.sqrt(squared_speed(m, v, w)) / span
        if m.agreed_s >= _AGREED_S and m.agreed_m >= _AGREED_M:
            state.excluded &= ~(1 << i)


@inner
def _forget_agreement(state: Record, mice: Records, members: int) -> None:
    for i in range(state.count):
        if members >> i & 1:
            mice[i].agreed_s = mice[i].agreed_m = 0.0
