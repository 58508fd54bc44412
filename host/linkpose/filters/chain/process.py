"""Blocks of samples through the bank of hypotheses, each a filter from another heading of sensor 2 at the start.

The relative heading is unknown at the start, and the constraint is far from linear in it. Several filters therefore
start with headings all around; each step compares their likelihoods, and drops one that is improbable or has come to
the same rotation as the best. In motion one is left after some seconds.

Source: D. T. Magill, "Optimal adaptive estimation of sampled stochastic processes", IEEE Trans. Automatic Control
10(4), 1965.
"""

from __future__ import annotations

import math

from linkpose.compiling import compiled, inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY, ImuSamples
from linkpose.filters.chain.angles import report_angles, set_frame
from linkpose.filters.chain.first_pose import begin_path, begin_rest, begin_start, end_step, follow_path, trace_variance
from linkpose.filters.chain.hinge import follow_axis, hinge_angle, hinge_angle_std, update_axis
from linkpose.filters.chain.joint import update_fixed_joint, update_joint
from linkpose.filters.chain.level import begin_level, follow_level, misalignment_variance
from linkpose.filters.chain.misfit import follow_misfit, forget, has_to_forget, is_misfit
from linkpose.filters.chain.motion import follow_rest, update_rest, update_velocity
from linkpose.filters.chain.prior import narrow_prior
from linkpose.filters.chain.propagate import integrate, propagate_covariance
from linkpose.filters.chain.rotation import between, cross, rotate, rotate_back, to_matrix, turn
from linkpose.filters.chain.state import OF_SENSOR, START, Floats, R, Record, V
from linkpose.filters.chain.stops import clear_stops, stop_variance, update_stop
from linkpose.filters.chain.update import add_linearization_errors, apply_correction, clear_row, expected_square
from linkpose.filters.frozen import MEMORY, is_frozen
from linkpose.wire.messages import SampleFlags

_NEEDED = int(SampleFlags.IMU_VALID | SampleFlags.IMU2_VALID)
_CLIPPED = int(
    SampleFlags.ACCEL_SATURATED
    | SampleFlags.GYRO_SATURATED
    | SampleFlags.ACCEL2_SATURATED
    | SampleFlags.GYRO2_SATURATED
)
# Readings of a sensor at rest may repeat to the last bit (low-pass filter, little noise): below this rate of all axes
# they do not show a frozen sensor, unless they repeat for _LONGEST_REPEAT_S.
_RESTING_RAD_S, _LONGEST_REPEAT_S = 0.05, 2.0
_LARGEST = 1e4  # m/s² or rad/s: beyond what any sensor reads
_UNKNOWN_HEADING = math.pi / math.sqrt(3.0)  # σ of a heading that is uniform all around (rad)


@inner
def _align(s: Record, k: int, accel: Floats, std: float, heading_std: float, q: Record) -> None:
    """Attitude of sensor k from one reading of the accelerometer, heading and velocity 0."""
    p, o = s.covariance, OF_SENSOR * k
    x, y, z = accel[k, 0] - s.accel_bias[k, 0], accel[k, 1] - s.accel_bias[k, 1], accel[k, 2] - s.accel_bias[k, 2]
    norm = math.sqrt(x * x + y * y + z * z) + 1e-9
    w = 1 + z / norm
    attitude = s.attitude[k]
    if w > 1e-6:  # the shortest rotation of the force onto Z
        attitude[0], attitude[1], attitude[2], attitude[3] = w, y / norm, -x / norm, 0.0
    else:
        attitude[0], attitude[1], attitude[2], attitude[3] = 0.0, 1.0, 0.0, 0.0
    turn(attitude, 0.0, 0.0, 0.0, 1.0)  # which normalises
    to_matrix(attitude, s.rotation[k])
    for i in range(6):
        s.velocity[k, i % 3] = 0.0
        for j in range(p.shape[0]):
            p[o + i, j] = p[j, o + i] = 0.0
    for i in range(3):
        p[o + i, o + i] = std * std
        p[o + V + i, o + V + i] = q.speed_m_s**2
    p[o + 2, o + 2] = heading_std**2


