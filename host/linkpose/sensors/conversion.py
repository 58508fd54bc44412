"""Raw counts of SAMPLE messages to SI units, in blocks of any length: the one conversion for live, CSV and raw replay.

Every value is rounded to the decimals that a recording stores. The filters therefore receive the same values live and
in a replay of the recording, to the last bit.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors import bmp180, mpu6050
from linkpose.sensors.measurements import Block, Floats, Measurements
from linkpose.wire.messages import DeviceFamily, DeviceState, Hello, Sample, SampleFlags

Integers = NDArray[np.int64]

TIME_DECIMALS = 6

IMU_VALID = int(SampleFlags.IMU_VALID)
BARO_VALID = int(SampleFlags.BARO_VALID)
MOUSE_VALID = tuple(int(flag) for flag in SampleFlags if re.fullmatch(r"MOUSE\d_VALID", flag.name or ""))
GAP_BEFORE = int(SampleFlags.GAP_BEFORE)
MAX_MICE = len(MOUSE_VALID)  # mouse ports of the protocol

COUNT_FIELDS = tuple(name for name in Sample._fields if name != "mice")  # columns of RawSamples.counts
_IMU = slice(
    COUNT_FIELDS.index("accel_x"), COUNT_FIELDS.index("gyro_z") + 1
)  # accel x, y, z, temperature, gyro x, y, z
_BARO = [COUNT_FIELDS.index(name) for name in ("baro_ut", "baro_up", "baro_count")]

# Rounding steps in one unit of each IMU column. `rint(value * steps) / steps` gives the same bits for any block length.
_IMU_STEPS = 10.0 ** np.array(
    [mpu6050.ACCEL_DECIMALS] * 3 + [mpu6050.TEMPERATURE_DECIMALS] + [mpu6050.GYRO_DECIMALS] * 3, dtype=np.float64
)
_MOUSE_BITS = np.array(MOUSE_VALID, dtype=np.int64)
_PORTS = np.arange(MAX_MICE)


@dataclass(frozen=True, slots=True)
class BoardSettings:
    """The settings in force on a board that raw counts depend on, and the calibration words of its barometer."""

    sample_rate_hz: int
    accel_range_g: int
    gyro_range_deg_s: int
    dlpf: int
    baro_oversampling: int
    bmp180: bmp180.Calibration
    mouse_ports: int  # up to the last at which a mouse was found

    @staticmethod
    def of(hello: Hello) -> BoardSettings:
        """The settings that a HELLO announces."""
        words = bmp180.Calibration.of(hello.baro_words)
        found = [port for port, mouse in enumerate(hello.mice, 1) if mouse.state != DeviceState.ABSENT]
        return BoardSettings(
            hello.sample_rate_hz,
            hello.accel_range_g,
            hello.gyro_range_deg_s,
            hello.dlpf,
            hello.baro_oversampling,
            words,
            max(found, default=0),
        )


class Placed(NamedTuple):
    """A sample's place: seconds since the first, ticks since START, and its flags with `gap_before`."""

    time_s: float
    seq: int
    flags: int


