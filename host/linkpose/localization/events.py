"""What a localization log holds: one event a measurement, read from CSV (`time_s,kind,a,b,c`)."""

from __future__ import annotations

import csv
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Protocol, TypeVar

from linkpose.errors import LinkposeError
from linkpose.localization.linalg import Floats
from linkpose.outputs import new_file
from linkpose.presentation import counted

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


# A clock was set back where the times of one sensor jump back by more than SET_BACK_S (s), and at least FEWEST_SET_BACK
# rows before and after have the same times. With more than MOST_SET_BACK jumps, the rows are out of order instead.
SET_BACK_S, FEWEST_SET_BACK, MOST_SET_BACK = 1.0, 10, 3


class _TimedLine(Protocol):
    @property
    def time_s(self) -> float: ...
    @property
    def line(self) -> int: ...


class _Timed(Protocol):
    @property
    def time_s(self) -> float: ...


Timed = TypeVar("Timed", bound=_Timed)


@dataclass(frozen=True, slots=True)
class LogFile:
    """A log as read from a file: its events, the start that it states (x m, y m, heading rad), and what was changed.

    `is_carmen`: the file is a CARMEN log, whose units are defined.
    """

    events: Log
    start: tuple[float, float, float] | None
    remarks: tuple[str, ...]
    is_carmen: bool = False


def in_order(items: list[Timed]) -> tuple[list[Timed], int]:
    """The items in order of time (a stable sort), and how many had an earlier time than one before."""
    latest, moved = -math.inf, 0
    for item in items:
        moved += item.time_s < latest
        latest = max(latest, item.time_s)
    return (sorted(items, key=lambda item: item.time_s) if moved else items), moved


def check_clock(series: Iterable[Sequence[_TimedLine]], path: Path) -> None:
    """Raises LinkposeError for a log whose clock was set back. `series` are each sensor's rows as they were written.

    Rows of two stretches of a log that have the same times cannot be put into the order of time. A log that is written
    backwards, in parts, or sensor after sensor can.
    """
    for rows in series:
        starts = [i for i in range(1, len(rows)) if rows[i].time_s < rows[i - 1].time_s - SET_BACK_S]
        if len(starts) > MOST_SET_BACK:
            continue
        for first, second, last in zip([0, *starts], starts, [*starts[1:], len(rows)], strict=False):
            until, since = rows[second - 1].time_s, rows[second].time_s
            low, high = max(rows[first].time_s, since), min(until, rows[last - 1].time_s)
            shared = (
                sum(low <= row.time_s <= high for row in part) for part in (rows[first:second], rows[second:last])
            )
            if min(shared) >= FEWEST_SET_BACK:
                raise LinkposeError(
                    f"{path} line {rows[second].line}: the clock jumps back from {until:.6g} to {since:.6g} s; "
                    "split the log at this line"
                )


def read_events(path: Path, lines: Sequence[str]) -> LogFile:
    """The log in the lines of a CSV file. Rows that are not in order of time are sorted, negative ranges are left out;
    `remarks` has the counts. Raises LinkposeError with file, line and cure for whatever cannot be a measurement.
    """
    events = list(stream_events(lines, path))
    kept = [event for event in events if not is_negative(event)]
    if not kept:
        raise LinkposeError(
            f"{path} holds no measurements; a log has the header {','.join(HEADER)} and one row a measurement"
        )
    remarks = []
    if len(kept) < len(events):
        remarks.append(f"{path}: {counted(len(events) - len(kept), 'negative range')} left out")
    series: dict[tuple[str, str], list[Event]] = {}
    for event in kept:
        series.setdefault((event.kind, event.beacon), []).append(event)
    check_clock(series.values(), path)
    ordered, moved = in_order(kept)
    if moved:
        remarks.append(f"{path}: {counted(moved, 'row')} moved into the order of time")
    return LogFile(list(ordered), None, tuple(remarks))


