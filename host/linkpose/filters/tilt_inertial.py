"""`tilt-inertial`: the tilt of a sensor whose velocity stays small, with the gyro's bias in the state.

Method B reads the acceleration off the tilt that it is to find, which suits accelerations of a few samples. Here the
accelerometer is integrated instead: a sensor that a hand, a robot or a pendulum moves comes back to where it was, so
its velocity is small and of short memory. No joint is needed. The state, all in the sensor's frame s:

    Z    tilt, n's Z axis                       Ż = −(s_G − b) × Z
    v    velocity of the sensor (m/s)           v̇ = −(s_G − b) × v + s_A − g Z
    b    bias of the gyro (rad/s)               random walk

At every sample the measurement is  0 = v + e, with e the velocity that the sensor really has: zero in the mean, of
standard deviation σ and correlation time T. To an estimate slower than T that is white noise of the same density,

    R = σ² · 2T / Ts.

A wrong tilt lets g sin δ into v̇, and its integral grows where e does not. σ is measured: what the acceleration of the
last second adds up to, less the share of a tilt that is not known. Scale and alignment errors of both sensors go in
proportion to the motion, last as long, and count in the same way. A velocity beyond what σ and the covariance allow for
lets the covariance grow, so that a start in motion with an unknown bias is found out.

Where rate and force stay the same, the rate is the bias:  s_G = b + e_ω.  The variance of e_ω is measured too, from
what rate and force have moved by over the memory M, and its noise is var(e_ω) · 2M / Ts. There is no threshold of rest,
but two limits: a rate that no bias reaches is a turn, and a bias that is known does not jump. A slow turn about the
vertical, at a constant rate from switch-on, cannot be told from a bias.

Over a step the frame turns by the exact exponential of the mean rate and v is integrated by the trapezoid. A low-pass
filter in the sensor delays force and rate alike: the tilt that is given is turned on by the last rate for that long
(`delay_s` of the rig). The height is Zᵀd.

Source: the sensor model is (2), (3) of the link paper. White noise of density 2σ²T stands for a first-order
Gauss-Markov process of variance σ² and correlation time T: it is that process's density at low frequencies.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inlined
from linkpose.filters import _vector as vec
from linkpose.filters._imu import (
    GRAVITY,
    LONGEST_GAP_S,
    LONGEST_STEP_S,
    Floats,
    ImuCalibration,
    read_accel,
    read_gyro,
    rotation_variance,
)
from linkpose.filters._vector import Vec
from linkpose.filters.tilt import describe, start
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

_N = 9
_Z, _V, _B = 0, 3, 6  # where each begins in the state
_GAP_ACCEL_M_S2 = 10.0  # where the accelerometer did not see
_DOUBT = 3.0  # times its mean square that a velocity may be before the covariance is doubted
_GATE = 25.0  # χ² of a rate at rest, with one degree of freedom: five standard deviations
_LARGEST_RAD_S = 0.5  # gyro bias that can be, half as much again as the data sheet's ±20 °/s: else begin anew


class TiltInertialParameters(NamedTuple):
    """What the filter assumes."""

    bias_std_rad_s: float = 0.17  # at switch-on: half of the data sheet's ±20 °/s
    bias_walk_rad_s: float = 3e-4  # in a second: 1 °/s in the hour of warming up
    accel_misfit: float = 0.01  # scale and alignment, as a share of the force: the data sheet's ±3 % is three times it
    gyro_misfit: float = 0.005  # scale and alignment, as a share of the rate
    first_speed_m_s: float = 0.5  # σ before it has been measured
    least_speed_m_s: float = 0.01  # σ at rest
    most_speed_m_s: float = 2.0  # σ of an arm that throws
    swing_time_s: float = 1.0  # over which acceleration is added up to measure σ,
    speed_memory_s: float = 2.0  # and over which that is averaged
    correlation_s: float = 0.2  # T of the velocity, and of the errors in proportion
    fade_s: float = 1.0  # in which a covariance that is doubted grows e-fold
    calm_memory_s: float = 0.5  # M, over which rate and force are to stay the same
    swing_share: float = 3.0  # a rate that moves by so much in M moves by this times as much in a whole motion
    least_turn_rad_s: float = 0.001  # standard deviation of the rate of a sensor that is held still


class State(NamedTuple):
    """What the filter remembers from one block to the next; changed in place."""

    time: Floats  # (2,) of the last sample, NaN before the first; how long the rate has been held (s)
    mean: Floats  # (9,) Z, v, b
    covariance: Floats  # (9, 9)
    last: Floats  # (2, 3) last usable force (m/s²) and rate (rad/s), calibrated
    speed: Floats  # (4,) velocity that the last second's acceleration adds up to (m/s), σ² (m²/s²)
    calm: Floats  # (7,) means of force and rate over M, mean square of what moved (rad²/s²)
    work: Floats  # (6, 9) F P, within a step
    counts: NDArray[np.int64]  # (2,) rejected samples, restarts

    @staticmethod
    def fresh() -> State:
        return State(
            np.array([np.nan, 0.0]),
            np.zeros(_N),
            np.zeros((_N, _N)),
            np.zeros((2, 3)),
            np.zeros(4),
            np.zeros(7),
            np.zeros((6, _N)),
            np.zeros(2, np.int64),
        )


class TiltInertialFilter:
    """The filter over blocks of samples. Without J2S there is no height, and its columns are NaN."""

    name = "tilt-inertial"
    columns = (
        "tilt_inertial_height_m",
        "tilt_inertial_height_std_m",
        "tilt_inertial_roll_deg",
        "tilt_inertial_pitch_deg",
    )

    def __init__(self, rig: Rig, parameters: TiltInertialParameters | None = None) -> None:
        self.parameters = parameters or TiltInertialParameters()
        self.state = State.fresh()
        self._imu = ImuCalibration.of(rig.imu)
        self._j2s = rig.joint.known_j2s_m or (math.nan, math.nan, math.nan)

    @property
    def rejected(self) -> int:
        """Samples so far whose accelerometer, gyro or time could not be used."""
        return int(self.state.counts[0])

    @property
    def restarts(self) -> int:
        """How often the state ran away from what can be, and was begun anew."""
        return int(self.state.counts[1])

    @property
    def gyro_bias_rad_s(self) -> Floats:
        """(3,) as estimated so far, over the rig's calibration."""
        return self.state.mean[_B:].copy()

    def process(self, block: Measurements) -> Floats:
        """Height and its standard deviation (m), roll and pitch (°) at each of the N samples: (N, 4)."""
        out = np.empty((len(block), 4))
        _process(
            block.time_s, block.accel_m_s2, block.gyro_rad_s, block.flags,
            self._imu, self.parameters, self._j2s, self.state, out,
        )  # fmt: skip
        return out


