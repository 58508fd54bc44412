"""The gyro against the mice: a jump of its bias under way, or a dead gyro.

Two or more mice show the turn without the gyro. Where they turn by another amount, either the gyro's bias has jumped,
or all mice slip, are lifted, or are on another floor. Both hypotheses run until the data decide: the filter follows the
gyro, and a second pose follows the mice alone from the last agreement on. Until the decision, the distance between the
two poses is part of the stated standard deviation.

A jump adds the same rate whatever the robot does. Mice that slip, or saturate, or have another scale or angle than
assumed, err in proportion to the turn, with one share to the left and one to the right, or to the way, where the share
of a mouse whose scale drifts grows with time. Mice that lose counts at low speed lose about one rate while they turn.
The residuals of both models, fitted to blocks of 0.2 s since the last agreement, decide as soon as the motion of the
robot has changed.

Source of the change detection: E. S. Page, "Continuous inspection schemes", Biometrika 41 (1954).
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters.mice import reading
from linkpose.filters.mice.faults import number, trusted
from linkpose.filters.mice.least_squares import ROUNDING, fit, squared_speed
from linkpose.filters.mice.plane import dot, scaled, square, turned, turned_mean, unit
from linkpose.filters.mice.state import NOBODY, Record, Records
from linkpose.filters.planar.state import ANGLE, BIAS, CAUSES, HEADING, MICE, OF_MOUSE, SCALE, VX, VY, WZ, X, Y

_BLOCK_S = 0.2  # one comparison (s). Doubled: a jump is found 0.2 s later, and half as large.
# Cumulative sums of the difference over its σ, less this much per block; beyond the second number, the models are
# compared. Twice the first: jumps below 0.3 °/s pass. Twice the second: a jump is found some blocks later.
_SUM_DRIFT, _SUM_LIMIT, _SUM_MOST = 0.75, 5.0, 15.0
# Gyro and mice may differ by this share of the turn (1σ): scale of the gyro, positions of the mice. Doubled: a jump is
# found on straights only.
_SHARE = 0.03
# A jump: this many σ; a fit that is better than the other one by this much (−2 log of the ratio of likelihoods), with
# χ² per block below the third number; no larger than the fourth (rad/s, the data sheet's ±20 °/s). Doubled: later.
_JUMP_Z, _BETTER, _MOST_CHI2, _MOST_RAD_S = 5.0, 14.0, 3.0, 0.35
_SUM_CALIBRATED = 2.0  # beyond it, the mice are not calibrated. Doubled: a jump spoils the calibration
# Blocks before a verdict: mice slip as long as a robot accelerates, up to a second. Halved: that passes for a jump.
_FEWEST_BLOCKS = 8
# Mice that agree again (|z| below the second number) in so many blocks, in which a jump would show by so many σ, end
# the dispute. Doubled: σ stays large for longer after a lift.
_CALM_BLOCKS, _CALM_Z, _SHOWS_Z = 4, 1.5, 4.0
# Blocks after which hypotheses that both fit badly are dropped (10 s): neither a jump nor a slip.
_PATIENCE_BLOCKS = 50
# Errors of the mice (all 1σ): the share of each motion that they lose, to either side; the rate that they lose while
# they turn (rad/s); the turn that they show per way of the robot (rad/m), and by how much that grows in a second
# (rad/m/s). Of two mice 0.2 m apart, one that is turned by 10° shows 0.9 rad/m, one that is turned by 90° 5 rad/m, and
# one that loses 20 % of its scale in a minute 0.017 rad/m more each second. On a carpet, mice 0.14 m from the centre
# that lost half of their counts at 5 cm/s and none from 25 cm/s on lost 0.24 rad/s in slow and in fast turns. Without
# any one of these, such mice passed for jumps of the gyro, and the heading was lost. Doubled: no change; a jump is
# found once the speed or the turn has changed.
_LOST_STD = 0.25
_CAUSE_STD = (_LOST_STD, _LOST_STD, 0.1, 5.0, 0.03)
# Mice whose resolution has changed show the same share of the gyro's turn in two turns in a row: each of at least so
# much turning (rad²/s), equal within the second number, off by more than the third. A turn ends below the fourth
# (rad/s). Doubled second: two slips in a row pass for a resolution. Its σ is the last number.
_RESOLVED_TURN, _RESOLVED_EQUAL, _RESOLVED_OFF, _STRAIGHT_RAD_S, _RESOLVED_STD = 0.3, 0.02, 0.2, 0.1, 0.01
# A share that only turns have shown is corrected by this part on straights, less for shares beyond the second number
# (1σ): floors differ by some percent, and mice that lose a fifth in turns slip or lose the surface there. Robots go two
# to three times as far on straights as in turns: with a half, a slip in turns that was corrected on straights is as bad
# as one that was not. Doubled second: a slip of 20 % in turns makes the path worse than without a correction.
_ON_STRAIGHTS, _FLOORS_STD = 0.38, 0.1
# On a straight, the velocity has jumped to this share, within so much of it: the resolution has changed there. Doubled:
# a collision before a slip in turns may pass for another resolution.
_JUMPED_EQUAL = 0.1
_RESOLVED_LEAST = 0.15  # a smaller share: mice that are lifted or mounted the other way round show no jump of the gyro
# A mouse that a jump of the gyro has excluded differs from the expected motion by less than this share, and velocity
# (m/s). Doubled: with two mice, one that slips passes for a jump of the gyro.
_NEARLY_SHARE, _NEARLY_M_S = 0.15, 0.02
_SILENT_S = 0.05  # a mouse without a count for so long does not move (s)
_JUMP_SHARE = 0.03  # of a jump of the bias: its σ beyond that of the fit
_REPAIR_SHARE = 0.3  # of a correction of the heading or the position: its σ


@inner
def watch_gyro(state: Record, m: Record, mice: Records, p: Record) -> int:
    """Compare gyro and mice over the last step; correct bias and pose after a jump, the heading after a dead gyro.

    Returns 1 where `m.fit` and `m.fit_turn` are the motion by the mice alone, 0 where they rest, −1 without one.
    """
    if not m.step > 0.0:
        return -1
    motion = _motion_by_mice(state, m, mice, p)
    if motion < 0 or m.missed > 0.0 or m.is_saturated:
        if state.dispute.up == 0.0 and state.dispute.down == 0.0:
            agree(state)  # the update of the bias at a rest corrects the heading of the past in one pose only
        else:
            _advance_other(state, complex(state.at.vx, state.at.vy), state.at.wz, m.step + m.missed)
        return -1
    _watch_dead_gyro(state, m, motion)
    turn_rate = m.fit_turn if motion else 0.0
    _advance_other(state, m.fit if motion else 0j, turn_rate, m.step)
    if math.isfinite(m.mean_rate):
        _watch_resolution(state, m, turn_rate)
        _add_step(state, m, mice, turn_rate, motion)
    return motion


@inner
def _motion_by_mice(state: Record, m: Record, mice: Records, p: Record) -> int:
    """Velocity and turn rate of the last step by the mice alone into `m.fit…`: 1; 0 where they rest; −1 without one.

    Where fewer than two mice are trusted, excluded ones count too: a wrong gyro makes the fault tests exclude sound
    mice.
    """
    counting, judges = NOBODY, trusted(m)
    if number(judges) < 2:
        judges = judges | _nearly_sound(state, m, mice)
    if number(judges) < 2:
        return -1
    if judges != state.dispute.judges:  # a fault has been found or is over: compare anew
        state.dispute.judges = judges
        _forget(state.dispute)
    for i in range(m.count):
        if judges >> i & 1 and mice[i].silent_s < _SILENT_S:
            counting |= 1 << i
    if counting == NOBODY:
        return 0
    if counting != judges:
        return -1
    velocity, turn_rate = complex(state.at.vx, state.at.vy), state.at.wz
    for i in range(m.count):
        if counting >> i & 1:
            mouse = mice[i]
            mouse.sum = scaled(1.0 / m.step, mouse.moved)
            speed2 = squared_speed(mouse, velocity, turn_rate)
            mouse.weight = 1.0 / reading.variance(mouse, m.step, speed2, p.scatter, p.noise_m_s)
    if not fit(m, mice, counting, 0.0, 0j, 0.0, 0.0) > reading.NEAREST_M**2:
        return -1
    _add_gradient(state, m, mice, counting)
    return 1


@inner
def _nearly_sound(state: Record, m: Record, mice: Records) -> int:
    """All mice; of two, the excluded one only where its motion differs no more than a jump of the gyro explains."""
    everybody: int = m.sound
    nearly: int = trusted(m)
    if nearly == NOBODY or number(everybody) > 2:
        return everybody
    velocity, turn_rate = complex(state.at.vx, state.at.vy), state.at.wz
    for i in range(m.count):
        if everybody >> i & 1:
            expected = velocity + scaled(turn_rate, mice[i].arm)
            off2 = square(scaled(1.0 / m.step, mice[i].moved) - expected)
            if off2 < _NEARLY_SHARE**2 * square(expected) + _NEARLY_M_S**2:
                nearly |= 1 << i
    return nearly


@inner
def _watch_resolution(state: Record, m: Record, by_mice: float) -> None:
    """Find another resolution of all mice, by the share of the gyro's turn that they show; `by_mice` is their rate."""
    seen, by_gyro = state.resolution, m.mean_rate - state.at.bias
    if not is_turning(state, m):
        if seen.square > _RESOLVED_TURN:
            _end_turn(state, m, seen.product / seen.square)
        seen.square = seen.product = 0.0
    seen.square += by_gyro * by_gyro * m.step
    seen.product += by_gyro * by_mice * m.step


