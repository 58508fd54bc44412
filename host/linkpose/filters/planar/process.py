"""One step of the planar filters, from a reading of the mice to the next, and the loop over a block of samples."""

from __future__ import annotations

import math

from linkpose.compiling import compiled_rules, inner
from linkpose.filters._vector import wrapped
from linkpose.filters.mice import reading
from linkpose.filters.mice.faults import fault_limit, number, trusted
from linkpose.filters.mice.least_squares import squared_speed
from linkpose.filters.mice.plane import dot, scaled, square, turned, turned_mean, unit
from linkpose.filters.mice.state import Record, Records
from linkpose.filters.planar import linear, sigma
from linkpose.filters.planar.acceleration import forget, watch_acceleration
from linkpose.filters.planar.gyro import (
    accept_share,
    agree,
    is_turning,
    is_undecided,
    restart_turns,
    watch_gyro,
    widen_way,
)
from linkpose.filters.planar.limit import watch_limit
from linkpose.filters.planar.measure import arm, update
from linkpose.filters.planar.rest import watch_rest
from linkpose.filters.planar.slip import correct_slip
from linkpose.filters.planar.snapping import snapped_std, watch_snapping
from linkpose.filters.planar.state import ANGLE, BIAS, HEADING, MICE, OF_MOUSE, POSITION, SCALE, VX, VY, WZ, X, Y

# How long mice that contradict the prediction are left out (s). Doubled: the velocity is held longer after a collision.
_PATIENCE_S = 0.5
# A change of velocity that only the mice show stays unconfirmed for at most so long (s), until mice and gyro agree on a
# turn of so much (rad, within a share and a rate in rad/s), or until the velocity jumps back. The stated ± of the
# position grows by the distance to the position without this change. Doubling the time doubles the ± after a collision
# on a straight. A jump is a change from one reading to the next of this acceleration (m/s²) and so many σ of the
# velocity: small robots brake with 2 to 4 m/s², a lift at 0.3 m/s is 30 m/s².
_JUMP_M_S2, _JUMP_Z = 3.0, 6.0
_SATURATED_SHARE = 0.5  # of the speed that saturated mice show: by so much they may count too little (1σ)
_SPREAD_S = 0.05  # a jump spreads over two or three readings
# A stop of all mice shorter than this (s), before and after which they show one velocity within this share, is a bump:
# no robot stops and starts so fast. Doubled time: a collision may pass for a bump.
_SHORT_STOP_S, _SAME_SHARE = 1.0, 0.2
# Below this speed (m/s) a robot rests. Mice that then begin at a higher one have missed the way of so long (s, 1σ):
# they need 0.05 to 0.5 s to wake. Doubled: so is the σ of the position after such a start.
_RESTING_M_S, _MISSED_START_S = 0.02, 0.3
_UNCONFIRMED_S, _CONFIRMING_RAD, _AGREED_SHARE, _AGREED_RAD_S = 10.0, 0.2, 0.1, 0.05
# Within one step a velocity changes by about this (m/s², rad/s²): the velocity is the mean over the step, the estimate
# belongs to its end. Doubled: the stated ± of the velocity grows by half.
_ACCEL_M_S2, _ANGULAR_RAD_S2 = 0.6, 1.2
# A gyro whose rates are missing for part of a step may be wrong by this for each second (rad/s²).
_RATE_CHANGE_RAD_S2 = 4.0
# The gyro sees another floor: by this many standard deviations, and at least by this share, over so much turning
# (rad²/s), forgotten after so long (s). Halving the share takes scale errors of the gyro for floors. A larger share
# than the second one is no floor but a slip or a lift.
_FLOOR_Z, _FLOOR_SHARE, _FLOOR_MOST, _FLOOR_TURN, _FLOOR_MEMORY_S = 4.0, 0.015, 0.2, 0.5, 30.0
# The difference is accepted with this share of it as σ. Tripled: where all mice lose more in faster turns, what they
# lose after that goes into their scale on straights. What a turn has shown too little of it, `slip` corrects.
_FLOOR_STD = 0.03
# Another floor shows in two turns in a row, each of at least this much turning (rad²/s), equal within this share.
# A turn ends below this rate (rad/s). A slip lasts for one turn. Doubled: a floor is found later. Doubled share: a
# floor that varies is taken for another one.
_ONE_TURN, _FLOOR_EQUAL, _TURN_END_RAD_S = 0.05, 0.3, 0.1
# Turns in which the mice show different shares of the gyro's turn: noise of a share (1σ, by positions, angles and the
# bias), standard deviations from which a difference counts, and turns over which it is averaged. Doubled noise: slips
# of 3 % do not widen the position.
_TURN_NOISE, _TURN_Z, _TURNS = 0.003, 3.5, 6.0
# A mouse is misplaced: after so much turning (rad²/s), by at least this much (m), with this share of the squared
# differences left, once its scale and angle are known to this σ. Its new place has this share of the change as σ.
# Doubled: a place is corrected later, or a wrong mouse is corrected.
_PLACE_TURN, _PLACE_M, _PLACE_LEFT, _PLACE_SCALE, _PLACE_SHARE = 0.3, 0.012, 0.15, 0.008, 0.2
# While the last turn is off by so many standard deviations, the mice are not calibrated. Doubled: positions of the mice
# take up the scale of another floor.
_OFF_Z = 3.0
# The bias that the fault tests assume is this much less certain than the filter's (rad/s): slow drift of a gyro.
_BIAS_MARGIN_RAD_S = 0.005
# A mouse at fault whose scale or angle is further from the rig's than this (standard deviations to begin with) has
# spoilt the calibration of all. Doubled: a mouse that is mounted wrong by 10° turns the path by 3°.
_SPOILT_Z = 2.0
_UNKNOWN_SHARE = 0.25  # of the variance to begin with: above it, nothing is lost. Doubled: a mouse wrong from the start
# turns the others by a degree.
# A single count of a mouse that has hardly changed its counts for half a second, with silence of so long (s) after it,
# is creeping. After so many, one does not end a rest. Doubled: the gyro's bias is measured later.
_CREEPING_CHANGE, _CREEPING_S, _KNOWN_CREEPS = 1.4, 0.3, 2
_NOISE_S = 0.01  # over which noise common to all mice keeps its value (s)


