"""The core over a block of samples: integrate each sample, update some 25 times in a second, report each sample.

A reading that repeats the last one to the last bit is an old one, read again by a logger that is faster than the
sensor: the step then waits for the next new force, with the rotation summed over the rates that arrive.
"""

from __future__ import annotations

import math
from typing import cast

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import (
    GRAVITY,
    LONGEST_BLIND_S,
    LONGEST_HOLD_S,
    Floats,
    ImuCalibration,
    blind_for,
    is_bounded,
    read_accel,
    read_gyro,
    rotation_variance,
    unknown_accel,
    unpacked,
)
from linkpose.filters._vector import Vec
from linkpose.filters.frozen import is_frozen
from linkpose.filters.inertial.free_velocity import correlation_time, follow_speed, update_free_velocity
from linkpose.filters.inertial.gravity import align_to_gravity, heading_axis, relate_heading
from linkpose.filters.inertial.joint_velocity import FIRST_REACH_M2_S2, measured_shares, update_joint_velocity
from linkpose.filters.inertial.noise import follow_noise, start_noise, with_noise
from linkpose.filters.inertial.propagate import (
    add_noise,
    angular_rate,
    clear_increments,
    corrected,
    decay_to_prior,
    integrate,
    propagate_covariance,
    specific_force,
    velocity_variance,
)
from linkpose.filters.inertial.report import report
from linkpose.filters.inertial.rest import (
    align_at_rest,
    follow_rest,
    follow_steadiness,
    update_bias_from_rest,
    update_bias_from_steadiness,
    update_tilt_from_rest,
)
from linkpose.filters.inertial.state import (
    BA,
    BG,
    MG,
    PSI,
    SIZE,
    D,
    Record,
    V,
    Z,
)
from linkpose.filters.inertial.unobservable import restore_unobservable
from linkpose.filters.inertial.update import sub_covariance

# Least interval between two updates (s). A faster pace gains nothing: what the models leave over is correlated.
_UPDATE_INTERVAL_S = 0.035
# From one sample to the next: a spike, or at least no smooth motion. A rate is compared with its linear extrapolation:
# at 1200 °/s it changes by more between sound samples.
_JUMP_RAD_S, _JUMP_M_S2 = 1.0, 10.0
_JUMP_VARIANCES = 100.0  # and beyond the measured noise: six times the σ of a difference of two readings
# By how much a rate beyond the gyro's range may exceed it (rad/s): a blow. Doubled, σ after one is twice as large.
_LARGEST_EXCESS_RAD_S = 10.0
_NO_JUMP = cast(bool, np.bool_(False))  # the compiler would take a Python constant for a type of its own
_STEADY_SIGMAS = 5.0  # a force within this of the last may be the same
# Start in motion: angular acceleration (rad/s²) at rest, and per rad/s of rate (1/s).
_START_RAD_S2, _SWING_PER_S = 3.0, 5.0
_START_SWING_S = 0.2  # velocity of such a start per acceleration, without a joint (s): a swing of 5 rad/s
# How much stronger the motion after a gap may be than the one before: factors of the mean square acceleration and of
# the variance of the velocity. Chosen on BROAD 01 with gaps: with 4 and 1, 89 % of the errors in the 3 s after a gap
# are within 2σ, with 4 and 2, 98 %. Without the motion before, the errors on BROAD are 20 to 30 % larger.
_GAP_ACCEL_GROWTH, _GAP_SPEED_GROWTH = 4.0, 2.0
_MOTION_LASTS_S = 10.0  # after a longer gap nothing is assumed of the motion
_LEAST_GAP_ACCEL_M2_S4 = 1.0  # at least: a slow hand, as σ of the tilt 6°
# The tilt is lost when the constraint leaves over this share of (ω×d)² for seconds, where there is that much motion.
_LOST, _LOST_M2_S2 = 0.5, 0.01
_ANY_HEADING_RAD2 = math.pi**2  # variance of a heading that is not known
# σ of what was learned grows by this factor then: after two or three losses in a row it is that of the start.
_WIDEN = 3.0
_LARGEST_ACCEL_BIAS_M_S2, _LARGEST_J2S_M = 5.0, 10.0
# Equivalent number of sensor errors for the assumed level. Chosen on the simulated Tests (calibrated, seeds 0 to 9):
# with 1, seven run-quantities of 360 have less than 85 % of their errors within 2σ, with 2 three; doubled, 0.3 % more
# of the errors are within 2σ.
_LEVEL_PRIOR = 2.0