@inner
def _end_turn(state: Record, m: Record, share: float) -> None:
    """A turn has ended, of which the mice have shown this share. Two wrong ones in a row are no lift or slip."""
    seen, position = state.resolution, complex(state.at.x, state.at.y)
    is_wrong, was_wrong = abs(share - 1.0) > _RESOLVED_OFF, abs(seen.share - 1.0) > _RESOLVED_OFF
    if is_wrong and share > _RESOLVED_LEAST and abs(share - seen.share) < _RESOLVED_EQUAL * share:
        _accept_resolution(state, m, share)
        seen.share = 1.0
        return
    if is_wrong and was_wrong:  # exchanged or reversed axes, wrong angles
        widen_way(state, min(abs(1.0 - share), 2.0), position - seen.start)
    if was_wrong or not is_wrong:
        seen.start = position
    seen.share = share


@inner
def _accept_resolution(state: Record, m: Record, share: float) -> None:
    """All mice count `share` times as much as before, from a time on since the last turn in which they did not."""
    accept_share(state, share, _RESOLVED_STD)
    position = complex(state.at.x, state.at.y)
    widen_way(state, 1.0 / share - 1.0, position - state.resolution.start)
    state.resolution.start = position
    m.excluded = NOBODY
    state.resolution.changes += 1
    state.resolution.factor, state.resolution.time = share, m.time
    restart_turns(state)
    agree(state)


