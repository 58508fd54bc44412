"""Readings of a sensor that moves freely, made by code: smooth rotation and translation with known truth."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.measurements import Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY as GRAVITY

Floats = NDArray[np.float64]


class Motion(NamedTuple):
    """Times (N,) s, force (N, 3) m/s², rate (N, 3) rad/s and tilt (N, 3), in the sensor's axes, without errors."""

    time_s: Floats
    accel_m_s2: Floats
    gyro_rad_s: Floats
    tilt: Floats

    def block(self, accel_noise: float = 0.04, gyro_noise: float = 0.0016, seed: int = 0) -> Measurements:
        """The readings with white noise (m/s², rad/s)."""
        rng, shape = np.random.default_rng(seed), self.accel_m_s2.shape
        return Measurements.from_imu(
            self.time_s,
            self.accel_m_s2 + rng.normal(0, accel_noise, shape),
            self.gyro_rad_s + rng.normal(0, gyro_noise, shape),
        )

    def tilt_error_deg(self, roll_pitch_deg: Floats) -> Floats:
        """Angle (N,) between the tilts of an estimate's roll and pitch (N, 2) and the true ones."""
        roll, pitch = np.radians(roll_pitch_deg).T
        tilt = np.column_stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])
        return np.asarray(np.degrees(np.arccos(np.clip((tilt * self.tilt).sum(axis=1), -1, 1))))


def motion(duration_s: float, rate: Callable[[float], Floats], accel: Callable[[Floats], Floats]) -> Motion:
    """100 Hz readings of a sensor turned by `rate`(t) (3,) rad/s in its own axes, from level.

    `accel`(time_s) is its acceleration (N, 3) m/s² in axes with Z up.
    """
    time_s = np.arange(0, duration_s, 0.01)
    matrix, matrices = np.eye(3), []
    for t in time_s:
        matrices.append(matrix)
        matrix = matrix @ _rotation(0.01 * rate(t + 0.005))
    turned = np.array(matrices)
    force = np.einsum("nji,nj->ni", turned, accel(time_s) + GRAVITY * np.eye(3)[2])
    return Motion(time_s, force, np.array([rate(t) for t in time_s]), turned[:, 2, :])


def _rotation(turn: Floats) -> Floats:
    angle = float(np.linalg.norm(turn))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = turn / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
