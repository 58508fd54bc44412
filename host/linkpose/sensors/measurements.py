"""Measurements in SI units: the input of the filters, from a port, a recording or a simulation."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from linkpose.errors import InvalidValue
from linkpose.wire.messages import SampleFlags

Floats = NDArray[np.float64]

# Types of the arrays of Measurements.
_FLOAT = np.dtype(np.float64)
_DTYPES = {"baro_fresh": np.dtype(np.bool_), "mag_fresh": np.dtype(np.bool_), "flags": np.dtype(np.uint32)}


@lru_cache(maxsize=16)
def _absent(size: int) -> dict[str, NDArray[Any]]:
    """Read-only values of sensors that are not there, for `size` samples: they share the memory of one number."""
    shapes = {"accel2_m_s2": (size, 3), "gyro2_rad_s": (size, 3), "imu2_temp_degC": (size,), "mag_uT": (size, 3)}
    values: dict[str, NDArray[Any]] = {name: np.broadcast_to(np.nan, shape) for name, shape in shapes.items()}
    return values | {"mag_fresh": np.broadcast_to(np.False_, size)}


@dataclass(frozen=True, slots=True)
class Measurements:
    """N consecutive samples in the sensors' own axes, before the rig's calibration. A value that is missing is NaN.

    All arrays are C-contiguous. A block of one sample and a whole recording have the same form.

    Attributes:
        time_s: (N,) device clock fitted to the host's (s), 0 at the recording's start, increasing.
        accel_m_s2: (N, 3) specific force, +9.81 along the upward axis at rest.
        gyro_rad_s: (N, 3) angular rate.
        imu_temp_degC: (N,) temperature of the inertial sensor.
        pressure_Pa: (N,) the last compensated pressure, repeated until the next one.
        baro_temp_degC: (N,) temperature of the barometer.
        baro_fresh: (N,) True at the first sample that carries a new pressure.
        mice_counts: (N, M, 2) counts dx, dy of each mouse since it was last read; 0 where MICE_STALE is set.
        flags: (N,) `linkpose.wire.messages.SampleFlags`.
        accel2_m_s2, gyro2_rad_s: (N, 3) the second inertial sensor's, in its own axes; NaN without such a sensor.
        imu2_temp_degC: (N,) temperature of the second inertial sensor.
        mag_uT: (N, 3) field in the magnetometer's axes, repeated until the next reading; NaN without a magnetometer.
        mag_fresh: (N,) True where a new field arrived.
    """

    time_s: Floats
    accel_m_s2: Floats
    gyro_rad_s: Floats
    imu_temp_degC: Floats
    pressure_Pa: Floats
    baro_temp_degC: Floats
    baro_fresh: NDArray[np.bool_]
    mice_counts: Floats
    flags: NDArray[np.uint32]
    accel2_m_s2: Floats = None  # type: ignore[assignment]
    gyro2_rad_s: Floats = None  # type: ignore[assignment]
    imu2_temp_degC: Floats = None  # type: ignore[assignment]
    mag_uT: Floats = None  # type: ignore[assignment]
    mag_fresh: NDArray[np.bool_] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Absent sensors become rows of NaN, without memory of their own; other arrays get the type of their field.

        The filters are compiled for this one type: another one, as a transposed array has, would wait for the compiler.
        """
        for name, values in _absent(len(self.time_s)).items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, values)
        for name in self.__slots__:
            values, dtype = getattr(self, name), _DTYPES.get(name, _FLOAT)
            is_as_compiled = values.dtype == dtype and values.flags.c_contiguous and values.flags.writeable
            if not is_as_compiled and 0 not in values.strides:
                object.__setattr__(self, name, np.array(values, dtype, order="C"))

    @property
    def has_imu2(self) -> bool:
        """Whether any sample has a reading of a second inertial sensor."""
        return bool(np.isfinite(self.gyro2_rad_s).any())

    @property
    def has_mag(self) -> bool:
        """Whether any sample has a reading of a magnetometer."""
        return bool(np.isfinite(self.mag_uT).any())

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, rows: slice) -> Measurements:
        """The samples of a slice, as views."""
        return Measurements(*(getattr(self, field.name)[rows] for field in fields(self)))

    @staticmethod
    def from_imu(
        time_s: ArrayLike,
        accel_m_s2: ArrayLike,
        gyro_rad_s: ArrayLike,
        *,
        accel2_m_s2: ArrayLike | None = None,
        gyro2_rad_s: ArrayLike | None = None,
        mag_uT: ArrayLike | None = None,
    ) -> Measurements:
        """Makes measurements from the arrays of your own inertial sensor, or of two, with or without a magnetometer.

        A sample with NaN in its acceleration or rate counts as missing. The result has no pressure and no mice.

        Args:
            time_s: (N,) time of each sample (s), not decreasing.
            accel_m_s2: (N, 3) specific force in the sensor's axes (m/s²): +9.81 along the upward axis at rest.
            gyro_rad_s: (N, 3) angular rate in the same axes (rad/s).
            accel2_m_s2: (N, 3) specific force of a second sensor in its own axes (m/s²); requires gyro2_rad_s.
            gyro2_rad_s: (N, 3) angular rate of the second sensor (rad/s); requires accel2_m_s2.
            mag_uT: (N, 3) magnetic field in the first sensor's axes (µT). Repeat the last row where there is no new
                reading.

        Raises:
            InvalidValue: an array has another shape or holds no real numbers, only one of accel2_m_s2 and gyro2_rad_s
                is given, or a time is missing, infinite or earlier than the one before it.
        """
        time = _checked_times(time_s)
        accel = _checked_vectors("accel_m_s2", accel_m_s2, len(time))
        gyro = _checked_vectors("gyro_rad_s", gyro_rad_s, len(time))
        others = _others(len(time), accel2_m_s2, gyro2_rad_s, mag_uT)
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
            np.where(valid, SampleFlags.IMU_VALID, 0).astype(np.uint32) | others.pop("flags"),
            **others,
        )