@compiled
def process(
    times_s: Floats, accels: Floats, gyros: Floats, all_flags: NDArray[np.uint32],
    calibration: Floats, parameters: Record, states: Record, out: Record,
) -> None:  # fmt: skip
    """Advance the state over N samples: `out` (N,) of ESTIMATE, NaN where there is no estimate.

    The first four arguments are the fields of `ImuSamples`; `calibration` (12,) is a packed `ImuCalibration`.
    """
    s, q, imu = states[0], parameters[0], unpacked(calibration)
    for i in range(len(times_s)):
        time_s, flags = times_s[i], all_flags[i]
        accel, gyro = vec.row(accels, i), vec.row(gyros, i)
        dead = is_frozen(s.last_readings, time_s, accel, gyro)
        has_force, force = read_accel(accel, flags, imu)
        has_rate, rate = read_gyro(gyro, flags, imu)
        has_force, has_rate = has_force and not dead, has_rate and not dead
        good, first, h = has_force and has_rate, math.isnan(s.time), time_s - s.time
        noisy = with_noise(s, imu)
        if good and first and math.isfinite(time_s):
            _begin(s, force, rate, noisy, q)
            _take_sample(s, time_s, force, rate)
        elif good and max(h, s.blind_s) > LONGEST_BLIND_S and h < math.inf:
            _bridge(s, h, rate, noisy)
            _align(s, force, rate, noisy, q)
            _take_sample(s, time_s, force, rate)
        elif 0.0 < h < math.inf:
            good = _advance(s, time_s, dead, has_force, force, has_rate, rate, imu, noisy, q) and good
        else:
            good = False
        s.rejected += 0 if good else 1
        report(s, time_s, imu, out[i])


@inner
def _take_sample(s: Record, time_s: float, force: Vec, rate: Vec) -> None:
    """Continue from this sample, with nothing accumulated."""
    s.time = s.turned_at = time_s
    s.angle_variance = s.blind_s = s.no_force_s = s.clipped_s = 0.0
    vec.store(s.force, force)
    vec.store(s.rate, rate)
    vec.store(s.newest_rate, rate)
    vec.store(s.rate_slope, (0.0, 0.0, 0.0))
    vec.store(s.angle, (0.0, 0.0, 0.0))
    vec.store(s.force_change, (0.0, 0.0, 0.0))
    start_noise(s, force, rate)
    clear_increments(s)


@inner
def _begin(s: Record, force: Vec, rate: Vec, imu: ImuCalibration, q: Record) -> None:
    """Mean and covariance from one sample and the priors; at a restart, heading and its variance stay."""
    heading_variance = s.covariance[PSI, PSI]
    if not 0.0 <= heading_variance <= _ANY_HEADING_RAD2:  # NaN too, after impossible readings
        heading_variance = _ANY_HEADING_RAD2
    s.unmoved = s.north[0] == 0.0 and s.north[1] == 0.0 and s.north[2] == 0.0
    for i in range(SIZE):
        s.nominal[i] = s.start_mean[i]
        for j in range(SIZE):
            s.covariance[i, j] = s.start_covariance[i, j]
    _judge_parameters(s)
    s.rate_noise = s.force_noise = s.accel_square = 0.0
    s.covariance[PSI, PSI] = heading_variance
    if s.unmoved:
        vec.store(s.tilt, vec.unit(force) if vec.dot(force, force) > 0.0 else (0.0, 0.0, 1.0))
        vec.store(s.north, heading_axis(vec.load(s.tilt)))
    _forget_motion(s, q)
    _align(s, force, rate, imu, q)
    if s.unmoved:
        relate_heading(s)


