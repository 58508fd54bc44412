"""What the inertial filters share: the calibrated reading of one sample, and the limits of a usable step."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._vector import Vec
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Imu
from linkpose.wire.messages import SampleFlags

Floats = NDArray[np.float64]

GRAVITY = STANDARD_GRAVITY  # m/s²
# The slowest sampling is 50 Hz. Over a longer step, or where the gyro is of no use, the rotation is partly a guess.
LONGEST_STEP_S = 0.025
LONGEST_GAP_S = 2.0  # beyond this nothing of the attitude is left to remember
_JERK_RAD_S3 = 50.0  # of a hand's motion: between two known rates Ts apart the angle is wrong by Ts³/12 of it
_ACCEL_RAD_S2 = 5.0  # a rate that is held grows wrong by this
_GUESS_RAD_S = 1.0  # the most that a rate is thought to be wrong

# Unknown lever arm and rhythm of a start in motion: acceleration (m/s²) to a rate of 1 rad/s.
_START_ACCEL_PER_RATE = 5.0
# Beyond what any sensor reads: garbage, the square of which could overflow.
_MOST_M_S2 = 1e4
_MOST_RAD_S = 1e4

_ACCEL_SATURATED = int(SampleFlags.ACCEL_SATURATED)
_GYRO_SATURATED = int(SampleFlags.GYRO_SATURATED)


class ImuCalibration(NamedTuple):
    """The rig's [imu] as the compiled steps read it: numbers only, since an array costs a reference count a call."""

    gyro_bias: Vec  # rad/s
    accel_offset: Vec  # m/s²
    accel_gain: Vec  # 1/scale
    gyro_variance: float  # (rad/s)² of one sample
    accel_variance: float  # (m/s²)² of one sample
    delay: float  # of the readings (s)

    @staticmethod
    def of(imu: Imu) -> ImuCalibration:
        x, y, z = imu.accel_scale
        return ImuCalibration(
            imu.gyro_bias_rad_s,
            imu.accel_offset_m_s2,
            (1 / x, 1 / y, 1 / z),
            imu.gyro_noise_rad_s**2,
            imu.accel_noise_m_s2**2,
            imu.known_delay_s,
        )


@inner
def rotation_variance(step_s: float, held_s: float, imu: ImuCalibration) -> float:
    """Variance (rad²) about each axis of the rotation over a step, with a rate that has been held for `held_s`."""
    if held_s == 0.0 and step_s <= LONGEST_STEP_S:
        return step_s * step_s * imu.gyro_variance
    wrong = _JERK_RAD_S3 / 12.0 * step_s * step_s + _ACCEL_RAD_S2 * held_s
    return step_s * step_s * (imu.gyro_variance + min(wrong, _GUESS_RAD_S) ** 2)


@inner
def blind_for(held_s: float, step_s: float, has_rate: bool, longest_s: float) -> float:
    """For how long the gyro has been of no use (s). Beyond the longest, a rate alone does not end it: Z is lost."""
    return 0.0 if has_rate and max(held_s, step_s) <= longest_s else held_s + step_s


@inner
def _below(reading: Vec, most: float) -> bool:
    """Whether all components are less than `most`, and none is NaN."""
    return abs(reading[0]) < most and abs(reading[1]) < most and abs(reading[2]) < most


@inner
def read_accel(raw: Vec, flags: int, imu: ImuCalibration) -> tuple[bool, Vec]:
    """Whether a sample's specific force can be used, and the calibrated force (m/s²)."""
    o, k = imu.accel_offset, imu.accel_gain
    force = ((raw[0] - o[0]) * k[0], (raw[1] - o[1]) * k[1], (raw[2] - o[2]) * k[2])
    return _below(force, _MOST_M_S2) and not flags & _ACCEL_SATURATED, force


@inner
def read_gyro(raw: Vec, flags: int, imu: ImuCalibration) -> tuple[bool, Vec]:
    """Whether a sample's angular rate can be used, and the rate less its bias (rad/s)."""
    b = imu.gyro_bias
    rate = (raw[0] - b[0], raw[1] - b[1], raw[2] - b[2])
    return _below(rate, _MOST_RAD_S) and not flags & _GYRO_SATURATED, rate


@inner
def is_bounded(reading: Vec) -> bool:
    """Whether a reading that cannot be used is at least finite and of a possible size, as a saturated one is."""
    return _below(reading, _MOST_M_S2)


@inner
def unknown_accel(force: Vec, rate: Vec) -> float:
    """Square of the acceleration (m/s²)² that a sample of unknown history may hold: 0 at rest."""
    excess = math.sqrt(vec.dot(force, force)) - GRAVITY
    return excess * excess + _START_ACCEL_PER_RATE**2 * vec.dot(rate, rate)