class Block(NamedTuple):
    """Consecutive measurements together with their tick numbers."""

    seq: NDArray[np.int64]  # (N,) ticks since START, without wraps; a lost sample leaves a gap
    measurements: Measurements


def _others(size: int, accel2: ArrayLike | None, gyro2: ArrayLike | None, mag: ArrayLike | None) -> dict[str, Any]:
    """The fields of a second sensor and a magnetometer, those that are given, and their `flags` (N,)."""
    if (accel2 is None) != (gyro2 is None):
        raise InvalidValue("accel2_m_s2", "and gyro2_rad_s belong together: give both or neither")
    fields: dict[str, Any] = {"flags": np.zeros(size, np.uint32)}
    if accel2 is not None and gyro2 is not None:
        fields["accel2_m_s2"] = _checked_vectors("accel2_m_s2", accel2, size)
        fields["gyro2_rad_s"] = _checked_vectors("gyro2_rad_s", gyro2, size)
        valid = np.isfinite(fields["accel2_m_s2"]).all(axis=1) & np.isfinite(fields["gyro2_rad_s"]).all(axis=1)
        fields["flags"] |= np.where(valid, SampleFlags.IMU2_VALID, 0).astype(np.uint32)
    if mag is not None:
        field = fields["mag_uT"] = _checked_vectors("mag_uT", mag, size)
        finite = np.isfinite(field).all(axis=1)
        fields["mag_fresh"] = finite & (np.diff(field, axis=0, prepend=np.full((1, 3), np.nan)) != 0).any(axis=1)
        fields["flags"] |= np.where(finite, SampleFlags.MAG_VALID, 0).astype(np.uint32)
    return fields


def _numbers(name: str, values: ArrayLike) -> Floats:
    """The values as float64; a masked one is missing. Raises InvalidValue for dates, complex numbers and text."""
    if isinstance(values, np.ma.MaskedArray):
        values = np.where(np.ma.getmaskarray(values), np.nan, values.data)
    try:
        array = np.asarray(values)
        if array.dtype.kind in "mM":
            raise InvalidValue(
                name,
                f"has the type {array.dtype}; it must be numbers, in seconds: (t - t[0]) / numpy.timedelta64(1, 's')",
            )
        if array.dtype.kind == "c":
            raise InvalidValue(name, "is complex; it must be real numbers")
        return np.ascontiguousarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidValue(name, f"is no array of numbers: {error}") from None


def _checked_times(time_s: ArrayLike) -> Floats:
    time = _numbers("time_s", time_s)
    if time.ndim != 1:
        raise InvalidValue("time_s", f"has the shape {time.shape}; it must be (N,)")
    if not np.isfinite(time).all() or (np.diff(time) < 0).any():
        at = int(np.flatnonzero(~np.isfinite(time) | (np.diff(time, prepend=-np.inf) < 0))[0])
        raise InvalidValue("time_s", f"is {time[at]} at index {at}; times must be finite and must not decrease")
    return time


def _checked_vectors(name: str, values: ArrayLike, rows: int) -> Floats:
    vectors = _numbers(name, values)
    if vectors.shape != (rows, 3):
        raise InvalidValue(name, f"has the shape {vectors.shape}; it must be ({rows}, 3), one row per time")
    return vectors