@inner
def _forget_motion(s: Record, q: Record) -> None:
    """What was measured of the motion is measured again: the constraint's residual, the excited directions, a rest."""
    s.reach_square, s.assumed = FIRST_REACH_M2_S2, 1.0
    for i in range(3):
        s.residual_square[i] = FIRST_REACH_M2_S2 * q.first_residual**2
    s.rest_s = 0.0
    for i in range(3):
        for j in range(3):
            s.spread[i, j] = 0.0


@inner
def _align(s: Record, force: Vec, rate: Vec, imu: ImuCalibration, q: Record) -> None:
    """Tilt from the force, velocity from the model, as if nothing had been known of them."""
    rotation = angular_rate(s, rate)
    if q.has_joint:
        d = vec.load(s.j2s)
        # The acceleration that there may be: of a link that starts to turn, that swings, that whirls.
        reach = vec.dot(d, d) + vec.trace(sub_covariance(s.covariance, D))
        speed = vec.dot(rotation, rotation) + vec.trace(sub_covariance(s.covariance, BG))
        accel = imu.accel_variance + reach * (_START_RAD_S2**2 + speed * (_SWING_PER_S**2 + speed))
        align_to_gravity(s, force, accel, vec.cross(rotation, d), speed * reach + 1e-4)
        return
    accel = unknown_accel(force, rate)
    if s.accel_square > 0.0 and not s.unmoved:  # a gap: the motion goes on
        accel = min(accel, max(_GAP_ACCEL_GROWTH * s.accel_square, _LEAST_GAP_ACCEL_M2_S4))
        s.speed_square = min(_GAP_SPEED_GROWTH * s.speed_square, q.most_speed_m_s**2)
    else:
        s.speed_square = max(q.first_speed_m_s**2, s.speed_square, _START_SWING_S**2 * accel)
    align_to_gravity(s, force, imu.accel_variance + accel, (0.0, 0.0, 0.0), s.speed_square)
    vec.store(s.swing, (0.0, 0.0, 0.0))
    vec.store(s.mean_force, force)
    vec.store(s.mean_rate, rate)
    s.unsteadiness = 1.0


@inner
def _bridge(s: Record, h: float, rate: Vec, imu: ImuCalibration) -> None:
    """Heading across a gap, at the mean of the rates at its ends."""
    turn = angular_rate(s, vec.scale(0.5, vec.axpy(1.0, vec.load(s.newest_rate), rate)))
    integrate(s, vec.scale(h, turn), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)
    gap = min(max(h, s.blind_s), 3.0)
    add_noise(s, rotation_variance(gap, gap, imu), 0.0)
    s.rest_s = 0.0
    if max(h, s.blind_s) > _MOTION_LASTS_S:
        s.accel_square = 0.0


