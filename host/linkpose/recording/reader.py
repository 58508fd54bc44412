"""Reads recordings, a CSV or a raw capture, and returns measurements for the filters."""

from __future__ import annotations

import difflib
import json
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import FileFormatError
from linkpose.recording import columns
from linkpose.recording.table import Table, read_bytes, read_table
from linkpose.recording.units import suspicions
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
from linkpose.sensors.timeline import Gap
from linkpose.wire.frames import OtherProtocol
from linkpose.wire.messages import PROTOCOL_MAJOR, Hello, SampleFlags

if TYPE_CHECKING:
    from linkpose.wire.capture import Capture

MOST_CHANGES = 10  # of sensors' states, in the remarks
_T_WRAP = 1 << 32
_SEQ_WRAP = 1 << 16


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
    def dlpf(self) -> int | None:
        """The MPU-6050's low-pass setting (DLPF_CFG, 0 to 6) in force; None if the file does not contain it."""
        settings = self.metadata.get("settings")
        value = settings.get("dlpf") if isinstance(settings, dict) else None
        return value if isinstance(value, int) and 0 <= value < len(mpu6050.DLPF_DELAY_S) else None


def load_recording(path: str | PathLike[str]) -> Recording:
    """Reads a recording: a CSV file, or a raw capture (`.bin`).

    Raises FileError, which names the file, the line and the reason, for anything else.
    """
    path = Path(path)
    return _checked(_from_capture(path) if path.suffix == ".bin" else _from_csv(path))


def _checked(recording: Recording) -> Recording:
    """The recording with unusable readings replaced by NaN and the faults listed in `remarks`."""
    from linkpose.sensors.health import HealthMonitor

    monitor = HealthMonitor(recording.sample_rate_hz, dict.fromkeys(_sensors_in(recording), "ok"))
    measurements, changes = monitor.check(recording.measurements)
    if any("pressure_Pa" in remark for remark in recording.remarks):  # another unit, not a faulty sensor
        changes = [change for change in changes if change.sensor != "baro"]
    remarks = [f"{recording.path}: {change}" for change in changes[:MOST_CHANGES]]
    if len(changes) > MOST_CHANGES:
        remarks.append(f"{recording.path}: {len(changes) - MOST_CHANGES} more such changes")
    return replace(
        recording,
        measurements=measurements,
        remarks=[*recording.remarks, *remarks],
        health=monitor.as_dict(),
        unusable="" if monitor.is_usable else monitor.why_unusable,
    )


def _sensors_in(recording: Recording) -> list[str]:
    """Sensors that the metadata lists or that have at least one value."""
    listed, block = recording.metadata.get("sensors"), recording.measurements
    names = listed if isinstance(listed, list) else []
    sensors = ["imu"] if "mpu6050" in names or np.isfinite(block.accel_m_s2).any() else []
    sensors += ["imu2"] if "imu2" in names or block.has_imu2 else []
    sensors += ["baro"] if "bmp180" in names or np.isfinite(block.pressure_Pa).any() else []
    sensors += ["mag"] if "mag" in names or block.has_mag else []
    counted = np.isfinite(block.mice_counts).any(axis=(0, 2))
    return sensors + [f"mouse{port + 1}" for port in np.flatnonzero(counted).tolist()]


# ---- CSV ----


def _from_csv(path: Path) -> Recording:
    table = read_table(path, "recording")
    mouse_ports = _check_columns(table)
    _check_time(table)
    has_imu = all(name in table.columns for name in columns.ACCEL + columns.GYRO)
    if not (has_imu or mouse_ports):
        missing = [name for name in columns.ACCEL + columns.GYRO if name not in table.columns]
        raise FileFormatError(path, f"{path} has no column {', '.join(missing)}, and no mice: nothing to estimate from")
    measurements = Measurements(
        table.columns["time_s"],
        _vectors(table, columns.ACCEL),
        _vectors(table, columns.GYRO),
        _column(table, "imu_temp_degC"),
        _column(table, "pressure_Pa"),
        _column(table, "baro_temp_degC"),
        _fresh(table),
        _mice(table, mouse_ports),
        _flags(table),
        **_other_sensors(table),
    )
    remarks = [*table.remarks, *_origin(table)]
    remarks += suspicions(path, measurements, _stated_rate(table))
    rig = Rig.from_dict(_metadata_object(table, "rig"), f"{path}, line 2") if "rig" in table.metadata else None
    return Recording(path, measurements, rig, _rate(table), table.metadata, remarks)


def _origin(table: Table) -> list[str]:
    """A remark on a recording without metadata or closing line."""
    if not table.kind:
        return [
            f"{table.path} has no metadata: another program has written or saved it; "
            "its rate is taken from time_s, and it contains no rig"
        ]
    if not table.closing:
        return [f"{table.path} has no closing line: it was cut; its {len(table)} whole rows are used"]
    return []