@inner
def _begin(bank: Record, states: Record, gyro: Floats, accel: Floats, q: Record) -> None:
    """One filter at the first sample, or anew after a gap: mounting and sensor errors stay as the best has them."""
    count = states.shape[0]
    best = states[bank.best]
    for i in range(count):
        s = states[i]
        if bank.begun:
            _copy_constants(best, s, bank.length)
            s.has_axis *= bank.spread  # an axis in sensor 1's axes came with the heading
        for k in range(2):
            force = math.sqrt(accel[k, 0] ** 2 + accel[k, 1] ** 2 + accel[k, 2] ** 2)
            rate = math.sqrt(gyro[k, 0] ** 2 + gyro[k, 1] ** 2 + gyro[k, 2] ** 2)
            std = q.tilt_rad + abs(force / GRAVITY - 1) + q.tilt_moving_s * rate
            _align(s, k, accel, std, 0.8 * math.pi / count * k, q)
            s.speed_square[k], s.accel_square[k], s.shared_square[k] = 0.25, 1.0, 0.0
            s.up_spread[k] = s.up_square[k] = 0.0
            for j in range(3):
                s.up[k, j], s.up_swing[k, j] = s.rotation[k, 2, j], 0.0
        s.moved_heading = 0.0
        begin_level(s, q)
        for k in range(2):
            for j in range(3):
                s.moved_axis[k, j] = 0.0
        s.narrow_span = 0.0
        s.residual_share, s.innovation_ratio, s.widening = q.first_residual**2, 1.0, 1.0
        s.play_square = q.first_play_rad**2
        clear_stops(s)
        s.alive, s.log_likelihood, s.odds, s.apart, s.rotation_std = int(i == 0), 0.0, 0.0, math.pi, math.pi
        if not bank.begun:
            begin_start(s, bank.length)
    begin_path(bank, -1 if bank.begun else 0)
    if bank.hinge < 0 and not bank.begun:
        set_frame(bank, states[0].rotation[0, 2])
    bank.rests, bank.rested = int(not bank.begun), 0
    bank.begun, bank.spread, bank.best = 1, 0, 0
    if bank.hinge >= 0 and states[0].has_axis > 0.0:  # axes in both sensors give the heading
        _spread(bank, states, 0.0, gyro, q)


@inner
def _spread(bank: Record, states: Record, axis_turns: float, gyro: Floats, q: Record) -> None:
    """From now on the heading can be found: copies of the one filter, with headings of sensor 2 all around."""
    count = states.shape[0]
    for i in range(count - 1, -1, -1):
        if i > 0:
            states[i] = states[0]
        _turn_link(states[i], bank, 2 * math.pi * i / count, axis_turns, gyro, q)
    bank.spread = 1


@inner
def _turn_link(s: Record, bank: Record, heading: float, axis_turns: float, gyro: Floats, q: Record) -> None:
    """Turn link 2 by `heading` (rad); its velocity is forgotten and follows from the joint.

    `axis_turns` 1: the axis in sensor 1's axes was found with the former heading and turns, too.
    """
    p, size, hinge, m = s.covariance, bank.length, bank.hinge, s.m
    turn(s.attitude[1], 0.0, 0.0, heading, 1.0)
    to_matrix(s.attitude[1], s.rotation[1])
    _about(s.rotation[0, 2], heading, m)
    if hinge >= 0 and axis_turns > 0.0:
        rotate(m, s.axis[0], s.a)
        for i in range(3):
            s.axis[0, i] = s.a[i]
        _turn_block(p, size, hinge, m, s.a, s.b)
    s.a[0], s.a[1], s.a[2] = 0.0, 0.0, 1.0
    _about(s.a, heading, m)
    _turn_block(p, size, OF_SENSOR, m, s.a, s.b)
    turn(s.start[1], 0.0, 0.0, heading, 1.0)
    _turn_block(p, size, START + 3, m, s.a, s.b)
    for k in range(2):
        for i in range(3):
            s.a[i] = gyro[k, i] - s.gyro_bias[k, i]
        cross(s.a, s.lever[k], s.b)
        rotate(s.rotation[k], s.b, s.c)
        for i in range(3):  # v_2 = v_1 − R_1 (ω_1 × r_1) + R_2 (ω_2 × r_2)
            s.velocity[1, i] = s.velocity[0, i] - s.c[i] if k == 0 else s.velocity[1, i] + s.c[i]
    for i in range(3):
        row = OF_SENSOR + V + i
        for j in range(size):
            p[row, j] = p[j, row] = 0.0
        p[row, row] = q.speed_m_s**2


@inner
def _about(axis: Floats, angle: float, m: Floats) -> None:
    """The matrix (3, 3) that turns by an angle (rad) about a unit axis."""
    c, s = math.cos(angle), math.sin(angle)
    for i in range(3):
        for j in range(3):
            m[i, j] = (1 - c) * axis[i] * axis[j]
        j, k = (i + 1) % 3, (i + 2) % 3
        m[i, i] += c
        m[i, j] -= s * axis[k]
        m[i, k] += s * axis[j]


