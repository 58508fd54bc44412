"""The constraint of a fixed joint as equations in J2S and the sensor errors, with their Jacobian.

Within a piece of a recording, the rotation C from the sensor's axes to those at the piece's first sample is the
integral of the gyro. In these axes gravity is constant, and the joint's constraint on the velocity, C(ω×d), is

    d/dt C(ω×d) = C f − γ,        γ = C g Z, constant, ‖γ‖ = g

where f is the specific force. Multiplied by a smooth weight w that is zero at both ends of a fraction of a second, and
integrated by parts, the equation contains no derivative of a reading:

    γ = ∫ w C f dt + ∫ ẇ C(ω×d) dt,        ∫ w dt = 1

These are three equations for each weight, in d and in the sensor errors: ω = (I − M_g)(s_G − b_g),
f = (I − M_a)(s_A − b_a). An error of ω accumulates in C: its column of the Jacobian holds the angle since the start of
the piece.

Source: the constraint is (9) of [Link]; the weights are the "method functions" of M. Shinbrot, NACA TN 3288, 1954.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.rotations import product
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.rig import Imu
from linkpose.wire.messages import SampleFlags

# Where each unknown begins: d, biases of gyro and accelerometer, and by rows M_a and M_g.
J2S, GYRO_BIAS, ACCEL_BIAS, ACCEL_MATRIX, GYRO_MATRIX, UNKNOWNS = 0, 3, 6, 9, 18, 27

_WEIGHT_S = 0.3  # length of a weight w; the outer half of it contributes little
_FEWEST_READINGS = 8  # within a weight
LONGEST_STEP_S = 0.051  # between samples that a trapezoid joins: 20 samples a second, or some lost ones
# A spike is away from both neighbours, to the same side, by more than a link moves within a sample, and by more than
# this many times the local median of such distances: a motor's vibration moves every sample, a spike only its own.
_SPIKE_RAD_S, _SPIKE_M_S2 = 1.0, 10.0
_SPIKE_MEDIANS = 10.0  # a normal distribution exceeds 5 medians of |x| in one of 1000 samples; doubled, it keeps more
_SPREAD_SAMPLES = 32  # over which the median is taken, and over the same before and after
_OF_GYRO = [*range(GYRO_BIAS, ACCEL_BIAS), *range(GYRO_MATRIX, UNKNOWNS)]
_SATURATED = int(SampleFlags.ACCEL_SATURATED | SampleFlags.GYRO_SATURATED)
_SATURATED_2 = int(SampleFlags.ACCEL2_SATURATED | SampleFlags.GYRO2_SATURATED)


class Stretch(NamedTuple):
    """N samples without a break."""

    time_s: Floats  # (N,)
    force: Floats  # (N, 3) m/s²
    rate: Floats  # (N, 3) rad/s


class Equations(NamedTuple):
    """The M equations of a piece of a recording."""

    gravity: Floats  # (M, 3) γ, m/s²
    jacobian: Floats  # (M, 3, UNKNOWNS) of γ
    apart_s: float  # from one to the next


def stretches(block: Measurements, imu: Imu) -> list[Stretch]:
    """The unbroken stretches of a recording's usable samples, with the rig's calibration applied."""
    readings = _readings(block.accel_m_s2, block.gyro_rad_s, imu)
    usable = _usable(*readings) & (block.flags & _SATURATED == 0)
    return [stretch for (stretch,) in _unbroken(block.time_s, usable, [readings])]


def paired_stretches(block: Measurements, imu: Imu) -> list[tuple[Stretch, Stretch]]:
    """As `stretches`, of both inertial sensors at the samples that both can use; the calibration is the first one's."""
    first = _readings(block.accel_m_s2, block.gyro_rad_s, imu)
    second = block.accel2_m_s2, block.gyro2_rad_s
    usable = _usable(*first) & _usable(*second) & (block.flags & (_SATURATED | _SATURATED_2) == 0)
    return [(one, two) for one, two in _unbroken(block.time_s, usable, [first, second])]


def _readings(accel: Floats, gyro: Floats, imu: Imu) -> tuple[Floats, Floats]:
    """Force and rate with the rig's calibration applied."""
    return (accel - np.array(imu.accel_offset_m_s2)) / np.array(imu.accel_scale), gyro - np.array(imu.gyro_bias_rad_s)


