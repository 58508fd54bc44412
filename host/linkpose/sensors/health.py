"""Health of the sensors' data: which readings are worth using, and what is wrong with the others.

The checks use the firmware's flags and the readings themselves, so that recordings of older firmware and of other
programs are checked too. They are causal: blocks of any length give the same result, live and in replay.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.checks import BaroCheck, Bools, Cause, Codes, ImuCheck, MagCheck, imu_flags
from linkpose.sensors.devices import DEVICE_NAMES, MAX_MICE
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.wire.messages import DeviceState, Hello, SampleFlags

REPORT_AFTER_S = 0.25  # a state that lasts this long is reported; single lost readings are only counted
SET_UP_S = 3.0  # longest set-up of a sensor that HELLO reports as being set up
USABLE_S = 0.25  # a frozen sensor passes as valid for FROZEN_S

LEFT_OUT = "left out"  # state of a sensor whose valid readings are not used


_REASON = {
    Cause.SILENT: "gives no valid reading",
    Cause.BLANK: "reads all zeros",
    Cause.FROZEN: "repeats the same reading",
    Cause.OUT_OF_RANGE: "gives impossible readings",
    Cause.STUCK: "repeats one axis while the others change",
    Cause.STARTING: "is still being set up",
}
_WIRING = "Check its wiring and its supply"
_POWER = "Unplug the board and plug it in again; if it happens again, check the wiring or replace the sensor"
_CURE = {
    Cause.SILENT: _WIRING,
    Cause.BLANK: _WIRING,
    Cause.FROZEN: _POWER,
    Cause.OUT_OF_RANGE: _POWER,
    Cause.STUCK: _POWER,
}


@dataclass(frozen=True, slots=True)
class Change:
    """A sensor's state changed."""

    time_s: float  # of the first sample in the new state
    sensor: str
    cause: Cause
    lasted_s: float  # of the state before
    before: Cause | None = None  # the state before

    def __str__(self) -> str:
        if self.cause == Cause.OK and self.before == Cause.ABSENT:
            return f"{self.time_s:.2f} s: {_title(self.sensor)} was found"
        if self.cause == Cause.OK:
            return f"{self.time_s:.2f} s: {_title(self.sensor)} is back after {self.lasted_s:.2f} s"
        return f"{self.time_s:.2f} s: {_title(self.sensor)} {_REASON[self.cause]}. {_CURE[self.cause]}"


def _title(sensor: str) -> str:
    names = {"imu": "the IMU", "imu2": "the second IMU", "baro": "the barometer", "mag": "the magnetometer"}
    return names.get(sensor, f"mouse {sensor.removeprefix('mouse')}")


class SensorHealth:
    """State and counts of one sensor."""

    def __init__(self, sensor: str, state: str) -> None:
        """`state` at the start: "ok", "being set up" or "absent"."""
        self.sensor = sensor
        self.samples = 0
        self.saturated = 0
        self.invalid: dict[Cause, int] = {}
        self.left_out = 0  # samples whose valid readings were not used
        # The state that was reported last; None before the first sample.
        self.cause: Cause | None = Cause.ABSENT if state == Cause.ABSENT.label else None
        self._starting = state == Cause.STARTING.label
        self._since_s = 0.0  # of the reported state
        self._pending: tuple[Cause, float] | None = None  # another state, and since when

    @property
    def valid(self) -> int:
        """Valid samples."""
        return self.samples - sum(self.invalid.values())

    @property
    def is_settled(self) -> bool:
        """Whether the sensor works, and no other state is pending."""
        return self.cause == Cause.OK and self._pending is None and not self._starting

    def is_usable(self, rate_hz: float) -> bool:
        """Whether there is more than what a sensor gives before its fault is found."""
        return self.valid > USABLE_S * rate_hz or 2 * self.valid > self.samples

    def count(self, codes: Codes, time_s: Floats, saturated: Bools) -> list[Change]:
        """Count a block of samples by their Cause; the changes of state that it completes."""
        if self.cause == Cause.ABSENT and self.samples == 0:  # counted from its first reading on
            found = int(np.argmax(codes != Cause.SILENT))
            if codes[found] == Cause.SILENT:
                return []
            codes, time_s, saturated = codes[found:], time_s[found:], saturated[found:]
        if self._starting:
            codes = self._excuse(codes, time_s)
        self.samples += len(codes)
        self.saturated += int(np.count_nonzero(saturated))
        if self._pending is None and self.cause is not None and (codes == int(self.cause)).all():
            if self.cause:
                self.invalid[self.cause] = self.invalid.get(self.cause, 0) + len(codes)
            return []
        for cause, number in zip(*np.unique(codes, return_counts=True), strict=True):
            if cause != Cause.OK:
                self.invalid[Cause(cause)] = self.invalid.get(Cause(cause), 0) + int(number)
        first = np.flatnonzero(np.diff(codes, prepend=-1))
        last = np.append(first[1:], len(codes)) - 1
        segments = zip(codes[first].tolist(), time_s[first].tolist(), time_s[last].tolist(), strict=True)
        return [change for segment in segments for change in self._advance(*segment)]

    def _excuse(self, codes: Codes, time_s: Floats) -> Codes:
        """A sensor that is being set up gives no reading yet."""
        answered = np.maximum.accumulate(codes != Cause.SILENT)
        self._starting = not answered[-1] and bool(time_s[-1] < SET_UP_S)
        return np.where((codes == Cause.SILENT) & ~answered & (time_s < SET_UP_S), np.int8(Cause.STARTING), codes)

    def _advance(self, code: int, first_s: float, last_s: float) -> list[Change]:
        cause = Cause(code)
        if cause == self.cause or cause == Cause.STARTING:
            self._pending = None
            return []
        if self._pending is None or self._pending[0] != cause:
            self._pending = (cause, first_s)
        if last_s - self._pending[1] < REPORT_AFTER_S:
            return []
        change = Change(self._pending[1], self.sensor, cause, self._pending[1] - self._since_s, self.cause)
        silent = self.cause is None and cause == Cause.OK  # it began well
        self.cause, self._since_s, self._pending = cause, change.time_s, None
        return [] if silent else [change]

    def as_dict(self) -> dict[str, Any]:
        """For the summary and the closing line; `since_s` is the time from which on the sensor is faulty."""
        if self.cause == Cause.ABSENT and not self.samples:
            of: dict[str, Any] = {"state": Cause.ABSENT.label}
            return of | {"state": LEFT_OUT, "left_out": self.left_out} if self.left_out else of
        state = self._pending[0] if self.cause in (None, Cause.ABSENT) and self._pending else self.cause
        if state is None:
            state = Cause.STARTING if self.samples == 0 or self._starting else Cause.SILENT
        since = {} if state == Cause.OK or state != self.cause else {"since_s": round(self._since_s, 6)}
        return {
            "state": state.label,
            **since,
            "samples": self.samples,
            "valid": self.valid,
            "invalid": {cause.label: number for cause, number in sorted(self.invalid.items())},
            "saturated": self.saturated,
        }


