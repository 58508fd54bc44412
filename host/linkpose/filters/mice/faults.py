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

from linkpose.compiling import compiled, inner
from linkpose.filters.mice.least_squares import ROUNDING, add_mouse, clear, misfit, solve, squared_speed
from linkpose.filters.mice.state import MOST, Record

# Length of the window (s): a few counts at 5 cm/s. Doubled: faults are found later, at half the speed.
WINDOW_S = 0.05
# Standard normal quantile of the tests: one false alarm in a million. Doubled: faults of 10 % pass.
_FAULT_Z = 4.75
# Cost of each mouse in F: −2 log of its likelihood as noise of ±1 m/s at 5 mm/s resolution is about 16.
# Doubled: a fault needs a larger contradiction.
_EXCLUSION = 16.0
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


@compiled
def fault_limit(freedom: int) -> float:
    """χ² that sound mice exceed once in a million tests, or less (Wilson and Hilferty 1931)."""
    part = 2.0 / (9.0 * freedom)
    return float(freedom * (1.0 - part + _FAULT_Z * math.sqrt(part)) ** 3)


@inner
def _cost(state: Record, place: Record, candidates: int, left_out: int, span: float, turn: float) -> float:
    """Cost of the hypothesis that the mice in `left_out` are at fault; `state.solution` is the X that fits best.

    `turn` (rad) is the gyro's over the time `span` (s), less its bias; NaN without a gyro.
    """
    clear(state)
    cost = 0.0
    for i in range(place.count):
        if not candidates >> i & 1:
            continue
        if left_out >> i & 1:
            cost += _EXCLUSION - (_SILENT_BONUS if state.silent_s[i] >= _SILENT_S else 0.0)
        else:
            add_mouse(state, place, i, state.weight[i], state.sums[i, 0], state.sums[i, 1])
    linear, angular, by_gyro = 0.0, 0.0, 0.0
    if math.isfinite(turn):
        share = _RATE_SHARE * turn
        by_gyro = 1.0 / ((state.bias_std * span) ** 2 + share * share)
        state.right[2] += by_gyro * turn
    if left_out and state.has_reference:
        linear, angular = 1.0 / (ACCEL_M_S2 * WINDOW_S * span) ** 2, 1.0 / (ANGULAR_RAD_S2 * WINDOW_S * span) ** 2
        state.right[0] += linear * state.reference[0] * span
        state.right[1] += linear * state.reference[1] * span
        state.right[2] += angular * state.reference[2] * span
    # Nothing else to hold X where all mice are left out.
    weak = 1.0 / (10.0 * span) ** 2
    solve(state, linear + weak, angular + by_gyro + weak)
    x, y, w = state.solution[0], state.solution[1], state.solution[2]
    for i in range(place.count):
        if candidates >> i & 1 and not left_out >> i & 1:
            cost += state.weight[i] * misfit(place, i, x, y, w, state.sums[i, 0], state.sums[i, 1])
    r = state.reference
    cost += linear * ((x - r[0] * span) ** 2 + (y - r[1] * span) ** 2) + angular * (w - r[2] * span) ** 2
    return float(cost + by_gyro * (w - turn) ** 2 if by_gyro > 0.0 else cost)


@inner
def _weigh(state: Record, place: Record, span: float, noise: float, mismatch: float) -> None:
    """1/σ_i² of the sums over `span` (s); `noise` (m²) is their variance from sample to sample."""
    r = state.reference
    for i in range(place.count):
        count = place.metres_per_count[i]
        lasting = mismatch * mismatch * span * span * squared_speed(place, i, r[0], r[1], r[2])
        state.weight[i] = 1.0 / (ROUNDING * count * count + lasting + noise)


@inner
def number(mask: int) -> int:
    """How many bits are set."""
    count = 0
    for i in range(MOST):
        count += mask >> i & 1
    return count


@inner
def trusted(state: Record) -> int:
    """Bit mask of the mice that have counts and are not excluded."""
    return int(state.sound & ~state.distrusted)


