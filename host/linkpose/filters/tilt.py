"""`tilt`: the unconstrained tilt Kalman filter with an acceleration model, the paper's Method B.

Frames: n is fixed, Z up; s is the sensor's. The state is the tilt Z = Zˢ, n's Z axis seen in s (unit vector).

    accelerometer  s_A = g Z + a + n_A       gyro  s_G = ω + n_G                          (2), (3)
    acceleration   a_k = c_a a_k−1 + ε                                                    (4)
    process        Z_k = exp(−Ts [s_G ×]) Z_k−1 + w,   Q = −Ts² [Z×] Σ_G [Z×]              (5), (7)
    measurement    z_k = s_A,k − c_a a⁺_k−1 = g Z_k + v,   M = ⅓ c_a² ‖a⁺_k−1‖² I + Σ_A    (6), (8)

with a⁺_k = s_A,k − g Z⁺_k. Two refinements over the paper's (5): the rate over a step is the mean of the rates at its
ends, and the rotation is exact, where I − Ts [s_G,k−1 ×] lags by half a sample (0.9° at 3 rad/s).

P is the covariance of the modelled noise, the least of the error: it holds neither the gyro's residual bias nor an
acceleration that lasts. What it leaves out shows in the residual s_A/g − Z⁺. Averaged over some seconds in a frame that
does not turn, the noise vanishes, and so do the accelerations, since velocities are bounded: what lasts is the error of
the tilt. Along Z, where a tilt does not err, it is the accelerometer's own, which the tilt takes over unseen across Z.
With the lasting residual r, and m for what a calibration leaves of the accelerometer's error (both in g),

    σ² = ½ (‖r‖² + (r·Z)²) + m²                          beyond P, on each axis across Z
    std² = dᵀPd + σ² ‖d×Z‖² + 2σ⁴ (d·Z)² + σ_d²           of the height Zᵀd

where 2σ⁴ is of what a link that leans loses in height, 1 − cos, and σ_d of J2S. No estimate is changed by it.

Sources: the link paper, equations (2)-(8); J. K. Lee, E. J. Park, S. N. Robinovitch, "Estimation of attitude and
external acceleration using inertial sensor measurement during various dynamic conditions", IEEE Trans. Instrum. Meas.
61(8), 2012.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import (
    GRAVITY,
    LONGEST_GAP_S,
    Floats,
    ImuCalibration,
    read_accel,
    read_gyro,
    rotation_variance,
    unknown_accel,
)
from linkpose.filters._vector import Sym, Vec
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

_GUESS_RAD2 = 0.005  # a tilt whose variances sum to more is a guess: 3° either way
_SWING_SAMPLES = 30.0  # that an acceleration lasts
_LASTING_S = 5.0  # over which the residual is averaged: some swings of a hand, and less than the filter's memory
_ACCEL_ERROR_M_S2 = 0.03  # that a calibration leaves, on each axis


class Lasting(NamedTuple):
    """The mean residual of the last seconds, in registers."""

    mean: Vec  # in g, turned along with the sensor
    span: float  # over how long it has been taken (s)
    share: float  # of the present sample


class Now(NamedTuple):
    """The state in registers, while a block is worked through."""

    time: float  # of the last sample (s), NaN before the first
    rate: Vec  # last usable rate (rad/s)
    held: float  # for how long that rate has had to do (s)
    tilt: Vec  # Z
    covariance: Sym  # of Z
    accel: Vec  # a⁺ (m/s²)
    lasting: Lasting


class TiltParameters(NamedTuple):
    """What the filter assumes."""

    accel_memory: float = 0.1  # c_a: how much of the last sample's acceleration is still there


class TiltState(NamedTuple):
    """What the filter remembers from one block to the next; changed in place."""

    time: Floats  # (2,) of the last sample, NaN before the first; how long the rate has been held (s)
    rate: Floats  # (3,) last usable rate (rad/s)
    tilt: Floats  # (3,) Z
    covariance: Floats  # (6,) of Z, xx xy xz yy yz zz
    accel: Floats  # (3,) a⁺ (m/s²)
    lasting: Floats  # (4,) mean residual (in g), over how long it has been taken (s)
    rejected: NDArray[np.int64]  # (1,) samples whose accelerometer, gyro or time could not be used

    @staticmethod
    def fresh() -> TiltState:
        time, upward = np.array([np.nan, 0.0]), np.array([0.0, 0.0, 1.0])
        return TiltState(time, np.zeros(3), upward, np.zeros(6), np.zeros(3), np.zeros(4), np.zeros(1, np.int64))


class TiltFilter:
    """Method B over blocks of samples. Without J2S there is no height, and its columns are NaN."""

    name = "tilt"
    columns = ("tilt_height_m", "tilt_height_std_m", "tilt_roll_deg", "tilt_pitch_deg")

    def __init__(self, rig: Rig, parameters: TiltParameters | None = None) -> None:
        self.parameters = parameters or TiltParameters()
        self.state = TiltState.fresh()
        self._imu = ImuCalibration.of(rig.imu)
        self._j2s = rig.joint.known_j2s_m or (math.nan, math.nan, math.nan)
        self._j2s_std = rig.joint.largest_std_m

    @property
    def rejected(self) -> int:
        """Samples so far whose accelerometer, gyro or time could not be used."""
        return int(self.state.rejected[0])

    def process(self, block: Measurements) -> Floats:
        """Height and its standard deviation (m), roll and pitch (°) at each of the N samples: (N, 4).

        The standard deviation is that of the modelled noise and of the error that the residuals show beyond it.
        """
        out = np.empty((len(block), 4))
        _process(
            block.time_s, block.accel_m_s2, block.gyro_rad_s, block.flags,
            self._imu, self.parameters, self._j2s, self._j2s_std, self.state, out,
        )  # fmt: skip
        return out


@inner
def start(force: Vec, rate: Vec, imu: ImuCalibration) -> tuple[Vec, Sym]:
    """Tilt and its covariance from one sample: the direction of the force, with the doubt that a motion brings."""
    variance = (imu.accel_variance + unknown_accel(force, rate)) / GRAVITY**2
    tilt = vec.unit(force) if vec.dot(force, force) > 0.0 else (0.0, 0.0, 1.0)
    return tilt, vec.cross_square(tilt, min(variance, 1.0))


@inner
def predict(now: Now, time_s: float, step_s: float, rate: Vec, held_s: float, imu: ImuCalibration) -> Now:
    """(5) over `step_s`, from the rates at its ends, the last of which has been held for `held_s`."""
    half, before = 0.5 * step_s, now.rate
    rotation = (half * (rate[0] + before[0]), half * (rate[1] + before[1]), half * (rate[2] + before[2]))
    tilt = vec.turn_back(rotation, now.tilt)
    covariance = vec.turn_back_sym(rotation, now.covariance)
    covariance = vec.add(covariance, rotation_variance(step_s, held_s, imu), vec.cross_square(tilt, 1.0))
    span = min(now.lasting.span + step_s, _LASTING_S)
    lasting = Lasting(vec.turn_back(rotation, now.lasting.mean), span, step_s / span)
    return Now(time_s, rate, held_s, tilt, covariance, now.accel, lasting)


@inner
def acceleration(force: Vec, tilt: Vec) -> Vec:
    """a⁺ = s_A − g Z⁺"""
    return (force[0] - GRAVITY * tilt[0], force[1] - GRAVITY * tilt[1], force[2] - GRAVITY * tilt[2])


@inner
def correct_by_accel(now: Now, force: Vec, memory: float, imu: ImuCalibration) -> Now:
    """(6), (8): the force less the acceleration that the model (4) expects.

    The model presumes a tilt that is known: a⁺ = s_A − gZ⁺ says nothing where Z⁺ is a guess (a start in motion, a gap).
    Then the acceleration is unknown, and so is that of the samples around: M is that of an average over them.
    """
    tilt, p = now.tilt, now.covariance
    expected = (memory * now.accel[0], memory * now.accel[1], memory * now.accel[2])
    variance = vec.dot(expected, expected) / 3.0 + imu.accel_variance
    if vec.trace(p) > _GUESS_RAD2:
        variance += _SWING_SAMPLES * unknown_accel(force, now.rate) / 3.0
    variance /= GRAVITY**2
    i = vec.inverse(vec.plus_diagonal(p, variance))
    # Equal noise on all axes commutes with the covariance: the gain is symmetric, and P⁺ = (M/g²) K.
    gain = (
        p[0] * i[0] + p[1] * i[1] + p[2] * i[2],
        p[0] * i[1] + p[1] * i[3] + p[2] * i[4],
        p[0] * i[2] + p[1] * i[4] + p[2] * i[5],
        p[1] * i[1] + p[3] * i[3] + p[4] * i[4],
        p[1] * i[2] + p[3] * i[4] + p[4] * i[5],
        p[2] * i[2] + p[4] * i[4] + p[5] * i[5],
    )
    innovation = (
        (force[0] - expected[0]) / GRAVITY - tilt[0],
        (force[1] - expected[1]) / GRAVITY - tilt[1],
        (force[2] - expected[2]) / GRAVITY - tilt[2],
    )
    change = vec.apply(gain, innovation)
    tilt = vec.unit((tilt[0] + change[0], tilt[1] + change[1], tilt[2] + change[2]))
    accel = acceleration(force, tilt)
    return Now(now.time, now.rate, now.held, tilt, vec.scaled(variance, gain), accel, now.lasting)


@inner
def hear(now: Now, residual: Vec) -> Now:
    """Takes a sample's residual (in g) into the lasting one."""
    m, share = now.lasting.mean, now.lasting.share
    mean = (
        m[0] + share * (residual[0] - m[0]),
        m[1] + share * (residual[1] - m[1]),
        m[2] + share * (residual[2] - m[2]),
    )
    lasting = Lasting(mean, now.lasting.span, share)
    return Now(now.time, now.rate, now.held, now.tilt, now.covariance, now.accel, lasting)


