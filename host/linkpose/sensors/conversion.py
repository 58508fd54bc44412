"""Raw counts of SAMPLE messages to SI units, in blocks of any length: the one conversion for live, CSV and raw replay.

Every value is rounded to the decimals that a recording stores. The filters therefore receive the same values live and
in a replay of the recording, to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors import magnetometer, mpu6050
from linkpose.sensors.barometer import Barometer
from linkpose.sensors.bmp180 import PRESSURE_DECIMALS, TEMPERATURE_DECIMALS
from linkpose.sensors.devices import MAX_MICE, MOUSE_VALID
from linkpose.sensors.measurements import Block, Floats, Measurements
from linkpose.wire.messages import DeviceFamily, DeviceState, Hello, Sample, SampleFlags

Integers = NDArray[np.int64]

TIME_DECIMALS = 6
_TIME_STEPS = 10.0**TIME_DECIMALS
_NO_READING = (math.nan, math.nan)

IMU_VALID = int(SampleFlags.IMU_VALID)
BARO_VALID = int(SampleFlags.BARO_VALID)
IMU2_VALID = int(SampleFlags.IMU2_VALID)
MAG_VALID = int(SampleFlags.MAG_VALID)
GAP_BEFORE = int(SampleFlags.GAP_BEFORE)

COUNT_FIELDS = tuple(name for name in Sample._fields if name != "mice")  # columns of RawSamples.counts
_FIRST = COUNT_FIELDS.index("accel_x")  # field of the first column of a conversion table, see `_Table`
_BARO = slice(COUNT_FIELDS.index("baro_ut"), COUNT_FIELDS.index("baro_count") + 1)  # UT, UP, count
_MAG_COUNT = COUNT_FIELDS.index("mag_count")
_IMU2_COLUMN = COUNT_FIELDS.index("accel2_x") - _FIRST
_MAG_COLUMN = COUNT_FIELDS.index("mag_x") - _FIRST

_IMU_DECIMALS = (*[mpu6050.ACCEL_DECIMALS] * 3, mpu6050.TEMPERATURE_DECIMALS, *[mpu6050.GYRO_DECIMALS] * 3)
_PRESSURE_STEPS, _TEMPERATURE_STEPS = 10.0**PRESSURE_DECIMALS, 10.0**TEMPERATURE_DECIMALS
_BARO_STEPS: Floats = np.array([_PRESSURE_STEPS, _TEMPERATURE_STEPS])
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
    barometer: Barometer
    mouse_ports: int  # up to the last at which a mouse was found
    imu_families: tuple[int, int] = (DeviceFamily.MPU6050, DeviceFamily.NONE)  # of the sensors at 0x68 and 0x69
    mag_family: int = DeviceFamily.NONE

    def as_dict(self) -> dict[str, int]:
        """The settings in the metadata of a recording."""
        names = ("sample_rate_hz", "accel_range_g", "gyro_range_deg_s", "dlpf", "baro_oversampling")
        return {name: getattr(self, name) for name in names}

    @property
    def imu_delay_s(self) -> float:
        """Mean age (s) of the first inertial sensor's readings at their timestamps."""
        return mpu6050.delay_s(self.dlpf, self.imu_families[0])

    @property
    def has_imu2(self) -> bool:
        """Whether the board has, or had, a second inertial sensor."""
        return self.imu_families[1] != DeviceFamily.NONE

    @property
    def has_mag(self) -> bool:
        """Whether the board has, or had, a magnetometer."""
        return self.mag_family != DeviceFamily.NONE

    @staticmethod
    def of(hello: Hello) -> BoardSettings:
        """The settings that a HELLO announces."""
        imu, imu2, _, mag = hello.devices
        found = [port for port, mouse in enumerate(hello.mice, 1) if mouse.state != DeviceState.ABSENT]
        return BoardSettings(
            hello.sample_rate_hz,
            hello.accel_range_g,
            hello.gyro_range_deg_s,
            hello.dlpf,
            hello.baro_oversampling,
            Barometer.of(hello),
            max(found, default=0),
            (imu.family or DeviceFamily.MPU6050, imu2.family),
            mag.family,
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


class _Table(NamedTuple):
    """Scales of the fields of SAMPLE from the first acceleration on, up to those of the last sensor of the board.

    One operation converts all of them. Fields of other sensors in between are converted too, and not used.
    """

    fields: slice  # in COUNT_FIELDS; column k of the table is the k-th of them
    scale: Floats  # (K,) units per count
    offset: Floats  # (K,) value at 0 counts
    steps: Floats  # (K,) rounding steps in one unit: `rint(value * steps) / steps`
    valid: Integers  # (K,) the bit of `flags` that is set where the reading is valid

    @staticmethod
    def of(settings: BoardSettings) -> _Table:
        """The table for these settings."""
        accel, gyro = mpu6050.accel_scale(settings.accel_range_g), mpu6050.gyro_scale(settings.gyro_range_deg_s)
        # scale, offset, decimals, valid
        columns: list[tuple[float, float, int, int]] = [(1.0, 0.0, 0, 0)] * (len(COUNT_FIELDS) - _FIRST)
        end = 0
        for at, family, valid in zip((0, _IMU2_COLUMN), settings.imu_families, (IMU_VALID, IMU2_VALID), strict=True):
            temperature, at_zero = mpu6050.temperature_scale(family)
            scales, offsets = [accel] * 3 + [temperature] + [gyro] * 3, [0.0] * 3 + [at_zero] + [0.0] * 3
            if at == 0 or settings.has_imu2:
                end = at + len(_IMU_DECIMALS)
                columns[at:end] = zip(scales, offsets, _IMU_DECIMALS, [valid] * len(scales), strict=True)
        if settings.has_mag:
            end = _MAG_COLUMN + 3
            scale = magnetometer.scale(settings.mag_family)
            columns[_MAG_COLUMN:end] = [(scale, 0.0, magnetometer.MAG_DECIMALS, MAG_VALID)] * 3
        table = np.array(columns[:end])
        steps = 10.0 ** table[:, 2]
        return _Table(slice(_FIRST, _FIRST + end), table[:, 0], table[:, 1], steps, table[:, 3].astype(np.int64))

    def convert(self, counts: Integers, flags: Integers) -> Floats:
        """Values (N, K), NaN where the reading is invalid."""
        values: Floats = np.rint((counts[:, self.fields] * self.scale + self.offset) * self.steps) / self.steps
        np.copyto(values, np.nan, where=flags[:, None] & self.valid == 0)
        return values

    @property
    def rows(self) -> list[tuple[float, float, float, int]]:
        """Scale, offset, steps and valid bit of each column, as Python's numbers."""
        columns = (self.scale, self.offset, self.steps, self.valid)
        return list(zip(*(column.tolist() for column in columns), strict=True))


class Converter:
    """Converts consecutive blocks of raw samples of one board; the last pressure carries over from block to block."""

    def __init__(self, settings: BoardSettings, mouse_ports: int | None = None) -> None:
        """`mouse_ports`: ports in the result, if these are not those that the board found."""
        self.settings = settings
        self.mouse_ports = settings.mouse_ports if mouse_ports is None else mouse_ports
        self._table = _Table.of(settings)
        self._rows, self._has_imu2, self._has_mag = self._table.rows, settings.has_imu2, settings.has_mag
        self._mag_count: int | None = None  # of the last sample; None where it had no valid reading
        self._has_baro = settings.barometer.is_sound
        self._baro_count: int | None = None  # of the last sample; None where that had no valid reading
        self._baro = _NO_READING  # last pressure (Pa) and temperature (degC)

    def convert(self, raw: RawSamples, time_s: Floats, flags: Integers) -> Measurements:
        """The samples at `time_s` (N,), s since the start, in SI units; `flags` (N,) as a recording stores them."""
        values = self._table.convert(raw.counts, flags)
        accel, temperature, gyro = _inertial(values, 0)
        others: dict[str, Any] = {}
        if self._has_imu2:
            accel2, temperature2, gyro2 = _inertial(values, _IMU2_COLUMN)
            others |= {"accel2_m_s2": accel2, "gyro2_rad_s": gyro2, "imu2_temp_degC": temperature2}
        if self._has_mag:
            valid = flags & MAG_VALID != 0
            fresh, self._mag_count = _new_readings(valid, raw.counts[:, _MAG_COUNT], self._mag_count)
            others |= {"mag_uT": np.ascontiguousarray(values[:, _MAG_COLUMN : _MAG_COLUMN + 3]), "mag_fresh": fresh}
        baro, fresh = self._convert_baro(raw.counts[:, _BARO], flags)
        return Measurements(
            time_s.round(TIME_DECIMALS),
            accel,
            gyro,
            temperature,
            np.ascontiguousarray(baro[:, 0]),
            np.ascontiguousarray(baro[:, 1]),
            fresh,
            self._convert_mice(raw, flags),
            flags.astype(np.uint32),
            **others,
        )

    def convert_placed(self, samples: Sequence[Sample], places: Sequence[Placed]) -> Block:
        """Decoded samples with the places that a timeline assigned to them, in SI units. There may be none."""
        if len(samples) == 1:
            return self._convert_one(samples[0], places[0])
        time_s, seq, flags = zip(*places, strict=True) if places else ((), (), ())
        raw = RawSamples.of(samples, self.mouse_ports)
        measurements = self.convert(raw, np.array(time_s, dtype=np.float64), np.array(flags, dtype=np.int64))
        return Block(np.array(seq, dtype=np.int64), measurements)

    def _convert_one(self, sample: Sample, place: Placed) -> Block:
        """One sample, as a live stream brings it, to the same bits as in a longer block.

        Python's numbers take a quarter of the time that NumPy needs for arrays of length 1.
        """
        flags, counts = place.flags, cast("tuple[int, ...]", sample[self._table.fields])
        baro_fresh = self._receive_baro(flags, sample)
        values = [
            round((count * scale + offset) * steps, 0) / steps if flags & valid else math.nan
            for count, (scale, offset, steps, valid) in zip(counts, self._rows, strict=True)
        ]
        row = np.array([(*values, _rounded(place.time_s, _TIME_STEPS), *self._baro)])
        others: dict[str, Any] = {}
        if self._has_imu2:
            accel2, temperature2, gyro2 = _inertial(row, _IMU2_COLUMN)
            others |= {"accel2_m_s2": accel2, "gyro2_rad_s": gyro2, "imu2_temp_degC": temperature2}
        if self._has_mag:
            before, self._mag_count = self._mag_count, sample.mag_count if flags & MAG_VALID else None
            fresh = self._mag_count is not None and self._mag_count != before
            others |= {"mag_uT": row[:, _MAG_COLUMN : _MAG_COLUMN + 3], "mag_fresh": np.array([fresh])}
        accel, temperature, gyro = _inertial(row, 0)
        measurements = Measurements(
            row[:, -3], accel, gyro, temperature, row[:, -2], row[:, -1], np.array([baro_fresh]),
            self._mice_of(sample, flags), np.array([flags], dtype=np.uint32), **others,
        )  # fmt: skip
        return Block(np.array([place.seq]), measurements)

    def _receive_baro(self, flags: int, sample: Sample) -> bool:
        """Whether a sample has a new possible reading of the barometer; updates the last one."""
        if not self._has_baro:
            return False
        if not flags & BARO_VALID:
            self._baro_count, self._baro = None, _NO_READING
            return False
        if sample.baro_count == self._baro_count:
            return False
        self._baro_count = sample.baro_count
        temperature, pressure = self.settings.barometer.compensate_one(sample.baro_ut, sample.baro_up)
        self._baro = _rounded(pressure, _PRESSURE_STEPS), _rounded(temperature, _TEMPERATURE_STEPS)
        return not math.isnan(pressure)

    def _mice_of(self, sample: Sample, flags: int) -> Floats:
        """As `_convert_mice`, of one sample."""
        mice, ports = sample.mice, self.mouse_ports
        if not ports:
            return np.empty((1, 0, 2))
        pairs = [
            mice[2 * port : 2 * port + 2] if flags & MOUSE_VALID[port] and 2 * port < len(mice) else _NO_READING
            for port in range(ports)
        ]
        return np.array([pairs], dtype=np.float64)

    def _convert_baro(self, counts: Integers, flags: Integers) -> tuple[Floats, NDArray[np.bool_]]:
        """Pressure and temperature (N, 2), each reading repeated until the next, and where a new reading arrived (N,).

        An impossible reading is missing and not new: the sensor or its wiring is faulty.
        """
        size = len(flags)
        if not size or not self._has_baro:
            return np.full((size, 2), np.nan), np.zeros(size, np.bool_)
        valid = flags & BARO_VALID != 0
        fresh, self._baro_count = _new_readings(valid, counts[:, 2], self._baro_count)
        readings = np.concatenate(([self._baro], self._compensate(counts[fresh, :2])))
        baro = readings.take(fresh.cumsum(), axis=0)
        np.copyto(baro, np.nan, where=~valid[:, None])
        self._baro = tuple(baro[-1].tolist())
        return baro, fresh & np.isfinite(baro[:, 0])

    def _compensate(self, counts: Integers) -> Floats:
        """Pressure (Pa) and temperature (degC) of readings (N, 2); NaN for an impossible one."""
        baro = np.empty((len(counts), 2))
        if len(counts):
            baro[:, 1], baro[:, 0] = self.settings.barometer.compensate(counts[:, 0], counts[:, 1])
        return np.rint(baro * _BARO_STEPS, out=baro) / _BARO_STEPS

    def _convert_mice(self, raw: RawSamples, flags: Integers) -> Floats:
        """Counts (N, ports, 2); NaN where a port has no mouse or its reading is invalid."""
        ports = self.mouse_ports
        if not ports:
            return np.empty((len(flags), 0, 2))
        valid = (flags[:, None] & _MOUSE_BITS[:ports] != 0) & (_PORTS[:ports] < raw.mouse_count[:, None])
        return np.where(valid[:, :, None], raw.mice[:, :ports], np.nan)


def _rounded(value: float, steps: float) -> float:
    """The same bits as `np.rint(value * steps) / steps`."""
    return round(value * steps, 0) / steps


def _inertial(values: Floats, first: int) -> tuple[Floats, Floats, Floats]:
    """Acceleration (N, 3), temperature (N,) and rate (N, 3) of the inertial sensor at column `first` of the table."""
    accel, temperature, gyro = values[:, first : first + 3], values[:, first + 3], values[:, first + 4 : first + 7]
    return np.ascontiguousarray(accel), np.ascontiguousarray(temperature), np.ascontiguousarray(gyro)


def _new_readings(
    valid: NDArray[np.bool_], count: Integers, before: int | None
) -> tuple[NDArray[np.bool_], int | None]:
    """Where (N,) a sensor's count of readings shows a new one, and the last count; None where it was not valid.

    `before` is the last count of the preceding block.
    """
    if not len(valid):
        return valid, before
    fresh = valid.copy()
    if len(valid) > 1:
        fresh[1:] &= ~valid[:-1] | (count[1:] != count[:-1])
    fresh[0] &= count[0] != before
    return fresh, int(count[-1]) if valid[-1] else None
