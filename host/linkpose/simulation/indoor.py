"""A wheeled robot with a laser scanner in an office floor of 100 x 40 m, the size of the thesis's indoor experiment.

The robot drives a round through the corridors. Its motion deviates from the commands (Table 2.2), its odometry errs
on every sample, and the noise of a beam grows with its range. Every seed drives the same round with other errors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from linkpose.localization.carmen import FLASER_MAX_RANGE_M, Reading, flaser_angles
from linkpose.localization.grid import GridMap
from linkpose.localization.linalg import Floats, wrap_angle
from linkpose.localization.models import beams, unicycle
from linkpose.localization.tables import Truth

CELL_M = 0.1
SIZE_M = (100.0, 40.0)
ROUND_M = (
    (12.0, 12.0),
    (88.0, 12.0),
    (88.0, 28.0),
    (50.0, 28.0),
    (50.0, 34.5),
    (50.0, 28.0),
    (12.0, 28.0),
    (12.0, 12.0),
)
READINGS = 181
STEP_S = 0.1  # of the odometry
STEPS_PER_SCAN = 2
SPEED_M_S, TURN_RAD_S = 1.0, 0.8  # fastest
REACHED_M = 0.4
LONGEST_S = 3600.0


@dataclass(frozen=True, slots=True)
class IndoorErrors:
    """Standard deviations. A beam's is sqrt(σ² + (k r)²); an outlier is an obstacle that is not in the map,
    somewhere before the wall.
    """

    motion_speed_m_s: float = 0.05  # commanded against actual motion
    motion_turn_rad_s: float = 0.02
    odometry_speed_m_s: float = 0.05  # measured against actual motion
    odometry_turn_rad_s: float = 0.05
    range_m: float = 0.03
    range_growth: float = 0.02
    outlier_fraction: float = 0.02


@dataclass(frozen=True, slots=True)
class IndoorRun:
    """Truth and log of one drive. `pose` (N, 3): x m, y m, heading rad; `twist` (N, 2): v m/s, ω rad/s from each
    instant on.
    """

    time_s: Floats
    pose: Floats
    twist: Floats
    readings: list[Reading]

    @property
    def truth(self) -> Truth:
        return Truth(self.time_s, self.pose[:, :2], np.unwrap(self.pose[:, 2]))


def office_floor() -> NDArray[np.bool_]:
    """Occupied cells (400, 1000): corridors of 3 m around a block of rooms, rooms outside of them, doors of 1.2 m,
    pillars.
    """
    occupied = np.zeros((round(SIZE_M[1] / CELL_M), round(SIZE_M[0] / CELL_M)), np.bool_)

    def fill(x0: float, y0: float, x1: float, y1: float, value: bool = True) -> None:
        rows = slice(round(y0 / CELL_M), round(y1 / CELL_M))
        occupied[rows, round(x0 / CELL_M) : round(x1 / CELL_M)] = value

    wall = 0.2
    for x0, y0, x1, y1 in ((0.0, 0.0, *SIZE_M), (10.5, 10.5, 89.5, 29.5), (13.5, 13.5, 86.5, 26.5)):
        fill(x0, y0, x1, y0 + wall)
        fill(x0, y1 - wall, x1, y1)
        fill(x0, y0, x0 + wall, y1)
        fill(x1 - wall, y0, x1, y1)
    for i, x in enumerate((9.0, 17.0, 27.0, 35.0, 46.0, 54.0, 65.0, 73.0, 83.0)):
        fill(x, 0.0, x + wall, 10.5)
        fill(x + 2.0, 29.5, x + 2.0 + wall, SIZE_M[1])
        fill(x + 3.0, 10.5, x + 4.2, 10.5 + wall, False)
        fill(x - 1.5, 29.5 - wall, x - 0.3, 29.5, False)
        if 13.5 < x < 85.0:
            fill(x + 1.0, 13.5, x + 1.0 + wall, 26.5)
            door_y = 13.5 if i % 2 else 26.5 - wall
            fill(x + 4.0, door_y, x + 5.2, door_y + wall, False)
            fill(x - 2.0, 18.0, x - 1.6, 18.4)
    fill(49.0, 29.5 - wall, 51.0, 29.5, False)
    for y in (16.0, 24.0):
        fill(0.0, y, 10.5, y + wall)
        fill(89.5, y + 1.5, SIZE_M[0], y + 1.5 + wall)
        fill(10.5, y + 2.0, 10.5 + wall, y + 3.2, False)
        fill(89.5 - wall, y - 3.0, 89.5, y - 1.8, False)
    return occupied


def office_map() -> GridMap:
    """The floor as the filters read it."""
    return GridMap(office_floor().astype(np.uint8), np.array([CELL_M, 0.0, 0.0, 0.0]))


def simulate_indoor(
    seed: int, errors: IndoorErrors, duration_s: float | None, grid: GridMap | None = None
) -> IndoorRun:
    """One drive, the same for the same seed; `duration_s` None ends it after one round."""
    rng = np.random.default_rng(seed)
    grid = grid or office_map()
    pose, twist = _drive(rng, errors, duration_s)
    count = len(pose)
    wrong = rng.normal(0.0, (errors.odometry_speed_m_s, errors.odometry_turn_rad_s), (count, 2))
    odometry = np.empty_like(pose)
    odometry[0] = pose[0]
    for i in range(count - 1):
        unicycle.propagate(odometry[i], twist[i], wrong[i], STEP_S, odometry[i + 1])
    time = STEP_S * np.arange(count, dtype=np.float64)
    readings = []
    for i in range(count):
        x, y, heading = odometry[i]
        if i % STEPS_PER_SCAN:
            readings.append(Reading(float(time[i]), (x, y, heading)))
        else:
            ranges = _scan(rng, errors, grid, pose[i])
            readings.append(Reading(float(time[i]), (x, y, heading), ranges, flaser_angles(READINGS), (x, y, heading)))
    return IndoorRun(time, pose, twist, readings)


def _drive(rng: np.random.Generator, errors: IndoorErrors, duration_s: float | None) -> tuple[Floats, Floats]:
    """Table 2.2: the command plus Gaussian noise is what the robot does; dead reckoning gives the path."""
    targets = list(ROUND_M[1:])
    pose = np.array([*ROUND_M[0], 0.0])
    steps = round(min(duration_s or LONGEST_S, LONGEST_S) / STEP_S)
    poses, twists = [pose], []
    for _ in range(steps):
        if math.dist(pose[:2], targets[0]) < REACHED_M:
            targets = targets[1:]
            if not targets and duration_s is None:
                break
            targets = targets or list(ROUND_M[1:])
        command = _steer(pose, targets[0])
        twist = command + rng.normal(0.0, (errors.motion_speed_m_s, errors.motion_turn_rad_s))
        after = np.empty(3)
        unicycle.propagate(pose, twist, np.zeros(2), STEP_S, after)
        pose = after
        poses.append(pose)
        twists.append(twist)
    twists.append(np.zeros(2))
    return np.array(poses), np.array(twists)


def _steer(pose: Floats, target: tuple[float, float]) -> Floats:
    """Turns to the target and drives towards it, slower while it turns."""
    off = wrap_angle(math.atan2(target[1] - pose[1], target[0] - pose[0]) - pose[2])
    turn = min(max(1.5 * off, -TURN_RAD_S), TURN_RAD_S)
    return np.array([SPEED_M_S * max(0.0, math.cos(off)) ** 2, turn])


def _scan(rng: np.random.Generator, errors: IndoorErrors, grid: GridMap, pose: Floats) -> Floats:
    """Ranges (181,) from -90 to 90 degrees, cut to what a log line can hold."""
    table = np.zeros((READINGS, 5))
    table[:, 0], table[:, 4] = flaser_angles(READINGS), FLASER_MAX_RANGE_M
    ranges = np.empty(READINGS)
    beams.predict(pose, table, grid, ranges)
    silent = ranges >= FLASER_MAX_RANGE_M
    obstructed = rng.random(READINGS) < errors.outlier_fraction
    ranges = np.where(obstructed, ranges * rng.uniform(0.1, 0.9, READINGS), ranges)
    ranges += rng.normal(0.0, 1.0, READINGS) * np.sqrt(errors.range_m**2 + (errors.range_growth * ranges) ** 2)
    return np.where(silent, FLASER_MAX_RANGE_M, np.clip(ranges, 0.01, FLASER_MAX_RANGE_M))