@inner
def _advance(
    s: Record, time_s: float, dead: bool, has_force: bool, force: Vec, has_rate: bool, rate: Vec, imu: ImuCalibration,
    noisy: ImuCalibration, q: Record,
) -> bool:  # fmt: skip
    """One sample later. False where its reading is rejected as a spike.

    `imu` holds the declared noise, by which a rest is recognised, `noisy` the noise as measured.
    """
    before_force, before_rate, newest = vec.load(s.force), vec.load(s.rate), vec.load(s.newest_rate)
    had_rate = s.blind_s == 0.0
    h = time_s - s.time
    # A saturated reading is the nearest there is; a missing one is replaced by the last.
    clipped = not has_force and is_bounded(force) and not dead
    s.clipped_s = s.clipped_s + h if clipped else 0.0
    s.no_force_s = 0.0 if has_force or clipped else s.no_force_s + h
    force = force if has_force or clipped else before_force
    rate = rate if has_rate or is_bounded(rate) else newest
    waits = has_force and has_rate and h < LONGEST_HOLD_S and _same(force, before_force)
    jerk = vec.axpy(s.turned_at - time_s, vec.load(s.rate_slope), vec.minus(rate, newest))
    jumped = vec.dot(jerk, jerk) > _JUMP_RAD_S**2 + _JUMP_VARIANCES * noisy.gyro_variance
    if time_s > s.turned_at and not (waits and (jumped or _same(rate, newest))):
        _turn(s, time_s - s.turned_at, has_rate, rate, jumped, noisy)
    if waits:
        return True
    change = vec.minus(force, before_force)
    jumped = q.has_joint > 0.0 and (
        jumped or vec.dot(change, change) > _JUMP_M_S2**2 + _JUMP_VARIANCES * noisy.accel_variance
    )
    if jumped and s.span > 0.0:  # so that this reading is judged alone
        _update(s, had_rate, _NO_JUMP, before_rate, before_rate, imu, noisy, q)
    north = vec.load(s.north)
    _integrate(s, h, force, change, noisy)
    if has_force and has_rate:
        follow_noise(s, force, rate, h, imu)
        follow_rest(s, north, force, rate, h, imu)
    if not q.has_joint:
        follow_speed(s, vec.scale(h, angular_rate(s, rate)), force, h, q)
        if has_force and has_rate:
            follow_steadiness(s, force, rate, h, imu, q)
    taken = True
    if jumped or s.span > _UPDATE_INTERVAL_S:
        taken = _update(s, has_rate, jumped, before_rate, rate, imu, noisy, q)
    if not taken:
        # A spike: its effect on this step is uncertain, and the next step does without it.
        add_noise(s, 0.0, 0.25 * h * h * vec.dot(change, change))
        rate, force, change = before_rate, before_force, (0.0, 0.0, 0.0)
    s.time = s.turned_at = time_s
    s.angle_variance = 0.0
    vec.store(s.angle, (0.0, 0.0, 0.0))
    vec.store(s.force, force)
    vec.store(s.rate, rate)
    vec.store(s.newest_rate, rate)
    vec.store(s.force_change, change)
    _restart_if_lost(s, force, rate, noisy, q)
    return taken


@inner
def _turn(s: Record, step: float, has_rate: bool, rate: Vec, jumped: bool, imu: ImuCalibration) -> None:
    """Sum the rotation, gyro bias included, up to a new rate, and its variance."""
    s.blind_s = blind_for(s.blind_s, step, has_rate, LONGEST_BLIND_S)
    newest = vec.load(s.newest_rate)
    angle = vec.axpy(0.5 * step, newest, vec.load(s.angle))
    vec.store(s.angle, vec.axpy(0.5 * step, newest if jumped else rate, angle))
    s.angle_variance += rotation_variance(step, s.blind_s, imu)
    if jumped:
        jerk = vec.minus(rate, newest)
        s.angle_variance += 0.25 * step * step * vec.dot(jerk, jerk)
    change = vec.scale(1.0 / step, vec.minus(rate, newest))
    pace = math.sqrt(vec.dot(change, change))
    if s.blind_s > 0.0:  # a saturated or missing rate departs from the last as fast as it did before
        s.rate_pace = max(pace, s.rate_pace)
        error = min(s.rate_pace * s.blind_s, _LARGEST_EXCESS_RAD_S)
        s.angle_variance += step * step * error * error
    else:
        s.rate_pace = pace
        vec.store(s.rate_slope, (0.0, 0.0, 0.0) if jumped else change)
    s.turned_at += step
    vec.store(s.newest_rate, rate)