@compiled
def _set_upright(state: State, force: Vec, rate: Vec, imu: ImuCalibration, q: TiltInertialParameters) -> None:
    """Tilt from the force, as if nothing had been known of it; a velocity that may be any."""
    x, p = state.mean, state.covariance
    for i in range(6):
        for j in range(_N):
            p[i, j] = p[j, i] = 0.0
    tilt, s = start(force, rate, imu)
    square = max(q.first_speed_m_s**2, state.speed[3])  # what has been measured of it stays
    vec.put(x, _Z, tilt)
    vec.put(x, _V, (0.0, 0.0, 0.0))
    k = 0
    for i in range(3):
        for j in range(i, 3):
            p[i, j] = p[j, i] = s[k]
            k += 1
        p[_V + i, _V + i] = square
    state.speed[0] = state.speed[1] = state.speed[2] = 0.0
    state.speed[3] = square
    vec.put(state.calm, 0, force)
    vec.put(state.calm, 3, rate)
    state.calm[6] = 1.0


@compiled
def _begin(state: State, force: Vec, rate: Vec, imu: ImuCalibration, q: TiltInertialParameters) -> None:
    """Mean and covariance from one sample and the priors."""
    for i in range(3):
        state.mean[_B + i] = 0.0
    _set_upright(state, force, rate, imu, q)
    for i in range(_B, _N):
        for j in range(_B, _N):
            state.covariance[i, j] = q.bias_std_rad_s**2 if i == j else 0.0