@inner
def _decay(state: Record, at: int, std: float, keep: float) -> None:
    """A first-order process over one step: one number of the state keeps a share of its value."""
    state.mean[at] *= keep
    for k in range(state.size):
        state.covariance[at, k] *= keep
        state.covariance[k, at] *= keep
    state.covariance[at, at] += std * std * (1.0 - keep * keep)


@inner
def _move_on(state: Record, p: Record, dt: float) -> None:
    """Prediction of velocity, bias and calibration over `dt` (s): first-order processes and random walks."""
    keep = math.exp(-dt / p.speed_s)
    _decay(state, VX, p.speed_m_s, keep)
    _decay(state, VY, p.speed_m_s, keep)
    _decay(state, WZ, p.turn_rad_s, math.exp(-dt / p.turn_s))
    cov = state.covariance
    cov[BIAS, BIAS] += (p.bias_walk**2 + 2.0 * state.drift2 * state.since_rest_s) * dt
    for at in range(MICE, state.size, OF_MOUSE):
        cov[at + SCALE, at + SCALE] += p.scale_walk**2 * dt
        cov[at + ANGLE, at + ANGLE] += p.angle_walk**2 * dt


@inner
def _collect(state: Record, m: Record, mice: Records, rig: Records, sample: Record, p: Record) -> None:
    """The measurement of this step."""
    state.seen_by = 0
    if state.at_rest:
        state.rows = state.always = 3
        return
    state.rows = 0
    if math.isfinite(m.mean_rate):
        missing = _RATE_CHANGE_RAD_S2 * m.missed
        state.rate_variance = state.gyro_variance / max(m.rates, 1) + missing * missing
        state.rows = 1
    state.always = state.rows
    if not m.step > 0.0:
        return
    velocity, per_s = complex(state.at.vx, state.at.vy), 1.0 / (m.step * state.grip)
    for i in range(m.count):
        if m.used >> i & 1:
            seen, place, mouse = state.seen[i], rig[i], mice[i]
            speed2 = squared_speed(place, velocity, state.at.wz)
            seen.velocity = scaled(per_s * mouse.share, turned(place.axis, sample.counts[i]))
            seen.variance = reading.variance(mouse, m.step, speed2, p.scatter, p.noise_m_s)
            if m.is_saturated:  # a lower bound shows no turn
                seen.variance += _SATURATED_SHARE * _SATURATED_SHARE * speed2
            is_snapped = state.snapped >> i & 1
            seen.across = scaled(per_s, snapped_std(place, sample.counts[i])) if is_snapped else 0j
            state.rows += 2
    state.seen_by = m.used


