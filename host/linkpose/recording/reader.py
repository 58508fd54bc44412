"""Reads recordings: tables (CSV, Parquet) and raw captures become measurements for the filters.

A recording is read twice: a survey finds its sensors, faults and remarks, and a second pass yields the measurements in
blocks. A short recording stays in memory and is read once.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import FileFormatError
from linkpose.inputs import open_binary
from linkpose.presentation import counted
from linkpose.recording import columns
from linkpose.recording.ahead import ahead
from linkpose.recording.survey import Survey
from linkpose.recording.table import TableFile, require
from linkpose.recording.textfile import Part
from linkpose.recording.units import UNIT_ROWS, is_negated, suspicions
from linkpose.sensors import mpu6050
from linkpose.sensors.conversion import (
    COUNT_FIELDS,
    GAP_BEFORE,
    TIME_DECIMALS,
    BoardSettings,
    Converter,
    RawSamples,
)
from linkpose.sensors.devices import MAX_MICE, impossible
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.rig import Rig
from linkpose.sensors.timeline import OFF_TICKS, WINDOW_TICKS
from linkpose.wire.frames import OtherProtocol
from linkpose.wire.messages import PROTOCOL_MAJOR, DeviceFamily, Hello, SampleFlags

if TYPE_CHECKING:
    from linkpose.sensors.health import Change, HealthMonitor
    from linkpose.wire.capture import Capture

MOST_CHANGES = 10  # of sensors' states, in the remarks
# Rows that stay in memory: 83 min at 100 Hz, 70 MB without a second sensor. Twice of it doubles that memory, and files
# of that length are read once instead of twice.
KEPT_ROWS = 500_000
Progress = Callable[[float], None]
_T_WRAP = 1 << 32
_SEQ_WRAP = 1 << 16
_HIGHEST_RATE_HZ = 1e6


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording in memory."""

    path: Path
    measurements: Measurements
    rig: Rig | None  # in force during the recording; None for a raw capture
    sample_rate_hz: float
    metadata: dict[str, Any]
    remarks: list[str]  # anomalies, one sentence each: a truncated file, corrupt frames, faulty sensors
    health: dict[str, dict[str, Any]] = field(default_factory=dict)  # state and counts by sensor (sensors.health)
    unusable: str = ""  # why no filter can use the recording; "" if one can

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
    file = RecordingFile(Path(path))
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
        self._source: _TableSource | _CaptureSource = (
            _CaptureSource(path) if path.suffix == ".bin" else _TableSource(path)
        )
        self._kept: list[Measurements] | None = []  # the checked blocks of a short recording
        self._monitor = self._new_monitor(self._source.sensors)
        self.survey = Survey(self._source.rate_hz)
        self._remarks_on_values: list[str] = []
        self._changes: list[Change] = []  # the first of each sensor
        self._change_counts: dict[str, int] = {}
        self._read_all(progress)
        for sensor in [name for name in self._monitor.sensors if name not in self.sensors]:
            del self._monitor.sensors[sensor]
        self.health = self._monitor.as_dict()  # state and counts by sensor (sensors.health)
        self.unusable = "" if self._monitor.is_usable else self._monitor.why_unusable  # why no filter can use it
        self.remarks = [*self._source.remarks(), *self._remarks_on_values, *self._faults()]

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
        """The measurements from the first to the last, with NaN for readings that are worth nothing."""
        if self._kept is not None:
            yield from self._kept
            return
        monitor = self._new_monitor(self.sensors)
        for block in ahead(self._source.blocks(progress)):
            yield monitor.check(block)[0]

    def load(self) -> Measurements:
        """All measurements at once."""
        return _joined(list(self.blocks()))

    def contradictions(self, rig: Rig | None) -> list[str]:
        """Remarks on what contradicts the rig, from the first block."""
        joint = rig.joint.known_j2s_m if rig is not None else None
        block = next(self.blocks(), None)
        if joint is None or block is None or not is_negated(block, joint):
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
        found = suspicions(_joined(first), self._source.stated_rate_hz)
        self._remarks_on_values = [f"{self.path}: {suspicion}" for suspicion in found]

    def _faults(self) -> list[str]:
        """The changes of sensors' states, as remarks."""
        sensors = set(self.sensors)
        if any("pressure_Pa" in remark for remark in self._remarks_on_values):  # another unit, not a faulty sensor
            sensors.discard("baro")
        changes = sorted((c for c in self._changes if c.sensor in sensors), key=lambda change: change.time_s)
        remarks = [f"{self.path}: {change}" for change in changes[:MOST_CHANGES]]
        more = sum(count for sensor, count in self._change_counts.items() if sensor in sensors) - len(remarks)
        return [*remarks, f"{self.path}: {more} more such changes"] if more else remarks


