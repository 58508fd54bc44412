"""One reading of the mice: motion of each mouse, fault tests, velocity by least squares.

Counts cover the time since the mice were last read. At high rates, or with slow mice, some samples carry no counts
(MICE_STALE); the next reading then covers several samples. Lost samples lose their counts: the reading after them
covers one usual interval only.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters._imu import LONGEST_STEP_S
from linkpose.filters.mice import faults
from linkpose.filters.mice.least_squares import ROUNDING, fit, squared_speed
from linkpose.filters.mice.plane import scaled, square, turned
from linkpose.filters.mice.state import Record, Records

NEAREST_M = 1e-3  # mice closer than this to one another show no rotation
# How long the last velocity stands in where no mouse can be used (s).
HOLD_S = 0.5
# Gyro bias: before any calibration (data sheet: ±20 °/s), and how well agreeing mice determine it (rad/s). Doubling
# the floor hides slow turns of a lifted robot; halving it mistakes the drift of the bias for a lift.
BIAS_STD, BIAS_FLOOR, _BIAS_MEMORY_S, _BIAS_RATE_HZ = 0.35, 0.01, 10.0, 10.0
# A gyro that gives one value, to the last bit, for this long (s) and so often is dead: the noise of a real one is half
# a count or more, which repeats a value so often once in 10^12. Doubled: a dead gyro turns the path for twice as long.
_DEAD_S, _DEAD_RATES = 0.4, 40
# A mouse that gives the same counts for so many readings is stuck, if another one has been silent for so long (s), or
# has changed its counts by so much in about the same time. Doubled: it spoils the path for twice as long.
_STUCK_REPEATS, _STUCK_SILENT_S, _STUCK_CHANGE, _VARYING_REPEATS = 50, 0.3, 12.0, 10
_STUCK_COUNTS = 2.0  # by which it differs from the motion of all. Doubled: slow stuck mice stay
# A mouse that exceeds the speed limit by this factor has none. Doubled distance to 1: a wrong limit stays for longer.
_NO_LIMIT = 1.15
_CHANGE_KEPT = 0.98  # of the changes, from reading to reading
# A mouse that reports at 25 to 80 Hz gives nothing between two reports. A reading without counts, where at least so
# many are expected, is taken for a missing report for up to so long (s); the next counts cover all of this time.
# Doubled: a lift is found 35 ms later; half: a mouse with 40 reports in a second is excluded.
_EXPECTED_COUNTS, _HELD_S = 3.0, 0.035
# A report covers a time that differs from whole steps by up to a step: σ of the counts of one step. Doubled: no visible
# change.
_UNTIMED = 0.4


@inner
def follow_gyro(state: Record, sample: Record) -> None:
    """Integrate the gyro's rate up to a sample, by the trapezoidal rule."""
    dt, rate = sample.time - state.sample_time, sample.rate
    if rate == state.last_rate:
        state.same_rates += 1
        state.same_s += dt
    else:
        state.same_rates, state.same_s, state.last_rate = 0, 0.0, rate
    if state.same_rates >= _DEAD_RATES and state.same_s >= _DEAD_S:
        rate = math.nan
    if sample.is_after_gap or dt > LONGEST_STEP_S:
        state.lost = True
    if math.isfinite(rate):
        if dt > 0.0:
            before = state.rate if math.isfinite(state.rate) else rate
            state.turned += 0.5 * (before + rate) * dt
            state.turned_s += dt
        state.rates += 1
    if not dt <= 0.0:
        state.sample_time = sample.time
    state.rate = rate


@inner
def read_counts(state: Record, mice: Records, sample: Record) -> None:
    """Motion of each mouse in b, and whether its counts cover this step."""
    has_counts = at_limit = held = 0
    for i in range(state.count):
        m = mice[i]
        moved = turned(m.axis, sample.counts[i])
        if math.isfinite(moved.real + moved.imag):
            has_counts |= 1 << i
            if _is_missing_report(state, m, moved):
                held |= 1 << i
                continue
            _spread_report(state, m, moved)
            if _is_at_limit(m, sample.counts[i]) or _is_too_fast(state, m):
                at_limit |= 1 << i
            _watch_repeats(m, sample.counts[i])
    # The first counts of a mouse that was away cover an unknown time.
    state.sound = has_counts & ~state.away & ~held
    state.held = held
    state.away = ~has_counts & ((1 << state.count) - 1)
    # A mouse at the limit of its counter or sensor counts too little: it is left out, or all are lower bounds.
    state.is_saturated = at_limit != 0 and state.sound & ~at_limit == 0
    if not state.is_saturated:
        state.sound &= ~at_limit
    _exclude_stuck(state, mice)
    state.used = state.sound & ~state.excluded
    if state.is_saturated and state.used == 0:  # lower bounds are better than nothing
        state.used = state.sound


@inner
def _is_missing_report(state: Record, m: Record, moved: complex) -> bool:
    """Whether a reading without counts lies between two reports of a mouse that moves."""
    if square(moved) > 0.0 or not state.interval > 0.0 or m.held_s + state.interval > _HELD_S:
        return False
    expected = state.interval * math.sqrt(squared_speed(m, state.velocity, state.turn_rate))
    if expected < _EXPECTED_COUNTS * m.metres_per_count:
        return False
    m.held_s += state.interval
    m.missing += 1
    return True


