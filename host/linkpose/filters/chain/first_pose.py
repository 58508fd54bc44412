"""The attitudes S_k at the first sample, from which joint angles count.

The attitudes are corrected by tens of degrees until the heading and the gyro biases are found, further than the linear
correction of S_k reaches. Over the first seconds of motion the rates are kept, and S_k is traced back from the present
attitude with the present bias:

    S = R Π exp(−[(∫ω dt − b h)×]),   δs = δθ + (∫R dt) δb + e

A chain that rests at first shows its tilts there, to within the accelerometers' biases. Once the heading is found, S_k
is traced back, and these tilts are a measurement of it. From then on it is traced back only where that makes it more
certain: with calibrated sensors after 10 to 20 s, with those of the data sheet seldom.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY
from linkpose.filters.chain.hinge import hinge_angle
from linkpose.filters.chain.propagate import GYRO_MISFIT_S
from linkpose.filters.chain.rotation import between, rotate, to_matrix, turn
from linkpose.filters.chain.state import BA, BG, OF_SENSOR, PATH, START, Floats, Record
from linkpose.filters.chain.stops import shift_stops
from linkpose.filters.chain.update import apply_correction, clear_row, expected_square, update

_RETRACED = 25  # steps of the path between two traces back: 1 s
# Steps over which the pose of a start in motion is traced back in any case: 10 s, until the gyro biases are found.
_FREE = 256
# What scale and cross-axis errors add over a path of 10 s relative to `_misfit_variance`, which takes them for noise:
# 1.4 (hinge) to 2.3 (ball joint) in simulated legs, seeds 0-7. It is the weight of the path beside a rest.
_OF_PATH = 2.0
# Square of the angle between S_2 relative to S_1 and what is traced back, over the latter's variance, from which on the
# former has suffered from a wrong heading: 2 σ.
_CONTRADICTED = 4.0
_REST_TILT_RAD = 3e-4  # σ of the direction of the force over a rest: noise of the mean of a second


@inner
def begin_start(s: Record, size: int) -> None:
    """S_k is the attitude now, with its error."""
    p = s.covariance
    s.traced_square, s.is_traced = 0.0, 0
    for k in range(2):
        s.path_square[k] = 0.0
        for i in range(4):
            s.start[k, i] = s.attitude[k, i]
        for i in range(3):
            for j in range(size):
                p[START + 3 * k + i, j] = p[OF_SENSOR * k + i, j]
    for k in range(2):
        for i in range(3):
            for j in range(size):
                p[j, START + 3 * k + i] = p[j, OF_SENSOR * k + i]


@inner
def begin_rest(bank: Record, s: Record) -> None:
    """The chain still rests as at the first sample: S_k is the attitude now, which is closer to the truth than before.

    Keeps the force of the rest.
    """
    begin_start(s, bank.length)
    begin_path(bank, 0)
    bank.rested = 1
    for k in range(2):
        for i in range(3):
            bank.rest_force[k, i] = GRAVITY * s.rotation[k, 2, i] + s.accel_bias[k, i]


@inner
def begin_path(bank: Record, length: int) -> None:
    """Follow the path from now on (`length` 0), or not (−1)."""
    bank.path_length, bank.path_s = length, 0.0
    for k in range(2):
        for i in range(3):
            bank.path_sum[k, i] = 0.0


@inner
def follow_path(bank: Record, gyro: Floats, h: float) -> None:
    """Add the rotation vector over a step of h (s), from the rates in the bank to these, with its coning."""
    bank.path_s += h
    for k in range(2):
        so_far, before, now = vec.load(bank.path_sum[k]), vec.load(bank.gyro[k]), vec.load(gyro[k])
        step = vec.scale(0.5 * h, vec.axpy(1.0, before, now))
        coning, inner_coning = vec.cross(so_far, step), vec.cross(before, now)
        for i in range(3):
            bank.path_sum[k, i] += step[i] + 0.5 * coning[i] + h * h / 12 * inner_coning[i]


@inner
def end_step(bank: Record, states: Record, q: Record) -> None:
    """Store what has been added, and trace the first pose back where it is due."""
    at = bank.path_length
    if at < 0 or at == PATH:
        return
    bank.path_span[at] = bank.path_s
    for k in range(2):
        for i in range(3):
            bank.path[at, k, i] = bank.path_sum[k, i]
    begin_path(bank, at + 1)
    if bank.path_length % _RETRACED == 0:
        for n in range(states.shape[0]):
            if states[n].alive:
                _trace_back(states[n], bank, q)


@inner
def _misfit_variance(s: Record, path_square: float, q: Record) -> float:
    """Variance (rad²) about one axis that the misfit of the gyros adds over a path."""
    return float(min(s.level, 1.0) * q.gyro_misfit**2 * GYRO_MISFIT_S * path_square)


@inner
def trace_variance(s: Record, q: Record) -> float:
    """Variance (rad²) of the first relative rotation about one axis that P does not hold: misfit of the gyros.

    It follows the level, which has fallen long after the path was traced.
    """
    return _misfit_variance(s, s.traced_square, q)


@inner
def _trace_back(s: Record, bank: Record, q: Record) -> None:
    after_rest = bank.rested and not s.is_traced
    if after_rest and s.rotation_std > q.level_std_rad:
        return
    for k in range(2):
        _trace_sensor(s, bank, k)
    square = s.path_square[0] + s.path_square[1]
    if not after_rest and (bank.rested or bank.path_length > _FREE):
        before = _first_variance(s, bank, False) + 3 * trace_variance(s, q)
        after = _first_variance(s, bank, True) + 3 * _misfit_variance(s, square, q)
        if after > before and _moved_square(s) < _CONTRADICTED * after:
            return
    angle = hinge_angle(s)
    _set_start(s, bank.length)
    s.traced_square = square
    if after_rest:
        s.is_traced, s.traced_square = 1, 0.0
        _add_rest(s, bank, _OF_PATH * _misfit_variance(s, square, q), q)
    shift_stops(s, vec.wrapped(hinge_angle(s) - angle))


@inner
def _moved_square(s: Record) -> float:
    """Square of the angle (rad) between the first relative rotation as it is and as it was traced back."""
    between(s.start[0], s.start[1], s.first)
    between(s.traced[0], s.traced[1], s.relative)
    a, b = s.first, s.relative
    cosine = abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3])
    return float((2 * math.acos(min(cosine, 1.0))) ** 2)


@inner
def _set_start(s: Record, size: int) -> None:
    """S_k becomes what has been traced back, with its covariance."""
    p = s.covariance
    for k in range(2):
        for i in range(4):
            s.start[k, i] = s.traced[k, i]
    for side in range(2):
        for k in range(2):
            o, at, m = OF_SENSOR * k, START + 3 * k, s.by_bias[k]
            for i in range(3):
                for c in range(size):
                    total = p[o + i, c] if side == 0 else p[c, o + i]
                    for j in range(3):
                        total += m[i, j] * (p[o + BG + j, c] if side == 0 else p[c, o + BG + j])
                    if side == 0:
                        p[at + i, c] = total
                    else:
                        p[c, at + i] = total


@inner
def _add_rest(s: Record, bank: Record, misfit: float, q: Record) -> None:
    """Apply the force of the rest, with the present bias: S (f − b_a) / g = Z − δs × Z + S δb_a / g + e.

    e: scale and cross-axis errors of the accelerometer, which the bias stands for in other poses. `misfit`: variance
    (rad²) of the relative rotation about one axis that the path adds to P.
    """
    variance = min(s.level, 1.0) * q.accel_scale**2 + _REST_TILT_RAD**2
    for i in range(3):
        for k in range(2):
            s.covariance[START + 3 * k + i, START + 3 * k + i] += 0.5 * misfit
    for k in range(2):
        to_matrix(s.start[k], s.m)
        for i in range(3):
            s.a[i] = (bank.rest_force[k, i] - s.accel_bias[k, i]) / GRAVITY
        rotate(s.m, s.a, s.b)
        x, y = s.b[0], s.b[1]
        for row in range(2):
            sign, across = 1.0 - 2.0 * row, 1 - row
            clear_row(s)
            s.row[START + 3 * k + row] = 1.0
            for i in range(3):
                s.row[OF_SENSOR * k + BA + i] = sign * s.m[across, i] / GRAVITY
            update(s, bank.length, y if row == 0 else -x, variance, q.huber)
    apply_correction(s, bank.length, bank.hinge, bank.fixed)


@inner
def _first_variance(s: Record, bank: Record, traced: bool) -> float:
    """Variance (rad²) of the first relative rotation in P, about all axes: of S_k as it is, or `traced` back now."""
    total = 0.0
    for i in range(3):
        clear_row(s)
        for k in range(2):
            sign, o = 2.0 * k - 1.0, OF_SENSOR * k
            if traced:
                s.row[o + i] = sign
                for j in range(3):
                    s.row[o + BG + j] = sign * s.by_bias[k, i, j]
            else:
                s.row[START + 3 * k + i] = sign
        total += expected_square(s, bank.length)
    return total


@inner
def _trace_sensor(s: Record, bank: Record, k: int) -> None:
    """S_k in `traced`, and ∫R dt in `by_bias`."""
    q, m, sums = s.traced[k], s.m, s.by_bias[k]
    for i in range(4):
        q[i] = s.attitude[k, i]
    for i in range(3):
        for j in range(3):
            sums[i, j] = 0.0
    for back in range(bank.path_length):
        n = bank.path_length - 1 - back
        h = bank.path_span[n]
        x = 0.5 * (h * s.gyro_bias[k, 0] - bank.path[n, k, 0])
        y = 0.5 * (h * s.gyro_bias[k, 1] - bank.path[n, k, 1])
        z = 0.5 * (h * s.gyro_bias[k, 2] - bank.path[n, k, 2])
        turn(q, x, y, z, -1.0)
        to_matrix(q, m)
        for i in range(3):
            for j in range(3):
                sums[i, j] += h * m[i, j]
        turn(q, x, y, z, -1.0)
