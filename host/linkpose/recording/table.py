"""Reads the tables of linkpose, of spreadsheets, pandas and R, and refuses others with the line and the reason.

Files are read in blocks, so that a table of any length needs little memory. Blocks as linkpose writes them are parsed
at once by `numbers`; all others are split into cells by `delimited`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from linkpose.errors import FileFormatError, listed
from linkpose.inputs import read_bytes
from linkpose.recording.csvfile import metadata_path
from linkpose.recording.parquet import ParquetTable, is_parquet
from linkpose.recording.textfile import Part, TextTable, metadata_of
from linkpose.sensors.measurements import Floats

# A step longer than this many usual steps is a gap; a reference is not interpolated over it.
LONGEST_HOLE = 3.5


@dataclass(frozen=True, slots=True)
class Whole:
    """A file of which a table holds some rows."""

    rows: int
    interval_s: float  # the usual step between two rows
    gaps: int  # stretches without a row
    lost: int  # rows that the gaps would hold


@dataclass(frozen=True, slots=True)
class Table:
    """A table: columns by name, each (N,) float64 with NaN for an empty field; metadata of head and closing line."""

    path: Path
    kind: str  # "recording", "estimate", ...; "" for a plain table without linkpose's head
    columns: dict[str, Floats]
    metadata: dict[str, Any]
    closing: dict[str, Any] | None  # None: the file was cut, or never closed
    first_line: int  # line number of the first row
    remarks: tuple[str, ...] = ()  # anomalies, one sentence each
    whole: Whole | None = None  # where the table holds a part of the file's rows only

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def require(self, *names: str) -> None:
        """Raises FileFormatError unless the table has all these columns."""
        require(self.path, self.columns, *names)


Progress = Callable[[float], None]
_LARGEST_TIME_S = 9e15  # beyond it, stamps a second apart are one number; even microseconds since 1970 are below it
_LARGEST = 1e15  # of a value in any column; squares of larger ones exceed the range of numbers in later steps


class TableFile:
    """A table that is read in blocks. `closing` is known after a pass over all rows.

    Raises CannotRead, and FileFormatError naming the file and the line for whatever is no table of numbers, or is a
    linkpose file of another kind than `kind`; a table without linkpose's head is of any kind.
    """

    def __init__(self, path: Path, kind: str | None = None) -> None:
        self.path = path
        self._source: TextTable | ParquetTable = ParquetTable(path) if is_parquet(path) else TextTable(path)
        self.kind, self.metadata = self._source.kind, self._source.metadata
        self.names, self.remarks = self._source.names, self._source.remarks
        self.share_read = 0.0  # of the file, by the pass under way
        self._closing_beside: dict[str, Any] | None = None
        if not self.kind:
            self._read_metadata_beside()
        if kind is not None and self.kind not in ("", kind):
            raise FileFormatError(path, f"{path} is a linkpose {self.kind}, not a {kind}")

    @property
    def closing(self) -> dict[str, Any] | None:
        """The content of the closing line; None before a pass over all rows, and for a file that was cut."""
        return self._closing_beside or self._source.closing

    def parts(self, progress: Progress | None = None) -> Iterator[Part]:
        """The rows from the first to the last, in blocks. `progress` is called with the share that was read.

        Raises FileFormatError also for a `time_s` that is missing or runs backwards.
        """
        last_s = -np.inf

        def note(share: float) -> None:
            self.share_read = share
            if progress is not None:
                progress(share)

        for part in self._source.parts(note):
            if "time_s" in part.columns:
                check_times(self.path, part.columns["time_s"], part.first_line, last_s)
                last_s = part.columns["time_s"][-1]
            _check_sizes(self.path, part)
            yield part

    def require(self, *names: str) -> None:
        """Raises FileFormatError unless the table has all these columns."""
        require(self.path, self.names, *names)

    def close(self) -> None:
        """Closes the file."""
        self._source.close()

    def table(self, parts: list[Part], whole: Whole | None = None) -> Table:
        """These parts of the file as one table."""
        columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in self.names}
        line = parts[0].first_line
        return Table(self.path, self.kind, columns, self.metadata, self.closing, line, self.remarks, whole)

    def _read_metadata_beside(self) -> None:
        """The kind and the metadata that NAME.meta.json beside NAME.csv holds, if it is there."""
        beside = metadata_path(self.path)
        if not beside.is_file():
            return
        content = metadata_of(beside, read_bytes(beside).decode("utf-8", "replace"), 1)
        metadata, closing = content.get("metadata"), content.get("closing")
        if not isinstance(metadata, dict) or not isinstance(content.get("kind"), str):
            raise FileFormatError(beside, f"{beside} has no kind or no metadata; write it again, or remove it")
        self.kind, self.metadata = content["kind"], metadata
        self._closing_beside = closing if isinstance(closing, dict) else None


def read_table(path: Path, kind: str | None = None) -> Table:
    """Reads a table with a header of names: linkpose's own, or one that another program has written or saved again.

    `kind` refuses linkpose files of other kinds; a table without linkpose's head is of any kind. An incomplete last
    line of linkpose's own, as a killed program leaves it, is left out. Raises FileFormatError naming the file and the
    line for whatever else is not a number, a row of another length, or a time that runs backwards.
    """
    with contextlib.closing(TableFile(path, kind)) as file:
        return file.table(list(file.parts()))


def require(path: Path, found: Collection[str], *names: str) -> None:
    """Raises FileFormatError unless all of `names` are among the columns found."""
    missing = [name for name in names if name not in found]
    if missing:
        raise FileFormatError(path, f"{path} has no column {', '.join(missing)}; it has {listed(found)}")


def _check_sizes(path: Path, part: Part) -> None:
    """Makes infinite values missing ones, and raises FileFormatError for a number that no measurement is."""
    for name, values in part.columns.items():
        size = np.abs(values)
        largest = size.max()
        if largest <= _LARGEST or name == "time_s":
            continue
        values[np.isinf(values)] = np.nan
        wrong = np.flatnonzero((size > _LARGEST) & np.isfinite(size))
        if len(wrong):
            line = part.first_line + int(wrong[0])
            raise FileFormatError(
                path,
                f"{path}, line {line}: {name} is {values[wrong[0]]:g}, which no measurement is; correct that row",
                line,
            )


def check_times(path: Path, time_s: Floats, first_line: int, before_s: float = -np.inf) -> None:
    """Raises FileFormatError at the first stamp that is missing, impossible or earlier than the one before it.

    `before_s` is the stamp before the first.
    """
    with np.errstate(invalid="ignore", over="ignore"):  # of stamps that are infinite or not far from it
        bad = np.flatnonzero(~(np.diff(time_s, prepend=before_s) >= 0) | (np.abs(time_s) > _LARGEST_TIME_S))
    if len(bad):
        row = int(bad[0])
        what = f"runs backwards ({time_s[row]:.6f} s); remove the rows before or after it"
        if np.isnan(time_s[row]):
            what = "is missing; remove the rows before or after it"
        elif abs(time_s[row]) > _LARGEST_TIME_S:
            what = f"is {time_s[row]:g}; it must be a number of seconds"
        raise FileFormatError(path, f"{path}, line {first_line + row}: time_s {what}", first_line + row)
