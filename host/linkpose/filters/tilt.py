"""`tilt`: the unconstrained tilt Kalman filter with an acceleration model, Method B of [Link].

Frames: n is fixed with Z up, s is the sensor frame. The state is the tilt Z = Zˢ, the Z axis of n in s (unit vector).

    accelerometer  s_A = g Z + a + n_A       gyro  s_G = ω + n_G                          (2), (3)
    acceleration   a_k = c_a a_k−1 + ε                                                    (4)
    process        Z_k = exp(−Ts [s_G ×]) Z_k−1 + w,   Q = −Ts² [Z×] Σ_G [Z×]              (5), (7)
    measurement    z_k = s_A,k − c_a a⁺_k−1 = g Z_k + v,   M = ⅓ c_a² ‖a⁺_k−1‖² I + Σ_A    (6), (8)

with a⁺_k = s_A,k − g Z⁺_k. Two refinements of (5): the rate over a step is the mean of the rates at its ends, and the
rotation is exact, whereas I − Ts [s_G,k−1 ×] lags by half a sample (0.9° at 3 rad/s).

P covers the modelled noise only, neither the residual gyro bias nor a sustained acceleration. The low-frequency
residual r, the mean of s_A/g − Z⁺ over some seconds in a frame that does not rotate, estimates the rest: noise averages
out, and so do accelerations, because velocities are bounded. Perpendicular to Z, r is the tilt error; along Z, it is
the error of the accelerometer. An equal accelerometer error perpendicular to Z is not observable. With the residual
error m of a calibrated accelerometer (r and m in g), the variances beyond P are

    σ² = ½ (‖r‖² + (r·Z)²) + m²                          about each axis perpendicular to Z
    std² = dᵀPd + σ² ‖d×Z‖² + 2σ⁴ (d·Z)² + Σ Z_i² σ_d,i²   of the height Zᵀd

where 2σ⁴ is the second-order term (1 − cos) of an upright link and σ_d,i the standard deviation of d = J2S, the vector
from the joint centre to the sensor, along axis i. They change the standard deviation only, never the estimate.

Sources: [Link], equations (2)-(8); J. K. Lee, E. J. Park, S. N. Robinovitch, "Estimation of attitude and external
acceleration using inertial sensor measurement during various dynamic conditions", IEEE Trans. Instrum. Meas. 61(8),
2012.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import (
    GRAVITY,
    LONGEST_BLIND_S,
    LONGEST_GAP_S,
    Floats,
    ImuCalibration,
    ImuSamples,
    read_accel,
    read_gyro,
    rotation_variance,
    unknown_accel,
    unpacked,
)
from linkpose.filters._records import fields, zeros
from linkpose.filters._vector import Sym, Vec
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

# rad²: a tilt whose variances add up to more (3° about each axis) is too uncertain for the acceleration model (4).
_UNCERTAIN_TILT_RAD2 = 0.005
# Correlation time of an acceleration, in samples. Doubled, a start in motion takes twice as long to settle.
_SWING_SAMPLES = 30.0
# s: averaging time of the residual. Longer than a few swings of a hand, shorter than the time constant of the filter.
# Doubled, σ follows a change of the tilt error later.
_RESIDUAL_S = 5.0
_ACCEL_ERROR_M_S2 = 0.03  # m/s², 1σ per axis after `calibrate imu`; doubled, σ at rest doubles


class MeanResidual(NamedTuple):
    """The low-frequency residual, in registers."""

    mean: Vec  # in g, in the sensor frame
    span: float  # time over which it has been averaged (s)
    share: float  # weight of the present sample


class Registers(NamedTuple):
    """The state in registers while a block is processed."""

    time: float  # of the last sample (s), NaN before the first
    rate: Vec  # last usable rate (rad/s)
    held: float  # time since that rate was measured (s)
    tilt: Vec  # Z
    covariance: Sym  # of Z
    accel: Vec  # a⁺ (m/s²)
    residual: MeanResidual


class TiltParameters(NamedTuple):
    """Parameters of the acceleration model."""

    accel_memory: float = 0.1  # c_a of (4): share of the acceleration that remains after one sample; value of [Link]


# The state between two blocks; changed in place.
TILT_STATE = fields(
    time=2,  # s: time of the last sample, NaN before the first; time since the rate was measured
    rate=3,  # last usable rate (rad/s)
    tilt=3,  # Z
    covariance=6,  # of Z, xx xy xz yy yz zz
    accel=3,  # a⁺ (m/s²)
    residual=4,  # mean residual (in g), time over which it has been averaged (s)
    rejected=1,  # samples whose accelerometer, gyro or time was not usable
)


def fresh_tilt() -> Any:
    """An array of one TILT_STATE before the first sample."""
    states = zeros(1, TILT_STATE)
    states["time"], states["tilt"] = (math.nan, 0.0), (0.0, 0.0, 1.0)
    return states


class TiltFilter:
    """Method B of [Link] over blocks of samples. Without J2S the columns of the height are NaN."""

    name = "tilt"
    columns = ("tilt_height_m", "tilt_height_std_m", "tilt_roll_deg", "tilt_pitch_deg")

    def __init__(self, rig: Rig, parameters: TiltParameters | None = None) -> None:
        self.parameters = parameters or TiltParameters()
        self._states = fresh_tilt()
        self._imu = ImuCalibration.of(rig.imu).packed()
        self._j2s = rig.joint.known_j2s_m or (math.nan, math.nan, math.nan)
        self._j2s_std = rig.joint.std_of_axes_m

    @property
    def rejected(self) -> int:
        """Number of samples so far whose accelerometer, gyro or time was not usable."""
        return int(self._states[0].rejected[0])

    def process(self, block: Measurements) -> Floats:
        """Height and its standard deviation (m), roll and pitch (°) at each of the N samples: (N, 4).

        The standard deviation covers the modelled noise and the error estimated from the low-frequency residual.
        """
        out = np.empty((len(block), 4))
        _process(
            block.time_s, block.accel_m_s2, block.gyro_rad_s, block.flags,
            self._imu, self.parameters.accel_memory, self._j2s, self._j2s_std, self._states, out,
        )  # fmt: skip
        return out


@inner
def start(force: Vec, rate: Vec, imu: ImuCalibration) -> tuple[Vec, Sym]:
    """Tilt and its covariance from one sample: the direction of the force, with the variance of an unknown motion."""
    variance = (imu.accel_variance + unknown_accel(force, rate)) / GRAVITY**2
    tilt = vec.unit(force) if vec.dot(force, force) > 0.0 else (0.0, 0.0, 1.0)
    return tilt, vec.cross_square(tilt, min(variance, 1.0))


@inner
def predict(now: Registers, time_s: float, step_s: float, rate: Vec, held_s: float, imu: ImuCalibration) -> Registers:
    """(5) over `step_s`, from the rates at its ends; the last of them has been held for `held_s`."""
    half, before = 0.5 * step_s, now.rate
    rotation = (half * (rate[0] + before[0]), half * (rate[1] + before[1]), half * (rate[2] + before[2]))
    turn = vec.turn_of(rotation)
    tilt = vec.turn_back(turn, now.tilt)
    covariance = vec.turn_back_sym(rotation, now.covariance)
    covariance = vec.add(covariance, rotation_variance(step_s, held_s, imu), vec.cross_square(tilt, 1.0))
    span = min(now.residual.span + step_s, _RESIDUAL_S)
    residual = MeanResidual(vec.turn_back(turn, now.residual.mean), span, step_s / span)
    return Registers(time_s, rate, held_s, tilt, covariance, now.accel, residual)


@inner
def acceleration(force: Vec, tilt: Vec) -> Vec:
    """a⁺ = s_A − g Z⁺"""
    return (force[0] - GRAVITY * tilt[0], force[1] - GRAVITY * tilt[1], force[2] - GRAVITY * tilt[2])


@inner
def correct_by_accel(now: Registers, force: Vec, memory: float, imu: ImuCalibration) -> Registers:
    """(6), (8): update with the force minus the acceleration that the model (4) predicts.

    The model requires a known tilt, since a⁺ = s_A − gZ⁺. After a start in motion or a gap the tilt is uncertain and
    the acceleration unknown over a whole swing; M then includes its variance over the samples of that swing.
    """
    tilt, p = now.tilt, now.covariance
    expected = (memory * now.accel[0], memory * now.accel[1], memory * now.accel[2])
    variance = vec.dot(expected, expected) / 3.0 + imu.accel_variance
    if vec.trace(p) > _UNCERTAIN_TILT_RAD2:
        variance += _SWING_SAMPLES * unknown_accel(force, now.rate) / 3.0
    variance /= GRAVITY**2
    i = vec.inverse(vec.plus_diagonal(p, variance))
    # M is a multiple of I and commutes with P: the gain is symmetric, and P⁺ = (M/g²) K.
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
    return Registers(now.time, now.rate, now.held, tilt, vec.scaled(variance, gain), accel, now.residual)


@inner
def average_residual(now: Registers, residual: Vec) -> Registers:
    """Includes a sample's residual (in g) in the low-frequency residual."""
    m, share = now.residual.mean, now.residual.share
    mean = (
        m[0] + share * (residual[0] - m[0]),
        m[1] + share * (residual[1] - m[1]),
        m[2] + share * (residual[2] - m[2]),
    )
    average = MeanResidual(mean, now.residual.span, share)
    return Registers(now.time, now.rate, now.held, now.tilt, now.covariance, now.accel, average)


