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
from linkpose.localization.models.unicycle import sinc

KEYWORDS = ("ODOM", "FLASER", "ROBOTLASER1")
BEAM_ANGLES_RAD = np.radians(np.arange(-90.0, 91.0, 10.0))  # the thesis's 19 beams
FLASER_MAX_RANGE_M = 80.0  # a SICK scanner's; the line does not say
Pose = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class _Line:
    time_s: float
    odometry: Pose
    scan: Scan | None


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
    """Reads a log into events in order of time, which starts at 0, and the odometry's first pose.

    Lines of other sensors are passed over. Raises LinkposeError with file, line and cure for a damaged line.
    """
    lines: list[_Line] = []
    try:
        with path.open(encoding="utf-8") as file:
            for number, text in enumerate(file, 1):
                words = text.split()
                if words and words[0] in KEYWORDS:
                    lines.append(_read_line(path, number, words))
                    if len(lines) > 1 and lines[-1].time_s < lines[-2].time_s:
                        raise LinkposeError(
                            f"{path} line {number}: time runs backwards, from {lines[-2].time_s:.6f} "
                            f"to {lines[-1].time_s:.6f} s; sort the lines by their time"
                        )
    except UnicodeDecodeError as error:
        raise LinkposeError(f"{path} is not a CARMEN log: {error}") from error
    except OSError as error:
        raise LinkposeError(f"cannot read the log {path}: {error.strerror}") from error
    if not lines:
        raise LinkposeError(
            f"{path} holds no {', '.join(KEYWORDS[:-1])} or {KEYWORDS[-1]} lines; give a CARMEN log or a CSV log"
        )
    return _events(lines), lines[0].odometry


def _events(lines: list[_Line]) -> Log:
    """Controls between the odometry's poses, and the scans, on a clock that starts at 0."""
    start = lines[0].time_s
    log: Log = []
    for i, line in enumerate(lines):
        time = line.time_s - start
        if i == len(lines) - 1:
            log.append(Event(time, "odometry", (0.0, 0.0)))
        elif lines[i + 1].time_s > line.time_s:  # of two lines at one instant the second has the control
            later = lines[i + 1]
            log.append(Event(time, "odometry", _arc(line.odometry, later.odometry, later.time_s - line.time_s)))
        if line.scan is not None:
            scan = line.scan
            log.append(Scan(time, scan.ranges_m, scan.angles_rad, scan.mount, scan.max_range_m, scan.line))
    return log


def _arc(before: Pose, after: Pose, interval_s: float) -> tuple[float, float]:
    """Forward speed and turn rate of the arc from one pose to the next; what the odometry says aside of the arc is left
    out.
    """
    turn = wrap_angle(after[2] - before[2])
    middle = before[2] + 0.5 * turn
    chord = math.cos(middle) * (after[0] - before[0]) + math.sin(middle) * (after[1] - before[1])
    return chord / sinc(0.5 * turn) / interval_s, turn / interval_s


def _read_line(path: Path, number: int, words: list[str]) -> _Line:
    def cut(needed: int) -> None:
        if len(words) < needed:
            raise LinkposeError(
                f"{path} line {number}: {words[0]} is cut short, {len(words)} of {needed} words; "
                "complete or delete the line"
            )

    def numbers(first: int, count: int) -> list[float]:
        return [read_number(word, path, number) for word in words[first : first + count]]

    def size(index: int) -> int:
        cut(index + 1)
        value = read_number(words[index], path, number)
        if value < 0 or not value.is_integer():
            raise LinkposeError(
                f"{path} line {number}: {words[index]!r} is no number of readings; correct or delete the line"
            )
        return int(value)

    if words[0] == "ODOM":
        cut(8)
        x, y, heading = numbers(1, 3)
        return _Line(numbers(7, 1)[0], (x, y, heading), None)
    if words[0] == "FLASER":
        n = size(1)
        cut(n + 9)
        laser, odometry = numbers(n + 2, 3), numbers(n + 5, 3)
        time = numbers(n + 8, 1)[0]
        scan = _scan(time, np.array(numbers(2, n)), _flaser_angles(n), laser, odometry, FLASER_MAX_RANGE_M, number)
        return _Line(time, (odometry[0], odometry[1], odometry[2]), scan)
    n = size(8)
    k = size(9 + n)
    after = 10 + n + k
    cut(after + 12)
    start, step, longest = numbers(2, 1)[0], numbers(4, 1)[0], numbers(5, 1)[0]
    laser, odometry = numbers(after, 3), numbers(after + 3, 3)
    time = numbers(after + 11, 1)[0]
    scan = _scan(
        time, np.array(numbers(9, n)), start + step * np.arange(n, dtype=np.float64), laser, odometry, longest, number
    )
    return _Line(time, (odometry[0], odometry[1], odometry[2]), scan)


def _flaser_angles(count: int) -> Floats:
    """A FLASER line gives no angles: it begins at -90 degrees and spans 180, or a step less."""
    step_deg = {180: 1.0, 181: 1.0, 360: 0.5, 361: 0.5}.get(count, 180.0 / max(count - 1, 1))
    return np.radians(step_deg * np.arange(count, dtype=np.float64) - 90.0)


def _scan(
    time_s: float, ranges: Floats, angles: Floats, laser: list[float], robot: list[float], longest: float, line: int
) -> Scan:
    """The readings nearest to the 19 beams that lie within the scanner's field, and the laser's place on the robot."""
    step = abs(angles[1] - angles[0]) if len(angles) > 1 else 0.0
    wanted = (
        BEAM_ANGLES_RAD[(angles[0] - step - 1e-6 <= BEAM_ANGLES_RAD) & (angles[-1] + step + 1e-6 >= BEAM_ANGLES_RAD)]
        if len(angles)
        else []
    )
    chosen = sorted({int(np.argmin(np.abs(angles - angle))) for angle in wanted})
    echo = np.where((ranges[chosen] > 0.0) & (ranges[chosen] < longest), ranges[chosen], np.nan)
    dx, dy = laser[0] - robot[0], laser[1] - robot[1]
    c, s = math.cos(robot[2]), math.sin(robot[2])
    mount = (c * dx + s * dy, c * dy - s * dx, wrap_angle(laser[2] - robot[2]))
    return Scan(time_s, echo, angles[chosen], mount, longest, line)
