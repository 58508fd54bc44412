"""One step of the planar filters, from a reading of the mice to the next, and the loop over a block of samples."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inner
from linkpose.filters._imu import ImuCalibration, read_gyro
from linkpose.filters.mice import reading
from linkpose.filters.mice.faults import fault_limit, number
from linkpose.filters.mice.least_squares import squared_speed
from linkpose.filters.mice.state import Floats, Record
from linkpose.filters.planar.moments import (
    GYRO,
    MOUSE,
    ZERO_VX,
    ZERO_VY,
    ZERO_WZ,
    add_row,
    drive_on,
    linear_advance,
    linear_moments,
    sigma_advance,
    sigma_moments,
    spread_points,
    update_vector,
)
from linkpose.filters.planar.rest import watch_rest
from linkpose.filters.planar.state import ANGLE, BIAS, MICE, OF_MOUSE, POSITION, SCALE, VX, VY, WZ

SHOWN = 6  # pose and velocity
# How long mice that contradict the prediction are left out (s). Doubled: the velocity is held longer after a collision.
_PATIENCE_S = 0.5
# Residual motion at rest: m/s and rad/s. Doubled: no visible change.
_REST_M_S, _REST_RAD_S = 1e-4, 1e-5
# Within one step a velocity changes by about this (m/s², rad/s²): the velocity is the mean over the step, the estimate
# belongs to its end. Doubled: the stated ± of the velocity grows by half.
_ACCEL_M_S2, _ANGULAR_RAD_S2 = 0.6, 1.2
# A gyro whose rates are missing for part of a step may be wrong by this for each second (rad/s²).
_RATE_CHANGE_RAD_S2 = 4.0
# The gyro sees another floor: by this many standard deviations, and at least by this share, over so much turning
# (rad²/s), forgotten after so long (s). Halving the share takes scale errors of the gyro for floors.
_FLOOR_Z, _FLOOR_SHARE, _FLOOR_TURN, _FLOOR_MEMORY_S = 4.0, 0.015, 0.5, 30.0
# The bias that the fault tests assume is this much less certain than the filter's (rad/s): slow drift of a gyro.
_BIAS_MARGIN_RAD_S = 0.005
_NOISE_S = 0.01  # over which noise common to all mice keeps its value (s)


@inner
def _move_on(state: Record, p: Record, dt: float) -> None:
    """Prediction of velocity, bias and calibration over `dt` (s): first-order processes and random walks."""
    n, cov = state.size, state.covariance
    for j in range(3):
        at = int(VX) + j
        std = p.speed_m_s if j < 2 else p.turn_rad_s
        keep = math.exp(-dt / (p.speed_s if j < 2 else p.turn_s))
        state.mean[at] *= keep
        for k in range(n):
            cov[at, k] *= keep
        for k in range(n):
            cov[k, at] *= keep
        cov[at, at] += std * std * (1.0 - keep * keep)
    cov[BIAS, BIAS] += p.bias_walk**2 * dt
    for at in range(MICE, n, OF_MOUSE):
        cov[at + SCALE, at + SCALE] += p.scale_walk**2 * dt
        cov[at + ANGLE, at + ANGLE] += p.angle_walk**2 * dt


@inner
def _collect(state: Record, mice: Record, rig: Record, counts: Floats, p: Record, dt: float, step: float) -> None:
    """The rows of the measurement of this step."""
    state.rows = 0
    if state.at_rest:
        add_row(state, ZERO_VX, 0.0, _REST_M_S**2)
        add_row(state, ZERO_VY, 0.0, _REST_M_S**2)
        add_row(state, ZERO_WZ, 0.0, _REST_RAD_S**2)
        return
    if math.isfinite(mice.mean_rate):
        missing = _RATE_CHANGE_RAD_S2 * (dt - min(step, dt))
        add_row(state, GYRO, mice.mean_rate, state.gyro_variance / max(mice.rates, 1) + missing * missing)
    for i in range(rig.count):
        if mice.used >> i & 1 and step > 0.0:
            speed2 = squared_speed(rig, i, state.mean[VX], state.mean[VY], state.mean[WZ])
            variance = reading.variance(rig, i, step, speed2, p.scatter, p.noise_m_s)
            x, y = counts[i, 0] * rig.metres_per_count[i], counts[i, 1] * rig.metres_per_count[i]
            c, s = rig.axes[i, 0], rig.axes[i, 1]
            add_row(state, MOUSE + 2 * i, (c * x - s * y) / step, variance)
            add_row(state, MOUSE + 2 * i + 1, (s * x + c * y) / step, variance)


@inner
def _watch_floor(state: Record, mice: Record, p: Record, dt: float, step: float) -> None:
    """Widen the common scale of the mice where they turn by another amount than the gyro: another floor."""
    if state.at_rest or number(mice.used) < 2 or not (step == dt and math.isfinite(mice.mean_rate)):
        return
    keep = math.exp(-dt / _FLOOR_MEMORY_S)
    turn = mice.mean_rate - state.mean[BIAS]
    state.turn_square = keep * state.turn_square + turn * turn * dt
    state.turn_product = keep * state.turn_product + turn * mice.velocity[2] * dt
    state.turn_variance = keep * keep * state.turn_variance + (turn * dt * mice.std[2]) ** 2
    if state.turn_square < _FLOOR_TURN:
        return
    off = abs(state.turn_product / state.turn_square - 1.0)
    if off <= _FLOOR_SHARE + _FLOOR_Z * math.sqrt(state.turn_variance) / state.turn_square:
        return
    for a in range(MICE + SCALE, state.size, OF_MOUSE):
        for b in range(MICE + SCALE, state.size, OF_MOUSE):
            state.covariance[a, b] += p.floor_scale**2
    _forget_positions(state)
    state.turn_square = state.turn_product = state.turn_variance = 0.0
    state.floors += 1


@inner
def _forget_positions(state: Record) -> None:
    """Return the positions of the mice to the rig's: they have taken up part of the scale error."""
    for i in range(MICE, state.size, OF_MOUSE):
        for at in range(i + POSITION, i + OF_MOUSE):
            state.mean[at] = 0.0
            for k in range(state.size):
                state.covariance[at, k] = state.covariance[k, at] = 0.0
            state.covariance[at, at] = state.start[at] ** 2