@inner
def hear_accel(now: Now) -> Now:
    """Takes a⁺ as the sample's residual."""
    return hear(now, (now.accel[0] / GRAVITY, now.accel[1] / GRAVITY, now.accel[2] / GRAVITY))


@inner
def height_std(now: Now, j2s: Vec, j2s_std: float) -> float:
    """Standard deviation of the height (m): of the modelled noise, of what lasts in the residual, and of J2S."""
    mean, z = now.lasting.mean, now.tilt
    along, height = vec.dot(mean, z), vec.dot(z, j2s)
    variance = 0.5 * (vec.dot(mean, mean) + along * along) + (_ACCEL_ERROR_M_S2 / GRAVITY) ** 2
    beyond = variance * (vec.dot(j2s, j2s) + (2.0 * variance - 1.0) * height * height)
    return math.sqrt(max(vec.quadratic(now.covariance, j2s) + beyond, 0.0) + j2s_std * j2s_std)


@inner
def step_between(now: float, last: float) -> tuple[bool, float]:
    """Whether time has gone on, and by how much (s), at most LONGEST_GAP_S."""
    step = now - last
    return step > 0.0, min(step, LONGEST_GAP_S)


@inner
def describe(now: Now, delay_s: float, j2s: Vec) -> Vec:
    """Height Zᵀd (15) (m), roll and pitch (°), at the time of the stamp.

    Readings that are `delay_s` late tell the tilt of then: it is turned on by the last rate.
    """
    tilt = now.tilt
    if delay_s > 0.0:
        tilt = vec.turn_back(vec.scale(delay_s, now.rate), tilt)
    roll, pitch = vec.roll_pitch(tilt)
    return vec.dot(tilt, j2s), roll, pitch


