"""The attitudes S_k at the first sample, from which joint angles count.

A chain that rests at first shows them. In motion, a gyro bias that is still unknown turns the attitudes by tens of
degrees before it is found, further than the linear correction of S_k reaches. Over the first seconds the rates are
kept, and S_k is traced back from the present attitude with the present bias:

    S = R Π exp(−[(∫ω dt − b h)×]),   δs = δθ + (∫R dt) δb + e
"""

from __future__ import annotations

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters.chain.hinge import hinge_angle
from linkpose.filters.chain.propagate import GYRO_MISFIT_S
from linkpose.filters.chain.rotation import to_matrix, turn
from linkpose.filters.chain.state import BG, OF_SENSOR, PATH, START, Floats, Record
from linkpose.filters.chain.stops import shift_stops

_RETRACED = 25  # steps of the path between two traces back: 1 s


@inner
def begin_start(s: Record, size: int) -> None:
    """S_k is the attitude now, with its error."""
    p = s.covariance
    s.traced_square = 0.0
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
def begin_path(bank: Record, length: int) -> None:
    """Follow the path from now on (`length` 0), or not (−1)."""
    bank.path_length, bank.path_s = length, 0.0
    for k in range(2):
        for i in range(3):
            bank.path_sum[k, i] = 0.0


@inner
def follow_path(bank: Record, gyro: Floats, h: float) -> None:
    """Add the rotation over a step of h (s), from the rates in the bank to these."""
    bank.path_s += h
    for k in range(2):
        for i in range(3):
            bank.path_sum[k, i] += 0.5 * h * (bank.gyro[k, i] + gyro[k, i])


@inner
def end_step(bank: Record, states: Record) -> None:
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
                _trace_back(states[n], bank)


@inner
def trace_variance(s: Record, q: Record) -> float:
    """Variance (rad²) of the first relative rotation about one axis that P does not hold: misfit of the gyros.

    It follows the level, which has fallen long after the path was traced.
    """
    return float(min(s.level, 1.0) * q.gyro_misfit**2 * GYRO_MISFIT_S * s.traced_square)


@inner
def _trace_back(s: Record, bank: Record) -> None:
    p, size, angle = s.covariance, bank.length, hinge_angle(s)
    for k in range(2):
        _trace_sensor(s, bank, k)
    for k in range(2):
        o, at, m = OF_SENSOR * k, START + 3 * k, s.by_bias[k]
        for i in range(3):
            for c in range(size):
                total = p[o + i, c]
                for j in range(3):
                    total += m[i, j] * p[o + BG + j, c]
                p[at + i, c] = total
    for k in range(2):
        o, at, m = OF_SENSOR * k, START + 3 * k, s.by_bias[k]
        for i in range(3):
            for c in range(size):
                total = p[c, o + i]
                for j in range(3):
                    total += m[i, j] * p[c, o + BG + j]
                p[c, at + i] = total
    s.traced_square = s.path_square[0] + s.path_square[1]
    shift_stops(s, vec.wrapped(hinge_angle(s) - angle))


@inner
def _trace_sensor(s: Record, bank: Record, k: int) -> None:
    """S_k, and ∫R dt in `by_bias`."""
    q, m, sums = s.start[k], s.m, s.by_bias[k]
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
