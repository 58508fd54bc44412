"""Rest as a measurement of gyro bias and tilt: by a test of stillness, and without a threshold by steadiness."""

from __future__ import annotations

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY, ImuCalibration
from linkpose.filters._vector import Vec
from linkpose.filters.inertial.gravity import align_to_gravity, relate_heading
from linkpose.filters.inertial.propagate import specific_force
from linkpose.filters.inertial.state import BA, BG, MA, PSI, SIZE, Record, Z
from linkpose.filters.inertial.update import (
    constrain_attitude,
    project,
    start_parameters,
    sub_covariance,
    update_scalar,
    update_vector,
)

# Stillness before the mean rate counts as the gyro bias and the mean force as gravity (s): longer than a turning point
# of a slow swing. Doubled, a launch soon after switch-on leans the tilt.
REST_S = 0.5
# A link that is held still turns by no more than this in all (rad, 1σ): a hand's tremor through a metre of lever.
# Divided by the length of the rest it bounds the mean rate. Doubling it doubles the heading's drift after a short rest.
_SWAY_RAD = 5e-4
_MOST_SWAY_RAD_S = _SWAY_RAD / REST_S
_REST_SIGMAS = 5.0  # within which the readings must stay: one sound sample in 10⁶ ends a rest
# Rotation since the rest began that an unknown bias may have added (rad, 1σ, all axes), beyond which the attitude is
# taken from the rest anew. A linear update is wrong by half its square (0.03° at this).
_FAR_RAD = 0.03
_TURN_SIGMAS = 3.0  # a mean rate this far from the bias estimate is a turn at constant rate
_SWAY_M_S = 0.05  # change of velocity over a rest (m/s, 1σ): a hand's tremor
_REST_SPEED_M2_S2 = 1e-4  # variance of the velocity at rest, each axis: a hand's tremor
_NORM_M_S2 = 0.5  # 1σ of the force along Z at rest (m/s²): 3 % scale and 50 mg, an uncalibrated MPU-6050
_GATE = 25.0  # χ² with one degree of freedom: five standard deviations


@inner
def follow_rest(s: Record, north: Vec, force: Vec, rate: Vec, h: float, imu: ImuCalibration) -> None:
    """Measure how long neither force nor rate has left its noise; `north` is X at the sample before."""
    still = s.rest_s
    change = vec.minus(force, vec.load(s.rest_force))
    drift = vec.axpy(-1.0, vec.load(s.rest_rate_sum), vec.scale(still, rate))
    width = 3.0 * _REST_SIGMAS**2
    steady = vec.dot(change, change) < width * imu.accel_variance
    steady = steady and vec.dot(drift, drift) < width * (imu.gyro_variance + _MOST_SWAY_RAD_S**2) * still * still
    if still > 0.0 and not steady:
        s.rest_s, s.unmoved = 0.0, False
        return
    if still == 0.0:
        vec.store(s.rest_north, north)
        s.rest_heading_variance = s.covariance[PSI, PSI]
        vec.store(s.rest_force, force)
        vec.store(s.rest_force_sum, (0.0, 0.0, 0.0))
        vec.store(s.rest_rate_sum, (0.0, 0.0, 0.0))
    s.rest_s = still + h
    vec.store(s.rest_force_sum, vec.axpy(h, force, vec.load(s.rest_force_sum)))
    vec.store(s.rest_rate_sum, vec.axpy(h, rate, vec.load(s.rest_rate_sum)))


@inner
def update_bias_from_rest(s: Record, h: float, imu: ImuCalibration) -> None:
    """The gyro bias is the mean rate since the rest began, where that adds to what is known and is possible.

    `h`: time since the last update (s), over which the noise of the gyro counts as correlated.
    """
    p, rest_s = s.covariance, s.rest_s
    if rest_s <= REST_S:
        return
    variance = imu.gyro_variance * h / rest_s + (_SWAY_RAD / rest_s) ** 2
    if vec.trace(sub_covariance(p, BG)) <= 6.0 * variance or _is_turn(s, variance):
        return
    for j in range(3):
        update_scalar(s, BG + j, s.rest_rate_sum[j] / rest_s - s.nominal[BG + j], variance)
    constrain_attitude(s)


@inner
def _is_turn(s: Record, variance: float) -> bool:
    """Whether the mean rate is too far from the bias to be one."""
    for j in range(BG, BA):
        innovation = s.rest_rate_sum[j - BG] / s.rest_s - s.nominal[j]
        if innovation * innovation > _TURN_SIGMAS**2 * (s.covariance[j, j] + variance):
            return True
    return False


@inner
def _is_turn_at_start(s: Record) -> bool:
    """Whether the mean rate since the first sample is too large for a gyro's bias at switch-on."""
    for j in range(BG, BA):
        innovation = s.rest_rate_sum[j - BG] / s.rest_s - s.start_mean[j]
        if innovation * innovation > _TURN_SIGMAS**2 * s.switch_on_variance:
            return True
    return False