@inner
def _turn_block(p: Floats, size: int, at: int, m: Floats, column: Floats, turned: Floats) -> None:
    """Covariance with the three errors from `at` on in turned axes."""
    for side in range(2):
        for j in range(size):
            for i in range(3):
                column[i] = p[at + i, j] if side == 0 else p[j, at + i]
            rotate(m, column, turned)
            for i in range(3):
                if side == 0:
                    p[at + i, j] = turned[i]
                else:
                    p[j, at + i] = turned[i]


@inner
def _copy_constants(best: Record, s: Record, size: int) -> None:
    """What a gap does not change, with its variances but without covariances between parts."""
    for k in range(2):
        s.is_narrow[k] = best.is_narrow[k]
        for i in range(3):
            s.gyro_bias[k, i], s.accel_bias[k, i] = best.gyro_bias[k, i], best.accel_bias[k, i]
            s.lever[k, i], s.axis[k, i] = best.lever[k, i], best.axis[k, i]
    for i in range(3):
        s.lever0[i] = best.lever0[i]
    for k in range(2):
        for i in range(4):
            s.start[k, i] = best.start[k, i]
    s.has_axis = best.has_axis
    for i in range(size):
        for j in range(size):
            s.covariance[i, j] = best.covariance[i, j] if i // 3 == j // 3 else 0.0


@inner
def _update(s: Record, bank: Record, gyro: Floats, h: float, q: Record, noise: Floats) -> None:
    """All measurements of one update, `h` (s) after the last."""
    size, hinge, base = bank.length, bank.hinge, bank.fixed
    propagate_covariance(s, size, q)
    likelihood = s.heading_share * update_joint(s, size, 0 if bank.spread else 2, gyro, h, q, noise)
    apply_correction(s, size, hinge, base)
    if base >= 0:
        likelihood += update_fixed_joint(s, size, base, gyro, q, noise)
    narrow_prior(s, size, h, q)
    for k in range(2):
        likelihood += update_velocity(s, size, k, h, q)
        if bank.still_s[k] > q.rest_s:
            update_rest(s, size, k, gyro, bank.turning_square[k], h, q, noise)
    apply_correction(s, size, hinge, base)
    if hinge >= 0:
        if s.has_axis > 0.0:
            likelihood += update_axis(s, size, hinge, h, q)
            apply_correction(s, size, hinge, base)
        else:
            follow_axis(s, size, hinge, bank.spread, gyro, h, q)
        s.angle_std = hinge_angle_std(s, size, hinge)
        if s.has_axis > 0.0:
            update_stop(s, size, hinge_angle(s), q)
            apply_correction(s, size, hinge, base)
        first_and_now = 2 * misalignment_variance(s, q) + trace_variance(s, q)
        s.angle_std = math.sqrt(s.angle_std**2 + stop_variance(s) + first_and_now)
    if bank.spread:
        add_linearization_errors(s, hinge, h, q)
    follow_level(s, h, q)
    s.log_likelihood += q.tempering * likelihood
    p, total = s.covariance, 3 * misalignment_variance(s, q)
    for i in range(3):
        total += p[i, i] + p[OF_SENSOR + i, OF_SENSOR + i] - 2 * p[i, OF_SENSOR + i]
    s.rotation_std = math.sqrt(max(total, 0.0))


@inner
def _select(bank: Record, states: Record, q: Record) -> None:
    """The best hypothesis; the others' odds against it; those that are improbable or the same end."""
    top = -math.inf
    for i in range(states.shape[0]):
        s = states[i]
        if s.alive:
            far = 0.0  # a wrong heading is often explained by impossible gyro biases
            for k in range(2):
                std = q.gyro_bias_rad_s if s.is_narrow[k] else q.first_gyro_bias_rad_s
                for j in range(3):
                    far += (s.gyro_bias[k, j] / std) ** 2
            s.odds = s.log_likelihood - 0.5 * far
            if s.odds > top:
                top, bank.best = s.odds, i
    best = states[bank.best]
    between(best.attitude[0], best.attitude[1], best.relative)
    for i in range(states.shape[0]):
        s = states[i]
        if not s.alive:
            continue
        s.odds -= top
        s.log_likelihood -= top
        if i == bank.best:
            s.apart = 0.0
            continue
        between(s.attitude[0], s.attitude[1], s.relative)
        a, b = s.relative, best.relative
        cosine = abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3])
        s.apart = 2 * math.acos(min(cosine, 1.0))
        same = min(s.rotation_std, best.rotation_std, q.same_rad)
        if s.odds < -q.most_odds or s.apart < same:
            s.alive = 0


