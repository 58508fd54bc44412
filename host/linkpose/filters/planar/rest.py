"""Zero-rate updates: while the robot rests, the gyro shows its bias and its noise.

A rest is a time without a count of any mouse, in which the gyro stays near the assumed bias and does not change. The
robot starts to turn before the first count, and stops after the last one; the gyro's rates are therefore collected in
short blocks, and a block counts only when the rest still lasts some blocks later. A lifted robot that is turned has
silent mice too; the gyro guards against it.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters.mice.state import Record
from linkpose.filters.planar.gyro import explains, refute_jump, take_other_pose
from linkpose.filters.planar.measure import update
from linkpose.filters.planar.state import BIAS, HEADING, QUEUE

_BLOCK_S = 0.1  # one block (s)
# Silence before a rest is assumed (s): a count every 0.3 s is 0.4 mm/s. Doubled: short rests are missed.
_REST_S = 0.3
# A rate that a silent robot's gyro shows for so long (s), constant within its noise, is a new bias: nobody turns a
# lifted robot so steadily. Doubled: a bias that has jumped is found later.
_NEW_BIAS_S = 2.0
# A larger rate is a turn: the data sheet's bias is within ±20 °/s, and drifts with the temperature. Doubled: where the
# bias is not known, a turn about a mouse, which sees nothing of it, passes for the bias.
_LARGEST_RAD_S = 0.45
_UNSEEN_S = 10.0  # for at most so long a jump of the bias stays unnoticed while the robot moves (s)
_DRIFTED_Z = 5.0  # a change of the bias by more standard deviations is a drift. Doubled: small jumps stay unnoticed
# A bias that changes with the temperature: between two rests at least so far apart (s), by more standard deviations
# than this. The last interval has this weight in the drift. Doubled: an interval without a drift ends it.
_DRIFT_S, _DRIFT_Z, _DRIFT_NEW = 3.0, 2.0, 0.5
_GUARD_Z = 5.0  # standard normal quantile of the guards
# A block that differs from those after it by so many σ is dropped: the robot came to rest in it, by turning less than a
# count. Doubled: the bias takes up part of such a turn.
_SETTLING_Z = 2.5
# The gyro's noise may be three times the assumed one: the data sheet gives 0.05 °/s, real sensors reach 0.13 °/s.
_NOISE_MARGIN = 9.0


@inner
def watch_rest(state: Record, is_silent: bool, rate: float, step: float, time_s: float) -> None:
    """Take one reading into account: `is_silent` when no mouse counted, `rate` (rad/s) the gyro's, NaN without one."""
    state.since_rest_s += step
    state.rested_s += step
    if not is_silent:
        _end_rest(state)
        return
    if state.at_rest and math.isfinite(rate) and _contradicts(state, rate):
        _end_rest(state)
    state.rest_s += step
    if math.isfinite(rate):
        state.block_s += step
        state.block_sum += rate
        state.block_squares += rate * rate
        state.block_count += 1
        if state.block_s >= _BLOCK_S - 1e-9 and not _finish_block(state, time_s):
            _end_rest(state)
            return
    state.at_rest = state.rest_s >= _REST_S - 1e-9 and (state.queued > 0 or not math.isfinite(rate))


@inner
def _contradicts(state: Record, rate: float) -> bool:
    """Whether one rate (rad/s) shows that the robot turns."""
    limit2 = state.covariance[BIAS, BIAS] + _NOISE_MARGIN * state.gyro_variance
    return bool((rate - state.at.bias) ** 2 > _GUARD_Z**2 * limit2)


@inner
def _end_rest(state: Record) -> None:
    """The robot has begun to turn, perhaps up to QUEUE blocks ago: in this time, the gyro shows the turn."""
    if state.at_rest:
        _learn_drift(state)
        turn, span, count = state.block_sum, state.block_s, state.block_count
        turn = turn * span / count if count > 0 else 0.0
        variance = span * span / count if count > 0 else 0.0
        for k in range(max(0, state.queued - state.queued_at_rest), state.queued):
            block = state.queue[k]
            turn += block.mean * _BLOCK_S
            variance += _BLOCK_S * _BLOCK_S / block.count
            span += _BLOCK_S
        _turn_by_gyro(state, turn, span, state.gyro_variance * variance)
    state.rest_s = state.block_s = state.block_sum = state.block_squares = 0.0
    state.block_count = state.queued = state.queued_at_rest = 0
    state.at_rest = False


@inner
def _turn_by_gyro(state: Record, turn: float, span: float, variance: float) -> None:
    """Turn the heading by a turn of the gyro (rad, its bias included, with its variance) over the time `span` (s)."""
    p = state.covariance
    state.at.heading += turn - state.at.bias * span
    state.dispute.heading += turn - state.at.bias * span
    for k in range(state.size):  # F P
        p[HEADING, k] -= span * p[BIAS, k]
    for k in range(state.size):  # (F P) Fᵀ
        p[k, HEADING] -= span * p[k, BIAS]
    p[HEADING, HEADING] += variance