@inner
def align_at_rest(s: Record, h: float, imu: ImuCalibration) -> None:
    """Gyro bias and attitude from a rest, where the bias was unknown: no axis has turned since the rest began.

    Until then, the bias has turned the attitude, by up to 10° after switch-on, and the constraint has been met by wrong
    sensor errors of a small σ. After a rest since switch-on, all of them start anew, and the data sheet alone decides
    whether the mean rate is a bias. `h` as for `update_bias_from_rest`.
    """
    p, rest_s = s.covariance, s.rest_s
    if rest_s <= REST_S:
        return
    variance = imu.gyro_variance * h / rest_s + (_SWAY_RAD / rest_s) ** 2
    is_turn = _is_turn(s, variance)
    if not (s.unmoved and is_turn) and vec.trace(sub_covariance(p, BG)) * rest_s * rest_s <= _FAR_RAD**2:
        return
    if s.unmoved:
        is_turn = _is_turn_at_start(s)
    if is_turn:
        return
    if s.unmoved:
        start_parameters(s)
    for i in range(BG, BG + 4):
        k = i if i < BA else PSI
        for j in range(SIZE):
            p[k, j] = p[j, k] = 0.0
    for i in range(3):
        s.nominal[BG + i] = s.rest_rate_sum[i] / rest_s
        p[BG + i, BG + i] = variance
    p[PSI, PSI] = _SWAY_RAD**2 + (0.0 if s.unmoved else s.rest_heading_variance)
    vec.store(s.north, vec.load(s.rest_north))
    force = vec.scale(1.0 / rest_s, vec.load(s.rest_force_sum))
    accel = imu.accel_variance * h / rest_s + (_SWAY_M_S / rest_s) ** 2
    align_to_gravity(s, force, accel, (0.0, 0.0, 0.0), _REST_SPEED_M2_S2)
    if s.unmoved:
        relate_heading(s)


@inner
def update_tilt_from_rest(s: Record, h: float, imu: ImuCalibration) -> None:
    """The mean force since the rest began is gravity: f − g Z = g δZ + δb_a + δM_a s_A + e.

    The velocity of a rest is constant, which need not be zero: no velocity is assumed. Along Z the force shows no tilt,
    only the sensor's own scale and offset, which are those of a calibrated sensor in the state: it counts little.
    `h`: time since the last update (s), over which the noise of the accelerometer counts as correlated.
    """
    rest_s = s.rest_s
    if rest_s <= REST_S:
        return
    reading, jacobian = vec.scale(1.0 / rest_s, vec.load(s.rest_force_sum)), s.jacobian
    for c in range(3):
        for j in range(SIZE):
            jacobian[c, j] = 0.0
        jacobian[c, Z + c] = GRAVITY
        jacobian[c, BA + c] = 1.0
        for k in range(3):
            jacobian[c, MA + 3 * c + k] = reading[k]
    variance = imu.accel_variance * h / rest_s + (_SWAY_M_S / rest_s) ** 2
    expected = project(s)
    if vec.trace(expected) <= 6.0 * variance:
        return
    tilt = vec.load(s.tilt)
    innovation = vec.axpy(-GRAVITY, tilt, specific_force(s, reading))
    whole = vec.plus_diagonal(expected, variance + _NORM_M_S2**2)
    inverse = vec.inverse(vec.add(whole, -(_NORM_M_S2**2), vec.cross_square(tilt, 1.0)))
    distance = vec.quadratic(inverse, innovation)
    update_vector(s, innovation, vec.scaled(min(1.0, _GATE / max(distance, 1.0)), inverse))


@inner
def follow_steadiness(s: Record, force: Vec, rate: Vec, h: float, imu: ImuCalibration, q: Record) -> None:
    """Measure by how much rate and force have changed over the memory."""
    keep = min(h / q.steady_memory_s, 1.0)
    mean_force, mean_rate = vec.load(s.mean_force), vec.load(s.mean_rate)
    moved, turned = vec.minus(force, mean_force), vec.minus(rate, mean_rate)
    vec.store(s.mean_force, vec.axpy(keep, moved, mean_force))
    vec.store(s.mean_rate, vec.axpy(keep, turned, mean_rate))
    # A force that turns by so much in this time is that rate of turn.
    leaning = max(vec.dot(moved, moved) - 6.0 * imu.accel_variance, 0.0) / (GRAVITY * q.steady_memory_s) ** 2
    s.unsteadiness += keep * (vec.dot(turned, turned) + leaning - s.unsteadiness)


@inner
def update_bias_from_steadiness(s: Record, rate: Vec, h: float, imu: ImuCalibration, q: Record) -> None:
    """s_G = b_g + e: the less rate and force change, the smaller e."""
    p = s.covariance
    moving = max(s.unsteadiness - 6.0 * imu.gyro_variance, 0.0)
    variance = q.swing_share**2 * moving + q.least_turn_rad_s**2
    steady = vec.load(s.mean_rate)
    if vec.dot(steady, steady) > q.largest_bias_rad_s**2:
        return  # no bias reaches this: a turn at constant rate
    noise = variance * max(2.0 * q.steady_memory_s / h, 1.0)
    for k in range(BG, BA):
        innovation = rate[k - BG] - s.nominal[k]
        if innovation * innovation < _GATE * (p[k, k] + variance):  # a bias does not jump
            update_scalar(s, k, innovation, noise)
    constrain_attitude(s)