class RawSamples(NamedTuple):
    """N samples as raw counts."""

    counts: Integers  # (N, len(COUNT_FIELDS)) the fields of SAMPLE in their order
    mice: Integers  # (N, M, 2) dx, dy of the ports that a sample carries; 0 where it carries none
    mouse_count: Integers  # (N,) ports that each sample carries

    @staticmethod
    def of(samples: Sequence[Sample], mouse_ports: int) -> RawSamples:
        """The counts of decoded samples, with room for `mouse_ports` ports."""
        room = 2 * mouse_ports
        mice = [(*sample.mice[:room], *(0,) * (room - len(sample.mice))) for sample in samples]
        return RawSamples(
            np.array([sample[: len(COUNT_FIELDS)] for sample in samples], np.int64).reshape(-1, len(COUNT_FIELDS)),
            np.array(mice, dtype=np.int64).reshape(len(samples), mouse_ports, 2),
            np.array([len(sample.mice) // 2 for sample in samples], dtype=np.int64),
        )


class Converter:
    """Converts consecutive blocks of raw samples of one board; the last pressure carries over from block to block."""

    def __init__(self, settings: BoardSettings, mouse_ports: int | None = None) -> None:
        """`mouse_ports`: ports in the result, if these are not those that the board found."""
        self.settings = settings
        self.mouse_ports = settings.mouse_ports if mouse_ports is None else mouse_ports
        accel, gyro = mpu6050.accel_scale(settings.accel_range_g), mpu6050.gyro_scale(settings.gyro_range_deg_s)
        temperature, at_zero = mpu6050.TEMPERATURE[DeviceFamily.MPU6050]
        self._imu_scale = np.array([accel] * 3 + [temperature] + [gyro] * 3)
        self._imu_offset = np.array([0.0] * 3 + [at_zero] + [0.0] * 3)
        self._has_baro = bmp180.is_sound(settings.bmp180)
        self._baro_count: int | None = None  # of the last sample; None where that had no valid reading
        self._baro = np.full((1, 2), np.nan)  # last pressure (Pa) and temperature (degC)

    def convert(self, raw: RawSamples, time_s: Floats, flags: Integers) -> Measurements:
        """The samples at `time_s` (N,), s since the start, in SI units; `flags` (N,) as a recording stores them."""
        imu = np.rint((raw.counts[:, _IMU] * self._imu_scale + self._imu_offset) * _IMU_STEPS) / _IMU_STEPS
        imu[flags & IMU_VALID == 0] = np.nan
        baro, fresh = self._convert_baro(raw.counts[:, _BARO], flags)
        return Measurements(
            np.round(time_s, TIME_DECIMALS),
            np.ascontiguousarray(imu[:, :3]),
            np.ascontiguousarray(imu[:, 4:]),
            np.ascontiguousarray(imu[:, 3]),
            np.ascontiguousarray(baro[:, 0]),
            np.ascontiguousarray(baro[:, 1]),
            fresh,
            self._convert_mice(raw, flags),
            flags.astype(np.uint16),
        )

    def convert_placed(self, samples: Sequence[Sample], places: Sequence[Placed]) -> Block:
        """Decoded samples with the places that a timeline assigned to them, in SI units. There may be none."""
        time_s, seq, flags = zip(*places, strict=True) if places else ((), (), ())
        raw = RawSamples.of(samples, self.mouse_ports)
        measurements = self.convert(raw, np.array(time_s, dtype=np.float64), np.array(flags, dtype=np.int64))
        return Block(np.array(seq, dtype=np.int64), measurements)

    def _convert_baro(self, counts: Integers, flags: Integers) -> tuple[Floats, NDArray[np.bool_]]:
        """Pressure and temperature (N, 2), each reading repeated until the next, and where a new reading arrived (N,).

        A reading that no BMP180 gives is missing and not new: the sensor or its wiring is faulty.
        """
        size = len(flags)
        if not size or not self._has_baro:
            return np.full((size, 2), np.nan), np.zeros(size, np.bool_)
        valid, count = flags & BARO_VALID != 0, counts[:, 2]
        fresh = valid.copy()
        fresh[1:] &= ~valid[:-1] | (count[1:] != count[:-1])
        fresh[0] &= count[0] != self._baro_count
        if fresh.any():
            readings = np.concatenate([self._baro, self._compensate(counts[fresh])])
            baro = readings[np.cumsum(fresh)]
        else:
            baro = np.repeat(self._baro, size, axis=0)
        baro[~valid] = np.nan
        self._baro, self._baro_count = baro[-1:].copy(), int(count[-1]) if valid[-1] else None
        return baro, fresh & np.isfinite(baro[:, 0])

    def _compensate(self, counts: Integers) -> Floats:
        """Pressure (Pa) and temperature (degC) of readings (N, 2); NaN for one that no BMP180 gives."""
        words, oversampling = self.settings.bmp180, self.settings.baro_oversampling
        try:
            with np.errstate(divide="raise"):
                temperature, pressure = bmp180.compensate(counts[:, 0], counts[:, 1], words, oversampling)
        except FloatingPointError:  # at least one impossible reading: find it
            if len(counts) == 1:
                return np.full((1, 2), np.nan)
            half = len(counts) // 2
            return np.concatenate([self._compensate(counts[:half]), self._compensate(counts[half:])])
        return np.column_stack([pressure, temperature / 10])

    def _convert_mice(self, raw: RawSamples, flags: Integers) -> Floats:
        """Counts (N, ports, 2); NaN where a port has no mouse or its reading is invalid."""
        ports = self.mouse_ports
        if not ports:
            return np.empty((len(flags), 0, 2))
        valid = (flags[:, None] & _MOUSE_BITS[:ports] != 0) & (_PORTS[:ports] < raw.mouse_count[:, None])
        return np.where(valid[:, :, None], raw.mice[:, :ports], np.nan)