@inlined
def _predict_mean(x: Floats, turn: Vec, before: Vec, force: Vec, h: float) -> None:
    """Tilt and velocity after a step `h` that turns the frame by `turn` (rad), with the forces at its ends."""
    tilt, v, half = vec.at(x, _Z), vec.at(x, _V), 0.5 * h
    v = (
        v[0] + half * (before[0] - GRAVITY * tilt[0]),
        v[1] + half * (before[1] - GRAVITY * tilt[1]),
        v[2] + half * (before[2] - GRAVITY * tilt[2]),
    )
    tilt, v = vec.unit(vec.turn_back(turn, tilt)), vec.turn_back(turn, v)
    vec.put(x, _Z, tilt)
    x[_V] = v[0] + half * (force[0] - GRAVITY * tilt[0])
    x[_V + 1] = v[1] + half * (force[1] - GRAVITY * tilt[1])
    x[_V + 2] = v[2] + half * (force[2] - GRAVITY * tilt[2])


@inlined
def _spread(z: Vec, v: Vec, b: Vec, rows: tuple[Vec, Vec, Vec], tilt: Vec, velocity: Vec, h: float) -> tuple[Vec, Vec]:
    """Errors of tilt and velocity after a step, from small ones of tilt, velocity and bias before it."""
    z = (vec.dot(rows[0], z), vec.dot(rows[1], z), vec.dot(rows[2], z))
    g, by_tilt, by_velocity = GRAVITY * h, vec.cross(tilt, b), vec.cross(velocity, b)
    v = (
        vec.dot(rows[0], v) - g * z[0] - h * by_velocity[0],
        vec.dot(rows[1], v) - g * z[1] - h * by_velocity[1],
        vec.dot(rows[2], v) - g * z[2] - h * by_velocity[2],
    )
    return (z[0] - h * by_tilt[0], z[1] - h * by_tilt[1], z[2] - h * by_tilt[2]), v


@inlined
def _predict_covariance(p: Floats, work: Floats, turn: Vec, tilt: Vec, velocity: Vec, h: float) -> None:
    """F P Fᵀ; only the rows and columns of tilt and velocity change."""
    back = (-turn[0], -turn[1], -turn[2])
    rows = (
        vec.turn_back(back, (1.0, 0.0, 0.0)),
        vec.turn_back(back, (0.0, 1.0, 0.0)),
        vec.turn_back(back, (0.0, 0.0, 1.0)),
    )
    for j in range(_N):
        z, v = _spread(
            (p[0, j], p[1, j], p[2, j]), (p[3, j], p[4, j], p[5, j]), (p[6, j], p[7, j], p[8, j]),
            rows, tilt, velocity, h,
        )  # fmt: skip
        work[0, j], work[1, j], work[2, j] = z
        work[3, j], work[4, j], work[5, j] = v
    for i in range(6):
        z, v = _spread(
            (work[i, 0], work[i, 1], work[i, 2]), (work[i, 3], work[i, 4], work[i, 5]),
            (work[i, 6], work[i, 7], work[i, 8]), rows, tilt, velocity, h,
        )  # fmt: skip
        p[i, 0], p[i, 1], p[i, 2] = z
        p[i, 3], p[i, 4], p[i, 5] = v
        for j in range(6, _N):
            p[i, j] = p[j, i] = work[i, j]


@compiled
def _add_noise(p: Floats, tilt: Vec, velocity: Vec, rotation: float, gained: float, walk: float) -> None:
    """Noise of a step: variances of its rotation (rad²), of the velocity gained (m²/s²), of the bias (rad²/s²)."""
    # The same wrong rotation turns tilt and velocity: [Z×][Z×]ᵀ, [v×][v×]ᵀ, and [Z×][v×]ᵀ = (Z·v) I − v Zᵀ.
    zz, vv, zv = vec.cross_square(tilt, rotation), vec.cross_square(velocity, rotation), vec.dot(tilt, velocity)
    k = 0
    for i in range(3):
        for j in range(i, 3):
            p[_Z + i, _Z + j] += zz[k]
            p[_V + i, _V + j] += vv[k]
            p[_Z + j, _Z + i], p[_V + j, _V + i] = p[_Z + i, _Z + j], p[_V + i, _V + j]
            k += 1
        p[_V + i, _V + i] += gained
        p[_B + i, _B + i] += walk
        for j in range(3):
            p[_Z + i, _V + j] += rotation * ((zv if i == j else 0.0) - velocity[i] * tilt[j])
            p[_V + j, _Z + i] = p[_Z + i, _V + j]


