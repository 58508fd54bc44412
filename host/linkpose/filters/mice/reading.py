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
from linkpose.filters.mice.least_squares import ROUNDING, add_mouse, clear, solve, squared_speed
from linkpose.filters.mice.state import Floats, Record
from linkpose.wire.messages import SampleFlags

NEAREST_M = 1e-3  # mice closer than this to one another show no rotation

_GAP_BEFORE = int(SampleFlags.GAP_BEFORE)
STALE = int(SampleFlags.MICE_STALE)
_OVERFLOW = int(SampleFlags.MOUSE1_OVERFLOW)  # for mouse i, shifted left by i

# How long the last velocity stands in where no mouse can be used (s).
HOLD_S = 0.5
# Gyro bias: before any calibration (data sheet: ±20 °/s), and how well agreeing mice determine it (rad/s). Doubling
# the floor hides slow turns of a lifted robot; halving it mistakes the drift of the bias for a lift.
BIAS_STD, BIAS_FLOOR, _BIAS_MEMORY_S, _BIAS_RATE_HZ = 0.35, 0.01, 10.0, 10.0


@inner
def follow_gyro(state: Record, time_s: float, rate: float, flags: int) -> None:
    """Integrate the gyro's rate (rad/s, NaN without one) up to a sample, by the trapezoidal rule."""
    dt = time_s - state.sample_time
    if flags & _GAP_BEFORE or dt > LONGEST_STEP_S:
        state.lost = True
    if math.isfinite(rate):
        if dt > 0.0:
            before = state.rate if math.isfinite(state.rate) else rate
            state.turned += 0.5 * (before + rate) * dt
            state.turned_s += dt
        state.rates += 1
    if not dt <= 0.0:
        state.sample_time = time_s
    state.rate = rate


@inner
def read_counts(state: Record, place: Record, counts: Floats, flags: int) -> None:
    """Motion of each mouse in b, and whether its counts cover this step."""
    has_counts = 0
    for i in range(place.count):
        if i < counts.shape[0] and not flags & (_OVERFLOW << i):
            x, y = counts[i, 0] * place.metres_per_count[i], counts[i, 1] * place.metres_per_count[i]
            has_counts |= int(math.isfinite(x + y)) << i
            c, s = place.axes[i, 0], place.axes[i, 1]
            state.moved[i, 0], state.moved[i, 1] = c * x - s * y, s * x + c * y
    # The first counts of a mouse that was away cover an unknown time.
    state.sound = has_counts & ~state.away
    state.away = ~has_counts & ((1 << place.count) - 1)
    state.used = state.sound & ~state.distrusted


@inner
def begin_step(state: Record, time_s: float) -> tuple[float, float]:
    """Time since the last reading and the part of it that the counts cover (s); 0 and 0 at the first reading."""
    dt = time_s - state.time
    if not dt > 0.0:
        if math.isnan(state.time):
            state.time = time_s
        else:
            state.rejected += 1
        return 0.0, 0.0
    if not state.lost:
        state.interval = dt
    state.lost = False
    state.time = time_s
    state.mean_rate = state.turned / state.turned_s if state.turned_s > 0.0 else math.nan
    return dt, 0.0 if math.isnan(state.interval) else min(state.interval, dt)


@inner
def end_step(state: Record) -> None:
    """Begin to integrate the gyro for the next step."""
    state.turned = state.turned_s = 0.0
    state.rates = 0


@inner
def variance(place: Record, i: int, step: float, speed2: float, scatter: float, noise_m_s: float) -> float:
    """σ_i² of one mouse's velocity over a step ((m/s)²)."""
    count = place.metres_per_count[i] / step
    return float(ROUNDING * count * count + scatter * scatter * speed2 + noise_m_s * noise_m_s)