@inner
def _report(bank: Record, states: Record, out: Record, q: Record) -> None:
    """The best hypothesis, with σ of the mixture; the angle is the mean of all."""
    best, size, hinge, base = states[bank.best], bank.length, bank.hinge, bank.fixed
    weights = variance = 0.0
    for i in range(states.shape[0]):
        s = states[i]
        if s.alive:
            weight = math.exp(s.odds)
            weights += weight
            variance += weight * (s.rotation_std**2 + s.apart**2)
    out.rotation_std = min(math.sqrt(variance / weights), math.pi) if bank.spread else _UNKNOWN_HEADING
    between(best.attitude[0], best.attitude[1], best.relative)
    sign = 1.0 if best.relative[0] >= 0 else -1.0
    for i in range(4):
        known = out.rotation_std < q.unknown_rad or best.has_axis > 0.0
        out.q[i] = sign * best.relative[i] if known else math.nan
    out.angle = out.angle_std = math.nan
    if hinge >= 0 and best.has_axis > 0.0:
        _report_angle(best, states, out)
    for i in range(3):
        out.joint[i] = out.joint_std[i] = math.nan
    if hinge < 0 and out.rotation_std < q.unknown_rad:
        report_angles(bank, best, misalignment_variance(best, q), trace_variance(best, q), out)
    for k in range(2):
        out.height[k] = out.height_std[k] = math.nan
        if base >= 0:
            height, std = _height(best, k, size, base)
            if std < q.unknown_m:
                out.height[k], out.height_std[k] = height, std
    for k in range(2):
        for i in range(3):
            out.tilt[k, i] = best.rotation[k, 2, i]


@inner
def _report_covariance(s: Record, out: Record, q: Record) -> None:
    """Covariance of the relative rotation in sensor 1's axes: R_1ᵀ P_(θ2 − θ1) R_1, and that of misalignment."""
    p, o = s.covariance, OF_SENSOR
    for j in range(3):
        for i in range(3):
            s.a[i] = p[i, j] + p[o + i, o + j] - p[i, o + j] - p[o + i, j]
        rotate_back(s.rotation[0], s.a, s.b)
        for i in range(3):
            s.m[i, j] = s.b[i]
    for i in range(3):
        rotate_back(s.rotation[0], s.m[i], s.b)
        for j in range(3):
            out.covariance[i, j] = s.b[j]
        out.covariance[i, i] += misalignment_variance(s, q)


@inner
def _report_angle(best: Record, states: Record, out: Record) -> None:
    weights = mean = square = 0.0
    first = hinge_angle(best)
    for i in range(states.shape[0]):
        s = states[i]
        if s.alive and s.has_axis > 0.0:
            weight = math.exp(s.odds)
            turned = vec.wrapped(hinge_angle(s) - first)
            weights += weight
            mean += weight * turned
            square += weight * (turned * turned + s.angle_std**2)
    mean /= weights
    out.angle = vec.wrapped(first + mean)
    out.angle_std = min(math.sqrt(max(square / weights - mean * mean, 0.0)), math.pi)


@inner
def _height(s: Record, k: int, size: int, base: int) -> tuple[float, float]:
    """Height of sensor k over the fixed joint (m) and its σ: Z of R_1 r_0; of sensor 2, R_1 (r_0 − r_1) + R_2 r_2."""
    clear_row(s)
    h, height = s.row, 0.0
    for part in range(1 + k):  # link 1, then link 2
        m, o = s.rotation[part], OF_SENSOR * part
        for i in range(3):
            s.a[i] = s.lever[1, i] if part == 1 else s.lever0[i] - (s.lever[0, i] if k == 1 else 0.0)
            if part == 0:
                h[base + i] = m[2, i]
                if k == 1:
                    h[R + i] = -m[2, i]
            else:
                h[OF_SENSOR + R + i] = m[2, i]
        rotate(m, s.a, s.b)
        height += s.b[2]
        h[o], h[o + 1] = s.b[1], -s.b[0]  # Z of δθ × u
    return height, math.sqrt(max(expected_square(s, size), 0.0))


