"""How an MPU-6050 errs, and the counts that it gives.

The counts are made with the scales that `linkpose.sensors` reads them with.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.mpu6050 import STANDARD_GRAVITY, TEMPERATURE, accel_scale, gyro_scale
from linkpose.sensors.rig import Noise, Rig, Vector
from linkpose.wire.messages import DeviceFamily

Floats = NDArray[np.float64]

GYRO_NOISE_RAD_S = float(np.radians(0.05))  # data sheet, 3.1: total RMS noise 0.05 °/s
ACCEL_NOISE_M_S2 = 0.04  # data sheet, 3.2: 400 µg/√Hz over about 100 Hz
_BLOCK = 1000  # readings whose noise is drawn at once
_NODE_S = 0.5  # between two values of a drift (s): below it, white noise exceeds any flicker
_FLICKER_S = (1.0, 4.0, 16.0, 64.0, 256.0)  # time constants of its parts
# σ of a part over the bias instability B: the Allan deviation of their sum is 0.97 σ from 5 s to 100 s, and is to be
# √(2 ln 2 / π) B.
_FLICKER_STD = 0.664 / 0.97
_REFERENCE_DEGC = 25.0  # at which the drift with temperature is zero
LEVELS = ("calibrated", "datasheet", "none")
# Noise of a converter (counts, 1σ) where nothing else errs, below any sensor's. Without it an axis at rest repeats, as
# no real one does, and is taken for frozen; with half of it, 25 readings repeat by chance once in hours. Doubled, it
# exceeds the gyro's noise at 1000 °/s.
CONVERTER_NOISE = 0.7


@dataclass(frozen=True, slots=True)
class ImuErrors:
    """measured = matrix · true + bias + white noise, for either sensor."""

    gyro_matrix: Floats  # (3, 3)
    gyro_bias_rad_s: Floats  # (3,)
    gyro_noise_rad_s: float | Floats  # of one sample, all axes or (3,)
    accel_matrix: Floats  # (3, 3)
    accel_bias_m_s2: Floats  # (3,)
    accel_noise_m_s2: float | Floats

    @staticmethod
    def draw(level: str, rng: np.random.Generator, accel_range_g: int = 8, gyro_range_deg_s: int = 1000) -> ImuErrors:
        """Errors of one specimen, with these ranges.

        "calibrated": what a calibration leaves: gyro bias σ 0.05 °/s, accelerometer bias σ 0.03 m/s², scale σ 0.2 %.
        "datasheet": an uncalibrated part within the data sheet: ±20 °/s, ±50 mg, 3 % scale, 2 % cross-axis.
        "none": the noise of the converter alone.
        """
        if level == "none":
            accel_noise, gyro_noise = accel_scale(accel_range_g), gyro_scale(gyro_range_deg_s)
            return ImuErrors(
                *(np.eye(3), np.zeros(3), CONVERTER_NOISE * gyro_noise),
                *(np.eye(3), np.zeros(3), CONVERTER_NOISE * accel_noise),
            )
        if level == "calibrated":
            gyro_matrix, gyro_bias = np.eye(3), np.radians(0.05) * rng.standard_normal(3)
            accel_matrix = np.diag(1 + 0.002 * rng.standard_normal(3))
            accel_bias = 0.03 * rng.standard_normal(3)
        else:
            gyro_matrix, accel_matrix = _tolerance(rng), _tolerance(rng)
            gyro_bias = np.radians(20.0) * rng.uniform(-1, 1, 3)
            accel_bias = 0.05 * STANDARD_GRAVITY * rng.uniform(-1, 1, 3)
        return ImuErrors(gyro_matrix, gyro_bias, GYRO_NOISE_RAD_S, accel_matrix, accel_bias, ACCEL_NOISE_M_S2)

    @staticmethod
    def draw_from(rig: Rig, rng: np.random.Generator, rate_hz: float) -> ImuErrors:
        """Errors of one specimen whose noise and remaining biases are a rig file's, sampled at `rate_hz`.

        Figures that the rig lacks are those of a calibrated sensor. The walk of the biases is `BiasDrift`.
        """
        imu, noise, errors = rig.imu, rig.noise, ImuErrors.draw("calibrated", rng)
        gyro_bias, accel_bias = errors.gyro_bias_rad_s, errors.accel_bias_m_s2
        if imu.gyro_bias_std_rad_s is not None:
            gyro_bias = imu.gyro_bias_std_rad_s * rng.standard_normal(3)
        if imu.accel_offset_std_m_s2 is not None:
            accel_bias = imu.accel_offset_std_m_s2 * rng.standard_normal(3)
        gyro_noise, accel_noise = noise.gyro_density_rad_s_sqrtHz, noise.accel_density_m_s2_sqrtHz
        root = math.sqrt(rate_hz)
        return replace(
            errors,
            gyro_bias_rad_s=gyro_bias,
            accel_bias_m_s2=accel_bias,
            gyro_noise_rad_s=imu.gyro_noise_rad_s if gyro_noise is None else root * np.array(gyro_noise),
            accel_noise_m_s2=imu.accel_noise_m_s2 if accel_noise is None else root * np.array(accel_noise),
        )


class BiasDrift:
    """Bias instability, random walk and temperature drift of the gyro and the accelerometer, as functions of time.

    Flicker is the sum of first-order processes whose time constants are a factor of 4 apart: its Allan deviation is
    flat within 10 % between them. Values are drawn at nodes, in order, and linear between two nodes.
    """

    def __init__(self, noise: Noise, seed: tuple[int, ...]) -> None:
        def both(gyro: Vector | None, accel: Vector | None) -> Floats:
            return np.concatenate([gyro or np.zeros(3), accel or np.zeros(3)])

        self._seed = seed
        self._flicker = _FLICKER_STD * both(noise.gyro_instability_rad_s, noise.accel_instability_m_s2)
        self._walk = both(noise.gyro_walk_rad_s_sqrts, noise.accel_walk_m_s2_sqrts)
        self._per_degC = both(noise.gyro_drift_rad_s_degC, noise.accel_drift_m_s2_degC)
        self._parts = np.zeros((1 + len(_FLICKER_S), 6))  # at the last node: the walk, and each process
        self._nodes = [np.zeros(6)]

    def at(self, time_s: Floats, temp_degC: Floats) -> tuple[Floats, Floats]:
        """What the gyro (N, 3; rad/s) and the accelerometer (N, 3; m/s²) have drifted by since the start."""
        if not (self._flicker.any() or self._walk.any() or self._per_degC.any()):
            return np.zeros((len(time_s), 3)), np.zeros((len(time_s), 3))
        place = np.maximum(time_s, 0.0) / _NODE_S
        before = place.astype(np.int64)
        while len(self._nodes) < before.max(initial=0) + 2:
            self._add_node()
        nodes = np.array(self._nodes[before.min(initial=0) : before.max(initial=0) + 2])
        share, before = (place - before)[:, None], before - before.min(initial=0)
        drift = (1 - share) * nodes[before] + share * nodes[before + 1]
        drift = drift + np.outer(temp_degC - _REFERENCE_DEGC, self._per_degC)
        return drift[:, :3], drift[:, 3:]

    def _add_node(self) -> None:
        drawn = white(self._seed, len(self._nodes), 1, 6 * len(self._parts)).reshape(len(self._parts), 6)
        self._parts[0] += math.sqrt(_NODE_S) * self._walk * drawn[0]
        for part, time_constant_s, numbers in zip(self._parts[1:], _FLICKER_S, drawn[1:], strict=True):
            keep = math.exp(-_NODE_S / time_constant_s)
            part *= keep
            part += math.sqrt(1 - keep * keep) * self._flicker * numbers
        self._nodes.append(self._parts.sum(axis=0))


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
    """Cached, because a live board reads one sample at a time."""
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
