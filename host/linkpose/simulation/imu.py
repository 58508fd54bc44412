"""How an MPU-6050 errs, and the counts that it gives.

The counts are made with the scales that `linkpose.sensors` reads them with.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.mpu6050 import STANDARD_GRAVITY, TEMPERATURE, accel_scale, gyro_scale
from linkpose.wire.messages import DeviceFamily

Floats = NDArray[np.float64]

GYRO_NOISE_RAD_S = float(np.radians(0.05))  # data sheet, 3.1: total RMS noise 0.05 °/s
ACCEL_NOISE_M_S2 = 0.04  # data sheet, 3.2: 400 µg/√Hz over about 100 Hz
_BLOCK = 1000  # readings whose noise is drawn at once
LEVELS = ("calibrated", "datasheet", "none")


@dataclass(frozen=True, slots=True)
class ImuErrors:
    """measured = matrix · true + bias + white noise, for either sensor."""

    gyro_matrix: Floats  # (3, 3)
    gyro_bias_rad_s: Floats  # (3,)
    gyro_noise_rad_s: float
    accel_matrix: Floats  # (3, 3)
    accel_bias_m_s2: Floats  # (3,)
    accel_noise_m_s2: float

    @staticmethod
    def draw(level: str, rng: np.random.Generator) -> ImuErrors:
        """Errors of one specimen.

        "calibrated": what a calibration leaves: gyro bias σ 0.05 °/s, accelerometer bias σ 0.03 m/s², scale σ 0.2 %.
        "datasheet": an uncalibrated part within the data sheet: ±20 °/s, ±50 mg, 3 % scale, 2 % cross-axis.
        "none": the pure signals.
        """
        if level == "none":
            return ImuErrors(np.eye(3), np.zeros(3), 0.0, np.eye(3), np.zeros(3), 0.0)
        if level == "calibrated":
            gyro_matrix, gyro_bias = np.eye(3), np.radians(0.05) * rng.standard_normal(3)
            accel_matrix = np.diag(1 + 0.002 * rng.standard_normal(3))
            accel_bias = 0.03 * rng.standard_normal(3)
        else:
            gyro_matrix, accel_matrix = _tolerance(rng), _tolerance(rng)
            gyro_bias = np.radians(20.0) * rng.uniform(-1, 1, 3)
            accel_bias = 0.05 * STANDARD_GRAVITY * rng.uniform(-1, 1, 3)
        return ImuErrors(gyro_matrix, gyro_bias, GYRO_NOISE_RAD_S, accel_matrix, accel_bias, ACCEL_NOISE_M_S2)


def _tolerance(rng: np.random.Generator) -> Floats:
    """A matrix with 3 % scale and 2 % cross-axis tolerance, uniform."""
    matrix = 0.02 * rng.uniform(-1, 1, (3, 3))
    np.fill_diagonal(matrix, 1 + 0.03 * rng.uniform(-1, 1, 3))
    return np.asarray(matrix)


def white(seed: tuple[int, ...], first: int, count: int, width: int) -> Floats:
    """Standard normal numbers (count, width) of the readings from `first` on, a function of each one's number alone."""
    rows = []
    for block in range(first // _BLOCK, (first + count - 1) // _BLOCK + 1):
        whole = _white_block(seed, block, width)
        rows.append(whole[max(0, first - block * _BLOCK) : first + count - block * _BLOCK])
    return np.concatenate(rows) if rows else np.empty((0, width))


@lru_cache(maxsize=8)
def _white_block(seed: tuple[int, ...], block: int, width: int) -> Floats:
    """Kept for a while, because a live board asks for one reading at a time."""
    return np.random.default_rng([*seed, block]).standard_normal((_BLOCK, width))


def accel_counts(accel_m_s2: Floats, range_g: int) -> NDArray[np.int16]:
    return to_counts(accel_m_s2, accel_scale(range_g))


def gyro_counts(gyro_rad_s: Floats, range_deg_s: int) -> NDArray[np.int16]:
    return to_counts(gyro_rad_s, gyro_scale(range_deg_s))


def temperature_counts(temp_degC: Floats) -> NDArray[np.int16]:
    scale, offset = TEMPERATURE[DeviceFamily.MPU6050]
    return to_counts(temp_degC - offset, scale)


def to_counts(value: Floats, scale: float) -> NDArray[np.int16]:
    """Rounded to the nearest count, and held at the ends of the range as the sensor does."""
    return np.clip(np.rint(value / scale), -32768, 32767).astype(np.int16)
