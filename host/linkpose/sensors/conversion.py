"""From a SAMPLE's raw counts to a row of a recording in SI units, one sample at a time.

Every value is rounded to the decimals that a recording keeps. What the filters see live is therefore exactly what they
see when the recording is replayed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from linkpose.sensors import bmp180, mpu6050
from linkpose.wire.messages import DeviceState, Hello, Sample, SampleFlags

TIME_DECIMALS = 6

IMU_VALID = int(SampleFlags.IMU_VALID)
BARO_VALID = int(SampleFlags.BARO_VALID)
MOUSE_VALID = tuple(int(SampleFlags[f"MOUSE{port}_VALID"]) for port in (1, 2, 3, 4))
GAP_BEFORE = int(SampleFlags.GAP_BEFORE)

# Steps in one unit of what is kept. Rounded so, in floating point, a value is the same here and in NumPy: some lie
# half-way between two decimals, and round(value, decimals) decides those by the exact value.
_ACCEL_STEPS = 10.0**mpu6050.ACCEL_DECIMALS
_GYRO_STEPS = 10.0**mpu6050.GYRO_DECIMALS
_TEMPERATURE_STEPS = 10.0**mpu6050.TEMPERATURE_DECIMALS

_NO_IMU = (math.nan,) * 7
_NO_MOVEMENT = (math.nan,) * 2


@dataclass(frozen=True, slots=True)
class Settings:
    """What is needed to read the raw counts: the settings in force and the barometer's words."""

    sample_rate_hz: int
    accel_range_g: int
    gyro_range_deg_s: int
    dlpf: int
    baro_oversampling: int
    bmp180: bmp180.Calibration
    mouse_ports: int  # up to the last at which a mouse was found

    @staticmethod
    def of(hello: Hello) -> Settings:
        """The settings that a HELLO announces."""
        words = bmp180.Calibration.of(hello.baro_words)
        found = [port for port, mouse in enumerate(hello.mice, 1) if mouse.state != DeviceState.ABSENT]
        return Settings(
            hello.sample_rate_hz,
            hello.accel_range_g,
            hello.gyro_range_deg_s,
            hello.dlpf,
            hello.baro_oversampling,
            words,
            max(found, default=0),
        )


class Row(NamedTuple):
    """One sample in SI units, in the sensors' own axes; NaN is a missing value."""

    time_s: float
    seq: int
    imu: tuple[float, ...]  # accel x, y, z (m/s²), gyro x, y, z (rad/s), temperature (degC)
    pressure_Pa: float
    baro_temp_degC: float
    baro_fresh: int
    mice: tuple[float, ...]  # dx, dy (counts) of each port in turn
    flags: int


class Converter:
    """Reads samples of one board with one set of settings; remembers the last pressure."""

    def __init__(self, settings: Settings, mouse_ports: int | None = None) -> None:
        """`mouse_ports` gives the rows more room than for the mice that were found."""
        self.settings = settings
        self._mouse_ports = settings.mouse_ports if mouse_ports is None else mouse_ports
        self._accel = mpu6050.accel_scale(settings.accel_range_g)
        self._gyro = mpu6050.gyro_scale(settings.gyro_range_deg_s)
        self._has_baro = bmp180.is_sound(settings.bmp180)
        self._baro_count: int | None = None
        self._baro = (math.nan, math.nan)

    def row(self, sample: Sample, time_s: float, seq: int, flags: int) -> Row:
        """The sample taken at `time_s` (s since the start); `seq` and `flags` as the recording shows them."""
        imu = _NO_IMU
        if flags & IMU_VALID:
            accel, gyro = self._accel, self._gyro
            imu = (
                round(sample.accel_x * accel * _ACCEL_STEPS) / _ACCEL_STEPS,
                round(sample.accel_y * accel * _ACCEL_STEPS) / _ACCEL_STEPS,
                round(sample.accel_z * accel * _ACCEL_STEPS) / _ACCEL_STEPS,
                round(sample.gyro_x * gyro * _GYRO_STEPS) / _GYRO_STEPS,
                round(sample.gyro_y * gyro * _GYRO_STEPS) / _GYRO_STEPS,
                round(sample.gyro_z * gyro * _GYRO_STEPS) / _GYRO_STEPS,
                round(mpu6050.temperature(sample.imu_temp) * _TEMPERATURE_STEPS) / _TEMPERATURE_STEPS,
            )
        fresh = self._read_baro(sample, flags)
        mice = self._mice(sample, flags) if self._mouse_ports else ()
        return Row(round(time_s, TIME_DECIMALS), seq, imu, *self._baro, fresh, mice, flags)

    def _read_baro(self, sample: Sample, flags: int) -> int:
        """Takes over a new reading; 1 when there is one."""
        if not (flags & BARO_VALID and self._has_baro):
            self._baro, self._baro_count = (math.nan, math.nan), None
            return 0
        if sample.baro_count == self._baro_count:
            return 0
        self._baro_count = sample.baro_count
        try:
            temperature, pressure = bmp180.compensate(
                sample.baro_ut, sample.baro_up, self.settings.bmp180, self.settings.baro_oversampling
            )
        except ZeroDivisionError:  # no BMP180 reads so: the sensor or its wiring is ill
            self._baro = (math.nan, math.nan)
            return 0
        self._baro = (float(pressure), temperature / 10)
        return 1

    def _mice(self, sample: Sample, flags: int) -> tuple[float, ...]:
        values: list[float] = []
        for port in range(self._mouse_ports):
            moved = sample.mice[2 * port : 2 * port + 2]
            values += moved if moved and flags & MOUSE_VALID[port] else _NO_MOVEMENT
        return tuple(values)