@compiled
def process(
    first: ImuSamples, second: ImuSamples, calibration: Floats, bank_of: Record, states: Record, q_of: Record,
    noise: Floats, estimates: Record,
) -> None:  # fmt: skip
    """Estimates (N,) of ESTIMATE at N samples of both sensors; NaN where a sensor has no usable reading.

    `calibration` (2, 3, 3): offset (m/s²) and scale of each accelerometer, bias (rad/s) of each gyro. `noise`:
    variances of one reading of gyro and accelerometer.
    """
    bank, q = bank_of[0], q_of[0]
    for n in range(first.time_s.shape[0]):
        out, time_s, flags = estimates[n], first.time_s[n], first.flags[n]
        is_usable = flags & _NEEDED == _NEEDED and flags & _CLIPPED == 0
        is_usable = _read(bank, 0, time_s, first.accel[n], first.gyro[n], calibration) and is_usable
        is_usable = _read(bank, 1, time_s, second.accel[n], second.gyro[n], calibration) and is_usable
        bank.samples += 1
        if not is_usable:
            bank.rejected += 1
            _blank(out)
            continue
        gyro, accel = bank.new_gyro, bank.new_accel
        h = time_s - bank.time
        if has_to_forget(bank):
            forget(bank, states, q)
        if not bank.begun or h > q.longest_gap_s:
            bank.restarts += bank.begun
            _begin(bank, states, gyro, accel, q)
            _remember(bank, time_s, gyro, accel, True)
            bank.since_update = 0.0
        elif h > 0.0:
            _step(bank, states, gyro, accel, h, q, noise)
            _remember(bank, time_s, gyro, accel, False)
        if is_misfit(bank):
            bank.misfits += 1
            _blank(out)
        else:
            _report(bank, states, out, q)
            _report_covariance(states[bank.best], out, q)


@inner
def _read(bank: Record, k: int, time_s: float, accel: Floats, gyro: Floats, calibration: Floats) -> bool:
    """Calibrates the readings of sensor k into the bank. False where they are frozen, missing or impossible."""
    frozen = is_frozen(bank.last_readings[k], time_s, vec.load(accel), vec.load(gyro))
    is_possible, turns, norm, turning = True, False, 0.0, 0.0
    for i in range(3):
        force = (accel[i] - calibration[k, 0, i]) / calibration[k, 1, i]
        rate = gyro[i] - calibration[k, 2, i]
        bank.new_accel[k, i], bank.new_gyro[k, i] = force, rate
        norm += force * force
        turning += rate * rate
        is_possible = is_possible and abs(force) < _LARGEST and abs(rate) < _LARGEST
        turns = turns or abs(gyro[i]) > _RESTING_RAD_S
    if is_possible:
        bank.force_sum[k] += math.sqrt(norm)
        bank.rate_sum[k] += math.sqrt(turning)
        bank.readings[k] += 1
    frozen = frozen and (turns or time_s - bank.last_readings[k, MEMORY - 1] > _LONGEST_REPEAT_S)
    return is_possible and not frozen


@inner
def _step(bank: Record, states: Record, gyro: Floats, accel: Floats, h: float, q: Record, noise: Floats) -> None:
    """One sample, `h` (s) after the last."""
    for k in range(2):
        follow_rest(bank, states[bank.best], k, gyro, accel, h, q, noise)
        if bank.still_s[k] == 0.0:
            bank.rests = 0
    bank.since_update += h
    follow_path(bank, gyro, h)
    due = bank.since_update >= q.period_s
    for i in range(states.shape[0]):
        s = states[i]
        if s.alive:
            for k in range(2):
                integrate(s, k, bank, gyro, accel, h, q, noise)
            s.span += h
            if due:
                _update(s, bank, gyro, bank.since_update, q, noise)
                if bank.rests and min(bank.still_s[0], bank.still_s[1]) > q.rest_s:
                    begin_rest(bank, s)
    if due:
        bank.since_update = 0.0
        end_step(bank, states, q)
        _select(bank, states, q)
        follow_misfit(bank, states, q.period_s, q)
        if not bank.spread and states[0].heading_share > 0.0:
            _spread(bank, states, 1.0, gyro, q)


@inner
def _remember(bank: Record, time: float, gyro: Floats, accel: Floats, first: bool) -> None:
    bank.time = time
    for k in range(2):
        if first:
            bank.still_s[k] = 0.0
        for i in range(3):
            bank.gyro[k, i], bank.accel[k, i] = gyro[k, i], accel[k, i]
            if first:
                bank.mean_gyro[k, i], bank.mean_accel[k, i] = gyro[k, i], accel[k, i]
                bank.lagging_gyro[k, i], bank.lagging_accel[k, i] = gyro[k, i], accel[k, i]


@inner
def _blank(out: Record) -> None:
    for i in range(4):
        out.q[i] = math.nan
    out.rotation_std = out.angle = out.angle_std = math.nan
    for i in range(3):
        out.joint[i] = out.joint_std[i] = math.nan
    for k in range(2):
        out.height[k] = out.height_std[k] = math.nan
        for i in range(3):
            out.tilt[k, i] = math.nan
