"""Shared by the inertial filters: calibrated readings of one sample, and the limits of a usable time step."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._vector import Vec
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Imu
from linkpose.wire.messages import SampleFlags

Floats = NDArray[np.float64]

GRAVITY = STANDARD_GRAVITY  # m/s²
# s: 1.25 periods of the slowest sampling rate, 50 Hz. A longer step, or one without a usable gyro reading, adds
# variance to the rotation.
LONGEST_STEP_S = 0.025
# s: without a usable rate for longer, the tilt of a moving link is unknown: it is aligned to gravity again. Doubled, a
# swing of 1 s period is propagated with the wrong sign.
LONGEST_BLIND_S = 0.3
# s: identical readings for less than this are one reading of a slower sensor, held by the logger.
LONGEST_HOLD_S = 0.1
LONGEST_GAP_S = (
    2.0  # s: after a longer gap the attitude is unknown; doubled, an arbitrary attitude is propagated longer
)
# rad/s³, 1σ of hand motion: the trapezoid over a step Ts errs by Ts³/12 of it. Doubled, long steps weigh half.
_JERK_RAD_S3 = 50.0
# rad/s², 1σ of hand motion: error growth of a rate that is held because no reading is usable. Doubled: as above.
_ACCEL_RAD_S2 = 5.0
_LARGEST_RATE_ERROR_RAD_S = 1.0  # upper bound of the two errors above

# m/s² per rad/s: acceleration assumed per unit of rate at a start in motion, when lever arm and rhythm are unknown
# (1 m at 5 rad/s). Doubled, a start in motion takes longer to settle.
_START_ACCEL_PER_RATE = 5.0
# Larger readings come from no sensor; their squares could overflow.
_MOST_M_S2 = 1e4
_MOST_RAD_S = 1e4

_ACCEL_SATURATED = int(SampleFlags.ACCEL_SATURATED)
_GYRO_SATURATED = int(SampleFlags.GYRO_SATURATED)


class ImuCalibration(NamedTuple):
    """The rig's [imu] for compiled steps, as numbers only: an array would cost a reference count per call."""

    gyro_bias: Vec  # rad/s
    accel_offset: Vec  # m/s²
    accel_gain: Vec  # 1/scale
    gyro_variance: float  # (rad/s)² of one sample
    accel_variance: float  # (m/s²)² of one sample
    delay: float  # of the readings behind their timestamp (s)

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

    def packed(self) -> Floats:
        """(12,) its numbers in order, which Python passes in a tenth of the time of nested tuples."""
        return np.array([*self.gyro_bias, *self.accel_offset, *self.accel_gain, *self[3:]])


class ImuSamples(NamedTuple):
    """The arrays of a block that the inertial filters read, for compiled code.

    Filters that run live pass the arrays one by one: see `_records.fields`.
    """

    time_s: Floats  # (N,)
    accel: Floats  # (N, 3) m/s², as recorded
    gyro: Floats  # (N, 3) rad/s, as recorded
    flags: NDArray[np.uint32]  # (N,)

    @staticmethod
    def of(block: Measurements) -> ImuSamples:
        return ImuSamples(block.time_s, block.accel_m_s2, block.gyro_rad_s, block.flags)


@inner
def unpacked(a: Floats) -> ImuCalibration:
    """The calibration that `packed` gave."""
    return ImuCalibration((a[0], a[1], a[2]), (a[3], a[4], a[5]), (a[6], a[7], a[8]), a[9], a[10], a[11])


@inner
def rotation_variance(step_s: float, held_s: float, imu: ImuCalibration) -> float:
    """Variance (rad²) about each axis of the rotation over a step; the rate has been held for `held_s`."""
    if held_s == 0.0 and step_s <= LONGEST_STEP_S:
        return step_s * step_s * imu.gyro_variance
    error = _JERK_RAD_S3 / 12.0 * step_s * step_s + _ACCEL_RAD_S2 * held_s
    return step_s * step_s * (imu.gyro_variance + min(error, _LARGEST_RATE_ERROR_RAD_S) ** 2)


@inner
def blind_for(held_s: float, step_s: float, has_rate: bool, longest_s: float) -> float:
    """Time without a usable gyro reading (s). Beyond `longest_s` a rate alone does not reset it: Z is lost."""
    return 0.0 if has_rate and max(held_s, step_s) <= longest_s else held_s + step_s


@inner
def _below(reading: Vec, most: float) -> bool:
    """Whether all magnitudes are below `most` and none is NaN."""
    return abs(reading[0]) < most and abs(reading[1]) < most and abs(reading[2]) < most


@inner
def read_accel(raw: Vec, flags: int, imu: ImuCalibration) -> tuple[bool, Vec]:
    """Whether a sample's specific force is usable, and the calibrated force (m/s²)."""
    o, k = imu.accel_offset, imu.accel_gain
    force = ((raw[0] - o[0]) * k[0], (raw[1] - o[1]) * k[1], (raw[2] - o[2]) * k[2])
    return _below(force, _MOST_M_S2) and not flags & _ACCEL_SATURATED, force


@inner
def read_gyro(raw: Vec, flags: int, imu: ImuCalibration) -> tuple[bool, Vec]:
    """Whether a sample's angular rate is usable, and the rate minus the calibrated bias (rad/s)."""
    b = imu.gyro_bias
    rate = (raw[0] - b[0], raw[1] - b[1], raw[2] - b[2])
    return _below(rate, _MOST_RAD_S) and not flags & _GYRO_SATURATED, rate


@inner
def is_bounded(reading: Vec) -> bool:
    """Whether an unusable reading is at least finite and of plausible size, as a saturated one is."""
    return _below(reading, _MOST_M_S2)


@inner
def unknown_accel(force: Vec, rate: Vec) -> float:
    """Square of the acceleration ((m/s²)²) assumed for a sample of unknown history: 0 at rest."""
    excess = math.sqrt(vec.dot(force, force)) - GRAVITY
    return excess * excess + _START_ACCEL_PER_RATE**2 * vec.dot(rate, rate)