@compiled
def _take(x: Floats, p: Floats, c: int, innovation: float, noise: float) -> None:
    """The Kalman correction by a measurement of one component of the state, of that variance."""
    scale = 1.0 / (p[c, c] + noise)
    for i in range(_N):
        x[i] += p[i, c] * scale * innovation
    for i in range(_N):
        if i != c:
            k = p[i, c] * scale
            for j in range(i, _N):
                if j != c:
                    p[i, j] -= k * p[j, c]
                    p[j, i] = p[i, j]
    for i in range(_N):
        p[i, c] = p[c, i] = p[i, c] * noise * scale


@compiled
def _measure_speed(
    x: Floats, p: Floats, swing: Floats, turn: Vec, force: Vec, h: float, q: TiltInertialParameters
) -> None:
    """σ from what the last second's acceleration adds up to, less the share of a tilt that is not known."""
    u = vec.turn_back(turn, vec.at(swing, 0))
    keep = min(h / q.swing_time_s, 1.0)
    for j in range(3):
        swing[j] = u[j] - keep * u[j] + h * (force[j] - GRAVITY * x[j])
    own = (p[0, 0] + p[1, 1] + p[2, 2]) * (GRAVITY * q.swing_time_s) ** 2
    u = vec.at(swing, 0)
    square = max(vec.dot(u, u) - own, 0.0) / 3.0
    swing[3] += min(h / q.speed_memory_s, 1.0) * (square - swing[3])
    swing[3] = min(max(swing[3], q.least_speed_m_s**2), q.most_speed_m_s**2)


@compiled
def _correct_by_speed(x: Floats, p: Floats, square: float, h: float, q: TiltInertialParameters) -> None:
    """0 = v + e, one axis after the other, since e's axes are independent."""
    v = vec.at(x, _V)
    # A velocity that the covariance does not allow for: tilt or bias were believed too early (a start in motion).
    own = p[_V, _V] + p[_V + 1, _V + 1] + p[_V + 2, _V + 2]
    if vec.dot(v, v) > _DOUBT * (own + 3.0 * square):
        grow = 1.0 + min(h / q.fade_s, 1.0)
        for i in range(_N):
            for j in range(_N):
                p[i, j] *= grow
    noise = square * max(2.0 * q.correlation_s / h, 1.0)
    for c in range(_V, _B):
        _take(x, p, c, -x[c], noise)
    vec.put(x, _Z, vec.unit(vec.at(x, _Z)))


@compiled
def _correct_by_calm(
    x: Floats, p: Floats, calm: Floats, force: Vec, rate: Vec, h: float, imu: ImuCalibration, q: TiltInertialParameters
) -> None:
    """Where rate and force stay the same, the rate is the gyro's bias: the less they move, the more it is."""
    memory = q.calm_memory_s
    keep = min(h / memory, 1.0)
    moved, turned = 0.0, 0.0
    for j in range(3):
        moved += (force[j] - calm[j]) ** 2
        turned += (rate[j] - calm[3 + j]) ** 2
        calm[j] += keep * (force[j] - calm[j])
        calm[3 + j] += keep * (rate[j] - calm[3 + j])
    # A force that turns by so much in this time is that rate of turn.
    leaning = max(moved - 6.0 * imu.accel_variance, 0.0) / (GRAVITY * memory) ** 2
    calm[6] += keep * (turned + leaning - calm[6])
    moving = max(calm[6] - 6.0 * imu.gyro_variance, 0.0)
    variance = q.swing_share**2 * moving + q.least_turn_rad_s**2
    steady = vec.at(calm, 3)
    if vec.dot(steady, steady) > _LARGEST_RAD_S**2:
        return  # no bias, but a turn at a constant rate
    noise = variance * max(2.0 * memory / h, 1.0)
    for j in range(3):
        c = _B + j
        innovation = rate[j] - x[c]
        if innovation * innovation < _GATE * (p[c, c] + variance):  # a bias does not jump
            _take(x, p, c, innovation, noise)
    vec.put(x, _Z, vec.unit(vec.at(x, _Z)))