@inner
def recall(state: TiltState) -> Now:
    """The state in registers."""
    return Now(
        state.time[0],
        vec.load(state.rate),
        state.time[1],
        vec.load(state.tilt),
        vec.load_sym(state.covariance),
        vec.load(state.accel),
        Lasting(vec.load(state.lasting), state.lasting[3], 0.0),
    )


@inner
def keep(state: TiltState, now: Now, rejected: int) -> None:
    """The registers back into the state, and more rejected samples."""
    state.time[0], state.time[1] = now.time, now.held
    for j in range(3):
        state.rate[j] = now.rate[j]
        state.tilt[j] = now.tilt[j]
        state.accel[j] = now.accel[j]
        state.lasting[j] = now.lasting.mean[j]
    for j in range(6):
        state.covariance[j] = now.covariance[j]
    state.lasting[3] = now.lasting.span
    state.rejected[0] += rejected


@inner
def advance(
    now: Now, time_s: float, raw_accel: Vec, raw_gyro: Vec, flags: int, imu: ImuCalibration
) -> tuple[Now, bool, Vec, bool]:
    """Predicts up to a sample, or starts: the state, whether the force can be used, the force, whether the rate can."""
    has_force, force = read_accel(raw_accel, flags, imu)
    has_rate, rate = read_gyro(raw_gyro, flags, imu)
    if math.isnan(now.time):
        if not (has_force and has_rate and math.isfinite(time_s)):
            return now, False, force, False
        tilt, covariance = start(force, rate, imu)
        nothing = Lasting((0.0, 0.0, 0.0), 0.0, 1.0)
        return Now(time_s, rate, 0.0, tilt, covariance, acceleration(force, tilt), nothing), True, force, True
    goes_on, step_s = step_between(time_s, now.time)
    if not goes_on:
        return now, False, force, False
    held = 0.0 if has_rate else now.held + step_s
    if not has_rate:
        rate = now.rate
    return predict(now, time_s, step_s, rate, held, imu), has_force, force, has_rate


@compiled
def _process(
    time_s: Floats,
    accel: Floats,
    gyro: Floats,
    flags: NDArray[np.uint32],
    imu: ImuCalibration,
    parameters: TiltParameters,
    j2s: Vec,
    j2s_std: float,
    state: TiltState,
    out: Floats,
) -> None:
    now = recall(state)
    rejected = 0
    for i in range(len(time_s)):
        a = (accel[i, 0], accel[i, 1], accel[i, 2])
        w = (gyro[i, 0], gyro[i, 1], gyro[i, 2])
        now, has_force, force, has_rate = advance(now, time_s[i], a, w, flags[i], imu)
        rejected += not (has_force and has_rate)
        if has_force:
            now = correct_by_accel(now, force, parameters.accel_memory, imu)
            now = hear_accel(now)
        if math.isnan(now.time):
            out[i, 0] = out[i, 1] = out[i, 2] = out[i, 3] = np.nan
        else:
            out[i, 0], out[i, 2], out[i, 3] = describe(now, imu.delay, j2s)
            out[i, 1] = height_std(now, j2s, j2s_std)
    keep(state, now, rejected)
