"""The columns of a recording, the one place where their names, order and decimals stand."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from linkpose.sensors import bmp180, magnetometer, mpu6050
from linkpose.sensors.conversion import TIME_DECIMALS
from linkpose.sensors.measurements import Block

ACCEL = ("accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2")
GYRO = ("gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s")
ACCEL2 = tuple(f"imu2_{name}" for name in ACCEL)
GYRO2 = tuple(f"imu2_{name}" for name in GYRO)
MAG = ("mag_x_uT", "mag_y_uT", "mag_z_uT")


class ColumnLayout(NamedTuple):
    """Which columns a recording has besides those that every recording has."""

    mouse_ports: int
    imu2: bool = False
    mag: bool = False


_HEAD = (
    ("time_s", f"%.{TIME_DECIMALS}f"),
    ("seq", "%.0f"),
    *((name, f"%.{mpu6050.ACCEL_DECIMALS}f") for name in ACCEL),
    *((name, f"%.{mpu6050.GYRO_DECIMALS}f") for name in GYRO),
    ("imu_temp_degC", f"%.{mpu6050.TEMPERATURE_DECIMALS}f"),
    ("pressure_Pa", f"%.{bmp180.PRESSURE_DECIMALS}f"),
    ("baro_temp_degC", f"%.{bmp180.TEMPERATURE_DECIMALS}f"),
    ("baro_fresh", "%.0f"),
)
_IMU2 = (
    *((name, f"%.{mpu6050.ACCEL_DECIMALS}f") for name in ACCEL2),
    *((name, f"%.{mpu6050.GYRO_DECIMALS}f") for name in GYRO2),
    ("imu2_temp_degC", f"%.{mpu6050.TEMPERATURE_DECIMALS}f"),
)
_MAG = (*((name, f"%.{magnetometer.MAG_DECIMALS}f") for name in MAG), ("mag_fresh", "%.0f"))


def _columns(layout: ColumnLayout) -> list[tuple[str, str]]:
    """Name and format of each column."""
    mice = [(name, "%.0f") for port in range(1, layout.mouse_ports + 1) for name in mouse_columns(port)]
    return [*_HEAD, *_IMU2 * layout.imu2, *_MAG * layout.mag, *mice, ("flags", "%.0f")]


def mouse_columns(port: int) -> tuple[str, str]:
    """Names of a mouse's two columns; ports count from 1."""
    return f"mouse{port}_dx_counts", f"mouse{port}_dy_counts"


def names(layout: ColumnLayout) -> list[str]:
    """The header of a recording."""
    return [name for name, _ in _columns(layout)]


def text(block: Block, layout: ColumnLayout) -> str:
    """The block as lines of CSV. A missing value is an empty field."""
    part = block.measurements
    mice = part.mice_counts.reshape(len(part), 2 * layout.mouse_ports)
    head = [part.time_s, block.seq, part.accel_m_s2, part.gyro_rad_s, part.imu_temp_degC]
    imu2 = [part.accel2_m_s2, part.gyro2_rad_s, part.imu2_temp_degC] * layout.imu2
    mag = [part.mag_uT, part.mag_fresh] * layout.mag
    parts = [*head, part.pressure_Pa, part.baro_temp_degC, part.baro_fresh, *imu2, *mag, mice, part.flags]
    if len(part) == 1:  # live: joining a dozen arrays of length 1 would take longer than formatting the row
        values = [value for each in parts for value in each.ravel().tolist()]
    else:
        values = np.concatenate([each if each.ndim == 2 else each[:, None] for each in parts], axis=1).ravel().tolist()
    return ((_line(layout) * len(part)) % tuple(values)).replace("nan", "")


@lru_cache(maxsize=16)
def _line(layout: ColumnLayout) -> str:
    """The format of a row."""
    return ",".join(code for _, code in _columns(layout)) + "\n"