@inner
def _watch_floor(state: Record, m: Record, mice: Records) -> None:
    """Widen the common scale of the mice where they turn by another amount than the gyro: another floor."""
    if state.at_rest or m.missed > 0.0 or m.is_saturated or number(m.used) < 2 or not math.isfinite(m.mean_rate):
        return
    keep, turn = math.exp(-m.step / _FLOOR_MEMORY_S), m.mean_rate - state.at.bias
    if abs(m.turn_rate - turn) > _FLOOR_MOST * abs(turn) + _FLOOR_Z * m.turn_std:
        return
    if m.excluded:
        return
    _add_turn_of_each(state, m, mice, turn, keep)
    state.turn_square = keep * state.turn_square + turn * turn * m.step
    state.turn_product = keep * state.turn_product + turn * m.turn_rate * m.step
    state.turn_variance = keep * keep * state.turn_variance + (turn * m.step * m.turn_std) ** 2
    by_scales = _variance_by_scales(state, m, mice)
    _add_to_turn(state, m, turn, by_scales)
    state.is_off = abs(_off_of_turn(state) or state.off_of_turn) > _FLOOR_SHARE + _OFF_Z * math.sqrt(by_scales)
    if is_undecided(state):
        return
    _find_misplaced(state, m, mice)
    if state.turn_square < _FLOOR_TURN:
        return
    off = state.turn_product / state.turn_square - 1.0
    noise = math.sqrt(by_scales + state.turn_variance / state.turn_square**2)
    if abs(off) <= _FLOOR_SHARE + _FLOOR_Z * noise:
        return
    latest, before = _off_of_turn(state), state.off_of_turn
    if latest == 0.0:
        latest, before = before, state.off_of_turn_before
    varies = abs(latest - before) > _FLOOR_EQUAL * abs(off) or state.turn_spread > off * off
    if varies or not latest / off > 0.5 or _spread_of_turns(state, m, mice) > 0.5 * abs(off):
        return
    for at in range(MICE, state.size, OF_MOUSE):
        _restart(state, at + POSITION, at + OF_MOUSE, 0.0)
    _correct_way(state, off, accept_share(state, 1.0 + off, math.hypot(noise, _FLOOR_STD * off)))
    restart_turns(state)
    state.floors += 1


@inner
def _add_turn_of_each(state: Record, m: Record, mice: Records, by_gyro: float, keep: float) -> None:
    """Add the motion of each mouse relative to the mean of all, times the turn rate of the gyro."""
    moved = 0j
    for i in range(m.count):
        moved += scaled(1.0 / m.count, mice[i].moved)
    for i in range(m.count):
        own = scaled(keep, state.lever_of_each[i]) + scaled(by_gyro, mice[i].moved - moved)
        state.lever_of_each[i] = own


@inner
def _middle_of_arms(m: Record, mice: Records) -> complex:
    """Mean of the mice's levers (m, turned by 90°)."""
    middle = 0j
    for i in range(m.count):
        middle += scaled(1.0 / m.count, mice[i].arm)
    return middle


@inner
def _off_of_each(state: Record, m: Record, mice: Records, i: int) -> complex:
    """Lever of a mouse about the centre of all as the turns have shown it, less the assumed one (m, turned by 90°)."""
    arm = mice[i].arm - _middle_of_arms(m, mice)
    return complex(scaled(1.0 / state.turn_square, state.lever_of_each[i]) - arm)


@inner
def _spread_of_turns(state: Record, m: Record, mice: Records) -> float:
    """Spread of the shares of the gyro's turn that the mice show: on another floor all show the same."""
    least, most, middle = math.inf, -math.inf, _middle_of_arms(m, mice)
    for i in range(m.count):
        lever = mice[i].arm - middle
        share = dot(lever, _off_of_each(state, m, mice, i)) / max(square(lever), 1e-12)
        least, most = min(least, share), max(most, share)
    return most - least