# ---- tables ----


class _TableSource:
    """A recording as CSV or Parquet."""

    def __init__(self, path: Path) -> None:
        self._file = TableFile(path, "recording")
        self._names = self._file.names
        self._mouse_ports = _check_columns(path, self._names)
        has_imu = all(name in self._names for name in columns.ACCEL + columns.GYRO)
        if not (has_imu or self._mouse_ports):
            missing = [name for name in columns.ACCEL + columns.GYRO if name not in self._names]
            raise FileFormatError(
                path, f"{path} has no column {', '.join(missing)}, and no mice: nothing to estimate from"
            )
        self._path, self.metadata = path, self._file.metadata
        self.stated_rate_hz = self._stated_rate()
        first_s = next(self._file.parts()).columns["time_s"]
        self.rate_hz = self.stated_rate_hz or 1.0 / _usual_step(first_s)
        self.rig = Rig.from_dict(self._object("rig"), f"{path}, line 2") if "rig" in self.metadata else None
        listed = self.metadata.get("sensors")
        names = {"mpu6050": "imu", "bmp180": "baro"}
        self.listed_sensors = [names.get(str(name), str(name)) for name in listed] if isinstance(listed, list) else []
        self.sensors = self._possible_sensors()
        self._rows = 0
        self._contradicted: dict[str, int] = {}  # sensor -> rows with a reading that `flags` marks as invalid

    @property
    def closing(self) -> dict[str, Any] | None:
        return self._file.closing

    def blocks(self, progress: Progress | None) -> Iterator[Measurements]:
        """Measurements as they were recorded. Raises FileFormatError for values that no recording has."""
        self._rows, first_s, last_s = 0, np.nan, np.nan
        self._contradicted = {}
        previous: dict[str, float] = {}
        for part in self._file.parts(progress):
            time_s = part.columns["time_s"]
            yield self._measurements(part, previous)
            previous = {name: float(column[-1]) for name, column in part.columns.items()}
            first_s, last_s = (time_s[0] if not self._rows else first_s), time_s[-1]
            self._rows += len(part)
        if self._rows > 1 and first_s == last_s:
            raise FileFormatError(self._path, f"{self._path}: time_s is {first_s:g} in all rows; it must increase")

    def remarks(self) -> list[str]:
        """On the file, after a pass over all blocks: recordings without metadata or closing line."""
        found = list(self._file.remarks)
        if not self._file.kind:
            found.append(
                f"{self._path} has no metadata: another program has written or saved it; "
                "its rate is taken from time_s, and it contains no rig"
            )
        elif not self._file.closing:
            found.append(f"{self._path} has no closing line: it was cut; its {self._rows} whole rows are used")
        found += [
            f"{self._path}: flags marks {sensor} as invalid in {counted(rows, 'row')} with a reading, which is left "
            "out. If the column was changed, delete it: every reading then counts as valid"
            for sensor, rows in self._contradicted.items()
        ]
        return found

    def _measurements(self, part: Part, previous: dict[str, float]) -> Measurements:
        """The rows as measurements; `previous` holds the values of the row before them."""
        flags = _flags(self._path, part)
        for sensor, rows in _contradicted(part, flags):
            self._contradicted[sensor] = self._contradicted.get(sensor, 0) + rows
        return Measurements(
            part.columns["time_s"],
            _vectors(part, columns.ACCEL),
            _vectors(part, columns.GYRO),
            _column(part, "imu_temp_degC"),
            _column(part, "pressure_Pa"),
            _column(part, "baro_temp_degC"),
            _fresh(self._path, part, previous),
            _mice(part, self._mouse_ports),
            flags,
            **_other_sensors(part, previous),
        )

    def _possible_sensors(self) -> list[str]:
        """Sensors that are listed or that have columns."""
        first = {"imu": columns.ACCEL[0], "imu2": columns.GYRO2[0], "baro": "pressure_Pa", "mag": columns.MAG[0]}
        found = [name for name, column in first.items() if column in self._names or name in self.listed_sensors]
        ports = range(1, self._mouse_ports + 1)
        return found + [f"mouse{port}" for port in ports if columns.mouse_columns(port)[0] in self._names]

    def _object(self, name: str) -> dict[str, Any]:
        """One object of the metadata, empty if absent. Raises FileFormatError if it is not an object."""
        part = self.metadata.get(name, {})
        if not isinstance(part, dict):
            raise FileFormatError(
                self._path,
                f"{self._path}, line 2: {name} is {json.dumps(part)[:40]}; it must be a JSON object, or be left out",
            )
        return part

    def _stated_rate(self) -> float | None:
        """The sample rate in the metadata, Hz."""
        rate = self._object("settings").get("sample_rate_hz")
        return float(rate) if isinstance(rate, int | float) and 0 < rate < _HIGHEST_RATE_HZ else None


