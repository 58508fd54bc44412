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

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.localization.carmen_units import check_beam_angles, check_ranges
from linkpose.localization.events import Event, Log, LogFile, Scan, check_clock, in_order, read_number
from linkpose.localization.headings import check_headings
from linkpose.localization.linalg import Floats, wrap_angle
from linkpose.localization.models.se2 import sinc
from linkpose.presentation import counted

KEYWORDS = ("ODOM", "FLASER", "ROBOTLASER1")
BEAM_ANGLES_RAD = np.radians(np.arange(-90.0, 91.0, 10.0))  # the thesis's 19 beams
FLASER_MAX_RANGE_M = 80.0  # a SICK scanner's; the line does not contain it
# Readings this near to the longest of the log are equal to it, and this many of them are no coincidence.
SAME_RANGE_M, SHARED_READINGS = 0.005, 10
QUARTERS = 720  # quarters of a degree in a FLASER's field of view
FIRST_TIME_S = 60.0  # a log whose clock starts at 0 has its next line within this time
HEAD_LINES, LONGEST_HEAD = 1000, 200  # how far `is_carmen` looks
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


def is_carmen(lines: Sequence[str]) -> bool:
    """Whether the first line that is no comment begins with a CARMEN keyword or another log's parameter line."""
    for text in lines[:HEAD_LINES]:
        words = text[:LONGEST_HEAD].split(maxsplit=1)
        if words and not text.startswith("#"):
            return words[0].isascii() and words[0].isupper() and "," not in text
    return False


def read_carmen(path: Path, lines: Sequence[str]) -> LogFile:
    """The log in the lines of a file, in order of time, with the odometry's first pose as `start`.

    Lines of other sensors are passed over. Lines that are not in order of time are sorted, lines without a time (0) and
    a last line that is cut short are left out; `remarks` has the counts. Raises LinkposeError with file, line and cure
    for a damaged line, and for a log in other units or axes.
    """
    readings: list[Reading] = []
    remarks: list[str] = []
    for number, text in enumerate(lines, 1):
        words = text.split()
        if words and words[0] in KEYWORDS:
            try:
                readings.append(_read_line(path, number, words))
            except LinkposeError:
                if number < len(lines):
                    raise
                remarks.append(f"{path}: the last line is cut short and left out")
    timed = _timed(readings)
    if not timed:
        raise LinkposeError(
            f"{path} holds no {', '.join(KEYWORDS[:-1])} or {KEYWORDS[-1]} lines; give a CARMEN log or a CSV log"
        )
    if len(timed) < len(readings):
        remarks.append(f"{path}: {counted(len(readings) - len(timed), 'line')} without a time left out")
    scans = [reading for reading in timed if reading.ranges_m is not None]
    check_clock([scans, [reading for reading in timed if reading.ranges_m is None]], path)
    ordered, moved = in_order(timed)
    check_ranges([reading.ranges_m for reading in ordered if reading.ranges_m is not None], path)
    check_headings(np.array([reading.odometry for reading in ordered]), path, "the odometry")
    if moved:
        remarks.append(f"{path}: {counted(moved, 'line')} moved into the order of time")
    return LogFile(as_log(_without_echo(ordered)), ordered[0].odometry, tuple(remarks), is_carmen=True)


def _timed(readings: list[Reading]) -> list[Reading]:
    """Without the readings whose time is 0, unless that is where the log's own clock starts."""
    others = [reading for reading in readings if reading.time_s != 0.0]
    if not others or (readings[0].time_s == 0.0 and abs(others[0].time_s) < FIRST_TIME_S):
        leading = list(itertools.takewhile(lambda reading: reading.time_s == 0.0, readings))
        return leading + others
    return others


def _without_echo(readings: list[Reading]) -> list[Reading]:
    """FLASER lines do not state the longest range: a longest reading that many beams share means "no echo"."""
    scans = [reading.ranges_m for reading in readings if reading.ranges_m is not None and len(reading.ranges_m)]
    longest = max((float(ranges.max(initial=0.0, where=np.isfinite(ranges))) for ranges in scans), default=0.0)
    if sum(int(np.count_nonzero(ranges > longest - SAME_RANGE_M)) for ranges in scans) < SHARED_READINGS:
        return readings
    limit = longest - SAME_RANGE_M
    return [replace(reading, max_range_m=min(reading.max_range_m, limit)) for reading in readings]


