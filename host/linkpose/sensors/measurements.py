"""Measurements in SI units: what the filters read, whatever they came from (port, recording, simulation)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from linkpose.errors import InvalidValue
from linkpose.sensors.conversion import Row
from linkpose.wire.messages import SampleFlags

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Measurements:
    """N consecutive samples in the sensors' own axes, before the rig's calibration. A value that is missing is NaN.

    All arrays are C-contiguous. A block of one sample and a whole recording have the same form.
    """

    time_s: Floats  # (N,) device clock fitted to the host's, 0 at the recording's start, increasing
    accel_m_s2: Floats  # (N, 3) specific force, +g along the upward axis at rest
    gyro_rad_s: Floats  # (N, 3) angular rate
    imu_temp_degC: Floats  # (N,)
    pressure_Pa: Floats  # (N,) the last compensated pressure, repeated until the next
    baro_temp_degC: Floats  # (N,)
    baro_fresh: NDArray[np.bool_]  # (N,) True at the first sample that carries a new pressure
    mice_counts: Floats  # (N, M, 2) counts dx, dy of each mouse since it was last read; 0 where flags say MICE_STALE
    flags: NDArray[np.uint16]  # (N,) wire.messages.SampleFlags

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, rows: slice) -> Measurements:
        """The samples of a slice, as views."""
        return Measurements(*(getattr(self, field.name)[rows] for field in fields(self)))

    @staticmethod
    def from_imu(time_s: ArrayLike, accel_m_s2: ArrayLike, gyro_rad_s: ArrayLike) -> Measurements:
        """Measurements of one's own inertial sensor.

        Args:
            time_s: (N,) time of each sample (s), not decreasing.
            accel_m_s2: (N, 3) specific force in the sensor's axes (m/s²): +9.81 along the upward axis at rest.
            gyro_rad_s: (N, 3) angular rate in the same axes (rad/s). A sample with NaN counts as missing.

        Raises:
            InvalidValue: an array has another shape, or a time is missing, infinite or earlier than the one before it.
        """
        time = _checked_times(time_s)
        accel = _checked_vectors("accel_m_s2", accel_m_s2, len(time))
        gyro = _checked_vectors("gyro_rad_s", gyro_rad_s, len(time))
        missing = np.full(len(time), np.nan)
        valid = np.isfinite(accel).all(axis=1) & np.isfinite(gyro).all(axis=1)
        return Measurements(
            time,
            accel,
            gyro,
            missing,
            missing,
            missing,
            np.zeros(len(time), np.bool_),
            np.empty((len(time), 0, 2)),
            np.where(valid, SampleFlags.IMU_VALID, 0).astype(np.uint16),
        )

    @staticmethod
    def of(rows: Sequence[Row]) -> Measurements:
        """The samples of some rows."""
        imu = np.array([row.imu for row in rows]).reshape(-1, 7)
        mice = np.array([row.mice for row in rows], dtype=np.float64)
        return Measurements(
            np.array([row.time_s for row in rows]),
            np.ascontiguousarray(imu[:, :3]),
            np.ascontiguousarray(imu[:, 3:6]),
            np.ascontiguousarray(imu[:, 6]),
            np.array([row.pressure_Pa for row in rows]),
            np.array([row.baro_temp_degC for row in rows]),
            np.array([row.baro_fresh for row in rows], dtype=np.bool_),
            mice.reshape(len(rows), mice.size // (2 * len(rows)) if rows else 0, 2),
            np.array([row.flags for row in rows], dtype=np.uint16),
        )


def _checked_times(time_s: ArrayLike) -> Floats:
    time = np.ascontiguousarray(time_s, dtype=np.float64)
    if time.ndim != 1:
        raise InvalidValue("time_s", f"has the shape {time.shape}; it must be (N,)")
    if not np.isfinite(time).all() or (np.diff(time) < 0).any():
        at = int(np.flatnonzero(~np.isfinite(time) | (np.diff(time, prepend=-np.inf) < 0))[0])
        raise InvalidValue("time_s", f"is {time[at]} at index {at}; times must be finite and must not decrease")
    return time


def _checked_vectors(name: str, values: ArrayLike, rows: int) -> Floats:
    vectors = np.ascontiguousarray(values, dtype=np.float64)
    if vectors.shape != (rows, 3):
        raise InvalidValue(name, f"has the shape {vectors.shape}; it must be ({rows}, 3), one row per time")
    return vectors