def _check_columns(path: Path, names: list[str]) -> int:
    """Number of mouse ports; raises FileFormatError for a column that no recording has, or without time_s."""
    require(path, names, "time_s")
    known = columns.names(columns.ColumnLayout(MAX_MICE, imu2=True, mag=True))
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1, 0.4)
            hint = f"did you mean {near[0]}, with values in its unit?" if near else f"known are {', '.join(known)}"
            raise FileFormatError(path, f"{path}: unknown column {name}; {hint}")
    ports = [p for p in range(1, MAX_MICE + 1) if columns.mouse_columns(p)[0] in names]
    for port in ports:
        require(path, names, *columns.mouse_columns(port))
    if columns.GYRO2[0] in names:
        require(path, names, *columns.ACCEL2, *columns.GYRO2)
    if columns.MAG[0] in names:
        require(path, names, *columns.MAG)
    return max(ports, default=0)


def _other_sensors(part: Part, previous: dict[str, float]) -> dict[str, Any]:
    """Measurements of a second inertial sensor and a magnetometer, if the file has their columns."""
    fields: dict[str, Any] = {}
    if columns.GYRO2[0] in part.columns:
        fields |= {"accel2_m_s2": _vectors(part, columns.ACCEL2), "gyro2_rad_s": _vectors(part, columns.GYRO2)}
        fields["imu2_temp_degC"] = _column(part, "imu2_temp_degC")
    if columns.MAG[0] in part.columns:
        field = fields["mag_uT"] = _vectors(part, columns.MAG)
        before = [[previous.get(name, np.nan) for name in columns.MAG]]
        changes = (np.diff(field, axis=0, prepend=before) != 0).any(axis=1)
        fresh = part.columns["mag_fresh"] == 1 if "mag_fresh" in part.columns else changes
        fields["mag_fresh"] = np.asarray(fresh & np.isfinite(field).all(axis=1))
    return fields


def _column(part: Part, name: str) -> Floats:
    return part.columns[name] if name in part.columns else np.full(len(part), np.nan)


def _vectors(part: Part, names: tuple[str, ...]) -> Floats:
    return np.column_stack([_column(part, name) for name in names])


def _fresh(path: Path, part: Part, previous: dict[str, float]) -> NDArray[np.bool_]:
    """Column `baro_fresh`; without this column, the samples at which the pressure changes."""
    if "baro_fresh" in part.columns:
        fresh = part.columns["baro_fresh"]
        wrong = np.flatnonzero(~np.isin(fresh, (0, 1)) & ~np.isnan(fresh))
        if len(wrong):
            line = part.first_line + int(wrong[0])
            raise FileFormatError(
                path, f"{path}, line {line}: baro_fresh is {fresh[wrong[0]]:g}; it must be 0 or 1", line
            )
        return np.asarray(fresh == 1)
    pressure = _column(part, "pressure_Pa")
    before = previous.get("pressure_Pa", np.nan)
    return np.asarray(np.isfinite(pressure) & (np.diff(pressure, prepend=before) != 0))


def _mice(part: Part, ports: int) -> Floats:
    pairs = [_vectors(part, columns.mouse_columns(port)) for port in range(1, ports + 1)]
    return np.stack(pairs, axis=1) if pairs else np.empty((len(part), 0, 2))


def _flags(path: Path, part: Part) -> NDArray[np.uint32]:
    """Column `flags`; without this column, every value that is present is valid."""
    if "flags" not in part.columns:
        assumed = np.zeros(len(part), np.uint32)
        for names, bit in _VALID.values():
            assumed |= np.where(_present(part, names), np.uint32(bit), np.uint32(0))
        return assumed
    flags = part.columns["flags"]
    wrong = np.flatnonzero(~((flags >= 0) & (flags <= 0xFFFFFFFF) & (flags == np.floor(flags))))
    if len(wrong):
        raise FileFormatError(
            path, f"{path}, line {part.first_line + int(wrong[0])}: flags must be a whole number from 0 to 4294967295"
        )
    return flags.astype(np.uint32)


