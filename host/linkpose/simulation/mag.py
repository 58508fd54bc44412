"""A magnetometer on the simulated link: the earth's field in the sensor's axes, its errors, and raw counts."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.magnetometer import scale
from linkpose.sensors.rig import Mag
from linkpose.simulation.imu import CONVERTER_NOISE, to_counts
from linkpose.simulation.motion import Kinematics
from linkpose.wire.messages import DeviceFamily

Floats = NDArray[np.float64]

# Horizontal (towards n's X axis, north) and vertical (up) component, µT: Seoul, WMM 2020, rounded.
NORTH_UT, UP_UT = 30.0, -42.0
NOISE_UT = 0.2  # QMC5883L, 13-52-04, table 2: 2 mG RMS at 8 G
# Hard iron of the board: ±20 µT uncalibrated (GY-87 boards with steel screws); 2.5 % of that after a calibration.
_HARD_IRON_UT = {"none": 0.0, "calibrated": 0.5, "datasheet": 20.0}


def noise_uT(level: str) -> float:
    """Noise of a reading, µT."""
    return CONVERTER_NOISE * scale(DeviceFamily.QMC5883L) if level == "none" else NOISE_UT


def hard_iron(level: str, rng: np.random.Generator) -> Floats:
    """Constant offset (3,) of one specimen, µT."""
    return np.asarray(_HARD_IRON_UT[level] * rng.uniform(-1, 1, 3))


def calibration(level: str) -> Mag:
    """The rig's [mag] of a simulated magnetometer: none where the specimen is not calibrated."""
    if level == "datasheet":
        return Mag()
    strength, dip = math.hypot(NORTH_UT, UP_UT), math.degrees(math.atan2(-UP_UT, NORTH_UT))
    residual = math.hypot(NOISE_UT, 0.5 * _HARD_IRON_UT[level])
    return Mag((0.0, 0.0, 0.0), field_uT=round(strength, 3), residual_uT=round(residual, 3), dip_deg=round(dip, 2))


def field(moving: Kinematics) -> Floats:
    """The earth's field (N, 3) in the sensor's axes, µT: R_nsᵀ (north, 0, up)."""
    north, _, up = axes(moving)
    return NORTH_UT * north + UP_UT * up


def axes(moving: Kinematics) -> tuple[Floats, Floats, Floats]:
    """n's axes seen in the sensor's, (N, 3) each: the columns of R_nsᵀ."""
    sin_pitch, cos_pitch = -moving.tilt[:, 0], np.hypot(moving.tilt[:, 1], moving.tilt[:, 2])
    roll = np.arctan2(moving.tilt[:, 1], moving.tilt[:, 2])
    sin_roll, cos_roll = np.sin(roll), np.cos(roll)
    sin_yaw, cos_yaw = np.sin(moving.yaw_rad), np.cos(moving.yaw_rad)
    north = np.column_stack(
        [
            cos_pitch * cos_yaw,
            -cos_roll * sin_yaw + sin_roll * sin_pitch * cos_yaw,
            sin_roll * sin_yaw + cos_roll * sin_pitch * cos_yaw,
        ]
    )
    return north, np.cross(moving.tilt, north), moving.tilt


def counts(field_uT: Floats) -> NDArray[np.int16]:
    """Raw counts of the QMC5883L that simulated boards carry."""
    return to_counts(field_uT, scale(DeviceFamily.QMC5883L))