_IMU_FLAGS, _IMU2_FLAGS = imu_flags(""), imu_flags("2")
_IMU_FIELDS = {
    "imu": ("accel_m_s2", "gyro_rad_s", "imu_temp_degC"),
    "imu2": ("accel2_m_s2", "gyro2_rad_s", "imu2_temp_degC"),
}
_FIRST_FIELD = {"imu": "accel_m_s2", "imu2": "accel2_m_s2", "baro": "pressure_Pa", "mag": "mag_uT"}
_MAG_VALID, _MAG_SATURATED = int(SampleFlags.MAG_VALID), int(SampleFlags.MAG_SATURATED)
_MOUSE_OVERFLOW = {f"mouse{port}": int(SampleFlags[f"MOUSE{port}_OVERFLOW"]) for port in range(1, MAX_MICE + 1)}


def expected_sensors(hello: Hello, mouse_ports: int) -> dict[str, str]:
    """The sensors of a board for HealthMonitor: all its devices, and the mouse ports that a recording has."""
    states = [device.state for device in hello.devices] + [mouse.state for mouse in hello.mice[:mouse_ports]]
    names = [*DEVICE_NAMES, *(f"mouse{port}" for port in range(1, len(hello.mice) + 1))]
    words = {DeviceState.ABSENT: Cause.ABSENT.label, DeviceState.STARTING: Cause.STARTING.label}
    return {name: words.get(DeviceState(state), "ok") for name, state in zip(names, states, strict=False)}