@inner
def accept_share(state: Record, share: float, std: float) -> float:
    """All mice show `share` times as much of the gyro's turns as their scale explains, with this σ of the share.

    Either they count so much more everywhere (another floor, another resolution), or only in turns (they slip, or lose
    the surface as it turns under them). Turns do not tell which. In turns, the whole share is corrected; on straights,
    a part, so that neither cause makes the path worse than without a correction, with half the difference as σ. Where
    the velocity has jumped to this share on a straight, it is corrected there too. Returns the share on straights.
    """
    before = state.turn_factor
    shown = share * shown_in_turns(state)
    widen_way(state, state.straight_std, state.straight_way)
    state.straight_way = 0j
    if not abs(state.jumped_to - share) < _JUMPED_EQUAL * share:
        part = _ON_STRAIGHTS * math.exp(-0.5 * ((shown - 1.0) / _FLOORS_STD) ** 2)
        on_straights = 1.0 + part * (shown - 1.0)
        state.turn_factor = shown / on_straights
        state.straight_std = 0.5 * abs(shown - 1.0) / on_straights
    corrected = float(share * before / state.turn_factor)
    for a in range(MICE + SCALE, state.size, OF_MOUSE):
        state.mean[a] -= math.log(corrected)
        for b in range(MICE + SCALE, state.size, OF_MOUSE):
            state.covariance[a, b] += std * std
    return corrected


@inner
def shown_in_turns(state: Record) -> float:
    """Counts per metre of all mice in turns, relative to the rig's."""
    total, count = 0.0, 0.0
    for a in range(MICE + SCALE, state.size, OF_MOUSE):
        total += state.mean[a]
        count += 1.0
    return float(state.turn_factor * math.exp(-total / count))


@inner
def is_turning(state: Record, m: Record) -> bool:
    """Whether the gyro shows a turn in the last step."""
    return bool(abs(m.mean_rate - state.at.bias) >= _STRAIGHT_RAD_S)


