"""`joint`: the tilt filter with the joint's constraint as a second measurement, Method A of [Link].

The joint centre is fixed to the ground, so the angular motion determines the sensor's acceleration (9):
a = ([ω̇×] + [ω×][ω×]) d, where d = J2S is the vector from the joint centre to the sensor. With ω = s_G − n_G and
[n×][n×] = 0 this gives a second reference for gravity,

    z_c = s_A − ([ṡ_G×] + [s_G×][s_G×]) d = g Z + ε_c + n_A                               (10), (12)
    ε_c = [d×] ṅ_G + G n_G,   G = [(s_G×d)×] + [s_G×][d×]                                  (11)

applied after Method B's correction: K = gP(g²P + B)⁻¹, Z ← Z + K(z_c − gZ), P ← (I − gK)P (13), (14).

ṡ_G is the second-order backward difference over the last three samples, c₀ s_k + c₁ s_k−1 + c₂ s_k−2; the first-order
difference belongs to the middle of the step and lags by half a sample. The noise of the three readings is independent:

    B = (c₀D + G) Σ_G (c₀D + G)ᵀ + (c₁² + c₂²) D Σ_G Dᵀ + Σ_A,   D = [d×]

whereas [Link] assumes ṅ_G to be white noise of its own. The displacement is Zᵀd (15), the height of the sensor above
the joint centre. Its standard deviation is that of `tilt`, with the innovation z_c/g − Z as the residual.

Source: [Link], equations (9)-(15).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inner
from linkpose.errors import MissingJ2S
from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY, LONGEST_STEP_S, Floats, ImuCalibration, ImuSamples, unpacked
from linkpose.filters._records import fields, zeros
from linkpose.filters._vector import Sym, Vec
from linkpose.filters.tilt import (
    Registers,
    TiltParameters,
    acceleration,
    advance,
    average_accel,
    average_residual,
    correct_by_accel,
    describe,
    fresh_tilt,
    height_std,
    load_state,
    store_state,
)
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

# rad²: trace of P above which Method B's update is omitted, about 1 mrad per axis. Its model derives the acceleration
# from the tilt, so that it would confirm an uncertain tilt (a start in motion, a gap) for about a minute. Doubled, such
# a start settles more slowly.
_UNSETTLED_RAD2 = 2e-6


# The two samples before the present one, for the derivative of the rate; changed in place.
_HISTORY = fields(
    time=2,  # s: one and two samples ago, NaN where that sample has no usable rate
    last_rate=3,  # rad/s, one sample ago
    earlier_rate=3,  # rad/s, two samples ago
)


class JointFilter:
    """Method A of [Link] over blocks of samples."""

    name = "joint"
    columns = ("joint_height_m", "joint_height_std_m", "joint_roll_deg", "joint_pitch_deg")

    def __init__(self, rig: Rig, parameters: TiltParameters | None = None) -> None:
        """Raises MissingJ2S if the rig has no J2S (the vector from the joint centre to the sensor)."""
        if rig.joint.j2s_m is None:
            raise MissingJ2S(self.name)
        self.parameters = parameters or TiltParameters()
        self._states, self._histories = fresh_tilt(), zeros(1, _HISTORY)
        self._histories["time"] = math.nan
        self._imu = ImuCalibration.of(rig.imu).packed()
        self._j2s, self._j2s_std = rig.joint.j2s_m, rig.joint.std_of_axes_m

    @property
    def rejected(self) -> int:
        """Number of samples so far whose accelerometer, gyro or time was not usable."""
        return int(self._states[0].rejected[0])

    def process(self, block: Measurements) -> Floats:
        """Height and its standard deviation (m), roll and pitch (°) at each of the N samples: (N, 4).

        The standard deviation covers the modelled noise and the error estimated from the low-frequency residual.
        """
        out = np.empty((len(block), 4))
        joint = (self._j2s, self._j2s_std)
        _process(
            block.time_s, block.accel_m_s2, block.gyro_rad_s, block.flags,
            self._imu, self.parameters.accel_memory, joint, self._states, self._histories, out,
        )  # fmt: skip
        return out


@inner
def weights(h1: float, h2: float) -> Vec:
    """c₀, c₁, c₂ (1/s) of the derivative at the last of three samples; h1 and h2 (s): last and first interval."""
    return ((2.0 * h1 + h2) / (h1 * (h1 + h2)), -(h1 + h2) / (h1 * h2), h1 / (h2 * (h1 + h2)))


@inner
def gravity_reference(force: Vec, rate: Vec, derivative: Vec, d: Vec) -> Vec:
    """z_c of (12): the force minus the acceleration caused by the angular motion."""
    tangential = vec.cross(derivative, d)
    inward = vec.cross(rate, vec.cross(rate, d))
    return (
        force[0] - tangential[0] - inward[0],
        force[1] - tangential[1] - inward[1],
        force[2] - tangential[2] - inward[2],
    )


@inner
def reference_noise(rate: Vec, c: Vec, d: Vec, imu: ImuCalibration) -> Sym:
    """B / g². With [w×][d×] = d wᵀ − (w·d) I and [(w×d)×] = d wᵀ − w dᵀ, G = 2 d wᵀ − w dᵀ − (w·d) I."""
    wd = vec.dot(rate, d)
    tx, ty, tz = 2.0 * d[0], 2.0 * d[1], 2.0 * d[2]
    cx, cy, cz = c[0] * d[0], c[0] * d[1], c[0] * d[2]
    r0 = (tx * rate[0] - rate[0] * d[0] - wd, tx * rate[1] - rate[0] * d[1] - cz, tx * rate[2] - rate[0] * d[2] + cy)
    r1 = (ty * rate[0] - rate[1] * d[0] + cz, ty * rate[1] - rate[1] * d[1] - wd, ty * rate[2] - rate[1] * d[2] - cx)
    r2 = (tz * rate[0] - rate[2] * d[0] - cy, tz * rate[1] - rate[2] * d[1] + cx, tz * rate[2] - rate[2] * d[2] - wd)
    present = (vec.dot(r0, r0), vec.dot(r0, r1), vec.dot(r0, r2), vec.dot(r1, r1), vec.dot(r1, r2), vec.dot(r2, r2))
    past = vec.cross_square(d, c[1] * c[1] + c[2] * c[2])
    gyro = vec.scaled(imu.gyro_variance / GRAVITY**2, vec.add(present, 1.0, past))
    return vec.plus_diagonal(gyro, imu.accel_variance / GRAVITY**2)


@inner
def correct_by_joint(now: Registers, force: Vec, c: Vec, w1: Vec, w2: Vec, d: Vec, imu: ImuCalibration) -> Registers:
    """(12)-(14); `c` are the weights of the present and the two previous rates in the derivative."""
    rate, tilt = now.rate, now.tilt
    derivative = (
        c[0] * rate[0] + c[1] * w1[0] + c[2] * w2[0],
        c[0] * rate[1] + c[1] * w1[1] + c[2] * w2[1],
        c[0] * rate[2] + c[1] * w1[2] + c[2] * w2[2],
    )
    reference = gravity_reference(force, rate, derivative, d)
    innovation = (
        reference[0] / GRAVITY - tilt[0],
        reference[1] / GRAVITY - tilt[1],
        reference[2] / GRAVITY - tilt[2],
    )
    noise = reference_noise(rate, c, d, imu)
    inverse = vec.inverse(vec.add(now.covariance, 1.0, noise))
    change = vec.apply(now.covariance, vec.apply(inverse, innovation))
    tilt = vec.unit((tilt[0] + change[0], tilt[1] + change[1], tilt[2] + change[2]))
    covariance = vec.parallel(now.covariance, noise, inverse)
    now = Registers(now.time, now.rate, now.held, tilt, covariance, acceleration(force, tilt), now.residual)
    return average_residual(now, innovation)


@compiled
def _process(
    time_s: Floats,
    accel: Floats,
    gyro: Floats,
    flags: NDArray[np.uint32],
    calibration: Floats,
    accel_memory: float,
    joint: tuple[Vec, Vec],
    states: Any,
    histories: Any,
    out: Floats,
) -> None:
    samples, imu = ImuSamples(time_s, accel, gyro, flags), unpacked(calibration)
    now, history = load_state(states[0]), histories[0]
    d, d_std = joint
    t1, t2 = history.time[0], history.time[1]
    w1, w2 = vec.load(history.last_rate), vec.load(history.earlier_rate)
    rejected = 0
    for i in range(len(samples.time_s)):
        now, has_force, force, has_rate = advance(now, samples, i, imu)
        rejected += not (has_force and has_rate)
        # A comparison with NaN is False: no derivative across a gap or an unusable reading.
        derivable = has_force and has_rate and now.time - t1 <= LONGEST_STEP_S and t1 - t2 <= LONGEST_STEP_S
        if has_force and not (derivable and vec.trace(now.covariance) > _UNSETTLED_RAD2):
            now = correct_by_accel(now, force, accel_memory, imu)
        if derivable:
            c = weights(now.time - t1, t1 - t2)
            now = correct_by_joint(now, force, c, w1, w2, d, imu)
        elif has_force:
            now = average_accel(now)
        if now.time != t1:  # a repeated timestamp adds no sample
            t2, w2 = t1, w1
            t1, w1 = (now.time if has_rate else math.nan), now.rate
        if math.isnan(now.time):
            out[i, 0] = out[i, 1] = out[i, 2] = out[i, 3] = np.nan
        else:
            out[i, 0], out[i, 2], out[i, 3] = describe(now, imu.delay, d)
            out[i, 1] = height_std(now, d, d_std)
    store_state(states[0], now, rejected)
    history.time[0], history.time[1] = t1, t2
    vec.store(history.last_rate, w1)
    vec.store(history.earlier_rate, w2)
