"""CARMEN logs: `ODOM`, `FLASER` and `ROBOTLASER1` lines, each with the odometry's own pose and the time.

    ODOM x y θ v ω acceleration time host logger_time
    FLASER n r_1 … r_n x y θ odom_x odom_y odom_θ time host logger_time
    ROBOTLASER1 type start_angle field_of_view step max_range accuracy remission_mode n r_1 … r_n k e_1 … e_k
                laser_x laser_y laser_θ robot_x robot_y robot_θ v ω forward_safety side_safety turn_axis
                time host logger_time

Metres, radians, beams counterclockwise. The odometry's poses are cumulative, so the control between two of them is the
exact arc that joins them, valid from the first to the second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.localization.events import Event, Log, Scan, read_number
from linkpose.localization.linalg import Floats, wrap_angle
from linkpose.localization.models.se2 import sinc

KEYWORDS = ("ODOM", "FLASER", "ROBOTLASER1")
BEAM_ANGLES_RAD = np.radians(np.arange(-90.0, 91.0, 10.0))  # the thesis's 19 beams
FLASER_MAX_RANGE_M = 80.0  # a SICK scanner's; the line does not say
Pose = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Reading:
    """One line: the odometry's pose, and with a laser its n ranges (m) along n angles (rad) from `laser`.

    Both poses are in the odometry's frame.
    """

    time_s: float
    odometry: Pose
    ranges_m: Floats | None = None
    angles_rad: Floats | None = None
    laser: Pose = (0.0, 0.0, 0.0)
    max_range_m: float = FLASER_MAX_RANGE_M
    line: int = 0


def is_carmen(path: Path) -> bool:
    """Whether a file's first line that is no comment begins with a CARMEN keyword or another log's parameter line."""
    try:
        with path.open(encoding="utf-8") as file:
            for text in file:
                if text.strip() and not text.startswith("#"):
                    return text.split(maxsplit=1)[0].isupper() and "," not in text
    except UnicodeDecodeError:
        return False
    except OSError as error:
        raise LinkposeError(f"cannot read the log {path}: {error.strerror}") from error
    return False


def read_carmen(path: Path) -> tuple[Log, Pose]:
    """Reads a log into events in order of its own time, and the odometry's first pose.

    Lines of other sensors are passed over. Raises LinkposeError with file, line and cure for a damaged line.
    """
    readings: list[Reading] = []
    try:
        with path.open(encoding="utf-8") as file:
            for number, text in enumerate(file, 1):
                words = text.split()
                if words and words[0] in KEYWORDS:
                    readings.append(_read_line(path, number, words))
                    _check_order(path, readings[-2:])
    except UnicodeDecodeError as error:
        raise LinkposeError(f"{path} is not a CARMEN log: {error}") from error
    except OSError as error:
        raise LinkposeError(f"cannot read the log {path}: {error.strerror}") from error
    if not readings:
        raise LinkposeError(
            f"{path} holds no {', '.join(KEYWORDS[:-1])} or {KEYWORDS[-1]} lines; give a CARMEN log or a CSV log"
        )
    return as_log(readings), readings[0].odometry


def _check_order(path: Path, pair: list[Reading]) -> None:
    if len(pair) == 2 and pair[1].time_s < pair[0].time_s:
        raise LinkposeError(
            f"{path} line {pair[1].line}: time runs backwards, from {pair[0].time_s:.6f} to {pair[1].time_s:.6f} s; "
            "sort the lines by their time"
        )


def as_log(readings: list[Reading]) -> Log:
    """Controls between the odometry's poses, and the scans."""
    log: Log = []
    for i, reading in enumerate(readings):
        time = reading.time_s
        if i == len(readings) - 1:
            log.append(Event(time, "odometry", (0.0, 0.0)))
        elif readings[i + 1].time_s > reading.time_s:  # of two lines at one instant the second has the control
            later = readings[i + 1]
            arc = _arc(reading.odometry, later.odometry, later.time_s - reading.time_s)
            log.append(Event(time, "odometry", arc))
        if reading.ranges_m is not None and reading.angles_rad is not None:
            log.append(_scan(time, reading, reading.ranges_m, reading.angles_rad))
    return log