@inner
def _calibrate(state: Record, mice: Record, rig: Record, place: Record) -> None:
    """Give the fault tests the placement and the gyro bias as the filter has estimated them."""
    for i in range(rig.count):
        at = MICE + OF_MOUSE * i
        c, s = math.cos(state.mean[at + ANGLE]), math.sin(state.mean[at + ANGLE])
        place.axes[i, 0] = c * rig.axes[i, 0] - s * rig.axes[i, 1]
        place.axes[i, 1] = s * rig.axes[i, 0] + c * rig.axes[i, 1]
        place.metres_per_count[i] = rig.metres_per_count[i] * math.exp(state.mean[at + SCALE])
        place.position[i, 0] = rig.position[i, 0] + state.mean[at + POSITION]
        place.position[i, 1] = rig.position[i, 1] + state.mean[at + POSITION + 1]
    mice.bias = state.mean[BIAS]
    mice.bias_std = math.sqrt(state.covariance[BIAS, BIAS]) + _BIAS_MARGIN_RAD_S


@inner
def _restart(state: Record) -> None:
    """A covariance that rounding has spoilt starts anew; the mean stays."""
    state.restarts += 1
    for i in range(state.size):
        for j in range(state.size):
            state.covariance[i, j] = state.start[i] ** 2 if i == j else 0.0


@inner
def _advance(state: Record, is_ukf: bool, dt: float) -> bool:
    """Carry the pose on by `dt` (s) with the velocity."""
    if is_ukf:
        if not spread_points(state):
            return False
        sigma_advance(state, dt)
    else:
        linear_advance(state, dt)
    return True


@inner
def _correct(state: Record, rig: Record, is_ukf: bool, always: int, dt: float) -> bool:
    """Update with the collected rows, for a while without mice that contradict the prediction.

    Mice that slip or are lifted contradict at once; the fault tests take a few steps to find them, in which they would
    spoil the calibration.
    """
    if state.rows == 0:
        return True
    rows, is_patient = state.rows, state.refused_s < _PATIENCE_S
    if is_ukf:
        if not spread_points(state):
            return False
        sigma_moments(state, rig)
    else:
        linear_moments(state, rig)
    limit = fault_limit(rows)
    if not update_vector(state, always, limit if is_patient else math.inf):
        return False
    state.refused_s = state.refused_s + dt if state.chi2 > limit else 0.0
    return True


