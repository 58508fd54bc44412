"""A recording as a table (CSV or Parquet): its columns become measurements."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import FileFormatError
from linkpose.presentation import counted
from linkpose.recording import columns
from linkpose.recording.table import Progress, TableFile, require
from linkpose.recording.textfile import Part
from linkpose.sensors.devices import MAX_MICE
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.rig import Rig
from linkpose.wire.messages import SampleFlags

_HIGHEST_RATE_HZ = 1e6


class TableSource:
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

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

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
        rate = self._object("settings").get("sample_rate_hz")
        if rate is not None and self.stated_rate_hz is None:
            found.append(
                f"{self._path}: sample_rate_hz in the metadata is {json.dumps(rate)[:40]}, which no sampling rate is; "
                "the rate is taken from time_s"
            )
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


# Names of other programs for an axis of a sensor, such as ax, Acc_X, gyroX or wz.
_AXIS_OF_OTHERS = re.compile(r"(a|acc|accel|g|gyr|gyro|w|omega|m|mag)[a-z]*?[ _.]?([xyz])", re.IGNORECASE)
_SENSOR_BY_LETTER = {"a": columns.ACCEL, "g": columns.GYRO, "w": columns.GYRO, "o": columns.GYRO, "m": columns.MAG}


def _nearest_column(name: str, known: Sequence[str]) -> str:
    """The column that a name of another program is most likely to mean; "" if none is similar."""
    if axis := _AXIS_OF_OTHERS.fullmatch(name):
        return _SENSOR_BY_LETTER[axis[1][0].lower()]["xyz".index(axis[2].lower())]
    return next(iter(difflib.get_close_matches(name, known, 1, 0.4)), "")


def _check_columns(path: Path, names: list[str]) -> int:
    """Number of mouse ports; raises FileFormatError for a column that no recording has, or without time_s."""
    require(path, names, "time_s")
    known = columns.names(columns.ColumnLayout(MAX_MICE, imu2=True, mag=True))
    for name in names:
        if name not in known:
            near = _nearest_column(name, known)
            hint = f"did you mean {near}, with values in its unit?" if near else f"known are {', '.join(known)}"
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