def format_reading(reading: Reading) -> str:
    """The ODOM or FLASER line of a reading, without its end. The angles of a FLASER are implied by their number."""
    odometry, time = " ".join(f"{value:.6f}" for value in reading.odometry), f"{reading.time_s:.6f}"
    if reading.ranges_m is None:
        return f"ODOM {odometry} 0 0 0 {time} linkpose {time}"
    ranges = " ".join(f"{value:.3f}" for value in reading.ranges_m)
    laser = " ".join(f"{value:.6f}" for value in reading.laser)
    return f"FLASER {len(reading.ranges_m)} {ranges} {laser} {odometry} {time} linkpose {time}"


def _arc(before: Pose, after: Pose, interval_s: float) -> tuple[float, float]:
    """Forward speed and turn rate of the arc from one pose to the next; what the odometry says aside of the arc is left
    out.
    """
    turn = wrap_angle(after[2] - before[2])
    middle = before[2] + 0.5 * turn
    chord = math.cos(middle) * (after[0] - before[0]) + math.sin(middle) * (after[1] - before[1])
    return chord / sinc(0.5 * turn) / interval_s, turn / interval_s


def _read_line(path: Path, number: int, words: list[str]) -> Reading:
    line = _Words(path, number, words)
    if words[0] == "ODOM":
        line.require(8)
        return Reading(line.number(7), line.pose(1), line=number)
    if words[0] == "FLASER":
        n = line.count(1)
        line.require(n + 9)
        angles = flaser_angles(n)
        return Reading(line.number(n + 8), line.pose(n + 5), line.numbers(2, n), angles, line.pose(n + 2), line=number)
    n = line.count(8)
    after = 10 + n + line.count(9 + n)
    line.require(after + 12)
    angles = line.number(2) + line.number(4) * np.arange(n, dtype=np.float64)
    ranges, longest = line.numbers(9, n), line.number(5)
    return Reading(line.number(after + 11), line.pose(after + 3), ranges, angles, line.pose(after), longest, number)


@dataclass(frozen=True, slots=True)
class _Words:
    """One line as numbers. Raises LinkposeError with file and line for what is missing or is none."""

    path: Path
    line: int
    words: list[str]

    def require(self, count: int) -> None:
        if len(self.words) < count:
            raise LinkposeError(
                f"{self.path} line {self.line}: {self.words[0]} is cut short, {len(self.words)} of {count} words; "
                "complete or delete the line"
            )

    def number(self, index: int) -> float:
        return read_number(self.words[index], self.path, self.line)

    def numbers(self, first: int, count: int) -> Floats:
        return np.array([self.number(index) for index in range(first, first + count)])

    def pose(self, first: int) -> Pose:
        return self.number(first), self.number(first + 1), self.number(first + 2)

    def count(self, index: int) -> int:
        self.require(index + 1)
        value = self.number(index)
        if value < 0 or not value.is_integer():
            raise LinkposeError(
                f"{self.path} line {self.line}: {self.words[index]!r} is no number of readings; "
                "correct or delete the line"
            )
        return int(value)


def flaser_angles(count: int) -> Floats:
    """A FLASER line gives no angles: it begins at -90 degrees and spans 180, or a step less."""
    step_deg = {180: 1.0, 181: 1.0, 360: 0.5, 361: 0.5}.get(count, 180.0 / max(count - 1, 1))
    return np.radians(step_deg * np.arange(count, dtype=np.float64) - 90.0)


def _scan(time_s: float, reading: Reading, ranges: Floats, angles: Floats) -> Scan:
    """The readings nearest to the 19 beams that lie within the scanner's field, and the laser's place on the robot."""
    chosen: list[int] = []
    if len(angles):
        step = abs(angles[1] - angles[0]) if len(angles) > 1 else 0.0
        seen = (angles.min() - 1.5 * step < BEAM_ANGLES_RAD) & (angles.max() + 1.5 * step > BEAM_ANGLES_RAD)
        chosen = sorted({int(np.argmin(np.abs(angles - angle))) for angle in BEAM_ANGLES_RAD[seen]})
    echo = np.where((ranges[chosen] > 0.0) & (ranges[chosen] < reading.max_range_m), ranges[chosen], np.nan)
    dx, dy = reading.laser[0] - reading.odometry[0], reading.laser[1] - reading.odometry[1]
    c, s = math.cos(reading.odometry[2]), math.sin(reading.odometry[2])
    mount = (c * dx + s * dy, c * dy - s * dx, wrap_angle(reading.laser[2] - reading.odometry[2]))
    return Scan(time_s, echo, angles[chosen], mount, reading.max_range_m, reading.line)