@inner
def _spread_report(state: Record, m: Record, moved: complex) -> None:
    """The counts after missing reports cover their time too: the motion of one interval is a share of it."""
    m.share = 1.0
    if m.held_s > 0.0 and square(moved) > 0.0:
        m.share = state.interval / (state.interval + m.held_s)
        m.held_s = 0.0
    m.moved = scaled(m.share, moved)
    m.reports += square(moved) > 0.0


@inner
def _is_at_limit(m: Record, counts: complex) -> bool:
    """Whether an axis shows the largest count of 8 or 9 bits for the second time in a row."""
    x, y, last = abs(counts.real), abs(counts.imag), m.counts
    along = (x == 127.0 or x == 128.0 or x == 255.0 or x == 256.0) and counts.real == last.real
    across = (y == 127.0 or y == 128.0 or y == 255.0 or y == 256.0) and counts.imag == last.imag
    return bool(along or across)


@inner
def _is_too_fast(state: Record, m: Record) -> bool:
    """Whether a mouse moves at the speed limit, if one has been found."""
    if not (state.speed_limit > 0.0 and state.interval > 0.0):
        return False
    speed = math.sqrt(square(m.moved)) / state.interval
    if speed > _NO_LIMIT * state.speed_limit:
        state.speed_limit = 0.0
    if state.window_s > 0.0:  # one step has the noise of its counts
        speed = max(speed, math.sqrt(square(m.window)) / state.window_s)
    return bool(speed > state.speed_limit > 0.0)


@inner
def _watch_repeats(m: Record, counts: complex) -> None:
    """How often a mouse has given the same counts, and by how much they have changed of late."""
    change = counts - m.counts
    m.repeats = m.repeats + 1 if square(change) == 0.0 else 0
    m.change = _CHANGE_KEPT * m.change + abs(change.real) + abs(change.imag)
    m.counts = counts


@inner
def _moves_as_expected(state: Record, m: Record) -> bool:
    """Whether a mouse repeats the counts of a robot at constant speed."""
    if not state.interval > 0.0:
        return False
    off = m.moved - scaled(state.interval, state.velocity + scaled(state.turn_rate, m.arm))
    return bool(square(off) < (_STUCK_COUNTS * m.metres_per_count) ** 2)


@inner
def _exclude_stuck(state: Record, mice: Records) -> None:
    """Exclude mice that repeat one count while another mouse rests or changes its counts."""
    for i in range(state.count):
        m = mice[i]
        if not (state.sound >> i & 1 and m.repeats >= _STUCK_REPEATS and square(m.counts) > 0.0):
            continue
        if _moves_as_expected(state, m):
            continue
        for k in range(state.count):
            other = mice[k]
            varies = other.change > _STUCK_CHANGE and other.repeats < _VARYING_REPEATS
            is_apart = other.silent_s >= _STUCK_SILENT_S or varies
            if k != i and state.sound >> k & 1 and is_apart:
                state.excluded |= 1 << i
                state.sound &= ~(1 << i)
                m.agreed_s = m.agreed_m = 0.0
                break


@inner
def begin_step(state: Record, time_s: float) -> bool:
    """Time since the last reading, as `step` and `missed`; False at the first reading and where time does not go on."""
    dt = time_s - state.time
    if not dt > 0.0:
        if math.isnan(state.time):
            state.time = time_s
        else:
            state.rejected += 1
        return False
    if not state.lost:
        state.interval = dt
    state.lost = False
    state.time = time_s
    state.mean_rate = state.turned / state.turned_s if state.turned_s > 0.0 else math.nan
    state.step = 0.0 if math.isnan(state.interval) else min(state.interval, dt)
    state.missed = dt - state.step
    return True


@inner
def end_step(state: Record) -> None:
    """Begin to integrate the gyro for the next step."""
    state.turned = state.turned_s = 0.0
    state.rates = 0


@inner
def variance(m: Record, step: float, speed2: float, scatter: float, noise_m_s: float) -> float:
    """σ_i² of one mouse's velocity over a step ((m/s)²). Reports that cover several steps are not in time with them."""
    count: float = m.metres_per_count / step
    share = scatter if m.share == 1.0 else _UNTIMED * m.share
    return ROUNDING * count * count + share * share * speed2 + noise_m_s * noise_m_s


@inner
def _fuse(state: Record, mice: Records, p: Record) -> bool:
    """(11), (12) for one step: velocity and its standard deviation. False where the mice in use do not determine it."""
    per_s = 1.0 / state.step
    for i in range(state.count):
        m = mice[i]
        m.sum = scaled(per_s, m.moved)
        speed2 = squared_speed(m, state.velocity, state.turn_rate)
        m.weight = 1.0 / variance(m, state.step, speed2, p.scatter, p.noise_m_s)
    if not fit(state, mice, state.used, 0.0, 0j, 0.0, 0.0) > NEAREST_M * NEAREST_M:
        if not (state.used and math.isfinite(state.mean_rate)):
            return False
        fit(state, mice, state.used, 0.0, 0j, 1.0 / state.bias_std**2, state.mean_rate - state.bias)
    state.velocity, state.turn_rate = state.fit, state.fit_turn
    common = p.floor * p.floor * square(state.fit)
    state.x_std = math.sqrt(state.fit_x_variance + common)
    state.y_std = math.sqrt(state.fit_y_variance + common)
    state.turn_std = math.sqrt(state.fit_turn_variance)
    return True