# A reading is blank in a recording where its bit of `flags` is 0: the converter writes no invalid reading. The
# barometer's and the mice's bits are not used after that.
_VALID = {
    "the IMU": (columns.ACCEL + columns.GYRO, int(SampleFlags.IMU_VALID)),
    "the second IMU": (columns.ACCEL2 + columns.GYRO2, int(SampleFlags.IMU2_VALID)),
    "the magnetometer": (columns.MAG, int(SampleFlags.MAG_VALID)),
}


def _contradicted(part: Part, flags: NDArray[np.uint32]) -> Iterator[tuple[str, int]]:
    """The sensors with readings in rows that mark them as invalid, and the number of these rows."""
    for sensor, (names, bit) in _VALID.items():
        if names[0] in part.columns and (rows := np.count_nonzero(_present(part, names) & (flags & bit == 0))):
            yield sensor, int(rows)


def _present(part: Part, names: tuple[str, ...]) -> NDArray[np.bool_]:
    """Rows (N,) with values in all of these columns."""
    present = np.ones(len(part), np.bool_)
    for name in names:
        present &= np.isfinite(_column(part, name))
    return present


def _usual_step(time_s: Floats) -> float:
    """The usual interval between two samples (s)."""
    intervals = np.diff(time_s)
    return float(np.median(intervals[intervals > 0])) if np.any(intervals > 0) else 0.01


# ---- raw captures ----


class _CaptureSource:
    """A recording as the bytes that came from the board."""

    closing: dict[str, Any] | None = None
    rig: Rig | None = None

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = open_binary(path)
        self._size = max(1, self._file.seek(0, 2))
        self._restarts: list[int] = []  # samples before each
        self._mouse_ports = self._samples = self._corrupt = self._lost = self._gaps = self._jumps = 0
        self.settings = self._find_settings()
        self.rate_hz = self.stated_rate_hz = float(self.settings.sample_rate_hz)
        self.metadata: dict[str, Any] = {
            "device": str(path),
            "settings": self.settings.as_dict(),
            "devices": [{"family": family} for family in self.settings.imu_families],
        }
        self.listed_sensors: list[str] = []
        others = ["imu2"] * self.settings.has_imu2 + ["baro"] + ["mag"] * self.settings.has_mag
        self.sensors = ["imu", *others, *(f"mouse{port}" for port in range(1, self._mouse_ports + 1))]

    def blocks(self, progress: Progress | None) -> Iterator[Measurements]:
        """All samples in SI units."""
        converter = Converter(self.settings, self._mouse_ports)
        clock = _CaptureClock(self._restarts, self.rate_hz)
        for capture in self._parts(progress):
            if len(capture.samples):
                time_s, gap_before = clock.place(capture.samples)
                flags = (capture.samples["flags"].astype(np.int64) & ~GAP_BEFORE) | gap_before
                yield converter.convert(_raw_samples(capture, self._mouse_ports), time_s, flags)
        self._lost, self._gaps, self._jumps = clock.lost, clock.gaps, clock.jumps

    def remarks(self) -> list[str]:
        """On the capture, after a pass over all blocks."""
        found = [f"{self._path}: times are the board's own, because a raw capture holds no other clock"]
        if self._corrupt:
            found.append(f"{self._path}: {self._corrupt} corrupt frames left out")
        if self._gaps:
            found.append(f"{self._path}: {self._lost} samples lost in {self._gaps} gaps")
        if self._jumps:
            found.append(
                f"{self._path}: the board's clock jumped {self._jumps} times; its count of ticks gives the times there"
            )
        return found

    def _parts(self, progress: Progress | None) -> Iterator[Capture]:
        from linkpose.wire.capture import read_capture

        self._file.seek(0)
        for capture in read_capture(self._file):
            if progress is not None:
                progress(self._file.tell() / self._size)
            yield capture

    def _find_settings(self) -> BoardSettings:
        """Reads all messages but the samples; the settings in force. Raises FileFormatError where there are none."""
        found: Hello | None = None
        other: OtherProtocol | None = None
        for capture in self._parts(None):
            for before, message in capture.others:
                if isinstance(message, Hello):
                    found = self._hello(message, before, found)
                elif isinstance(message, OtherProtocol):
                    other = other or message
            self._samples += len(capture.samples)
            self._mouse_ports = max(self._mouse_ports, int(capture.mouse_count.max(initial=0)))
            self._corrupt = capture.corrupt.total
        self._restarts = sorted({before for before in self._restarts if before < self._samples})
        self._check_complete(found, other)
        assert found is not None
        return BoardSettings.of(found)

    def _hello(self, hello: Hello, before: int, found: Hello | None) -> Hello:
        """The HELLO whose settings are in force: the last before the first sample, or else the first."""
        if wrong := impossible(hello):
            raise FileFormatError(
                self._path, f"{self._path}: its HELLO states {wrong}, which is impossible; the capture is damaged"
            )
        if before and not hello.streaming and before not in self._restarts[-1:]:
            self._restarts.append(before)
        return hello if found is None or before == 0 else found

    def _check_complete(self, hello: Hello | None, other: OtherProtocol | None) -> None:
        if hello is None and other is not None:
            raise FileFormatError(
                self._path,
                f"{self._path} was captured with protocol {other.protocol_major}.{other.protocol_minor}, and this "
                f"linkpose reads protocol {PROTOCOL_MAJOR}: read it with the linkpose that captured it, or use the CSV "
                "recording",
            )
        if hello is None:
            raise FileFormatError(self._path, f"{self._path} holds no HELLO of a board; it is not a raw capture")
        if not self._samples:
            raise FileFormatError(self._path, f"{self._path} holds no sample; the board was never started")


