"""What a localisation log holds: one event a measurement, read from CSV (`time_s,kind,a,b,c`)."""

from __future__ import annotations

import csv
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from linkpose.errors import LinkposeError
from linkpose.localization.linalg import Floats
from linkpose.recording.csvfile import create, write_all

HEADER = ("time_s", "kind", "a", "b", "c")
# kind -> what its columns a, b, c hold; the first of a kind in NAMED is the name of a beacon or landmark.
KINDS = {
    "odometry": ("forward speed m/s", "turn rate rad/s"),
    "range": ("beacon", "range m"),
    "bearing_range": ("landmark", "range m", "bearing rad"),
    "depth": ("depth m",),
    "velocity": ("forward m/s", "left m/s", "up m/s"),
    "attitude": ("roll rad", "pitch rad", "yaw rad"),
    "pose": ("x m", "y m", "heading rad"),
}
NAMED = ("range", "bearing_range")


@dataclass(frozen=True, slots=True)
class Event:
    """One row: `values` are the numbers of its kind, in the order of KINDS, without the beacon's name."""

    time_s: float
    kind: str
    values: tuple[float, ...]
    beacon: str = ""
    line: int = 0


@dataclass(frozen=True, slots=True)
class Scan:
    """One laser scan: ranges (m) along angles (rad) from a sensor at `mount` (x m, y m, θ rad) on the robot. NaN where
    there is no echo.
    """

    time_s: float
    ranges_m: Floats
    angles_rad: Floats
    mount: tuple[float, float, float]
    max_range_m: float
    line: int = 0
    kind: ClassVar[str] = "scan"


Log = list[Event | Scan]


def read_events(path: Path) -> Log:
    """Reads a CSV log. Raises LinkposeError with file, line and cure for whatever cannot be a measurement."""
    log: Log = []
    header_seen = False
    last = -math.inf
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            for line, row in enumerate(csv.reader(file), 1):
                if not row or row[0].startswith("#"):
                    continue
                if not header_seen:
                    _check_header(path, line, row)
                    header_seen = True
                    continue
                event = _read_row(path, line, row)
                if event.time_s < last:
                    raise LinkposeError(
                        f"{path} line {line}: time runs backwards, from {last:.6g} to {event.time_s:.6g} s; "
                        "sort the rows by time_s"
                    )
                last = event.time_s
                log.append(event)
    except (UnicodeDecodeError, csv.Error) as error:
        raise LinkposeError(
            f"{path} is not a CSV file: {error}; give a log with the header {','.join(HEADER)}"
        ) from error
    except OSError as error:
        raise LinkposeError(f"cannot read the log {path}: {error.strerror}") from error
    if not log:
        raise LinkposeError(
            f"{path} holds no measurements; a log has the header {','.join(HEADER)} and one row a measurement"
        )
    return log


def format_event(event: Event) -> str:
    """The row of an event, without its end."""
    cells = [event.beacon] if event.beacon else []
    cells += [f"{value:.6f}" for value in event.values]
    return f"{event.time_s:.6f},{event.kind},{','.join(cells)}{',' * (3 - len(cells))}"


def write_lines(path: Path, lines: list[str], force: bool) -> None:
    """Writes a text file. Raises LinkposeError where that cannot be done, or the file exists and `force` is not set."""
    descriptor = create(path, force)
    try:
        write_all(descriptor, path, ("\n".join(lines) + "\n").encode())
    finally:
        os.close(descriptor)


def _check_header(path: Path, line: int, row: list[str]) -> None:
    names = [name.strip() for name in row]
    if names[:2] != ["time_s", "kind"] or "a" not in names[2:]:
        raise LinkposeError(
            f"{path} line {line}: the header is {','.join(names)[:60]!r}; it must be {','.join(HEADER)}"
        )


def _read_row(path: Path, line: int, row: list[str]) -> Event:
    kind = row[1].strip() if len(row) > 1 else ""
    if kind not in KINDS:
        found = f"unknown kind {kind!r}" if kind else "the row is cut short"
        raise LinkposeError(f"{path} line {line}: {found}; known kinds are {', '.join(KINDS)}")
    fields = KINDS[kind]
    cells = [cell.strip() for cell in row[2 : 2 + len(fields)]]
    if len(cells) < len(fields) or "" in cells:
        raise LinkposeError(f"{path} line {line}: {kind} needs {', '.join(fields)}; complete or delete the row")
    beacon = beacon_name(read_number(cells.pop(0), path, line)) if kind in NAMED else ""
    values = tuple(read_number(cell, path, line) for cell in cells)
    if kind in NAMED and values[0] < 0:
        raise LinkposeError(f"{path} line {line}: the range is {values[0]:g} m; a range is 0 or more")
    return Event(read_number(row[0], path, line), kind, values, beacon, line)


def beacon_name(number: float) -> str:
    """One spelling for a beacon's number: 5, 05 and 5.0 are the same beacon."""
    return f"{number:g}"


def read_number(cell: str, path: Path, line: int) -> float:
    """A finite number. Raises LinkposeError with file and line for anything else."""
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise LinkposeError(f"{path} line {line}: {cell.strip()!r} is not a number; correct or delete the row")
    return value
