"""Raw counts of SAMPLE messages to SI units, in blocks of any length: the one conversion for live, CSV and raw replay.

Every value is rounded to the decimals that a recording stores. The filters therefore receive the same values live and
in a replay of the recording, to the last bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

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

IMU_VALID = int(SampleFlags.IMU_VALID)
BARO_VALID = int(SampleFlags.BARO_VALID)
IMU2_VALID = int(SampleFlags.IMU2_VALID)
MAG_VALID = int(SampleFlags.MAG_VALID)
GAP_BEFORE = int(SampleFlags.GAP_BEFORE)

COUNT_FIELDS = tuple(name for name in Sample._fields if name != "mice")  # columns of RawSamples.counts
_IMU = slice(
    COUNT_FIELDS.index("accel_x"), COUNT_FIELDS.index("gyro_z") + 1
)  # accel x, y, z, temperature, gyro x, y, z
_IMU2 = slice(COUNT_FIELDS.index("accel2_x"), COUNT_FIELDS.index("gyro2_z") + 1)
_MAG = slice(COUNT_FIELDS.index("mag_x"), COUNT_FIELDS.index("mag_z") + 1)
_MAG_COUNT = COUNT_FIELDS.index("mag_count")
_BARO = slice(COUNT_FIELDS.index("baro_ut"), COUNT_FIELDS.index("baro_count") + 1)  # UT, UP, count

# Rounding steps in one unit of each IMU column. `rint(value * steps) / steps` gives the same bits for any block length.
_IMU_STEPS = 10.0 ** np.array(
    [mpu6050.ACCEL_DECIMALS] * 3 + [mpu6050.TEMPERATURE_DECIMALS] + [mpu6050.GYRO_DECIMALS] * 3, dtype=np.float64
)
_BARO_STEPS = 10.0 ** np.array([PRESSURE_DECIMALS, TEMPERATURE_DECIMALS], dtype=np.float64)
_MAG_STEPS = 10.0**magnetometer.MAG_DECIMALS
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


class Converter:
    """Converts consecutive blocks of raw samples of one board; the last pressure carries over from block to block."""

    def __init__(self, settings: BoardSettings, mouse_ports: int | None = None) -> None:
        """`mouse_ports`: ports in the result, if these are not those that the board found."""
        self.settings = settings
        self.mouse_ports = settings.mouse_ports if mouse_ports is None else mouse_ports
        accel, gyro = mpu6050.accel_scale(settings.accel_range_g), mpu6050.gyro_scale(settings.gyro_range_deg_s)
        self._imu_scales = []
        for family in settings.imu_families:
            temperature, at_zero = mpu6050.temperature_scale(family)
            scale, offset = [accel] * 3 + [temperature] + [gyro] * 3, [0.0] * 3 + [at_zero] + [0.0] * 3
            self._imu_scales.append((np.array(scale), np.array(offset)))
        self._mag_scale = magnetometer.scale(settings.mag_family)
        self._mag_count: int | None = None  # of the last sample; None where it had no valid reading
        self._has_baro = settings.barometer.is_sound
        self._baro_count: int | None = None  # of the last sample; None where that had no valid reading
        self._baro = np.full((1, 2), np.nan)  # last pressure (Pa) and temperature (degC)

    def convert(self, raw: RawSamples, time_s: Floats, flags: Integers) -> Measurements:
        """The samples at `time_s` (N,), s since the start, in SI units; `flags` (N,) as a recording stores them."""
        imu = self._convert_imu(0, raw.counts[:, _IMU], flags & IMU_VALID == 0)
        others: dict[str, Any] = {}
        if self.settings.has_imu2:
            imu2 = self._convert_imu(1, raw.counts[:, _IMU2], flags & IMU2_VALID == 0)
            others |= {
                "accel2_m_s2": np.ascontiguousarray(imu2[:, :3]),
                "gyro2_rad_s": np.ascontiguousarray(imu2[:, 4:]),
            }
            others["imu2_temp_degC"] = np.ascontiguousarray(imu2[:, 3])
        if self.settings.has_mag:
            others |= self._convert_mag(raw.counts, flags)
        baro, fresh = self._convert_baro(raw.counts[:, _BARO], flags)
        return Measurements(
            time_s.round(TIME_DECIMALS),
            np.ascontiguousarray(imu[:, :3]),
            np.ascontiguousarray(imu[:, 4:]),
            np.ascontiguousarray(imu[:, 3]),
            np.ascontiguousarray(baro[:, 0]),
            np.ascontiguousarray(baro[:, 1]),
            fresh,
            self._convert_mice(raw, flags),
            flags.astype(np.uint32),
            **others,
        )

    def convert_placed(self, samples: Sequence[Sample], places: Sequence[Placed]) -> Block:
        """Decoded samples with the places that a timeline assigned to them, in SI units. There may be none."""
        time_s, seq, flags = zip(*places, strict=True) if places else ((), (), ())
        raw = RawSamples.of(samples, self.mouse_ports)
        measurements = self.convert(raw, np.array(time_s, dtype=np.float64), np.array(flags, dtype=np.int64))
        return Block(np.array(seq, dtype=np.int64), measurements)

    def _convert_imu(self, number: int, counts: Integers, invalid: NDArray[np.bool_]) -> Floats:
        """Accelerations, temperature and rates (N, 7) of inertial sensor 0 or 1."""
        scale, offset = self._imu_scales[number]
        imu: Floats = np.rint((counts * scale + offset) * _IMU_STEPS) / _IMU_STEPS
        np.copyto(imu, np.nan, where=invalid[:, None])
        return imu

    def _convert_mag(self, counts: Integers, flags: Integers) -> dict[str, Any]:
        """Field (N, 3), µT, each reading repeated until the next, and where a new reading arrived (N,)."""
        valid = flags & MAG_VALID != 0
        fresh, self._mag_count = _new_readings(valid, counts[:, _MAG_COUNT], self._mag_count)
        field = np.rint(counts[:, _MAG] * self._mag_scale * _MAG_STEPS) / _MAG_STEPS
        return {"mag_uT": np.where(valid[:, None], field, np.nan), "mag_fresh": fresh}

    def _convert_baro(self, counts: Integers, flags: Integers) -> tuple[Floats, NDArray[np.bool_]]:
        """Pressure and temperature (N, 2), each reading repeated until the next, and where a new reading arrived (N,).

        An impossible reading is missing and not new: the sensor or its wiring is faulty.
        """
        size = len(flags)
        if not size or not self._has_baro:
            return np.full((size, 2), np.nan), np.zeros(size, np.bool_)
        valid = flags & BARO_VALID != 0
        fresh, self._baro_count = _new_readings(valid, counts[:, 2], self._baro_count)
        readings = np.concatenate((self._baro, self._compensate(counts[fresh, :2])))
        baro = readings.take(fresh.cumsum(), axis=0)
        np.copyto(baro, np.nan, where=~valid[:, None])
        self._baro = baro[-1:].copy()
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