@inner
def average_accel(now: Registers) -> Registers:
    """Includes a⁺/g in the low-frequency residual."""
    return average_residual(now, (now.accel[0] / GRAVITY, now.accel[1] / GRAVITY, now.accel[2] / GRAVITY))


@inner
def height_std(now: Registers, j2s: Vec, j2s_std: Vec) -> float:
    """Standard deviation of the height (m) from P, the low-frequency residual and J2S: std in the module docstring."""
    mean, z = now.residual.mean, now.tilt
    along, height = vec.dot(mean, z), vec.dot(z, j2s)
    variance = 0.5 * (vec.dot(mean, mean) + along * along) + (_ACCEL_ERROR_M_S2 / GRAVITY) ** 2
    beyond = variance * (vec.dot(j2s, j2s) + (2.0 * variance - 1.0) * height * height)
    lever = (z[0] * j2s_std[0], z[1] * j2s_std[1], z[2] * j2s_std[2])
    return math.sqrt(max(vec.quadratic(now.covariance, j2s) + beyond, 0.0) + vec.dot(lever, lever))


@inner
def step_between(now: float, last: float) -> tuple[bool, float]:
    """Whether the time has increased, and by how much (s), at most LONGEST_GAP_S."""
    step = now - last
    return step > 0.0, min(step, LONGEST_GAP_S)


