"""MPU-6050: raw counts to SI units. The scales are the wire schema's; the ranges in force come from HELLO."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeVar

from linkpose.wire.messages import SCALES

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Number = TypeVar("Number", float, NDArray[np.float64])

STANDARD_GRAVITY = 9.80665  # m/s² per g, by definition

# Decimals that a recording keeps: finer than the finest raw step (±2 g, ±250 deg/s), so that the raw counts come back.
ACCEL_DECIMALS = 6
GYRO_DECIMALS = 7
TEMPERATURE_DECIMALS = 4


def accel_scale(accel_range_g: int) -> float:
    """m/s² per count at a full-scale range in g."""
    return SCALES["SAMPLE.accel_x"].scale * accel_range_g * STANDARD_GRAVITY


def gyro_scale(gyro_range_deg_s: int) -> float:
    """rad/s per count at a full-scale range in deg/s."""
    return math.radians(SCALES["SAMPLE.gyro_x"].scale * gyro_range_deg_s)


def temperature(count: Number) -> Number:
    """Die temperature in degC of a count, or of an array of them (register map, 4.18)."""
    scale = SCALES["SAMPLE.imu_temp"]
    return count * scale.scale + scale.offset