def stream_events(lines: Iterable[str], path: Path) -> Iterator[Event]:
    """The measurements of the lines of a CSV log, one by one as they come, negative ranges among them.

    Semicolons and tabs separate cells too, then with decimal commas or points.
    """
    header_seen = False
    lines = iter(lines)
    head: list[str] = []
    for text in lines:  # up to the header, which shows the separator
        if text.lower().startswith("sep="):  # Excel's own first line
            text = "\n"
        head.append(text)
        if text.strip() and not text.lstrip('"').startswith("#"):
            break
    separator = max((",", ";", "\t"), key=head[-1].count) if head else ","
    numbers = _Numbers(path, separator != ",")
    try:
        for line, row in enumerate(csv.reader(itertools.chain(head, lines), delimiter=separator), 1):
            if not row or not "".join(row).strip() or row[0].startswith("#"):
                continue
            if header_seen:
                yield _read_row(path, line, row, numbers)
            else:
                _check_header(path, line, row)
                header_seen = True
    except csv.Error as error:
        raise LinkposeError(
            f"{path} is not a CSV file: {error}; give a log with the header {','.join(HEADER)}"
        ) from error


def is_negative(event: Event) -> bool:
    """Whether it is a range below 0, as some radios report near an anchor; it is no measurement."""
    return event.kind in NAMED and event.values[0] < 0.0


def format_event(event: Event) -> str:
    """The row of an event, without its end."""
    cells = [event.beacon] if event.beacon else []
    cells += [f"{value:.6f}" for value in event.values]
    return f"{event.time_s:.6f},{event.kind},{','.join(cells)}{',' * (3 - len(cells))}"


def write_lines(path: Path, lines: list[str], force: bool) -> None:
    """Writes a text file. Raises LinkposeError where that cannot be done, or the file exists and `force` is not set."""
    with new_file(path, force) as file:
        file.write(("\n".join(lines) + "\n").encode())


def _check_header(path: Path, line: int, row: list[str]) -> None:
    names = [name.strip() for name in row]
    if names[:2] != ["time_s", "kind"] or "a" not in names[2:]:
        raise LinkposeError(
            f"{path} line {line}: the header is {','.join(names)[:60]!r}; it must be {','.join(HEADER)}"
        )


@dataclass(slots=True)
class _Numbers:
    """Reads the numbers of one log, in which either all decimal marks are commas or none is."""

    path: Path
    may_have_commas: bool  # commas do not separate the cells
    comma: str = ""  # the first number with a comma, and the first with a point
    point: str = ""

    def read(self, cell: str, line: int) -> float:
        """A finite number. Raises LinkposeError with file and line for anything else."""
        if not self.may_have_commas:
            return read_number(cell, self.path, line)
        self.comma = self.comma or (cell if "," in cell else "")
        self.point = self.point or (cell if "." in cell else "")
        if self.comma and self.point:
            raise LinkposeError(
                f"{self.path} line {line}: {self.comma[:30]!r} and {self.point[:30]!r} can be read in two ways; "
                "save the log with one decimal mark and without separators of thousands"
            )
        return read_number(cell.replace(",", "."), self.path, line)


def _read_row(path: Path, line: int, row: list[str], numbers: _Numbers) -> Event:
    kind = row[1].strip() if len(row) > 1 else ""
    if kind not in KINDS:
        found = f"unknown kind {kind[:60]!r}" if kind else "the row is cut short"
        raise LinkposeError(f"{path} line {line}: {found}; known kinds are {', '.join(KINDS)}")
    fields = KINDS[kind]
    cells = [cell.strip() for cell in row[2 : 2 + len(fields)]]
    if len(cells) < len(fields) or "" in cells:
        raise LinkposeError(f"{path} line {line}: {kind} needs {', '.join(fields)}; complete or delete the row")
    beacon = beacon_name(cells.pop(0)) if kind in NAMED else ""
    time_s = numbers.read(row[0].strip(), line)
    return Event(time_s, kind, tuple(numbers.read(cell, line) for cell in cells), beacon, line)


def beacon_name(cell: str) -> str:
    """One spelling for a beacon: 5, 05 and 5.0 are the same; any other name stays as it is."""
    name = cell.strip()
    match = re.fullmatch(r"0*(0|[1-9]\d*)(?:\.0*)?", name)
    return match[1] if match else name


def read_number(cell: str, path: Path, line: int) -> float:
    """A finite number. Raises LinkposeError with file and line for anything else."""
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise LinkposeError(f"{path} line {line}: {cell.strip()[:60]!r} is not a number; correct or delete the row")
    return value