@inner
def _finish_block(state: Record, time_s: float) -> bool:
    """Append the current block to the queue; False where the gyro contradicts a rest."""
    count = state.block_count
    mean = state.block_sum / count
    noise = _NOISE_MARGIN * state.gyro_variance / count
    limit = _GUARD_Z * math.sqrt(state.covariance[BIAS, BIAS] + noise)
    if abs(mean) > _LARGEST_RAD_S:
        return False
    if abs(mean - state.at.bias) > limit and not _is_new_bias(state, mean, noise, time_s):
        return False
    if state.queued:
        last = state.queue[state.queued - 1]
        if abs(mean - last.mean) > _GUARD_Z * math.sqrt(2.0 * noise):
            return False
    if state.queued == QUEUE:
        if not _is_settling(state):
            _use_oldest(state)
        _drop_oldest(state)
    block = state.queue[state.queued]
    block.mean, block.count = mean, count
    block.squares = max(0.0, state.block_squares - count * mean * mean)
    state.queued += 1
    state.queued_at_rest += state.at_rest
    state.block_s = state.block_sum = state.block_squares = 0.0
    state.block_count = 0
    return True


@inner
def _is_new_bias(state: Record, mean: float, noise: float, time_s: float) -> bool:
    """Whether the rate that contradicts a rest has stayed the same for long: the bias has jumped."""
    is_same = abs(mean - state.strange) <= _GUARD_Z * math.sqrt(2.0 * noise)
    is_same = is_same and abs(mean - state.at.bias) < _LARGEST_RAD_S
    state.strange_s = state.strange_s + _BLOCK_S if is_same else 0.0
    if not is_same:
        state.strange = mean
    if state.strange_s < _NEW_BIAS_S:
        return False
    jump = mean - state.at.bias
    state.covariance[BIAS, BIAS] += jump * jump
    if explains(state, jump):  # the pose by the mice has not turned with the new bias
        take_other_pose(state)
    else:
        state.at.heading -= jump * state.rest_s
    _widen_heading(state, jump)
    state.strange_s = 0.0
    state.jumps += 1
    state.jump, state.jump_time = jump, time_s
    return True


@inner
def _widen_heading(state: Record, jump: float) -> None:
    """The bias has changed by `jump` (rad/s) at an unknown time since the last rest."""
    since = min(state.since_rest_s, _UNSEEN_S)
    state.covariance[HEADING, HEADING] += (jump * since) ** 2
    state.since_rest_s = 0.0


@inner
def _is_settling(state: Record) -> bool:
    """Whether the rate of the oldest block differs from that of the blocks after it."""
    first, total, count = state.queue[0], 0.0, 0.0
    for k in range(1, state.queued):
        total += state.queue[k].mean * state.queue[k].count
        count += state.queue[k].count
    variance = state.gyro_variance * (1.0 / first.count + 1.0 / count)
    return bool((first.mean - total / count) ** 2 > _SETTLING_Z**2 * variance)


@inner
def _drop_oldest(state: Record) -> None:
    for k in range(1, QUEUE):
        to, block = state.queue[k - 1], state.queue[k]
        to.mean, to.count, to.squares = block.mean, block.count, block.squares
    state.queued -= 1


@inner
def _learn_drift(state: Record) -> None:
    """Rate of the bias's drift (its square) from the change of the bias since the end of the last rest."""
    variance = state.covariance[BIAS, BIAS]
    if state.rested_s > _DRIFT_S:
        off2 = (state.at.bias - state.rested_bias) ** 2
        is_drift = state.rested_variance > 0.0 and off2 > _DRIFT_Z**2 * (variance + state.rested_variance)
        shown = off2 / (state.rested_s * state.rested_s) if is_drift else 0.0
        unknown = max(0.0, shown - state.drift2)  # the heading since then has turned by a drift that σ did not include
        state.covariance[HEADING, HEADING] += 0.25 * unknown * state.rested_s**4
        state.drift2 += _DRIFT_NEW * (shown - state.drift2)
    state.rested_s, state.rested_bias, state.rested_variance = 0.0, state.at.bias, variance


@inner
def _use_oldest(state: Record) -> None:
    """Update bias and noise with the oldest block. ω was 0 then, so its rate is b."""
    block, known = state.queue[0], state.gyro_samples
    more = block.count - 1.0
    state.gyro_samples = min(known + more, 1000.0)
    state.gyro_variance = (known * state.gyro_variance + block.squares) / (known + more)
    state.rows = 1
    off = state.residual[0] = block.mean - state.at.bias
    variance = state.covariance[BIAS, BIAS] + state.gyro_variance / block.count
    if off * off > _DRIFTED_Z**2 * variance:  # the bias has drifted by more than assumed
        state.covariance[BIAS, BIAS] += off * off
        if explains(state, off):
            take_other_pose(state)
            state.since_rest_s = _BLOCK_S
        _widen_heading(state, off)
        variance += off * off
    else:
        refute_jump(state)
    state.innovation[0, 0] = variance
    for k in range(state.size):
        state.cross[0, k] = state.covariance[BIAS, k]
    update(state, math.inf, math.inf, True)
    state.since_rest_s = 0.0