@compiled
def _undelayed(x: Floats, rate: Vec, delay_s: float) -> Vec:
    """Z at the time of the stamp, from the Z that the readings told, and the last rate."""
    turn = (delay_s * (rate[0] - x[_B]), delay_s * (rate[1] - x[_B + 1]), delay_s * (rate[2] - x[_B + 2]))
    return vec.turn_back(turn, vec.at(x, _Z))


@inlined
def _runs_away(x: Floats) -> bool:
    """Whether the state is beyond what can be; NaN is."""
    b = vec.at(x, _B)
    return not (vec.dot(b, b) < _LARGEST_RAD_S**2 and math.isfinite(x[0] + x[3] + x[4] + x[5]))


@compiled
def _process(
    time_s: Floats,
    accel: Floats,
    gyro: Floats,
    flags: NDArray[np.uint16],
    imu: ImuCalibration,
    q: TiltInertialParameters,
    j2s: Vec,
    state: State,
    out: Floats,
) -> None:
    x, p = state.mean, state.covariance
    last, held = state.time[0], state.time[1]
    before_a, before_w = vec.load(state.last[0]), vec.load(state.last[1])
    rejected, restarts = 0, 0
    for i in range(len(time_s)):
        has_force, force = read_accel((accel[i, 0], accel[i, 1], accel[i, 2]), flags[i], imu)
        has_rate, rate = read_gyro((gyro[i, 0], gyro[i, 1], gyro[i, 2]), flags[i], imu)
        h = time_s[i] - last
        good = has_force and has_rate
        if math.isnan(last):
            good = good and math.isfinite(time_s[i])
            if good:
                _begin(state, force, rate, imu, q)
                last, before_a, before_w = time_s[i], force, rate
        elif h > LONGEST_GAP_S and good:
            _set_upright(state, force, rate, imu, q)
            last, held, before_a, before_w = time_s[i], 0.0, force, rate
        elif h > 0.0:
            force = force if has_force else before_a
            held = 0.0 if has_rate else held + h
            rate = rate if has_rate else before_w
            turn = (
                h * (0.5 * (rate[0] + before_w[0]) - x[_B]),
                h * (0.5 * (rate[1] + before_w[1]) - x[_B + 1]),
                h * (0.5 * (rate[2] + before_w[2]) - x[_B + 2]),
            )
            _predict_mean(x, turn, before_a, force, h)
            tilt, velocity = vec.at(x, _Z), vec.at(x, _V)
            _predict_covariance(p, state.work, turn, tilt, velocity, h)
            lasting = max(2.0 * q.correlation_s / h, 1.0)
            noise = imu.accel_variance + lasting * q.accel_misfit**2 * vec.dot(force, force)
            if not has_force or h > LONGEST_STEP_S:
                noise = _GAP_ACCEL_M_S2**2
            rotation = rotation_variance(h, held, imu) + lasting * q.gyro_misfit**2 * vec.dot(turn, turn)
            _add_noise(p, tilt, velocity, rotation, noise * h * h, q.bias_walk_rad_s**2 * h)
            _measure_speed(x, p, state.speed, turn, force, h, q)
            _correct_by_speed(x, p, state.speed[3], h, q)
            if good:
                _correct_by_calm(x, p, state.calm, force, rate, h, imu, q)
            last, before_a, before_w = time_s[i], force, rate
            if _runs_away(x):
                _begin(state, force, rate, imu, q)
                restarts += 1
        else:
            good = False
        rejected += not good
        if math.isnan(last):
            out[i, 0] = out[i, 1] = out[i, 2] = out[i, 3] = np.nan
        else:
            ahead = _undelayed(x, before_w, imu.delay)
            c = (p[0, 0], p[0, 1], p[0, 2], p[1, 1], p[1, 2], p[2, 2])
            out[i, 0], out[i, 1], out[i, 2], out[i, 3] = describe(ahead, c, j2s)
    state.time[0], state.time[1] = last, held
    for j in range(3):
        state.last[0, j], state.last[1, j] = before_a[j], before_w[j]
    state.counts[0] += rejected
    state.counts[1] += restarts