@inner
def _integrate(s: Record, h: float, force: Vec, change: Vec, imu: ImuCalibration) -> None:
    """Advance the mean by a step `h`, and accumulate what the covariance needs of it."""
    before = vec.load(s.force)
    bend = vec.minus(change, vec.load(s.force_change))
    turn = corrected(s.nominal, MG, vec.axpy(-h, vec.load(s.gyro_bias), vec.load(s.angle)))
    begin, end = specific_force(s, before), specific_force(s, force)
    integrate(s, turn, begin, end, bend if s.no_force_s == 0.0 else (0.0, 0.0, 0.0), h)
    s.span += h
    s.rotation_variance += s.angle_variance
    s.velocity_variance += velocity_variance(s, change, bend, h, imu)
    vec.store(s.turned, vec.axpy(1.0, turn, vec.load(s.turned)))
    vec.store(s.impulse, vec.axpy(0.5 * h, vec.axpy(1.0, before, force), vec.load(s.impulse)))


@inner
def _update(
    s: Record, has_rate: bool, jumped: bool, before: Vec, rate: Vec, imu: ImuCalibration, noisy: ImuCalibration,
    q: Record,
) -> bool:  # fmt: skip
    """Bring the covariance up to the mean and apply the measurements. False where the reading is rejected."""
    h, impulse, taken = s.span, vec.load(s.impulse), True
    lasting = max(2.0 * correlation_time(s, q) / h, 1.0)
    rotation = lasting * q.gyro_misfit**2 * vec.dot(vec.load(s.turned), vec.load(s.turned))
    velocity = lasting * q.accel_misfit**2 * vec.dot(impulse, impulse)
    force = _steady_force(s, vec.scale(1.0 / h, impulse), noisy, q)
    propagate_covariance(s, force, rotation, velocity, _bias_walk(s, q) ** 2 * h)
    clear_increments(s)
    for i in range(D, PSI):
        s.covariance[i, i] += q.j2s_walk**2 * s.start_covariance[i, i] * h
    decay_to_prior(s, h)
    if q.has_joint and s.undecayed_s == 0.0:
        restore_unobservable(s)
    if q.has_joint:
        align_at_rest(s, h, noisy)
    update_bias_from_rest(s, h, noisy)
    if q.has_joint:
        if has_rate:
            taken = update_joint_velocity(s, jumped, before, rate, h, noisy, q)
    else:
        update_tilt_from_rest(s, h, noisy)
        update_free_velocity(s, h, q)
        if has_rate and s.no_force_s + s.clipped_s == 0.0:
            update_bias_from_steadiness(s, rate, h, imu, q)
    _judge_parameters(s)
    return taken


@inner
def _mean_residual_square(s: Record) -> float:
    """Mean over the axes (m²/s²)."""
    return float(s.residual_square[0] + s.residual_square[1] + s.residual_square[2]) / 3.0


@inner
def _bias_walk(s: Record, q: Record) -> float:
    """Random walk of the gyro bias ((rad/s)/√s); more where the joint's constraint leaves over more than its floor.

    Play, bending and the sensor's nonlinearity then act as a bias that follows the motion, and a bias that drifts fast
    shows there too. The third power makes the change steep: twice the floor allows eight times the walk. Only what has
    been measured counts: a share that is assumed at the start would widen a bias that is known already.
    """
    if not q.has_joint:
        return float(q.gyro_bias_walk_rad_s)
    x, y, z = measured_shares(s, q)
    share = math.sqrt((x + y + z) / 3.0) / q.least_residual
    return float(min(q.gyro_bias_walk_rad_s * share**3, q.most_bias_walk_rad_s))


