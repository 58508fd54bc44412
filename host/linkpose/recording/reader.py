"""Reads recordings: tables (CSV, Parquet) and raw captures become measurements for the filters.

A recording is read twice: a survey finds its sensors, faults and remarks, and a second pass yields the measurements in
blocks. A short recording stays in memory and is read once.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from linkpose.recording.ahead import ahead
from linkpose.recording.capture_source import CaptureSource
from linkpose.recording.survey import Survey
from linkpose.recording.table import Progress
from linkpose.recording.table_source import TableSource
from linkpose.recording.units import UNIT_ROWS, Suspicion, is_negated, suspicions
from linkpose.sensors import mpu6050
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig
from linkpose.wire.messages import DeviceFamily

if TYPE_CHECKING:
    from linkpose.sensors.health import Change, HealthMonitor

_INTERMITTENT = 0.1  # share of rows without a reading from which on an estimate is clearly worse
MOST_CHANGES = 10  # of sensors' states, in the remarks
# Rows that stay in memory: 83 min at 100 Hz, 70 MB without a second sensor. Doubling it doubles that memory, and files
# of that length are read once instead of twice.
KEPT_ROWS = 500_000


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording in memory.

    Attributes:
        path: the file.
        measurements: all samples in SI units, in the sensors' axes.
        rig: sensor placement and calibration during the recording; None for a raw capture.
        sample_rate_hz: the rate in the metadata, or else that of the usual interval.
        metadata: all settings of the run.
        remarks: anomalies, one sentence each: a truncated file, corrupt frames, faulty sensors.
        health: state and counts of each sensor.
        unusable: why no filter can use the recording; "" if one can.
    """

    path: Path
    measurements: Measurements
    rig: Rig | None
    sample_rate_hz: float
    metadata: dict[str, Any]
    remarks: list[str]
    health: dict[str, dict[str, Any]] = field(default_factory=dict)
    unusable: str = ""

    @property
    def imu_delay_s(self) -> float | None:
        """Mean age (s) of the inertial readings at their timestamps; None if the file does not contain the setting of
        the sensor's low-pass filter."""
        return _imu_delay_s(self.metadata)


def _imu_delay_s(metadata: dict[str, Any]) -> float | None:
    settings = metadata.get("settings")
    dlpf = settings.get("dlpf") if isinstance(settings, dict) else None
    if not isinstance(dlpf, int) or not 0 <= dlpf < mpu6050.DLPF_SETTINGS:
        return None
    devices = metadata.get("devices")  # absent in recordings of protocol 1, all of which are of an MPU-6050
    first = devices[0] if isinstance(devices, list) and devices else None
    family = first.get("family") if isinstance(first, dict) else None
    if not isinstance(family, int) or family not in list(DeviceFamily):
        family = DeviceFamily.MPU6050
    return mpu6050.delay_s(dlpf, family)


def load_recording(path: str | PathLike[str]) -> Recording:
    """Reads a recording as a whole: CSV, Parquet, or a raw capture (`.bin`, the bytes that the board sent).

    The result holds `measurements` (SI units, in the sensors' axes), the `rig` of the recording, and `remarks` on what
    is wrong with the data. Raises FileError, whose message names file, line and reason, for any other file.
    """
    with contextlib.closing(RecordingFile(Path(path))) as file:
        measurements = file.load()
        remarks = [*file.remarks, *file.contradictions(file.rig)]
        return Recording(
            file.path, measurements, file.rig, file.sample_rate_hz, file.metadata, remarks, file.health, file.unusable
        )


def _joined(blocks: list[Measurements]) -> Measurements:
    if len(blocks) == 1:
        return blocks[0]
    return Measurements(*(np.concatenate([getattr(b, f.name) for b in blocks]) for f in fields(Measurements)))