class HealthMonitor:
    """Checks consecutive blocks of measurements of one board or recording."""

    def __init__(self, rate_hz: float, sensors: Mapping[str, str]) -> None:
        """`sensors`: "imu", "imu2", "baro", "mag", "mouse1" ... with "ok", "being set up" or "absent"."""
        self._rate_hz = rate_hz
        self._samples = 0
        self.sensors = {name: SensorHealth(name, state) for name, state in sensors.items()}
        self._imus = {"imu": ImuCheck(_IMU_FLAGS), "imu2": ImuCheck(_IMU2_FLAGS)}
        self._baro = BaroCheck()
        self._mag = MagCheck()

    def check(self, block: Measurements) -> tuple[Measurements, list[Change]]:
        """The block with NaN for every invalid value, and the sensors whose state changed."""
        if not len(block):
            return block, []
        self._samples += len(block)
        changes: list[Change] = []
        flags, time_s = block.flags.astype(np.int64), block.time_s
        for name in [name for name in self._imus if self._is_present(name, block)]:
            block = self._check_imu(name, block, flags, changes)
        if self._is_present("baro", block):
            block = self._check_baro(block, changes)
        if self._is_present("mag", block):
            block = self._check_mag(block, flags, changes)
        for port in range(block.mice_counts.shape[1]):
            name = f"mouse{port + 1}"
            if (health := self.sensors.get(name)) is not None:
                silent = np.asarray(np.isnan(block.mice_counts[:, port]).any(axis=1)).astype(np.int8)
                overflow = flags & _MOUSE_OVERFLOW[name] != 0
                changes += health.count(silent, time_s, overflow)
        return block, changes

    def _is_present(self, name: str, block: Measurements) -> bool:
        """Whether a sensor was found at the start, or has a reading by now."""
        health = self.sensors.get(name)
        if health is None or health.cause != Cause.ABSENT or health.samples:
            return health is not None
        values: Floats = getattr(block, _FIRST_FIELD[name])
        return any(values.strides) and bool(np.isfinite(values).any())  # without memory of their own: absent

    def leave_out(self, sensor: str, samples: int) -> bool:
        """Count valid readings of a sensor that has no place in the measurements. True for the first of them."""
        health = self.sensors.setdefault(sensor, SensorHealth(sensor, Cause.ABSENT.label))
        health.left_out += samples
        return health.left_out == samples

    def _check_imu(
        self, name: str, block: Measurements, flags: NDArray[np.int64], changes: list[Change]
    ) -> Measurements:
        fields, bits = _IMU_FIELDS[name], _IMU2_FLAGS if name == "imu2" else _IMU_FLAGS
        accel, gyro, temp = (getattr(block, field) for field in fields)
        health = self.sensors[name]
        is_alone = len(block) == 1 and health.is_settled
        if is_alone and self._imus[name].passes(accel, gyro, temp, int(flags[0]), block.time_s):
            health.samples += 1
            return block
        codes = self._imus[name].check(accel, gyro, temp, flags, block.time_s)
        changes += health.count(codes, block.time_s, flags & bits.saturated != 0)
        bad = codes != 0
        if not bad.any():
            return block
        values = (
            np.where(bad[:, None], np.nan, accel),
            np.where(bad[:, None], np.nan, gyro),
            np.where(bad, np.nan, temp),
        )
        cleared = block.flags & ~np.where(bad, bits.valid, 0).astype(block.flags.dtype)
        return replace(block, flags=cleared, **dict(zip(fields, values, strict=True)))

    def _check_baro(self, block: Measurements, changes: list[Change]) -> Measurements:
        health = self.sensors["baro"]
        is_alone = len(block) == 1 and health.is_settled
        if is_alone and self._baro.passes(block.pressure_Pa.item(), block.baro_fresh.item(), block.time_s.item()):
            health.samples += 1
            return block
        codes = self._baro.check(block.pressure_Pa, block.baro_fresh, block.time_s)
        changes += health.count(codes, block.time_s, np.zeros(0, np.bool_))
        bad = codes != 0
        if not bad.any():
            return block
        return replace(
            block,
            pressure_Pa=np.where(bad, np.nan, block.pressure_Pa),
            baro_temp_degC=np.where(bad, np.nan, block.baro_temp_degC),
            baro_fresh=block.baro_fresh & ~bad,
        )

    def _check_mag(self, block: Measurements, flags: NDArray[np.int64], changes: list[Change]) -> Measurements:
        codes = self._mag.check(block.mag_uT, block.mag_fresh, block.time_s)
        changes += self.sensors["mag"].count(codes, block.time_s, flags & _MAG_SATURATED != 0)
        bad = codes != 0
        if not bad.any():
            return block
        return replace(
            block,
            mag_uT=np.where(bad[:, None], np.nan, block.mag_uT),
            mag_fresh=block.mag_fresh & ~bad,
            flags=block.flags & ~np.where(bad, _MAG_VALID, 0).astype(block.flags.dtype),
        )

    def as_dict(self) -> dict[str, dict[str, Any]]:
        """State and counts of every sensor, by name."""
        return {name: health.as_dict() for name, health in self.sensors.items()}

    @property
    def is_usable(self) -> bool:
        """Whether an inertial sensor or a mouse gave usable data. True before the first sample."""
        kinds = [health for name, health in self.sensors.items() if name.startswith(("imu", "mouse"))]
        return not self._samples or any(health.is_usable(self._rate_hz) for health in kinds if health.samples)

    @property
    def why_unusable(self) -> str:
        """The sentence for data without any usable reading."""
        reasons = [
            f"{_title(name)} {_REASON[max(health.invalid, key=lambda cause: health.invalid[cause])]}"
            for name, health in self.sensors.items()
            if health.invalid and _REASON.keys() & health.invalid.keys()
        ]
        return (
            f"no usable data: {'; '.join(reasons) or 'no inertial sensor and no mouse is connected'}. {_WIRING_OF_ALL}"
        )


_WIRING_OF_ALL = "Check the wiring and the supply of the sensors; `linkpose info` shows what the board finds"