def _usable(force: Floats, rate: Floats) -> NDArray[np.bool_]:
    """(N,) Which samples have finite readings without a spike."""
    usable = np.asarray(np.isfinite(force).all(axis=1) & np.isfinite(rate).all(axis=1))
    usable[usable] = ~(_spikes(force[usable], _SPIKE_M_S2) | _spikes(rate[usable], _SPIKE_RAD_S))
    return usable


def _unbroken(
    time_s: Floats, usable: NDArray[np.bool_], readings: Sequence[tuple[Floats, Floats]]
) -> list[tuple[Stretch, ...]]:
    """The usable samples of each sensor, cut where one follows another too late."""
    time_s = time_s[usable]
    steps = np.diff(time_s)
    breaks = np.flatnonzero((steps > LONGEST_STEP_S) | (steps <= 0)) + 1
    kept = [(force[usable], rate[usable]) for force, rate in readings]
    return [
        tuple(Stretch(time_s[rows], force[rows], rate[rows]) for force, rate in kept)
        for rows in np.split(np.arange(len(time_s)), breaks)
    ]


def pieces(stretch: Stretch, longest_s: float) -> Iterator[Stretch]:
    """The stretch in pieces of equal length; none where it is too short for equations.

    A piece is longer than `longest_s` where samples are so rare that a weight covers a good part of it.
    """
    time_s = stretch.time_s
    if len(time_s) < 2 * _FEWEST_READINGS:
        return
    count = max(1, int((time_s[-1] - time_s[0]) / max(longest_s, 4 * _weight_length(time_s))))
    edges = np.searchsorted(time_s, np.linspace(time_s[0], time_s[-1], count + 1))
    for first, last in itertools.pairwise(edges):
        rows = slice(int(first), int(last) + 1)
        if time_s[last] - time_s[first] >= 2 * _weight_length(time_s[rows]):
            yield Stretch(time_s[rows], stretch.force[rows], stretch.rate[rows])


def equations(piece: Stretch, unknowns: Floats) -> Equations:
    """γ at the unknowns (UNKNOWNS,), and its derivative by them."""
    d = unknowns[J2S:GYRO_BIAS]
    gyro, accel = piece.rate - unknowns[GYRO_BIAS:ACCEL_BIAS], piece.force - unknowns[ACCEL_BIAS:ACCEL_MATRIX]
    of_gyro = np.eye(3) - unknowns[GYRO_MATRIX:].reshape(3, 3)
    of_accel = np.eye(3) - unknowns[ACCEL_MATRIX:GYRO_MATRIX].reshape(3, 3)
    rate = gyro @ of_gyro.T
    turned = attitudes(piece.time_s, rate)
    force = np.einsum("nij,nj->ni", turned, accel @ of_accel.T)
    velocity = np.einsum("nij,nj->ni", turned, np.cross(rate, d))
    by_gyro = np.concatenate([np.broadcast_to(-of_gyro, (len(rate), 3, 3)), _by_matrix(gyro)], axis=2)
    by_accel = np.concatenate([np.broadcast_to(-of_accel, (len(rate), 3, 3)), _by_matrix(accel)], axis=2)
    angle = _integral(piece.time_s, turned @ by_gyro)
    of_force, of_velocity = (np.zeros((len(rate), 3, UNKNOWNS)) for _ in range(2))
    of_force[:, :, ACCEL_BIAS:GYRO_MATRIX] = turned @ by_accel
    of_force[:, :, _OF_GYRO] = _cross_columns(angle, force)
    of_velocity[:, :, J2S:GYRO_BIAS] = turned @ cross_matrices(rate)
    of_velocity[:, :, _OF_GYRO] = _cross_columns(angle, velocity) - turned @ cross_matrices(d[None]) @ by_gyro
    rows, weight, slope, apart_s = _weights(piece.time_s)
    return Equations(
        np.einsum("mk,mki->mi", weight, force[rows]) + np.einsum("mk,mki->mi", slope, velocity[rows]),
        np.einsum("mk,mkip->mip", weight, of_force[rows]) + np.einsum("mk,mkip->mip", slope, of_velocity[rows]),
        apart_s,
    )


def noise_of(piece: Stretch, imu: Imu) -> tuple[float, float]:
    """Variance of γ on each axis by the sensor's white noise: by the force ((m/s²)²), by the rate per metre of d."""
    _, weight, slope, _ = _weights(piece.time_s)
    force = imu.accel_noise_m_s2**2 * np.square(weight).sum(axis=1).mean()
    rate = imu.gyro_noise_rad_s**2 * 2 / 3 * np.square(slope).sum(axis=1).mean()
    return float(force), float(rate)