@inner
def _find_misplaced(state: Record, m: Record, mice: Records) -> None:
    """Correct the place of the one mouse that is elsewhere than the rig states, as the turns show it."""
    if m.count < 3 or state.turn_square < _PLACE_TURN:
        return
    worst, far2, total2 = 0, 0.0, 0.0
    for i in range(m.count):
        off2 = square(_off_of_each(state, m, mice, i))
        total2 += off2
        if off2 > far2:
            worst, far2 = i, off2
    own = 1.0 - 1.0 / m.count
    off = scaled(1.0 / own, _off_of_each(state, m, mice, worst))
    left2 = 0.0
    for i in range(m.count):
        expected = scaled(own if i == worst else own - 1.0, off)
        left2 += square(_off_of_each(state, m, mice, i) - expected)
    at = MICE + OF_MOUSE * worst
    p, known = state.covariance, _PLACE_SCALE * _PLACE_SCALE
    is_known = p[at + SCALE, at + SCALE] < known and p[at + ANGLE, at + ANGLE] < known
    if not is_known or square(off) < _PLACE_M * _PLACE_M or left2 > _PLACE_LEFT * total2:
        return
    mouse = state.at.mice[worst]
    _restart(state, at + POSITION, at + OF_MOUSE, 1.0)
    mouse.dx += off.imag
    mouse.dy -= off.real
    for k in range(2):
        p[at + POSITION + k, at + POSITION + k] = _PLACE_SHARE * _PLACE_SHARE * square(off)
    restart_turns(state)
    state.moved |= 1 << worst


@inner
def _variance_by_scales(state: Record, m: Record, mice: Records) -> float:
    """Variance of the share by which the mice in use turn too much, by the uncertainty of their scales."""
    centre, count = 0j, number(m.used)
    for i in range(m.count):
        if m.used >> i & 1:
            centre += scaled(1.0 / count, mice[i].arm)
    total = spread = 0.0
    for i in range(m.count):
        if m.used >> i & 1:
            own = square(mice[i].arm - centre)
            spread += own
            for k in range(m.count):
                if m.used >> k & 1:
                    other = square(mice[k].arm - centre)
                    total += own * other * state.covariance[MICE + OF_MOUSE * i + SCALE, MICE + OF_MOUSE * k + SCALE]
    return max(total, 0.0) / max(spread * spread, 1e-12)


@inner
def _off_of_turn(state: Record) -> float:
    """Share by which the mice turn more than the gyro in the current turn; 0 while it is too short."""
    if state.recent_square < _ONE_TURN:
        return 0.0
    off: float = state.recent_product / state.recent_square - 1.0
    return off


@inner
def _add_to_turn(state: Record, m: Record, by_gyro: float, by_scales: float) -> None:
    """Add a step to the current turn; `by_gyro` is its rate (rad/s). Another direction, or going straight, ends it."""
    if abs(by_gyro) < _TURN_END_RAD_S or by_gyro * state.turn_rate < 0.0:
        off = _off_of_turn(state)
        if off != 0.0:
            _compare_turns(state, off, by_scales)
            state.off_of_turn, state.off_of_turn_before = off, state.off_of_turn
        state.recent_square = state.recent_product = state.recent_variance = 0.0
    state.turn_rate = by_gyro
    state.recent_square += by_gyro * by_gyro * m.step
    state.recent_product += by_gyro * m.turn_rate * m.step
    state.recent_variance += (by_gyro * m.step * m.turn_std) ** 2


@inner
def _compare_turns(state: Record, off: float, by_scales: float) -> None:
    """Widen the position where this turn was off by another share than the last one: slips, or a floor that varies.

    The way since the last turn is uncertain by the difference, and each way by the mean of the last differences.
    """
    position = complex(state.at.x, state.at.y)
    if state.off_of_turn != 0.0:
        noise2 = 2.0 * (by_scales + _TURN_NOISE**2) + state.recent_variance / state.recent_square**2
        difference2 = (off - state.off_of_turn) ** 2
        excess = difference2 - noise2 if difference2 > _TURN_Z**2 * noise2 else 0.0
        state.turns += 1
        state.turn_spread += (0.5 * excess - state.turn_spread) / min(float(state.turns), _TURNS)
        widen_way(state, math.sqrt(max(excess, state.turn_spread)), position - state.turn_end)
    state.turn_end = position
    if abs(off) < _FLOOR_SHARE:
        state.floor_start = position