@inner
def fuse(state: Record, place: Record, p: Record, step: float) -> bool:
    """(11), (12) for one step: velocity and its standard deviation. False where the mice in use do not determine it."""
    vx, vy, w = state.velocity[0], state.velocity[1], state.velocity[2]
    clear(state)
    for i in range(place.count):
        if state.used >> i & 1:
            speed2 = squared_speed(place, i, vx, vy, w)
            weight = 1.0 / variance(place, i, step, speed2, p.scatter, p.noise_m_s)
            add_mouse(state, place, i, weight, state.moved[i, 0] / step, state.moved[i, 1] / step)
    n = state.normal
    by_gyro = 0.0
    # The weighted spread of the positions about their mean: 0 where A has not rank 3.
    if not (n[0] > 0.0 and n[3] - (n[1] * n[1] + n[2] * n[2]) / n[0] > n[0] * NEAREST_M * NEAREST_M):
        if not (n[0] > 0.0 and math.isfinite(state.mean_rate)):
            return False
        by_gyro = 1.0 / state.bias_std**2
        state.right[2] += by_gyro * (state.mean_rate - state.bias)
    solve(state, 0.0, by_gyro)
    common = p.floor * p.floor * (state.solution[0] ** 2 + state.solution[1] ** 2)
    for j in range(3):
        state.velocity[j] = state.solution[j]
        state.std[j] = math.sqrt(state.variance[j] + (common if j < 2 else 0.0))
    return True


@inner
def fill_window(state: Record, place: Record, dt: float, step: float) -> None:
    """Add the step to the window. A mouse without counts moves there as the others do: its return is no fault."""
    keep = math.exp(-dt / faults.WINDOW_S)
    vx, vy, w = state.velocity[0], state.velocity[1], state.velocity[2]
    for i in range(place.count):
        if not state.sound >> i & 1:
            state.moved[i, 0] = (vx - w * place.position[i, 1]) * step
            state.moved[i, 1] = (vy + w * place.position[i, 0]) * step
        is_silent = state.moved[i, 0] == 0.0 and state.moved[i, 1] == 0.0
        state.silent_s[i] = state.silent_s[i] + step if is_silent else 0.0
        for j in range(2):
            state.window[i, j] = keep * state.window[i, j] + state.moved[i, j]
    rate = state.mean_rate if math.isfinite(state.mean_rate) else w + state.bias
    state.window_s = keep * state.window_s + step
    state.window_turn = keep * state.window_turn + rate * step


@inner
def learn_bias(state: Record, step: float) -> None:
    """Gyro bias from mice that agree: the mean of gyro minus mice over the last ten seconds."""
    if faults.number(faults.trusted(state)) < 2 or not math.isfinite(state.mean_rate):
        return
    state.bias_s = min(state.bias_s + step, _BIAS_MEMORY_S)
    off = state.window_turn / state.window_s - state.reference[2] - state.bias
    state.bias += off * step / state.bias_s
    state.bias_std = BIAS_STD / (1.0 + _BIAS_RATE_HZ * state.bias_s) + BIAS_FLOOR


@inner
def correct(state: Record, place: Record, p: Record, dt: float, step: float, learns: bool) -> bool:
    """Velocity from the counts that cover the last `step` of `dt` (s); False where they do not determine it."""
    if dt == step:
        faults.skip_late(state, place, step, p.noise_m_s, p.mismatch)
    if not step > 0.0:
        return False
    is_known = fuse(state, place, p, step)
    if not is_known and math.isfinite(state.mean_rate):
        state.velocity[2] = state.mean_rate - state.bias
    fill_window(state, place, dt, step)
    if dt > step and is_known:  # a gap: the velocity before it says little of the velocity now
        for j in range(3):
            state.reference[j] = state.velocity[j]
    if faults.exclude(state, place, step, p.noise_m_s, p.mismatch):
        is_known = fuse(state, place, p, step)
    if state.disagree_s == 0.0:
        faults.readmit(state, place, step, p.noise_m_s, p.mismatch)
        if learns and is_known:
            learn_bias(state, step)
    return is_known
