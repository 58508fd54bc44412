"""MPU-6050: raw counts to SI units. The scales are the wire schema's; the ranges in force come from HELLO."""

from __future__ import annotations

import math

from linkpose.wire.messages import SCALES, SelfTestResult

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


# Of the readings through the low-pass filter at DLPF_CFG 0 to 6, by the slower of the two sensors; the other comes a
# millisecond sooner at the most. Source: register map, 4.3, "Configuration".
DLPF_DELAY_S = (0.00098, 0.0020, 0.0030, 0.0049, 0.0085, 0.0138, 0.0190)


SELF_TEST_LIMIT = 0.14  # of the factory's response (data sheet, 6.1 and 6.2)


def self_test_deviation(result: SelfTestResult) -> dict[str, float | None]:
    """How far each axis's answer to the self-test is from the factory's, as a share of that; None without a factory's.

    Source: register map, 4.1, "Self-test registers"; readings at 8 g and 250 deg/s.
    """
    fine = result.trim_a
    deviations: dict[str, float | None] = {}
    for at, axis in enumerate("xyz"):
        trim = getattr(result, f"trim_{axis}")
        accel_code = (trim >> 3 & 0x1C) | (fine >> (4 - 2 * at) & 3)
        gyro_code = trim & 0x1F
        accel_factory = 4096 * 0.34 * (0.92 / 0.34) ** ((accel_code - 1) / 30)
        gyro_factory = 25 * 131 * 1.046 ** (gyro_code - 1) * (-1 if axis == "y" else 1)
        for sensor, code, factory in (("accel", accel_code, accel_factory), ("gyro", gyro_code, gyro_factory)):
            answer = getattr(result, f"excited_{sensor}_{axis}") - getattr(result, f"plain_{sensor}_{axis}")
            deviations[f"{sensor}_{axis}"] = answer / factory - 1 if code else None
    return deviations