@inner
def describe(now: Registers, delay_s: float, j2s: Vec) -> Vec:
    """Height Zᵀd (15) (m), roll and pitch (°) at the timestamp.

    The readings describe the motion `delay_s` earlier; the tilt is extrapolated with the latest angular rate.
    """
    tilt = now.tilt
    if delay_s > 0.0:
        tilt = vec.turn_back(vec.turn_of(vec.scale(delay_s, now.rate)), tilt)
    roll, pitch = vec.roll_pitch(tilt)
    return vec.dot(tilt, j2s), roll, pitch


@inner
def load_state(state: Any) -> Registers:
    """A record of TILT_STATE in registers."""
    return Registers(
        state.time[0],
        vec.load(state.rate),
        state.time[1],
        vec.load(state.tilt),
        vec.load_sym(state.covariance),
        vec.load(state.accel),
        MeanResidual(vec.load(state.residual), state.residual[3], 0.0),
    )


@inner
def store_state(state: Any, now: Registers, rejected: int) -> None:
    """Store the registers in a record of TILT_STATE and add to the number of rejected samples."""
    state.time[0], state.time[1] = now.time, now.held
    for j in range(3):
        state.rate[j] = now.rate[j]
        state.tilt[j] = now.tilt[j]
        state.accel[j] = now.accel[j]
        state.residual[j] = now.residual.mean[j]
    for j in range(6):
        state.covariance[j] = now.covariance[j]
    state.residual[3] = now.residual.span
    state.rejected[0] += rejected


@inner
def advance(now: Registers, samples: ImuSamples, i: int, imu: ImuCalibration) -> tuple[Registers, bool, Vec, bool]:
    """Predict up to a sample, or start, also after a gap.

    Returns the state, whether the force is usable, the force, and whether the rate is usable.
    """
    time_s, flags = samples.time_s[i], samples.flags[i]
    has_force, force = read_accel(vec.row(samples.accel, i), flags, imu)
    has_rate, rate = read_gyro(vec.row(samples.gyro, i), flags, imu)
    good = has_force and has_rate and math.isfinite(time_s)
    has_passed, step_s = step_between(time_s, now.time)
    if math.isnan(now.time) or (good and has_passed and max(step_s, now.held) > LONGEST_BLIND_S):
        if not good:
            return now, False, force, False
        tilt, covariance = start(force, rate, imu)
        none = MeanResidual((0.0, 0.0, 0.0), 0.0, 1.0)
        return Registers(time_s, rate, 0.0, tilt, covariance, acceleration(force, tilt), none), True, force, True
    if not has_passed:
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
    calibration: Floats,
    accel_memory: float,
    j2s: Vec,
    j2s_std: Vec,
    states: Any,
    out: Floats,
) -> None:
    samples, imu = ImuSamples(time_s, accel, gyro, flags), unpacked(calibration)
    now = load_state(states[0])
    rejected = 0
    for i in range(len(samples.time_s)):
        now, has_force, force, has_rate = advance(now, samples, i, imu)
        rejected += not (has_force and has_rate)
        if has_force:
            now = correct_by_accel(now, force, accel_memory, imu)
            now = average_accel(now)
        if math.isnan(now.time):
            out[i, 0] = out[i, 1] = out[i, 2] = out[i, 3] = np.nan
        else:
            out[i, 0], out[i, 2], out[i, 3] = describe(now, imu.delay, j2s)
            out[i, 1] = height_std(now, j2s, j2s_std)
    store_state(states[0], now, rejected)