@inner
def _fill_window(state: Record, mice: Records) -> None:
    """Add the step to the window. A mouse without counts moves there as the others do: its return is no fault."""
    step = state.step
    keep = math.exp(-(step + state.missed) / faults.WINDOW_S)
    for i in range(state.count):
        m = mice[i]
        if not state.sound >> i & 1:
            m.moved = scaled(step, state.velocity + scaled(state.turn_rate, m.arm))
        m.silent_s = m.silent_s + step if square(m.moved) == 0.0 else 0.0
        m.window = scaled(keep, m.window) + m.moved
    rate = state.mean_rate if math.isfinite(state.mean_rate) else state.turn_rate + state.bias
    state.window_s = keep * state.window_s + step
    state.window_turn = keep * state.window_turn + rate * step


@inner
def _watch_turns(state: Record, mice: Records) -> None:
    """Add the step to the sums that show where each mouse sits."""
    if state.sound != (1 << state.count) - 1 or not math.isfinite(state.mean_rate):
        return
    turn = state.mean_rate * state.step
    state.turns += 1.0
    state.turns_sum += turn
    state.turns_squared += turn * turn
    for i in range(state.count):
        m = mice[i]
        m.way += scaled(m.share, m.counts)
        m.way_by_turn += scaled(turn * m.share, m.counts)


@inner
def _compare_excluded(state: Record, mice: Records) -> None:
    """Add the motion of each excluded mouse, and the motion that the others show at its place, to its sums."""
    for i in range(state.count):
        if state.excluded & state.sound & 1 << i:
            m = mice[i]
            _compare(m.while_excluded, m.moved, scaled(state.step, state.velocity + scaled(state.turn_rate, m.arm)))


@inner
def _compare_with_gyro(state: Record, mice: Records) -> None:
    """Add the motions of the mice relative to their mean, and those that the gyro's turn implies, to the sums."""
    share, moved, arm = 1.0 / max(faults.number(state.sound), 1), 0j, 0j
    for i in range(state.count):
        if state.sound >> i & 1:
            moved += scaled(share, mice[i].moved)
            arm += scaled(share, mice[i].arm)
    turn = (state.mean_rate - state.bias) * state.step
    for i in range(state.count):
        if state.sound >> i & 1:
            _compare(state.while_excluded, mice[i].moved - moved, scaled(turn, mice[i].arm - arm))


@inner
def _compare(sums: Record, shown: complex, expected: complex) -> None:
    sums.by_others += square(expected)
    if square(shown) == 0.0:
        sums.without_counts += square(expected)
    sums.by_others_double += turned(expected, expected)
    sums.direct += turned(shown, complex(expected.real, -expected.imag))
    sums.mirrored += turned(shown, expected)


@inner
def _learn_bias(state: Record) -> None:
    """Gyro bias from mice that agree: the mean of gyro minus mice over the last ten seconds."""
    if faults.number(faults.trusted(state)) < 2 or not math.isfinite(state.mean_rate):
        return
    state.bias_s = min(state.bias_s + state.step, _BIAS_MEMORY_S)
    off = state.window_turn / state.window_s - state.reference_rate - state.bias
    state.bias += off * state.step / state.bias_s
    state.bias_std = BIAS_STD / (1.0 + _BIAS_RATE_HZ * state.bias_s) + BIAS_FLOOR


@inner
def correct(state: Record, mice: Records, p: Record, finds_bias: bool) -> bool:
    """Velocity from the counts that cover the last step; False where they do not determine it."""
    is_gap = state.missed > 0.0
    if not (is_gap or state.is_saturated):
        faults.skip_late(state, mice, p.noise_m_s, p.mismatch)
    if not state.step > 0.0:
        return False
    if not (is_gap or state.is_saturated):
        _watch_turns(state, mice)
    is_known = _fuse(state, mice, p)
    if not is_known and math.isfinite(state.mean_rate):
        state.turn_rate = state.mean_rate - state.bias
    _fill_window(state, mice)
    if is_gap and is_known:  # the velocity before a gap carries little information on the velocity after it
        state.reference, state.reference_rate = state.velocity, state.turn_rate
    if state.is_saturated:
        return is_known
    if faults.exclude(state, mice, p.noise_m_s, p.mismatch):
        is_known = _fuse(state, mice, p)
    if state.disagree_s == 0.0:
        faults.readmit(state, mice, p.noise_m_s, p.mismatch)
        if finds_bias and is_known:
            _learn_bias(state)
    if state.excluded and state.used:
        _compare_excluded(state, mice)
    elif state.excluded and math.isfinite(state.mean_rate):
        _compare_with_gyro(state, mice)
    return is_known