def _check_columns(table: Table) -> int:
    """Number of mouse ports; raises FileFormatError for a column that no recording has, or without time_s."""
    table.require("time_s")
    known = columns.names(columns.Layout(MAX_MICE, imu2=True, mag=True))
    for name in table.columns:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1, 0.4)
            hint = f"did you mean {near[0]}, with values in its unit?" if near else f"known are {', '.join(known)}"
            raise FileFormatError(table.path, f"{table.path}: unknown column {name}; {hint}")
    ports = [p for p in range(1, MAX_MICE + 1) if columns.mouse_columns(p)[0] in table.columns]
    for port in ports:
        table.require(*columns.mouse_columns(port))
    return max(ports, default=0)


def _other_sensors(table: Table) -> dict[str, Any]:
    """Measurements of a second inertial sensor and a magnetometer, if the file has their columns."""
    fields: dict[str, Any] = {}
    if columns.GYRO2[0] in table.columns:
        table.require(*columns.ACCEL2, *columns.GYRO2)
        fields |= {"accel2_m_s2": _vectors(table, columns.ACCEL2), "gyro2_rad_s": _vectors(table, columns.GYRO2)}
        fields["imu2_temp_degC"] = _column(table, "imu2_temp_degC")
    if columns.MAG[0] in table.columns:
        table.require(*columns.MAG)
        field = fields["mag_uT"] = _vectors(table, columns.MAG)
        changes = (np.diff(field, axis=0, prepend=np.full((1, 3), np.nan)) != 0).any(axis=1)
        fresh = table.columns["mag_fresh"] == 1 if "mag_fresh" in table.columns else changes
        fields["mag_fresh"] = np.asarray(fresh & np.isfinite(field).all(axis=1))
    return fields


def _column(table: Table, name: str) -> Floats:
    return table.columns.get(name, np.full(len(table), np.nan))


def _vectors(table: Table, names: tuple[str, ...]) -> Floats:
    return np.column_stack([_column(table, name) for name in names])


def _fresh(table: Table) -> NDArray[np.bool_]:
    """Column `baro_fresh`; without this column, the samples at which the pressure changes."""
    if "baro_fresh" in table.columns:
        fresh = table.columns["baro_fresh"]
        wrong = np.flatnonzero(~np.isin(fresh, (0, 1)) & ~np.isnan(fresh))
        if len(wrong):
            line = table.first_line + int(wrong[0])
            raise FileFormatError(
                table.path, f"{table.path}, line {line}: baro_fresh is {fresh[wrong[0]]:g}; it must be 0 or 1", line
            )
        return np.asarray(fresh == 1)
    pressure = _column(table, "pressure_Pa")
    return np.asarray(np.isfinite(pressure) & (np.diff(pressure, prepend=np.nan) != 0))


def _mice(table: Table, ports: int) -> Floats:
    pairs = [_vectors(table, columns.mouse_columns(port)) for port in range(1, ports + 1)]
    return np.stack(pairs, axis=1) if pairs else np.empty((len(table), 0, 2))


def _flags(table: Table) -> NDArray[np.uint32]:
    """Column `flags`; without this column, every value that is present is valid."""
    if "flags" not in table.columns:
        imu = np.isfinite(_vectors(table, columns.ACCEL + columns.GYRO)).all(axis=1)
        return np.where(imu, SampleFlags.IMU_VALID, 0).astype(np.uint32)
    flags = table.columns["flags"]
    wrong = np.flatnonzero(~((flags >= 0) & (flags <= 0xFFFFFFFF)))
    if len(wrong):
        raise FileFormatError(
            table.path,
            f"{table.path}, line {table.first_line + int(wrong[0])}: flags must be a number from 0 to 4294967295",
        )
    return flags.astype(np.uint32)


def _metadata_object(table: Table, name: str) -> dict[str, Any]:
    """One object of the metadata, empty if absent. Raises FileFormatError if it is not an object."""
    part = table.metadata.get(name, {})
    if not isinstance(part, dict):
        raise FileFormatError(
            table.path,
            f"{table.path}, line 2: {name} is {json.dumps(part)[:40]}; it must be a JSON object, or be left out",
        )
    return part


def _stated_rate(table: Table) -> float | None:
    """The sample rate in the metadata, Hz."""
    rate = _metadata_object(table, "settings").get("sample_rate_hz")
    return float(rate) if isinstance(rate, int | float) and rate > 0 else None