def _spikes(values: Floats, jump: float) -> NDArray[np.bool_]:
    """(N,) Where a reading is off from both its neighbours, to the same side on some axis, unlike the others there."""
    away = np.zeros(len(values), dtype=bool)
    if len(values) < 3:
        return away
    steps = np.diff(values, axis=0)
    nearer = np.minimum(np.abs(steps[:-1]), np.abs(steps[1:]))
    distance = nearer * (steps[:-1] * steps[1:] < 0)
    away[1:-1] = (distance > np.maximum(jump, _SPIKE_MEDIANS * _local_median(nearer))).any(axis=1)
    return away


def _local_median(values: Floats) -> Floats:
    """(N, 3) The largest of the medians of each value's block of samples and of the blocks beside it."""
    blocks = max(len(values) // _SPREAD_SAMPLES, 1)
    parts = np.array_split(np.arange(len(values)), blocks)
    medians = np.array([np.median(values[part], axis=0) for part in parts])
    edged = np.pad(medians, ((1, 1), (0, 0)), mode="edge")
    largest = np.maximum(np.maximum(edged[:-2], medians), edged[2:])
    return np.repeat(largest, [len(part) for part in parts], axis=0)


def _weight_length(time_s: Floats) -> float:
    return max(_WEIGHT_S, _FEWEST_READINGS * float(np.median(np.diff(time_s))))


def _weights(time_s: Floats) -> tuple[NDArray[np.int64], Floats, Floats, float]:
    """M weights: the K samples under each; w and ẇ there, times a sample's share of the time, all (M, K).

    The last value is the distance from one weight to the next (s). w is sin⁴: smooth enough at its ends for a sum over
    samples to be the integral. The sums of w, of ẇ and of ẇ t are made exactly 1, 0 and −1.
    """
    length = _weight_length(time_s)
    apart = 0.5 * length
    starts = np.arange(time_s[0], time_s[-1] - length + 1e-6, apart)[:, None]
    first, after = np.searchsorted(time_s, starts), np.searchsorted(time_s, starts + length)
    rows = first + np.arange(int((after - first).max()))
    phase = (time_s[np.minimum(rows, len(time_s) - 1)] - starts) / length
    inside = (rows < after) & (phase < 1)
    rows, sine = np.where(inside, rows, first), np.where(inside, np.sin(np.pi * phase), 0.0)
    share, since = np.gradient(time_s)[rows], time_s[rows] - starts
    weight, slope = sine**4 * share, sine**3 * np.cos(np.pi * phase) * share
    weight /= weight.sum(axis=1, keepdims=True)
    slope -= weight * slope.sum(axis=1, keepdims=True)
    slope /= -(slope * since).sum(axis=1, keepdims=True)
    return rows, weight, slope, apart


def attitudes(time_s: Floats, rate: Floats) -> Floats:
    """C (N, 3, 3) from the sensor's axes to those at the first sample, by the mean rate (rad/s) over each step."""
    step = np.diff(time_s)[:, None]
    turn = 0.5 * step * (rate[1:] + rate[:-1])
    half = 0.5 * np.linalg.norm(turn, axis=1, keepdims=True)
    steps = np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * turn], axis=1)
    q = np.concatenate([[[1.0, 0.0, 0.0, 0.0]], steps])
    reach = 1
    while reach < len(q):  # products of all quaternions up to each, doubling how many are in
        q = np.concatenate([q[:reach], product(q[:-reach], q[reach:])])
        reach *= 2
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
        2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, axis=1).reshape(-1, 3, 3)


def _integral(time_s: Floats, values: Floats) -> Floats:
    """The integral (N, ...) up to each sample, by trapezoids."""
    step = np.diff(time_s)[:, None, None]
    sums = np.cumsum(0.5 * step * (values[1:] + values[:-1]), axis=0)
    return np.concatenate([np.zeros_like(values[:1]), sums])


def _by_matrix(reading: Floats) -> Floats:
    """(N, 3, 9): derivative of (I − M) s by the rows of M."""
    columns = np.zeros((len(reading), 3, 9))
    for axis in range(3):
        columns[:, axis, 3 * axis : 3 * axis + 3] = -reading
    return columns


def _cross_columns(left: Floats, right: Floats) -> Floats:
    """(N, 3, K): each column of `left` (N, 3, K) × `right` (N, 3)."""
    return -cross_matrices(right) @ left


def cross_matrices(v: Floats) -> Floats:
    """[v×], (N, 3, 3)."""
    zero = np.zeros(len(v))
    x, y, z = v.T
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