class _CaptureClock:
    """Board time from 0 over its wraps.

    The duration of a restart is unknown. The next sample is placed one interval later and flagged.
    """

    def __init__(self, restarts: list[int], rate_hz: float) -> None:
        """`restarts`: number of samples before each restart."""
        self._restarts = np.array(restarts, dtype=np.int64)
        self._period_us = round(1e6 / rate_hz)
        self._placed = self._elapsed_us = 0
        self._last: tuple[int, int] | None = None  # t_us and seq
        self.gaps = self.lost = self.jumps = 0

    def place(self, raw: NDArray[np.void]) -> tuple[Floats, NDArray[np.int64]]:
        """Times (N,) of the next samples, s, and the flag of those after a gap."""
        t_us, seq = raw["t_us"].astype(np.int64), raw["seq"].astype(np.int64)
        before = self._last or (int(t_us[0]), -1)
        step_us = np.diff(t_us, prepend=before[0]) % _T_WRAP
        ticks = np.diff(seq, prepend=before[1]) % _SEQ_WRAP
        inside = (self._restarts >= self._placed) & (self._restarts < self._placed + len(raw))
        restarts = self._restarts[inside] - self._placed
        jumped = self._jumps(step_us, ticks)
        step_us[jumped] = ticks[jumped] * self._period_us
        self.jumps += int(np.count_nonzero(jumped))
        step_us[restarts], ticks[restarts] = self._period_us, 1
        elapsed_us = self._elapsed_us + np.cumsum(step_us)
        marked = ticks > 1
        self.gaps += int(np.count_nonzero(marked))
        self.lost += int(np.sum(ticks[marked] - 1))
        marked[restarts] = True
        self._placed, self._elapsed_us = self._placed + len(raw), int(elapsed_us[-1])
        self._last = int(t_us[-1]), int(seq[-1])
        return np.round(elapsed_us * 1e-6, TIME_DECIMALS), np.where(marked, GAP_BEFORE, 0)

    def _jumps(self, step_us: NDArray[np.int64], ticks: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which steps of the board's clock contradict its count of ticks, as `sensors.timeline.Stamps` finds live."""
        off_us = (step_us - ticks * self._period_us + _T_WRAP // 2) % _T_WRAP - _T_WRAP // 2
        wrap_us = _SEQ_WRAP * self._period_us
        off_us -= np.maximum(0, np.rint(off_us / wrap_us)).astype(np.int64) * wrap_us
        jumps = (ticks > 0) & (ticks <= WINDOW_TICKS) & (np.abs(off_us) > OFF_TICKS * self._period_us)
        if self._last is None:
            jumps[0] = False
        return np.asarray(jumps)


def _raw_samples(capture: Capture, ports: int) -> RawSamples:
    """The capture's samples, with these mouse ports."""
    raw = capture.samples
    mice = np.stack([raw["mice"]["dx"], raw["mice"]["dy"]], axis=2)[:, :ports]
    return RawSamples(
        np.stack([raw[name].astype(np.int64) for name in COUNT_FIELDS], axis=1),
        mice.astype(np.int64),
        capture.mouse_count.astype(np.int64),
    )