class RecordingFile:
    """A recording on disk, surveyed and ready to be read in blocks.

    Raises FileError, which names the file, the line and the reason, for what is no recording.
    """

    def __init__(self, path: Path, progress: Progress | None = None) -> None:
        """`progress` is called with the share of the file that the survey has read."""
        self.path = path
        self._source: TableSource | CaptureSource = CaptureSource(path) if path.suffix == ".bin" else TableSource(path)
        self._kept: list[Measurements] | None = []  # the checked blocks of a short recording
        self._monitor = self._new_monitor(self._source.sensors)
        self.survey = Survey(self._source.rate_hz)
        self._remarks_on_values: list[Suspicion] = []
        self._changes: list[Change] = []  # the first of each sensor
        self._change_counts: dict[str, int] = {}
        self._read_all(progress)
        for sensor in [name for name in self._monitor.sensors if name not in self.sensors]:
            del self._monitor.sensors[sensor]
        self.health = self._monitor.as_dict()  # state and counts by sensor (sensors.health)
        self.unusable = "" if self._monitor.is_usable else self._monitor.why_unusable  # why no filter can use it
        self.remarks = [*self._source.remarks(), *self._value_remarks(), *self._faults()]

    @property
    def metadata(self) -> dict[str, Any]:
        """All settings of the run."""
        return self._source.metadata

    @property
    def closing(self) -> dict[str, Any] | None:
        """The content of the closing line."""
        return self._source.closing

    @property
    def rig(self) -> Rig | None:
        """In force during the recording; None for a raw capture."""
        return self._source.rig

    @property
    def sample_rate_hz(self) -> float:
        """The rate in the metadata, or else of the usual interval (Hz)."""
        return self._source.rate_hz

    @property
    def imu_delay_s(self) -> float | None:
        """As Recording.imu_delay_s."""
        return _imu_delay_s(self.metadata)

    @property
    def sensors(self) -> list[str]:
        """Sensors that the metadata lists or that have at least one value."""
        seen = self.survey.seen
        return [name for name in self._source.sensors if name in seen or name in self._source.listed_sensors]

    def blocks(self, progress: Progress | None = None) -> Iterator[Measurements]:
        """The measurements from the first to the last, with NaN for invalid readings."""
        if self._kept is not None:
            yield from self._kept
            return
        monitor = self._new_monitor(self.sensors)
        for block in ahead(self._source.blocks(progress)):
            yield monitor.check(block)[0]

    def close(self) -> None:
        """Closes the file. What was read stays; `blocks` of a long recording can no longer be read."""
        self._source.close()

    def load(self) -> Measurements:
        """All measurements at once."""
        return _joined(list(self.blocks()))

    def contradictions(self, rig: Rig | None) -> list[str]:
        """Remarks on what contradicts the rig, from the first block."""
        joint = rig.joint.known_j2s_m if rig is not None else None
        block = next(self.blocks(), None)
        # A fault of the gyro looks like this.
        is_explained = any(found.quantity == "gyro" for found in self._remarks_on_values)
        if joint is None or block is None or is_explained or not is_negated(block, joint):
            return []
        return [
            f"{self.path}: accel_* fits the motion about the joint only with its sign reversed: specific force is "
            "+9.81 m/s² along the upward axis at rest; multiply accel_* by -1, or correct J2S"
        ]

    def _new_monitor(self, sensors: list[str]) -> HealthMonitor:
        from linkpose.sensors.health import HealthMonitor

        return HealthMonitor(self._source.rate_hz, dict.fromkeys(sensors, "ok"))

    def _read_all(self, progress: Progress | None) -> None:
        """Surveys all blocks."""
        first: list[Measurements] | None = []  # as they were read, to judge the units
        for block in ahead(self._source.blocks(progress)):
            checked, changes = self._monitor.check(block)
            self._note(changes)
            self.survey.add(block, checked)
            if self._kept is not None:
                self._kept = [*self._kept, checked] if self.survey.rows <= KEPT_ROWS else None
            if first is not None:
                first.append(block)
                if self.survey.rows > UNIT_ROWS:
                    self._judge_units(first)
                    first = None
        if first is not None:
            self._judge_units(first)

    def _note(self, changes: list[Change]) -> None:
        """Keeps the first changes of each sensor, and counts all."""
        for change in changes:
            count = self._change_counts[change.sensor] = self._change_counts.get(change.sensor, 0) + 1
            if count <= MOST_CHANGES:
                self._changes.append(change)

    def _judge_units(self, first: list[Measurements]) -> None:
        self._remarks_on_values = suspicions(_joined(first), self._source.stated_rate_hz)

    def _value_remarks(self) -> list[str]:
        """What is implausible in the values, as remarks."""
        return [f"{self.path}: {found.sentence}" for found in self._remarks_on_values]

    def _faults(self) -> list[str]:
        """The changes of sensors' states, as remarks."""
        sensors = set(self.sensors)
        if any(found.quantity == "pressure" for found in self._remarks_on_values):  # another unit, not a faulty sensor
            sensors.discard("baro")
        changes = sorted((c for c in self._changes if c.sensor in sensors), key=lambda change: change.time_s)
        remarks = [f"{self.path}: {change}" for change in changes[:MOST_CHANGES]]
        more = sum(count for sensor, count in self._change_counts.items() if sensor in sensors) - len(remarks)
        if more:
            remarks.append(f"{self.path}: {more} more such changes")
        return [*remarks, *(f"{self.path}: {sentence}" for sentence in self._intermittent(sensors))]

    def _intermittent(self, sensors: set[str]) -> Iterator[str]:
        """On inertial sensors without a reading in many rows, never in so many in succession that it is a change."""
        for sensor, name in (("imu", "the IMU"), ("imu2", "the second IMU")):
            health = self.health.get(sensor, {}) if sensor in sensors and not self._change_counts.get(sensor) else {}
            invalid, rows = sum(health.get("invalid", {}).values()), health.get("samples", 0)
            if invalid > _INTERMITTENT * rows:
                yield (
                    f"{name} has no valid reading in {invalid} of {rows} rows. Check its wiring and its supply; if "
                    "another program put sensors of different rates into one table, delete the rows without a reading"
                )