@inner
def _scatter_way(state: Record, p: Record, dt: float, missed: float) -> None:
    """Noise that mice do not show: common to all of them, and what a robot does while samples are lost."""
    speed2 = state.mean[VX] ** 2 + state.mean[VY] ** 2
    unseen = 0.25 * _ACCEL_M_S2 * missed * missed
    variance = p.floor * p.floor * speed2 * dt * _NOISE_S + unseen * unseen
    state.covariance[0, 0] += variance
    state.covariance[1, 1] += variance


@inner
def _step(
    state: Record, mice: Record, rig: Record, place: Record, p: Record, q: Record, counts: Floats, time_s: float,
    is_ukf: bool,
) -> None:  # fmt: skip
    """One reading of the mice."""
    dt, step = reading.begin_step(mice, time_s)
    if not dt > 0.0:
        return
    if reading.correct(mice, place, p, dt, step, False):
        mice.known_time = time_s
    is_silent = mice.sound != 0
    for i in range(rig.count):
        is_silent = is_silent and (not mice.sound >> i & 1 or mice.silent_s[i] > 0.0)
    watch_rest(state, is_silent, mice.rate, dt)
    missed = dt - step if step > 0.0 else 0.0
    is_good = missed == 0.0 or _advance(state, is_ukf, 0.5 * missed)
    _move_on(state, q, dt)
    _collect(state, mice, rig, counts, p, dt, step)
    state.rejected += state.rows == 0 or (mice.used == 0 and not state.at_rest)
    always = state.rows if state.at_rest else int(math.isfinite(mice.mean_rate))
    is_good = is_good and _correct(state, rig, is_ukf, always, dt) and _advance(state, is_ukf, dt - 0.5 * missed)
    if not is_good:
        _restart(state)
    _scatter_way(state, p, dt, missed)
    _watch_floor(state, mice, q, dt, step)
    _calibrate(state, mice, rig, place)


@inner
def _show(state: Record, since: float, step: float, out: Floats) -> None:
    """Pose (heading in [−π, π)), velocity and their standard deviations, `since` (s) after the last reading."""
    drive_on(state.mean, since, out)
    out[2] -= 2.0 * math.pi * math.floor((out[2] + math.pi) / (2.0 * math.pi))
    lag = since if state.at_rest else 0.5 * step + since
    for j in range(SHOWN):
        variance = state.covariance[j, j]
        if j < 3:
            variance += (
                since * (2.0 * state.covariance[j, VX + j] if j == 2 else 0.0)
                + since * since * (state.covariance[VX + j, VX + j])
            )
        else:
            out[j] = state.mean[j]
            change = (_ACCEL_M_S2 if j < 5 else _ANGULAR_RAD_S2) * lag
            variance += change * change
        out[SHOWN + j] = math.sqrt(max(variance, 0.0))


@compiled
def process(
    time_s: Floats,
    counts: Floats,
    gyro: Floats,
    flags: NDArray[np.uint32],
    is_ukf: bool,
    rig: Record,
    place: Record,
    imu: ImuCalibration,
    p: Record,
    q: Record,
    mice: Record,
    state: Record,
    out: Floats,
) -> None:
    """Every sample of a block: estimates (N, 12) into `out`. `p` are MiceParameters, `q` PlanarParameters."""
    for i in range(len(time_s)):
        has_rate, rate = read_gyro((gyro[i, 0], gyro[i, 1], gyro[i, 2]), flags[i], imu)
        reading.follow_gyro(mice, time_s[i], rate[2] if has_rate else math.nan, flags[i])
        if not flags[i] & reading.STALE:
            reading.read_counts(mice, place, counts[i], flags[i])
            _step(state, mice, rig, place, p, q, counts[i], time_s[i], is_ukf)
            reading.end_step(mice)
        since = time_s[i] - mice.time
        step = mice.interval if math.isfinite(mice.interval) else 0.0
        _show(state, since if since > 0.0 else 0.0, step, out[i])