@inner
def _correct_way(state: Record, off: float, on_straights: float) -> None:
    """The mice count by the share `off` too much in turns, and `on_straights` times as much as assumed on straights.

    Probably since the last turn in which they did not.
    """
    way = complex(state.at.x, state.at.y) - state.floor_start
    back = 1.0 - 1.0 / on_straights
    state.at.x -= back * way.real
    state.at.y -= back * way.imag
    widen_way(state, off, way)
    state.floor_start = complex(state.at.x, state.at.y)


@inner
def _common_errors(state: Record, m: Record, mice: Records) -> tuple[float, float]:
    """Variances of the mean scale and of the mean angle of the mice, by how far the mice are apart.

    The drive shows the mice's errors relative to each other; their mean stays as the rig states it. Where they are far
    apart, the mean is as uncertain as that of so many draws. Positions beyond three standard deviations of the rig's
    are taken for wrong ones, which show as scale and angle too, unless the turns have shown where the mouse is.
    """
    count = m.count
    scale = angle = scale2 = angle2 = moved2 = arm2 = 0.0
    for i in range(count):
        mouse = state.at.mice[i]
        if not state.moved >> i & 1:
            moved2 += mouse.dx**2 + mouse.dy**2 - 18.0 * state.fresh[MICE + POSITION, MICE + POSITION]
        arm2 += square(mice[i].arm)
        scale += mouse.scale
        angle += mouse.angle
        scale2 += mouse.scale**2
        angle2 += mouse.angle**2
    pairs = max(count * (count - 1.0), 1.0)
    placed = max(moved2, 0.0) / (count * max(arm2, 1e-6))
    by_scale = max(scale2 - scale * scale / count, 0.0) / pairs + placed
    return by_scale, max(angle2 - angle * angle / count, 0.0) / pairs + placed


@inner
def _restart(state: Record, first: int, end: int, keep: float) -> None:
    """Part of the state starts anew, uncorrelated with the rest; `keep` of its mean and no smaller variances stay.

    Positions of the mice, when they have taken up part of a scale error; the calibration, when a mouse at fault has
    spoilt it; all, where rounding has spoilt the covariance.
    """
    cov, fresh = state.covariance, state.fresh
    for at in range(first, end):
        state.mean[at] *= keep
        before = cov[at, at]
        for k in range(state.size):
            cov[at, k] = cov[k, at] = 0.0
        cov[at, at] = before if keep > 0.0 and before > fresh[at, at] else fresh[at, at]
    for at in range(first, end):
        for k in range(first, at):
            cov[at, k] = cov[k, at] = fresh[at, k]