@inner
def _steady_force(s: Record, force: Vec, imu: ImuCalibration, q: Record) -> Vec:
    """The part of the force that may update the accelerometer's matrix M_a.

    What is in v too would be explained by M_a = 1, whatever it is (errors in variables). At rest that is the noise: the
    force counts as far as it has moved by more than noise does. Without a joint it is all acceleration, since the model
    0 = v + e has the true velocity in e: gravity alone counts.
    """
    if not q.has_joint:
        return vec.scale(GRAVITY, vec.load(s.tilt))
    slack = _STEADY_SIGMAS * math.sqrt(imu.accel_variance)
    steady = vec.load(s.steady_force)
    ahead = vec.minus(force, steady)
    distance = math.sqrt(vec.dot(ahead, ahead))
    if distance > slack:
        steady = vec.axpy(1.0 - slack / distance, ahead, steady)
        vec.store(s.steady_force, steady)
    return steady


@inner
def _judge_parameters(s: Record) -> None:
    """Half the χ² of the estimated sensor errors under the prior, and the level of each sensor's errors.

    A right prior has an expected χ² of Σ (1 − σ²/prior): the number of errors that the motion has resolved. The level
    is the variance of unit weight, χ² over that number. The gyro bias is left out: it may be any.
    """
    accel, of_accel = _chi_square(s, BA, MG)
    gyro, of_gyro = _chi_square(s, MG, D)
    s.distance = 0.5 * (accel + gyro)
    s.tilt_level = (_LEVEL_PRIOR + accel) / (_LEVEL_PRIOR + of_accel)
    s.heading_level = (_LEVEL_PRIOR + gyro) / (_LEVEL_PRIOR + of_gyro)


@inner
def _chi_square(s: Record, first: int, end: int) -> tuple[float, float]:
    """χ² of some of the estimated sensor errors, and its expected value."""
    square = resolved = 0.0
    for i in range(first, end):
        inverse = 1.0 / s.prior[i]
        square += s.nominal[i] * s.nominal[i] * inverse
        resolved += max(1.0 - s.covariance[i, i] * inverse, 0.0)
    return square, resolved


@inner
def _restart_if_lost(s: Record, force: Vec, rate: Vec, imu: ImuCalibration, q: Record) -> None:
    """Begin anew where the state is impossible; align anew, keeping what was learned, where the tilt is lost."""
    bg, ba, d = vec.load(s.gyro_bias), vec.load(s.accel_bias), vec.load(s.j2s)
    attitude = vec.trace(sub_covariance(s.covariance, Z))
    possible = (
        vec.dot(bg, bg) < q.largest_bias_rad_s**2
        and vec.dot(ba, ba) < _LARGEST_ACCEL_BIAS_M_S2**2
        and vec.dot(d, d) < _LARGEST_J2S_M**2
        and s.distance < s.largest_distance
        and attitude < 1e6
        and math.isfinite(s.nominal[V] + s.nominal[V + 1] + s.nominal[V + 2] + s.tilt[0])
        and math.isfinite(vec.trace(sub_covariance(s.covariance, V)) + vec.trace(sub_covariance(s.covariance, D)))
    )
    lost = q.has_joint > 0.0 and _mean_residual_square(s) > _LOST * max(s.reach_square, _LOST_M2_S2)
    if possible and not lost:
        return
    s.restarts += 1
    clear_increments(s)
    if not possible:
        _begin(s, force, rate, imu, q)
        return
    _widen_parameters(s)
    _forget_motion(s, q)
    _align(s, force, rate, imu, q)


@inner
def _widen_parameters(s: Record) -> None:
    """Keep the estimates of J2S and the sensor errors, with a wider σ: at most that of the start."""
    p = s.covariance
    for i in range(BG, PSI):
        factor = min(_WIDEN, math.sqrt(s.start_covariance[i, i] / max(p[i, i], 1e-300)))
        for j in range(SIZE):
            p[i, j] *= factor
        for j in range(SIZE):
            p[j, i] *= factor


@inner
def _same(a: Vec, b: Vec) -> bool:
    return bool(a[0] == b[0] and a[1] == b[1] and a[2] == b[2])
