"""MPU-6050 and its successors: raw counts to SI units. Scales by the wire schema and the family, ranges by HELLO."""

from __future__ import annotations

import math

from linkpose.wire.messages import SCALES, DeviceFamily, SelfTestResult

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


# Die temperature by family: degC per count, degC at 0 counts. Sources: RM-MPU-6000A 4.18; PS-MPU-6500A 3.4.2
# (333.87 LSB/degC, 0 at 21 degC); DS ICM-20602, ICM-20608, ICM-20689 (326.8 LSB/degC, 0 at 25 degC).
TEMPERATURE = {
    DeviceFamily.MPU6050: (1 / 340, 36.53),
    DeviceFamily.MPU6500: (1 / 333.87, 21.0),
    DeviceFamily.ICM20600: (1 / 326.8, 25.0),
}


def temperature_scale(family: int) -> tuple[float, float]:
    """Die temperature: degC per count and degC at 0 counts; NaN for a family whose formula is unknown."""
    return TEMPERATURE.get(DeviceFamily(family), (0.0, math.nan))


# Group delay (s) through the low-pass filter at DLPF_CFG 0 to 6, of the slower of accelerometer and gyro; the other is
# at most 1 ms faster. Sources: RM-MPU-6000A 4.3; RM-MPU-6500A and RM-MPU-9250A, registers 0x1A and 0x1D. The ICM-20600
# family's data sheets state the bandwidths of the MPU-6500 and no delays.
_DELAY_6050_S = (0.00098, 0.0020, 0.0030, 0.0049, 0.0085, 0.0138, 0.0190)
_DELAY_6500_S = (0.00188, 0.0029, 0.0039, 0.0059, 0.0099, 0.01785, 0.03348)
_DELAYS_S = {DeviceFamily.MPU6500: _DELAY_6500_S, DeviceFamily.ICM20600: _DELAY_6500_S}
DLPF_SETTINGS = len(_DELAY_6050_S)
# The sensor samples at 1 kHz by its own clock: at a tick its latest sample is 0 to 1 ms old.
MEAN_AGE_S = 0.0005


def delay_s(dlpf: int, family: int = DeviceFamily.MPU6050) -> float:
    """Mean age (s) of a reading at its timestamp, with DLPF_CFG 0 to 6: filter delay and age of the sample.

    An unknown chip is assumed to filter as an MPU-6050.
    """
    return _DELAYS_S.get(DeviceFamily(family), _DELAY_6050_S)[dlpf] + MEAN_AGE_S


SELF_TEST_LIMIT = 0.14  # deviation from the factory's response, MPU-6050 (data sheet, 6.1 and 6.2)
SELF_TEST_LIMIT_6500 = 0.5  # the successors (AN-MPU-9250A-03: response within 50 to 150 % of the factory's)


def self_test_limit(result: SelfTestResult) -> float:
    """Largest permitted magnitude of `self_test_deviation` for the family that was tested."""
    return SELF_TEST_LIMIT if result.family == DeviceFamily.MPU6050 else SELF_TEST_LIMIT_6500


def self_test_deviation(result: SelfTestResult) -> dict[str, float | None]:
    """Relative deviation of each axis's self-test response from the factory's; None if no factory response is stored
    or the chip is unknown.

    Sources: MPU-6050: RM-MPU-6000A 4.1, readings at 8 g and 250 deg/s. Successors: AN-MPU-9250A-03, factory response
    2620 · 1.01^(code − 1) counts at 2 g and 250 deg/s.
    """
    deviations: dict[str, float | None] = {}
    for at, axis in enumerate("xyz"):
        for sensor, factory in zip(("accel", "gyro"), _factory_responses(result, at), strict=True):
            answer = getattr(result, f"excited_{sensor}_{axis}") - getattr(result, f"plain_{sensor}_{axis}")
            deviations[f"{sensor}_{axis}"] = answer / factory - 1 if factory else None
    return deviations


def _factory_responses(result: SelfTestResult, axis: int) -> tuple[float, float]:
    """The factory's response (counts) of the accelerometer and the gyro of an axis, 0 to 2; 0: not known."""
    if result.family == DeviceFamily.UNKNOWN_IMU:
        return 0.0, 0.0
    trims = (result.trim_1, result.trim_2, result.trim_3, result.trim_4, result.trim_5, result.trim_6)
    if result.family == DeviceFamily.MPU6050:
        accel_code = (trims[axis] >> 3 & 0x1C) | (trims[3] >> (4 - 2 * axis) & 3)
        gyro_code = trims[axis] & 0x1F
        accel = 4096 * 0.34 * (0.92 / 0.34) ** ((accel_code - 1) / 30)
        gyro = 25 * 131 * 1.046 ** (gyro_code - 1) * (-1 if axis == 1 else 1)
    else:
        gyro_code, accel_code = trims[axis], trims[3 + axis]
        accel = 2620 * 1.01 ** (accel_code - 1) * 2 / 8  # the readings are at 8 g
        gyro = 2620 * 1.01 ** (gyro_code - 1)
    return accel if accel_code else 0.0, gyro if gyro_code else 0.0