@inner
def _restart_spoilt(state: Record, excluded: int) -> None:
    """Start the calibration anew where the mice in `excluded`, found at fault just now, have been taken for sound mice
    of another scale or angle: the error would be shared among all mice. A calibration that has hardly begun starts anew
    in any case.
    """
    for i in range((state.size - MICE) // OF_MOUSE):
        if excluded >> i & 1:
            for at in range(MICE + OF_MOUSE * i, MICE + OF_MOUSE * i + POSITION):
                is_unknown = state.covariance[at, at] > _UNKNOWN_SHARE * state.fresh[at, at]
                if is_unknown or state.mean[at] ** 2 > _SPOILT_Z**2 * state.fresh[at, at]:
                    _restart(state, MICE, state.size, 0.0)
                    return


@inner
def _calibrate(state: Record, m: Record, mice: Records, rig: Records) -> None:
    """Give the fault tests the placement and the gyro bias as the filter has estimated them."""
    state.grip = state.turn_factor if is_turning(state, m) else 1.0
    for i in range(m.count):
        error, place, mouse = state.at.mice[i], rig[i], mice[i]
        mouse.arm = arm(error, place)
        scale = math.exp(error.scale) / state.grip
        mouse.axis = scaled(scale, turned(unit(error.angle), place.axis))
        mouse.metres_per_count = scale * place.metres_per_count
    m.bias = state.at.bias
    m.bias_std = math.sqrt(state.covariance[BIAS, BIAS]) + _BIAS_MARGIN_RAD_S


@inner
def _advance(state: Record, points: Records, dt: float) -> bool:
    """Carry the pose on by `dt` (s) with the velocity; False where the covariance is not positive definite."""
    if len(points):
        return sigma.advance(state, points[0], dt)
    linear.advance(state, dt)
    return True


@inner
def _correct(state: Record, tangent: Records, points: Records, rig: Records, m: Record, dt: float) -> bool:
    """Update with the measurement, for a while without mice that contradict the prediction.

    Mice that slip or are lifted contradict at once; the fault tests take a few steps to find them, in which they would
    spoil the calibration.
    """
    if state.rows == 0:
        return True
    limit = fault_limit(state.rows)
    if not len(points):
        linear.moments(state, tangent[0], rig, m.mean_rate)
    elif not sigma.moments(state, points[0], rig, m.mean_rate):
        return False
    before = complex(state.at.vx, state.at.vy)
    is_calibrating = not (is_undecided(state) or state.is_off or m.is_saturated or state.snapped)
    is_patient = state.refused_s < _PATIENCE_S and not state.unconfirmed_s > 0.0
    if not update(state, limit if is_patient else math.inf, limit, is_calibrating):
        return False
    _watch_jump(state, m, before, dt)
    state.refused_s = state.refused_s + dt if state.chi2 > limit else 0.0
    return True


@inner
def _watch_jump(state: Record, m: Record, before: complex, dt: float) -> None:
    """A change of velocity is unconfirmed from a jump between two readings until the velocity jumps back.

    `before` is the filter's velocity before this reading.
    """
    shown, last = m.velocity, state.shown
    limit = _JUMP_Z * math.sqrt(m.x_std**2 + m.y_std**2) + _JUMP_M_S2 * dt
    state.shown = shown
    is_jump = square(shown - last) > limit * limit
    if state.unconfirmed_s > 0.0:
        if state.unconfirmed_s < _SPREAD_S and not is_turning(state, m):
            state.jumped_to = math.sqrt(square(shown) / square(state.held))
        state.unconfirmed_s += dt
        is_back = is_jump and square(state.held - shown) < square(state.held - last)
        if is_back:
            state.jumped_to = 0.0
            _restore_way(state, shown)
        if is_back or state.unconfirmed_s > _UNCONFIRMED_S:
            state.unconfirmed_s = -_SPREAD_S
            forget(state.acceleration)  # it would contradict the jump back
    elif state.unconfirmed_s < 0.0:
        state.unconfirmed_s = min(state.unconfirmed_s + dt, 0.0)
    elif is_jump and square(shown - state.earlier) > limit * limit:
        if square(state.earlier) < _RESTING_M_S**2:
            _add_missed_start(state, shown)
        else:
            state.held, state.unconfirmed_s, state.unconfirmed_turn = state.earlier, dt, 0.0
            state.unconfirmed_m, state.unconfirmed_way = 0.0, 0j
    state.earlier = before


@inner
def _add_missed_start(state: Record, shown: complex) -> None:
    """The mice begin to count at a speed to which no robot jumps from a rest: they slept, or were lifted."""
    way = scaled(_MISSED_START_S, turned(unit(state.at.heading), shown))
    widen_way(state, 1.0, way)


@inner
def _restore_way(state: Record, shown: complex) -> None:
    """After a short stop of the mice from which they jump back to the velocity before it: the robot has gone on."""
    is_same = square(shown - state.held) < _SAME_SHARE**2 * square(state.held)
    if is_same and state.unconfirmed_s < _SHORT_STOP_S and square(state.earlier) < _SAME_SHARE**2 * square(state.held):
        state.at.x += state.unconfirmed_way.real
        state.at.y += state.unconfirmed_way.imag
        state.dispute.position += state.unconfirmed_way


@inner
def _add_unconfirmed_way(state: Record, m: Record, dt: float) -> None:
    """Add the variance of an unconfirmed change: the distance between the position with it and without it, squared."""
    if not state.unconfirmed_s > 0.0:
        return
    turn = m.mean_rate - state.at.bias
    if abs(m.turn_rate - turn) < _AGREED_SHARE * abs(turn) + _AGREED_RAD_S and number(m.used) > 1:
        state.unconfirmed_turn += abs(turn) * dt
        if state.unconfirmed_turn > _CONFIRMING_RAD:
            state.unconfirmed_s = 0.0
            return
    way = scaled(dt, turned(unit(state.at.heading), state.held - complex(state.at.vx, state.at.vy)))
    state.unconfirmed_m += _add_systematic(state, way, state.unconfirmed_m)
    state.unconfirmed_way += way


@inner
def _add_saturated_way(state: Record, m: Record, dt: float) -> None:
    """Add the variance of a way of which saturated mice show a lower bound only."""
    if not m.is_saturated:
        return
    share = max(_SATURATED_SHARE, state.limited_share)
    way = scaled(share * dt, turned(unit(state.at.heading), complex(state.at.vx, state.at.vy)))
    state.saturated_m += _add_systematic(state, way, state.saturated_m)


@inner
def _add_systematic(state: Record, way: complex, before_m: float) -> float:
    """Add the variance of an error of position that grows by `way` (m) in this step, and was `before_m` before.

    Returns the length of the way (m).
    """
    length = math.sqrt(square(way))
    if not length > 0.0:
        return length
    grown = length * (2.0 * before_m + length) / (length * length)
    state.covariance[X, X] += grown * way.real * way.real
    state.covariance[Y, Y] += grown * way.imag * way.imag
    state.covariance[X, Y] += grown * way.real * way.imag
    state.covariance[Y, X] = state.covariance[X, Y]
    return length


@inner
def _scatter_way(state: Record, m: Record, p: Record, q: Record, dt: float, missed: float) -> None:
    """Noise that mice do not show: common to all of them, light slips, and what a robot does while samples are lost."""
    speed2 = state.at.vx**2 + state.at.vy**2
    unseen = 0.25 * _ACCEL_M_S2 * missed * missed
    variance = p.floor * p.floor * speed2 * dt * _NOISE_S + unseen * unseen
    state.covariance[X, X] += variance
    state.covariance[Y, Y] += variance
    if speed2 > 0.0:
        length = dt * math.sqrt(speed2)
        way = scaled(dt, turned(unit(state.at.heading), complex(state.at.vx, state.at.vy)))
        widen_way(state, q.slip * math.sqrt(q.slip_m / length), way)
        state.swept += scaled(state.at.heading, complex(-way.imag, way.real))
        if not is_turning(state, m):
            state.straight_way += way


@inner
def _are_silent(m: Record, mice: Records) -> bool:
    """Whether no mouse counts, but for single counts of a mouse that creeps at rest."""
    judges = trusted(m) or m.sound
    is_silent = judges != 0
    for i in range(m.count):
        if judges >> i & 1:
            is_silent = is_silent & (_is_lone_count(mice[i]) or mice[i].silent_s > 0.0)
    return bool(is_silent)


@inner
def _is_lone_count(mouse: Record) -> bool:
    """Whether a mouse that is known to creep gives a single count after long silence; counts such counts.

    A robot that starts gives a single count too, but more after it.
    """
    is_lone = square(mouse.counts) == 1.0 and mouse.change < _CREEPING_CHANGE
    if is_lone or mouse.silent_s >= _CREEPING_S:
        mouse.creeps += mouse.is_lone and mouse.silent_s >= _CREEPING_S
        mouse.is_lone = is_lone
    elif square(mouse.counts) > 0.0:
        mouse.is_lone = False
    return bool(is_lone and mouse.creeps >= _KNOWN_CREEPS)


@inner
def _step(
    state: Record, tangent: Records, points: Records, m: Record, mice: Records, rig: Records, p: Record, q: Record,
    sample: Record,
) -> None:  # fmt: skip
    """One reading of the mice."""
    if not reading.begin_step(m, sample.time):
        return
    dt, half = m.step + m.missed, 0.5 * m.missed if m.step > 0.0 else 0.0
    before = m.excluded
    watch_snapping(state, m, mice, sample)
    if reading.correct(m, mice, p, False):
        m.known_time = sample.time
    is_silent = _are_silent(m, mice)
    _restart_spoilt(state, m.excluded & ~before)
    watch_rest(state, is_silent, m.rate, dt, sample.time)
    is_good = half == 0.0 or _advance(state, points, half)
    _move_on(state, q, dt)
    _collect(state, m, mice, rig, sample, p)
    state.rejected += state.rows == 0 or (m.used == 0 and not state.at_rest)
    is_good = is_good and _correct(state, tangent, points, rig, m, dt) and _advance(state, points, dt - half)
    if not is_good:
        state.restarts += 1
        _restart(state, X, state.size, 1.0)
        agree(state)
    _scatter_way(state, m, p, q, dt, m.missed if m.step > 0.0 else 0.0)
    _add_unconfirmed_way(state, m, dt)
    _add_saturated_way(state, m, dt)
    watch_limit(state, m, mice)
    watch_acceleration(state, m, mice, sample.accel)
    _watch_floor(state, m, mice)
    correct_slip(state, m, mice, rig, watch_gyro(state, m, mice, p))
    _calibrate(state, m, mice, rig)


@inner
def _std(state: Record, at: int, since: float, change: float) -> float:
    """Standard deviation of one number of the state, `since` (s) after the last reading."""
    variance = state.covariance[at, at] + change * change
    if at < VX:
        variance += since * since * state.covariance[VX + at, VX + at]
    if at == HEADING:
        variance += 2.0 * since * state.covariance[HEADING, WZ]
    return math.sqrt(max(variance, 0.0))


@inner
def _show(state: Record, m: Record, mice: Records, time_s: float, out: Record) -> None:
    """Pose (heading in [−π, π)), velocity and their standard deviations at a sample."""
    at, since = state.at, time_s - m.time
    if not since > 0.0:
        since = 0.0
    turn = at.wz * since
    velocity = complex(at.vx, at.vy)
    way = scaled(since, turned(turned(unit(at.heading), turned_mean(turn)), velocity))
    out.x, out.y, out.heading = at.x + way.real, at.y + way.imag, wrapped(at.heading + turn)
    out.vx, out.vy, out.wz = at.vx, at.vy, at.wz
    out.excluded = float(m.excluded)
    # At rest too: the robot starts before the first count, and before its rate exceeds the noise of the gyro.
    lag = since + (0.5 * m.interval if math.isfinite(m.interval) else 0.0)
    by_scale, by_angle = _common_errors(state, m, mice)
    other = state.dispute.position - complex(at.x, at.y)
    straight, swept = scaled(state.straight_std, state.straight_way), scaled(state.gyro_std, state.swept)
    spread, last = state.turn_spread, complex(at.x, at.y) - state.turn_end
    x_variance = by_scale * out.x**2 + by_angle * out.y**2 + other.real**2 + straight.real**2
    x_variance += spread * last.real**2 + swept.real**2
    y_variance = by_scale * out.y**2 + by_angle * out.x**2 + other.imag**2 + straight.imag**2
    y_variance += spread * last.imag**2 + swept.imag**2
    out.x_std, out.y_std = _std(state, X, since, math.sqrt(x_variance)), _std(state, Y, since, math.sqrt(y_variance))
    out.heading_std = _std(
        state, HEADING, since, abs(state.dispute.heading - at.heading) + state.gyro_std * abs(at.heading)
    )
    out.vx_std, out.vy_std = _std(state, VX, since, _ACCEL_M_S2 * lag), _std(state, VY, since, _ACCEL_M_S2 * lag)
    out.wz_std = _std(state, WZ, since, _ANGULAR_RAD_S2 * lag)


@compiled_rules
def process(
    samples: Records, parameters: Records, planar: Records, rig: Records, mice: Records, mice_states: Records,
    tangent: Records, points: Records, states: Records, out: Records,
) -> None:  # fmt: skip
    """Every sample of a block: estimates (N,) of ESTIMATE into `out`.

    `parameters` are MiceParameters, `planar` PlanarParameters, `rig` the mice as the rig places them, `mice` as the
    filter has calibrated them. The extended filter has one `tangent`, the unscented one has one `points`; the other
    array is empty. Both run the same machine code, which is therefore compiled once.
    """
    state, m, p, q = states[0], mice_states[0], parameters[0], planar[0]
    for k in range(len(samples)):
        sample = samples[k]
        reading.follow_gyro(m, sample)
        if not sample.is_stale:
            reading.read_counts(m, mice, sample)
            _step(state, tangent, points, m, mice, rig, p, q, sample)
            reading.end_step(m)
        _show(state, m, mice, sample.time, out[k])