def _rate(table: Table) -> float:
    """The sample rate in the metadata, or else of the usual interval."""
    intervals = np.diff(table.columns["time_s"])
    usual = float(np.median(intervals[intervals > 0])) if np.any(intervals > 0) else 0.01
    return _stated_rate(table) or 1.0 / usual


def _check_time(table: Table) -> None:
    """Raises FileFormatError when a time is not finite, or all are the same."""
    time_s = table.columns["time_s"]
    wrong = np.flatnonzero(~np.isfinite(time_s))
    if len(wrong):
        line = table.first_line + int(wrong[0])
        raise FileFormatError(
            table.path, f"{table.path}, line {line}: time_s is {time_s[wrong[0]]}; it must be a number of seconds", line
        )
    if len(time_s) > 1 and np.all(time_s == time_s[0]):
        raise FileFormatError(table.path, f"{table.path}: time_s is {time_s[0]:g} in all rows; it must increase")


# ---- raw capture ----


def _from_capture(path: Path) -> Recording:
    from linkpose.wire.capture import decode_capture

    capture = decode_capture(read_bytes(path))
    hellos = [(before, message) for before, message in capture.others if isinstance(message, Hello)]
    other = next((message for _, message in capture.others if isinstance(message, OtherProtocol)), None)
    if not hellos and other is not None:
        raise FileFormatError(
            path,
            f"{path} was captured with protocol {other.protocol_major}.{other.protocol_minor}, and this linkpose reads "
            f"protocol {PROTOCOL_MAJOR}: read it with the linkpose that captured it, or use the CSV recording",
        )
    if not hellos:
        raise FileFormatError(path, f"{path} holds no HELLO of a board; it is not a raw capture")
    if not len(capture.samples):
        raise FileFormatError(path, f"{path} holds no sample; the board was never started")
    for _, hello in hellos:
        if wrong := impossible(hello):
            raise FileFormatError(path, f"{path}: its HELLO says {wrong}, which is impossible; the capture is damaged")
    first = [hello for before, hello in hellos if before == 0]
    settings = BoardSettings.of(first[-1] if first else hellos[0][1])
    raw = capture.samples
    restarts = sorted({before for before, hello in hellos if 0 < before < len(raw) and not hello.streaming})
    time_s, gap_before, gaps = _times(raw, restarts, settings.sample_rate_hz)
    flags = (raw["flags"].astype(np.int64) & ~GAP_BEFORE) | gap_before
    counts = _raw_samples(capture)
    measurements = Converter(settings, counts.mice.shape[1]).convert(counts, time_s, flags)
    remarks = [f"{path}: times are the board's own, for a raw capture holds no other clock"]
    if capture.corrupt.total:
        remarks.append(f"{path}: {capture.corrupt.total} corrupt frames left out")
    if gaps:
        remarks.append(f"{path}: {sum(gap.lost for gap in gaps)} samples lost in {len(gaps)} gaps")
    metadata = {"device": str(path), "settings": {"dlpf": settings.dlpf}}
    return Recording(path, measurements, None, settings.sample_rate_hz, metadata, remarks)


def _times(raw: NDArray[np.void], restarts: list[int], rate_hz: float) -> tuple[Floats, NDArray[np.int64], list[Gap]]:
    """Board time from 0 over its wraps, the flag of samples after a gap, and the gaps.

    The duration of a restart is unknown. The next sample is placed one interval later and flagged.
    """
    t_us, seq = raw["t_us"].astype(np.int64), raw["seq"].astype(np.int64)
    step_us = np.diff(t_us, prepend=t_us[:1]) % _T_WRAP
    ticks = np.diff(seq, prepend=-1) % _SEQ_WRAP
    step_us[restarts], ticks[restarts] = round(1e6 / rate_hz), 1
    step_us[0] = 0
    time_s = np.round(np.cumsum(step_us) * 1e-6, TIME_DECIMALS)
    marked = ticks > 1
    gaps = [
        Gap(float(time_s[max(i - 1, 0)]), float(step_us[i] * 1e-6), int(ticks[i] - 1), "link")
        for i in np.flatnonzero(marked).tolist()
    ]
    marked[restarts] = True
    return time_s, np.where(marked, GAP_BEFORE, 0), gaps


def _raw_samples(capture: Capture) -> RawSamples:
    """The capture's samples, with the mouse ports that any of them carries."""
    raw = capture.samples
    ports = int(capture.mouse_count.max(initial=0))
    mice = np.stack([raw["mice"]["dx"], raw["mice"]["dy"]], axis=2)[:, :ports]
    return RawSamples(
        np.stack([raw[name].astype(np.int64) for name in COUNT_FIELDS], axis=1),
        mice.astype(np.int64),
        capture.mouse_count.astype(np.int64),
    )
