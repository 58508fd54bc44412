"""The columns of a recording, the one place where their names, order and decimals stand."""

from __future__ import annotations

import numpy as np

from linkpose.sensors import bmp180, mpu6050
from linkpose.sensors.conversion import TIME_DECIMALS
from linkpose.sensors.measurements import Block

ACCEL = ("accel_x_m_s2", "accel_y_m_s2", "accel_z_m_s2")
GYRO = ("gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s")

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
_FORMATS = tuple(code for _, code in _HEAD)


def mouse_columns(port: int) -> tuple[str, str]:
    """Names of a mouse's two columns; ports count from 1."""
    return f"mouse{port}_dx_counts", f"mouse{port}_dy_counts"


def names(mouse_ports: int) -> list[str]:
    """The header of a recording with so many mouse ports."""
    mice = [name for port in range(1, mouse_ports + 1) for name in mouse_columns(port)]
    return [name for name, _ in _HEAD] + mice + ["flags"]


def text(block: Block) -> str:
    """The block as lines of CSV. A missing value is an empty field."""
    part = block.measurements
    mice = part.mice_counts.reshape(len(part), -1)
    head = [part.time_s, block.seq, part.accel_m_s2, part.gyro_rad_s, part.imu_temp_degC]
    table = np.column_stack(
        [*head, part.pressure_Pa, part.baro_temp_degC, part.baro_fresh, mice, part.flags],
    )
    line = ",".join([*_FORMATS, *["%.0f"] * (mice.shape[1] + 1)]) + "\n"
    return ((line * len(table)) % tuple(table.ravel().tolist())).replace("nan", "")
