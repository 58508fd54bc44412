"""Noise of the readings, measured in motion: the fourth difference, in which a smooth motion vanishes.

A motion of angular frequency w, sampled every h seconds, leaves (w h)⁴ of its amplitude: 0.2 % at 3 Hz and 100 Hz.
White noise leaves √70 of its σ (the root of the sum of the squared weights 1, −4, 6, −4, 1). A motor's vibration counts
as white, with the σ that it has at the time.
"""

from __future__ import annotations

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import ImuCalibration
from linkpose.filters._vector import Vec
from linkpose.filters.inertial.state import Floats, Record

_WEIGHTS_SQUARE = 70.0
_MEMORY_S = 0.5  # over which the square is averaged (s): a motor starts within it; doubled, its start leans the tilt
# A single spike must not pass for noise: no square counts for more than this many times the mean so far.
_LARGEST_RISE = 30.0


@inner
def start_noise(s: Record, force: Vec, rate: Vec) -> None:
    """Forget the readings before this one; what was measured of the noise stays."""
    for i in range(4):
        vec.store(s.force_differences[i], (0.0, 0.0, 0.0))
        vec.store(s.rate_differences[i], (0.0, 0.0, 0.0))
    vec.store(s.force_differences[0], force)
    vec.store(s.rate_differences[0], rate)


@inner
def follow_noise(s: Record, force: Vec, rate: Vec, h: float, imu: ImuCalibration) -> None:
    """Measure both variances from readings `h` (s) after the last; `imu` holds the least."""
    keep = min(h / _MEMORY_S, 1.0)
    square = _next_square(s.force_differences, force)
    most = _LARGEST_RISE * max(s.force_noise, imu.accel_variance)
    s.force_noise += keep * (min(square, most) - s.force_noise)
    square = _next_square(s.rate_differences, rate)
    most = _LARGEST_RISE * max(s.rate_noise, imu.gyro_variance)
    s.rate_noise += keep * (min(square, most) - s.rate_noise)


@inner
def _next_square(differences: Floats, reading: Vec) -> float:
    """Square of the fourth difference as the variance of one axis of white noise; the differences move on."""
    newest = reading
    for order in range(4):
        before = vec.load(differences[order])
        vec.store(differences[order], newest)
        newest = vec.minus(newest, before)
    return vec.dot(newest, newest) / (3.0 * _WEIGHTS_SQUARE)


@inner
def with_noise(s: Record, imu: ImuCalibration) -> ImuCalibration:
    """The calibration with the noise as measured, at least the declared one."""
    return ImuCalibration(
        imu.gyro_bias,
        imu.accel_offset,
        imu.accel_gain,
        max(imu.gyro_variance, s.rate_noise),
        max(imu.accel_variance, s.force_noise),
        imu.delay,
    )