def as_log(readings: list[Reading]) -> Log:
    """Controls between the odometry's poses, and the scans; `readings` are in order of time.

    Lines of one instant have one pose, which is the last scan's, or the last line's where there is no scan: the
    odometry is cumulative, and a pose between two lines of one instant must not be lost.
    """
    groups = [list(group) for _, group in itertools.groupby(readings, key=lambda reading: reading.time_s)]
    poses = [_pose_of(group) for group in groups]
    log: Log = []
    for i, (group, pose) in enumerate(zip(groups, poses, strict=True)):
        time = group[0].time_s
        last = i == len(groups) - 1
        control = (0.0, 0.0) if last else _arc(pose, poses[i + 1], groups[i + 1][0].time_s - time)
        log.append(Event(time, "odometry", control))
        for reading in group:
            if reading.ranges_m is not None and reading.angles_rad is not None:
                log.append(_scan(reading, pose, reading.ranges_m, reading.angles_rad))
    return log


def _pose_of(group: list[Reading]) -> Pose:
    """The odometry's pose at an instant with several lines."""
    scans = [reading for reading in group if reading.ranges_m is not None]
    return (scans or group)[-1].odometry


def format_reading(reading: Reading) -> str:
    """The ODOM or FLASER line of a reading, without its end. The angles of a FLASER are implied by their number."""
    odometry, time = " ".join(f"{value:.6f}" for value in reading.odometry), f"{reading.time_s:.6f}"
    if reading.ranges_m is None:
        return f"ODOM {odometry} 0 0 0 {time} linkpose {time}"
    ranges = " ".join(f"{value:.3f}" for value in reading.ranges_m)
    laser = " ".join(f"{value:.6f}" for value in reading.laser)
    return f"FLASER {len(reading.ranges_m)} {ranges} {laser} {odometry} {time} linkpose {time}"


def _arc(before: Pose, after: Pose, interval_s: float) -> tuple[float, float]:
    """Forward speed and turn rate of the arc from one pose to the next; the odometry's sideways motion is left out."""
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
        return Reading(line.number(n + 8), line.pose(n + 5), line.ranges(2, n), angles, line.pose(n + 2), line=number)
    n = line.count(8)
    after = 10 + n + line.count(9 + n)
    line.require(after + 12)
    check_beam_angles(line.number(2), line.number(4), n, path, number)
    angles = line.number(2) + line.number(4) * np.arange(n, dtype=np.float64)
    ranges, longest = line.ranges(9, n), line.number(5)
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

    def ranges(self, first: int, count: int) -> Floats:
        """The readings of a scan; other programs write a beam without an echo as infinity or as no number."""
        words = self.words[first : first + count]
        try:
            return np.array(words, dtype=np.float64)
        except ValueError:
            return np.array([self.number(index) for index in range(first, first + count)])

    def pose(self, first: int) -> Pose:
        return self.number(first), self.number(first + 1), self.number(first + 2)

    def count(self, index: int) -> int:
        self.require(index + 1)
        value = self.number(index)
        if value < 0 or not value.is_integer():
            raise LinkposeError(
                f"{self.path} line {self.line}: {self.words[index][:60]!r} is no number of readings; "
                "correct or delete the line"
            )
        return int(value)


def flaser_angles(count: int) -> Floats:
    """A FLASER line gives no angles: it begins at -90 degrees and spans 180, or a step less.

    The step is the one of both that is a multiple of a quarter of a degree, as scanners have it, too where every n-th
    reading was kept.
    """
    steps = max(count - 1, 1)
    if count and QUARTERS % steps and QUARTERS % count == 0:
        steps = count
    return np.radians(180.0 / steps * np.arange(count, dtype=np.float64) - 90.0)


def _scan(reading: Reading, robot: Pose, ranges: Floats, angles: Floats) -> Scan:
    """The whole scan, NaN where there is no echo, and the laser's place on the robot, whose odometry is at `robot`."""
    echo = np.where((ranges > 0.0) & (ranges < reading.max_range_m), ranges, np.nan)
    dx, dy = reading.laser[0] - robot[0], reading.laser[1] - robot[1]
    c, s = math.cos(robot[2]), math.sin(robot[2])
    mount = (c * dx + s * dy, c * dy - s * dx, wrap_angle(reading.laser[2] - robot[2]))
    return Scan(reading.time_s, echo, angles, mount, reading.max_range_m, reading.line)