@inner
def _rounding_share(m: Record, mice: Records) -> float:
    """Share of the variance of the turn over a step that comes from whole counts: it does not accumulate."""
    for i in range(m.count):
        if m.sound >> i & 1:
            per_step = mice[i].metres_per_count / m.step
            share: float = ROUNDING * per_step * per_step * mice[i].weight
            return min(1.0, share)
    return 1.0


@inner
def _add_gradient(state: Record, m: Record, mice: Records, counting: int) -> None:
    """∂(turn by the mice) / ∂(ε_i, α_i), summed over the dispute: ε̂, α̂ turn s_i into s_i (1 + ε_i + j α_i)."""
    weights, centre = 0.0, 0j
    for i in range(m.count):
        if counting >> i & 1:
            weights += mice[i].weight
            centre += scaled(mice[i].weight, mice[i].arm)
    centre = scaled(1.0 / weights, centre)
    for i in range(m.count):
        if counting >> i & 1:
            mouse = mice[i]
            lever = scaled(m.fit_turn_variance * mouse.weight * m.step, mouse.arm - centre)
            state.dispute.by_scale[i] += dot(lever, mouse.sum)
            state.dispute.by_angle[i] += dot(lever, complex(-mouse.sum.imag, mouse.sum.real))


@inner
def _variance_of_calibration(state: Record) -> float:
    """Variance (rad²) of the turn by the mice since the dispute began, by the uncertainty of their calibration."""
    dispute, p, total = state.dispute, state.covariance, 0.0
    for i in range((state.size - MICE) // OF_MOUSE):
        a = MICE + OF_MOUSE * i
        for k in range((state.size - MICE) // OF_MOUSE):
            b = MICE + OF_MOUSE * k
            total += dispute.by_scale[i] * p[a + SCALE, b + SCALE] * dispute.by_scale[k]
            total += dispute.by_angle[i] * p[a + ANGLE, b + ANGLE] * dispute.by_angle[k]
            total += 2.0 * dispute.by_scale[i] * p[a + SCALE, b + ANGLE] * dispute.by_angle[k]
    return total


@inner
def _advance_other(state: Record, velocity: complex, turn_rate: float, dt: float) -> None:
    """Carry the pose by the mice alone on by `dt` (s)."""
    dispute, turn = state.dispute, turn_rate * dt
    dispute.position += scaled(dt, turned(turned(unit(dispute.heading), turned_mean(turn)), velocity))
    dispute.heading += turn


@inner
def _add_step(state: Record, m: Record, mice: Records, turn_rate: float, motion: int) -> None:
    """Add a step to the current block, and a whole block to the sums since the last agreement."""
    dispute = state.dispute
    dispute.block_s += m.step
    dispute.block_gyro += (m.mean_rate - state.at.bias) * m.step
    dispute.block_mice += turn_rate * m.step
    if motion:
        dispute.block_way += m.fit.real * m.step
        dispute.block_moved_s += m.step
    variance = m.step * m.step * m.fit_turn_variance
    rounding = variance * _rounding_share(m, mice) if motion else 0.0
    if rounding > dispute.block_rounding:
        dispute.block_rounding = rounding
    dispute.block_variance += m.step * m.step * state.gyro_variance / max(m.rates, 1)
    if motion:
        dispute.block_variance += variance - rounding
    if dispute.block_s >= _BLOCK_S - 1e-9:
        _finish_block(state, m)
        dispute.block_s = dispute.block_gyro = dispute.block_mice = dispute.block_way = dispute.block_variance = 0.0
        dispute.block_rounding = dispute.block_moved_s = 0.0


@inner
def _finish_block(state: Record, m: Record) -> None:
    dispute, span = state.dispute, state.dispute.block_s
    off, share = dispute.block_gyro - dispute.block_mice, _SHARE * dispute.block_mice
    variance = dispute.block_variance + dispute.block_rounding + share * share
    _add_block(state, off, variance, span)
    total = variance + _variance_of_calibration(state) * (span / dispute.span) ** 2
    total += state.covariance[BIAS, BIAS] * span * span
    z = off / math.sqrt(total)
    dispute.up = min(max(0.0, dispute.up + z - _SUM_DRIFT), _SUM_MOST)
    dispute.down = min(max(0.0, dispute.down - z - _SUM_DRIFT), _SUM_MOST)
    if _is_over(state, z, math.sqrt(total)) or (dispute.up == 0.0 and dispute.down == 0.0):
        agree(state)
    elif max(dispute.up, dispute.down) > _SUM_LIMIT:
        _decide(state, m)


@inner
def _is_over(state: Record, z: float, std: float) -> bool:
    """Whether moving mice have agreed for some blocks in which a jump that explains the headings would have shown."""
    dispute = state.dispute
    turned_by, span = state.at.heading - dispute.heading, dispute.block_s
    would_show = abs(turned_by) * span > _SHOWS_Z * std * dispute.age and dispute.block_moved_s > 0.5 * span
    dispute.calm = dispute.calm + 1 if would_show and abs(z) < _CALM_Z else 0
    return bool(dispute.calm >= _CALM_BLOCKS)


@inner
def _add_block(state: Record, off: float, variance: float, span: float) -> None:
    """Add the terms of both fits: off = J span (a jump), off = c turn + d |turn| + r span + (e + f age) way (mice).

    r has the sign of the turn. With c and d, mice may lose one share of turns to the left, and another one of those to
    the right.
    """
    dispute, turn = state.dispute, state.dispute.block_gyro
    dispute.age += span
    dispute.span += span
    dispute.blocks += 1
    if dispute.blocks == 1 or dispute.block_moved_s < 0.5 * span:  # a change within a block, or a lift, fits neither
        return
    weight = 1.0 / variance
    dispute.jump_square += weight * span * span
    dispute.jump_product += weight * span * off
    terms, way = dispute.terms, dispute.block_way
    terms[0], terms[1], terms[2] = turn, abs(turn), min(max(turn / _STRAIGHT_RAD_S, -span), span)
    terms[3], terms[4], terms[CAUSES] = way, way * dispute.span, off
    for i in range(CAUSES + 1):
        for k in range(CAUSES + 1):
            dispute.sums[i, k] += weight * terms[i] * terms[k]


@inner
def is_undecided(state: Record) -> bool:
    """Whether gyro and mice differ, and neither hypothesis has been accepted: nothing is calibrated meanwhile."""
    return bool(max(state.dispute.up, state.dispute.down) > _SUM_CALIBRATED)


@inner
def _decide(state: Record, m: Record) -> None:
    """Accept the hypothesis that fits decisively better; keep both while none does."""
    dispute = state.dispute
    if dispute.blocks < _FEWEST_BLOCKS or dispute.jump_square == 0.0:
        return
    jump = dispute.jump_product / dispute.jump_square
    by_jump = dispute.sums[CAUSES, CAUSES] - jump * dispute.jump_product
    by_mice = _cost_of_mice(dispute)
    variance = 1.0 / dispute.jump_square + _variance_of_calibration(state) / (dispute.span * dispute.span)
    is_jump = by_mice - by_jump > _BETTER and by_jump < _MOST_CHI2 * dispute.blocks
    is_jump = is_jump and state.resolution.share > _RESOLVED_LEAST and state.straight_std == 0.0
    if is_jump and abs(jump) < _MOST_RAD_S and jump * jump > _JUMP_Z**2 * (variance + state.covariance[BIAS, BIAS]):
        _accept_jump(state, m, jump, variance)
    elif by_jump - by_mice > _BETTER or (
        dispute.blocks > _PATIENCE_BLOCKS and min(by_jump, by_mice) > _MOST_CHI2 * dispute.blocks
    ):
        refute_jump(state)


@inner
def refute_jump(state: Record) -> None:
    """End the dispute with the pose of the gyro: the mice have erred since it began. The way is uncertain by it."""
    dispute = state.dispute
    lost = dispute.sums[0, CAUSES] / (dispute.sums[0, 0] + 1.0 / _LOST_STD**2)
    widen_way(state, min(abs(lost), 1.0), complex(state.at.x, state.at.y) - dispute.start)
    agree(state)


@inner
def _cost_of_mice(dispute: Record) -> float:
    """χ² of the best fit of the mice's terms, by elimination."""
    left = dispute.left
    for i in range(CAUSES + 1):
        for k in range(CAUSES + 1):
            left[i, k] = dispute.sums[i, k]
    for i in range(CAUSES):
        left[i, i] += 1.0 / _CAUSE_STD[i] ** 2
    for j in range(CAUSES):
        for i in range(j + 1, CAUSES + 1):
            share = left[i, j] / left[j, j]
            for k in range(j, CAUSES + 1):
                left[i, k] -= share * left[j, k]
    return float(left[CAUSES, CAUSES])


@inner
def widen_way(state: Record, share: float, way: complex) -> None:
    """Add the variance of an error of the position by a share of the way."""
    p = state.covariance
    p[X, X] += (share * way.real) ** 2
    p[Y, Y] += (share * way.imag) ** 2
    p[X, Y] += share * share * way.real * way.imag
    p[Y, X] = p[X, Y]


@inner
def agree(state: Record) -> None:
    """End the dispute: both poses are the same again."""
    dispute = state.dispute
    dispute.position, dispute.heading = complex(state.at.x, state.at.y), state.at.heading
    dispute.start = dispute.position
    dispute.up = dispute.down = dispute.age = 0.0
    dispute.calm = 0
    _forget(dispute)


@inner
def _forget(dispute: Record) -> None:
    """Forget the blocks so far."""
    dispute.span = 0.0
    dispute.jump_square = dispute.jump_product = 0.0
    for i in range(CAUSES + 1):
        for k in range(CAUSES + 1):
            dispute.sums[i, k] = 0.0
    dispute.blocks = 0
    for i in range(len(dispute.by_scale)):
        dispute.by_scale[i] = dispute.by_angle[i] = 0.0


@inner
def explains(state: Record, jump: float) -> bool:
    """Whether a bias that is wrong by `jump` (rad/s) since the dispute began explains the headings' difference."""
    turned_by, expected = state.at.heading - state.dispute.heading, jump * state.dispute.age
    return is_undecided(state) and abs(turned_by - expected) < 0.5 * abs(expected)


@inner
def take_other_pose(state: Record) -> None:
    """Replace the pose by that of the mice alone."""
    dispute, at, p = state.dispute, state.at, state.covariance
    back2 = square(dispute.position - complex(at.x, at.y))
    p[X, X] += _REPAIR_SHARE**2 * back2
    p[Y, Y] += _REPAIR_SHARE**2 * back2
    at.x, at.y, at.heading = dispute.position.real, dispute.position.imag, dispute.heading
    agree(state)


@inner
def restart_turns(state: Record) -> None:
    """Begin again to compare the turns of gyro and mice."""
    state.turn_square = state.turn_product = state.turn_variance = 0.0
    state.recent_square = state.recent_product = state.recent_variance = 0.0
    state.resolution.square = state.resolution.product = 0.0
    state.off_of_turn = state.off_of_turn_before = 0.0
    for i in range(len(state.lever_of_each)):
        state.lever_of_each[i] = 0j
    state.is_off = False


@inner
def _accept_jump(state: Record, m: Record, jump: float, variance: float) -> None:
    """The bias is another one since the dispute began: take the pose by the mice, and their velocity."""
    p, span = state.covariance, state.dispute.span
    p[HEADING, HEADING] += variance * span * span + (jump * _BLOCK_S) ** 2
    take_other_pose(state)
    state.at.bias += jump
    for at_index in (VX, VY, WZ, BIAS):
        for k in range(state.size):
            p[at_index, k] = p[k, at_index] = 0.0
        p[at_index, at_index] = state.fresh[at_index, at_index]
    p[BIAS, BIAS] = variance + (_JUMP_SHARE * jump) ** 2
    m.excluded = NOBODY
    state.since_rest_s = 0.0
    restart_turns(state)
    state.jumps += 1
    state.jump, state.jump_time = jump, m.time


@inner
def _watch_dead_gyro(state: Record, m: Record, motion: int) -> None:
    """Add up what the mice turn beyond a gyro that repeats one value, and turn the heading by it once it is dead."""
    if motion == 0 or m.disagree_s > 0.0:
        return
    if m.same_rates == 0:
        state.dead_turn = 0.0
    elif math.isfinite(m.rate):
        state.dead_turn += (m.fit_turn - (m.rate - state.at.bias)) * m.step
    elif state.dead_turn != 0.0:
        _turn_heading(state, state.dead_turn)
        state.dead_turn = 0.0


@inner
def _turn_heading(state: Record, turn: float) -> None:
    """Correct the heading by what a wrong gyro has turned it (rad), and widen the pose by what is not known of it."""
    state.at.heading += turn
    state.covariance[HEADING, HEADING] += (_REPAIR_SHARE * turn) ** 2
    way2 = (state.at.vx**2 + state.at.vy**2) * turn * turn
    state.covariance[X, X] += way2
    state.covariance[Y, Y] += way2
