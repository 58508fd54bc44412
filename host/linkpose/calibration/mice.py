"""Counts per metre and mounting angle of each mouse, from straight lines of known length and full turns.

Written with complex numbers (x + jy in the robot's frame), mouse i at p_i turned by φ_i counts c_i over a drive. With
g_i = e^{jφ_i} / (counts per metre), (6) and (7) integrated are linear in all that is unknown:

    a line of length L that turned by δ    g_i c_i − jδ p_i = L
    a turn of Θ about wherever             g_i c_i − D = jΘ p_i

D, by how far the robot's centre went (in its own, turning axes), is found as well: the robot need not turn on the spot.
So is L where nobody measured it: the scale then comes from the turn and from where two or more mice sit. The ahead of
the robot's frame is by definition the way along which the line goes.

Source: the redundant-mice paper, (6), (7).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import LinkposeError
from linkpose.recording.reader import Recording
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.rig import Mouse, Rig
from linkpose.wire.messages import SampleFlags

REST_S = 0.5  # of standing still that must come before a drive, for the gyro's bias
FULL_TURN = 2 * math.pi
TURN_TOLERANCE_RAD = math.radians(20)  # from a straight line, or from full turns
GYRO_SCALE = 0.04  # of an uncalibrated gyro: 3 % (data sheet), and 1 % of cross-axis sensitivity
MOST_TURNS = 12  # beyond which such a gyro miscounts
FEWEST_COUNTS = 1000  # of a mouse over a line: so that a count is a tenth of a percent
PLACE_STD_M = 0.001  # σ of a mouse's position measured with a ruler
LINE_STD_M = 0.001  # to which a line is driven straight
GYRO_STD_RAD = 0.01  # of a line's small turn, by the gyro
WORST_MISFIT = 8.0  # of these standard deviations


@dataclass(frozen=True, slots=True)
class MouseCalibration:
    """What was found of a mouse (1 for the first), with standard deviations."""

    mouse: int
    counts_per_m: float
    counts_per_m_std: float
    angle_deg: float
    angle_std_deg: float
    residual_mm: float  # rms over all drives

    def as_dict(self) -> dict[str, int | float]:
        """The object that `calibrate mice --json` prints."""
        return {name: round(getattr(self, name), 5) for name in self.__slots__}


@dataclass(frozen=True, slots=True)
class _DriveSums:
    """What a recording adds up to."""

    name: str
    counts: NDArray[np.complex128]  # (M,) of each mouse
    turn_rad: float  # by the gyro
    turns: int  # full ones


def calibrate_mice(recordings: Sequence[Recording], rig: Rig, length_m: float | None) -> list[MouseCalibration]:
    """Calibration of each mouse that the rig places. `length_m` is the length of every line; None if unknown.

    Raises LinkposeError naming the drive and the cure for a rig without mice, a motion that is missing or is neither a
    line nor full turns, a recording that did not see it all, and mice that contradict their places.
    """
    if not rig.mouse:
        raise LinkposeError(
            "the rig file lacks the positions of the mice; add one [[mouse]] table with x_m and y_m for each port"
        )
    drives = [_sums(recording, len(rig.mouse)) for recording in recordings]
    if all(drive.turns for drive in drives):
        line = f"one of {length_m:g} m" if length_m else "one of a metre or more"
        raise LinkposeError(f"no recording is of a straight line; drive {line} and add its recording")
    if not any(drive.turns for drive in drives):
        raise LinkposeError("no recording is of a full turn; turn the robot once round and add its recording")
    places = np.array([complex(mouse.x_m, mouse.y_m) for mouse in rig.mouse])
    design, target = _equations(drives, places, length_m)
    if np.linalg.matrix_rank(design / np.linalg.norm(design, axis=0)) < design.shape[1]:
        raise LinkposeError("these drives do not determine the scale; measure the length of the line and give it")
    solution, covariance, residual = _least_squares(design, target)
    _check_fit(residual, len(rig.mouse))
    return [_described(i, solution, covariance, _own(residual, i, drives, len(places))) for i in range(len(places))]


def with_calibration(rig: Rig, found: Sequence[MouseCalibration]) -> Rig:
    """The rig with the mice as they were found."""
    mice = list(rig.mouse)
    for mouse in found:
        old: Mouse = mice[mouse.mouse - 1]
        mice[mouse.mouse - 1] = replace(
            old, counts_per_m=round(mouse.counts_per_m, 2), angle_deg=round(mouse.angle_deg, 4)
        )
    return replace(rig, mouse=tuple(mice))


# ---- from a recording to a drive ----


def _sums(recording: Recording, mice: int) -> _DriveSums:
    name, m = str(recording.path), recording.measurements
    if m.mice_counts.shape[1] < mice:
        raise LinkposeError(f"{name} has {m.mice_counts.shape[1]} mice, and the rig file {mice}; connect all of them")
    counts = m.mice_counts[:, :mice]
    moving = np.flatnonzero(np.nan_to_num(counts).any(axis=(1, 2)))
    if not len(moving):
        raise LinkposeError(f"{name}: no mouse moves in it; drive a line of known length, or a full turn")
    first, last = int(moving[0]), int(moving[-1]) + 1
    _check_whole(name, m, counts, first, last)
    turn = _turned(name, m, first, last)
    turns = round(turn / FULL_TURN)
    if abs(turns) > MOST_TURNS:
        raise LinkposeError(
            f"{name} has {abs(turns)} full turns; more than {MOST_TURNS} cannot be counted with a gyro that may be "
            f"{100 * GYRO_SCALE:.0f} % off. Drive {MOST_TURNS} turns or fewer."
        )
    if abs(turn - turns * FULL_TURN) > TURN_TOLERANCE_RAD + GYRO_SCALE * abs(turn):
        raise LinkposeError(
            f"{name} turns by {math.degrees(turn):.0f}°, so it is neither a straight line nor full turns; drive it anew"
        )
    total = counts[first:last].sum(axis=0)
    if not turns and (np.hypot(total[:, 0], total[:, 1]) < FEWEST_COUNTS).any():
        fewest = float(np.hypot(total[:, 0], total[:, 1]).min())
        raise LinkposeError(f"{name}: a mouse counts only {fewest:.0f}; drive a longer line, of a metre or more")
    return _DriveSums(name, total[:, 0] + 1j * total[:, 1], turn, turns)


def _check_whole(name: str, m: Measurements, counts: Floats, first: int, last: int) -> None:
    """Every movement must be in the recording."""
    away = np.argwhere(np.isnan(counts[first:last]).any(axis=2))
    if len(away):
        row, mouse = away[0]
        when = m.time_s[first + row]
        raise LinkposeError(f"{name}: mouse {mouse + 1} is away at {when:.2f} s, while the robot moves; drive it anew")
    lost = np.flatnonzero(m.flags[first + 1 : last] & int(SampleFlags.GAP_BEFORE))
    if len(lost):
        when = m.time_s[first + 1 + lost[0]]
        raise LinkposeError(f"{name}: samples were lost before {when:.2f} s, and their counts with them; drive it anew")


def _turned(name: str, m: Measurements, first: int, last: int) -> float:
    """The turn (rad) while the mice move, by the gyro less its mean over the rest before."""
    rate, time = m.gyro_rad_s[:, 2], m.time_s
    if not np.isfinite(rate).any():
        raise LinkposeError(f"{name} holds no gyro, which distinguishes lines from turns: check the MPU6050's wiring")
    rest = rate[:first][np.isfinite(rate[:first])]
    if time[first] - time[0] < REST_S or not len(rest):
        raise LinkposeError(f"{name} begins in motion; stand still for a second, then drive")
    span = slice(max(first - 1, 0), last)
    known = np.isfinite(rate[span])
    w, t = rate[span][known] - rest.mean(), time[span][known]
    return float(0.5 * (w[1:] + w[:-1]) @ np.diff(t))


# ---- least squares ----


def _equations(
    drives: Sequence[_DriveSums], places: NDArray[np.complex128], length_m: float | None
) -> tuple[Floats, Floats]:
    """Design matrix and right-hand side, each row over its standard deviation. The rows of a drive are 2 to a mouse.

    Unknowns: real and imaginary part of each g_i; for each drive δ (a line) or the two parts of D (a turn); last the
    lines' length where it is not given.
    """
    mice = len(places)
    width = 2 * mice + sum(2 if drive.turns else 1 for drive in drives) + (length_m is None)
    rows, target = [], []
    own = 2 * mice
    for drive in drives:
        arm = 1j * places
        for i in range(mice):
            std = PLACE_STD_M * FULL_TURN * abs(drive.turns) if drive.turns else LINE_STD_M
            c = drive.counts[i]
            aim = FULL_TURN * drive.turns * arm[i] if drive.turns else complex(length_m or 0.0)
            for part, of_g, of_arm, value in (
                (0, (c.real, -c.imag), arm[i].real, aim.real),
                (1, (c.imag, c.real), arm[i].imag, aim.imag),
            ):
                row = np.zeros(width)
                row[2 * i : 2 * i + 2] = of_g
                row[own + (part if drive.turns else 0)] = -1.0 if drive.turns else -of_arm
                if length_m is None and not drive.turns and part == 0:
                    row[-1] = -1.0
                rows.append(row / std)
                target.append(value / std)
        if not drive.turns:
            row = np.zeros(width)
            row[own] = 1 / GYRO_STD_RAD
            rows.append(row)
            target.append(drive.turn_rad / GYRO_STD_RAD)
        own += 2 if drive.turns else 1
    return np.array(rows), np.array(target)


def _least_squares(design: Floats, target: Floats) -> tuple[Floats, Floats, Floats]:
    """Solution, its covariance (widened where the fit is worse than it should be), and weighted residuals."""
    scale = np.linalg.norm(design, axis=0)  # counts and radians side by side
    scaled = design / scale
    solution = np.linalg.lstsq(scaled, target, rcond=None)[0]
    residual = target - scaled @ solution
    freedom = len(target) - design.shape[1]
    worse = max(1.0, float(residual @ residual) / freedom) if freedom else 1.0
    covariance = np.linalg.inv(scaled.T @ scaled) * worse / np.outer(scale, scale)
    return solution / scale, covariance, residual


def _own(residual: Floats, mouse: int, drives: Sequence[_DriveSums], mice: int) -> float:
    """The rms (mm) of what a mouse's own equations leave."""
    squares, at = [], 0
    for drive in drives:
        std = PLACE_STD_M * FULL_TURN * abs(drive.turns) if drive.turns else LINE_STD_M
        squares += [(std * value) ** 2 for value in residual[at + 2 * mouse : at + 2 * mouse + 2].tolist()]
        at += 2 * mice + (0 if drive.turns else 1)
    return 1e3 * math.sqrt(sum(squares) / len(squares))


def _check_fit(residual: Floats, mice: int) -> None:
    worst = float(np.abs(residual).max())
    if worst > WORST_MISFIT:
        raise LinkposeError(
            f"the {mice} mice contradict one another ({worst:.0f} standard deviations): check their x_m and y_m in the "
            "rig file, the --length of the line, and that no mouse slipped"
        )


def _described(i: int, solution: Floats, covariance: Floats, residual_mm: float) -> MouseCalibration:
    g = complex(solution[2 * i], solution[2 * i + 1])
    along = np.array([g.real, g.imag]) / abs(g)
    across = np.array([-along[1], along[0]])
    part = covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2]
    return MouseCalibration(
        mouse=i + 1,
        counts_per_m=1 / abs(g),
        counts_per_m_std=math.sqrt(along @ part @ along) / abs(g) ** 2,
        angle_deg=math.degrees(math.atan2(g.imag, g.real)),
        angle_std_deg=math.degrees(math.sqrt(across @ part @ across) / abs(g)),
        residual_mm=residual_mm,
    )