@inner
def find_fault(state: Record, place: Record, candidates: int, span: float, turn: float) -> tuple[int, bool]:
    """The mice most probably at fault (0: none), and whether every other set is decisively less probable.

    `state.sums` and `state.weight` hold the motions of the candidates over `span`.
    """
    count = number(candidates)
    # One mouse and a gyro have as many unknowns as equations; of two mice one is at fault only if a gyro shows which.
    if count < 2 or (count == 2 and not math.isfinite(turn)):
        return 0, False
    freedom = 2 * count - (2 if math.isfinite(turn) else 3)
    if not _cost(state, place, candidates, 0, span, turn) > fault_limit(freedom):
        return 0, False
    # Three mice that agree with each other and not with the gyro share one cause: the robot slips or is lifted.
    if count > 2 and not _cost(state, place, candidates, 0, span, math.nan) > fault_limit(2 * count - 3):
        return candidates, True
    best, second, worst = math.inf, math.inf, 0
    for left_out in range(1, 1 << place.count):
        if left_out & ~candidates or (left_out == candidates and not math.isfinite(turn)):
            continue
        cost = _cost(state, place, candidates, left_out, span, turn)
        if cost < best:
            best, second, worst = cost, best, left_out
        else:
            second = min(second, cost)
    return worst, second - best > _DECISIVE


@inner
def skip_late(state: Record, place: Record, step: float, noise_m_s: float, mismatch: float) -> None:
    """Leave out, for this step, mice whose counts are impossible: a packet is late, and all counts come at once."""
    for i in range(place.count):
        state.sums[i, 0], state.sums[i, 1] = state.moved[i, 0], state.moved[i, 1]
    _weigh(state, place, step, (step * noise_m_s) ** 2, mismatch)
    mask = trusted(state)
    faulty, decisive = find_fault(state, place, mask, step, (state.mean_rate - state.bias) * step)
    if decisive and faulty != mask:
        state.used &= ~faulty


@inner
def _load_window(state: Record, place: Record, step: float, noise_m_s: float, mismatch: float) -> float:
    """Prepare the tests over the window; returns the gyro's turn in it (rad), NaN without a gyro."""
    for i in range(place.count):
        state.sums[i, 0], state.sums[i, 1] = state.window[i, 0], state.window[i, 1]
    _weigh(state, place, state.window_s, 0.5 * state.window_s * step * noise_m_s**2, mismatch)
    has_gyro = math.isfinite(state.mean_rate)
    return state.window_turn - state.bias * state.window_s if has_gyro else math.nan


@inner
def exclude(state: Record, place: Record, step: float, noise_m_s: float, mismatch: float) -> bool:
    """Exclude the mice that have been at fault in the window for long enough; whether there are any."""
    turn = _load_window(state, place, step, noise_m_s, mismatch)
    faulty, decisive = find_fault(state, place, trusted(state), state.window_s, turn)
    state.disagree_s = state.disagree_s + step if faulty else 0.0
    is_found = faulty != 0 and (decisive or state.disagree_s >= _UNDECIDED_S)
    state.suspected_s = state.suspected_s + step if is_found and faulty == state.suspects else step
    state.suspects = faulty if is_found else 0
    if not (is_found and state.suspected_s >= _LATE_S):
        return False
    state.distrusted |= faulty
    state.used &= ~faulty
    _forget_agreement(state, faulty)
    state.disagree_s = 0.0
    state.suspects = 0
    return True


@inner
def readmit(state: Record, place: Record, step: float, noise_m_s: float, mismatch: float) -> None:
    """Update the reference from the mice that agree, and readmit excluded mice that have agreed for long enough."""
    turn = _load_window(state, place, step, noise_m_s, mismatch)
    judges = trusted(state)
    if judges == 0:  # excluded mice that agree with each other and with the gyro are sound, and one that moves alone
        faulty, _ = find_fault(state, place, state.sound, state.window_s, turn)
        judges = state.sound & ~faulty
        for i in range(place.count):
            if judges == 1 << i and state.silent_s[i] > 0.0:
                judges = 0
    if judges == 0:
        _forget_agreement(state, state.distrusted)
        return
    _cost(state, place, judges, 0, state.window_s, turn)
    x, y, w = state.solution[0], state.solution[1], state.solution[2]
    if trusted(state):
        state.has_reference = True
        state.reference[0], state.reference[1], state.reference[2] = (
            x / state.window_s,
            y / state.window_s,
            w / state.window_s,
        )
    for i in range(place.count):
        if not state.distrusted & state.sound & 1 << i:
            continue
        off = misfit(place, i, x, y, w, state.sums[i, 0], state.sums[i, 1])
        if state.weight[i] * off > _AGREES:
            _forget_agreement(state, 1 << i)
            continue
        state.agreed_s[i] += step
        state.agreed_m[i] += step * math.sqrt(squared_speed(place, i, x, y, w)) / state.window_s
        if state.agreed_s[i] >= _AGREED_S and state.agreed_m[i] >= _AGREED_M:
            state.distrusted &= ~(1 << i)


@inner
def _forget_agreement(state: Record, mice: int) -> None:
    for i in range(MOST):
        if mice >> i & 1:
            state.agreed_s[i] = state.agreed_m[i] = 0.0
