"""Counts per metre and mounting angle of each mouse, from straight lines of known length and full turns.

With complex numbers (x + jy in the robot's frame), mouse i at p_i, turned by φ_i, counts c_i over a drive. With
g_i = e^{jφ_i} / (counts per metre), (6) and (7) of [Mice], integrated over the drive, are linear in all unknowns:

    a line of length L that turned by δ    g_i c_i − jδ p_i = L
    a turn of Θ about any point            g_i c_i − D − jΘ δp_i − jδΘ p_i = jΘ p_i

D is the displacement of the robot's centre in its own, turning axes, so the robot need not turn on the spot. δp_i is
the error of the mouse's position in the rig file, and δΘ the angle by which the turn does not close; both are known to
be small. Without a measured length, L is an unknown too: the scale then follows from the turn and from the positions of
two or more mice. The direction of the line defines "ahead".

Where both a length and a turn show the common scale, they must agree; what they differ by beyond their standard
deviations is part of the stated ones.
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
PLACE_STD_M = 0.001  # σ of a mouse's position measured with a ruler. Doubled: a scale without a length is half as sure
# σ of a mouse's way over a line, and over a full turn (m): scatter of the surface, and how straight a line is driven.
# Doubled: so are the stated deviations of scale and angle.
WAY_STD_M = 0.001
CLOSING_STD_RAD = math.radians(1.0)  # σ of the heading at which a turn ends, set by eye against a mark
GYRO_STD_RAD = 0.01  # of a line's small turn, by the gyro
WORST_MISFIT = 8.0  # largest residual over its standard deviation. Doubled: a wrong place of 2 cm passes
WORST_SCALE_Z = 4.0  # difference of the scales of line and turn over its σ. Doubled: a slip of 4 % passes


@dataclass(frozen=True, slots=True)
class MouseCalibration:
    """What was found of a mouse (1 for the first), with standard deviations."""

    mouse: int
    counts_per_m: float
    counts_per_m_std: float
    angle_deg: float
    angle_std_deg: float
    x_m: float  # position as the turns show it, relative to the mean of all mice, which the rig file states
    y_m: float
    position_std_m: float
    residual_mm: float  # rms over all drives, with the mouse where the rig file places it

    def as_dict(self) -> dict[str, int | float]:
        """The object that `calibrate mice --json` prints."""
        return {name: round(getattr(self, name), 5) for name in self.__slots__}


@dataclass(frozen=True, slots=True)
class _DriveSums:
    """Sums over one recording."""

    name: str
    counts: NDArray[np.complex128]  # (M,) of each mouse
    turn_rad: float  # by the gyro
    turns: int  # full ones


def calibrate_mice(recordings: Sequence[Recording], rig: Rig, length_m: float | None) -> list[MouseCalibration]:
    """Calibration of each mouse that the rig places. `length_m` is the length of every line; None if unknown.

    Raises LinkposeError naming the drive and the cure for a rig without mice, a motion that is missing or is neither a
    line nor full turns, a recording that does not cover the whole motion, a mouse without counts, and mice that
    contradict their positions or the length.
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
    fit = _solve(drives, places, length_m)
    _check_fit(fit)
    common_std = _scale_disagreement(drives, places, fit) if length_m is not None and len(places) > 1 else 0.0
    return [_described(i, places, fit, drives, common_std) for i in range(len(places))]


def with_calibration(rig: Rig, found: Sequence[MouseCalibration]) -> Rig:
    """The rig with the scales and angles as they were found."""
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
            f"{name} turns by {math.degrees(turn):.0f}°, so it is neither a straight line nor full turns; repeat the "
            "drive"
        )
    total = counts[first:last].sum(axis=0)
    if not turns:
        _check_line(name, counts[first:last], total)
    return _DriveSums(name, total[:, 0] + 1j * total[:, 1], turn, turns)


def _check_line(name: str, counts: Floats, total: Floats) -> None:
    """Every mouse must count over the whole line."""
    size = np.hypot(total[:, 0], total[:, 1])
    worst = int(np.argmin(size))
    if size[worst] < 0.1 * size.max() or not counts[len(counts) // 2 :, worst].any():
        raise LinkposeError(
            f"{name}: mouse {worst + 1} counts {size[worst]:.0f} while another counts {size.max():.0f}; check that it "
            "lies flat on the floor and that its plug sits, then repeat the drive"
        )
    if size[worst] < FEWEST_COUNTS:
        raise LinkposeError(
            f"{name}: mouse {worst + 1} counts only {size[worst]:.0f}; drive a longer line, of a metre or more"
        )


def _check_whole(name: str, m: Measurements, counts: Floats, first: int, last: int) -> None:
    """Every movement must be in the recording."""
    away = np.argwhere(np.isnan(counts[first:last]).any(axis=2))
    if len(away):
        row, mouse = away[0]
        when = m.time_s[first + row]
        raise LinkposeError(
            f"{name}: mouse {mouse + 1} is away at {when:.2f} s, while the robot moves; repeat the drive"
        )
    lost = np.flatnonzero(m.flags[first + 1 : last] & int(SampleFlags.GAP_BEFORE))
    if len(lost):
        when = m.time_s[first + 1 + lost[0]]
        raise LinkposeError(
            f"{name}: samples were lost before {when:.2f} s, and their counts with them; repeat the drive"
        )


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


@dataclass(frozen=True, slots=True)
class _Fit:
    """Least-squares solution for M mice: g_i (real, imaginary part), then δp_i (x, y), then what belongs to drives."""

    mice: int
    design: Floats  # each row over its standard deviation
    target: Floats
    solution: Floats
    covariance: Floats  # widened where the fit is worse than its standard deviations
    owner: NDArray[np.int64]  # the mouse of each row, -1 for none

    @property
    def residual(self) -> Floats:
        """Of each row, over its standard deviation."""
        return np.asarray(self.target - self.design @ self.solution)


class _Equations:
    """Rows of the design matrix and of the right-hand side, each divided by its standard deviation."""

    def __init__(self, width: int) -> None:
        self._width = width
        self.rows: list[Floats] = []
        self.target: list[float] = []
        self.owner: list[int] = []

    def add(self, owner: int, std: float, terms: Sequence[tuple[int, complex]], value: complex) -> None:
        """A complex equation: `terms` are a column and the complex factor of the real number in it."""
        for part in (np.real, np.imag):
            self.add_real(owner, std, [(column, float(part(factor))) for column, factor in terms], float(part(value)))

    def add_real(self, owner: int, std: float, terms: Sequence[tuple[int, float]], value: float) -> None:
        """A real equation."""
        row = np.zeros(self._width)
        for column, factor in terms:
            row[column] += factor
        self.rows.append(row / std)
        self.target.append(value / std)
        self.owner.append(owner)


def _solve(drives: Sequence[_DriveSums], places: NDArray[np.complex128], length_m: float | None) -> _Fit:
    """The fit to all drives. Raises LinkposeError where they do not determine the scale."""
    mice = len(places)
    width = 4 * mice + sum(3 if drive.turns else 1 for drive in drives) + (length_m is None)
    equations, own = _Equations(width), 4 * mice
    for i in range(mice):
        at = 2 * mice + 2 * i
        equations.add(i, PLACE_STD_M, ((at, 1.0), (at + 1, 1j)), 0.0)
    for drive in drives:
        if drive.turns:
            _add_turn(equations, drive, places, own)
        else:
            _add_line(equations, drive, places, own, length_m)
        own += 3 if drive.turns else 1
    design, target = np.array(equations.rows), np.array(equations.target)
    scale = np.linalg.norm(design, axis=0)  # counts and radians side by side
    scaled = design / scale
    weak = _without_priors(scaled, mice, drives)
    if np.linalg.matrix_rank(weak) < weak.shape[1]:
        raise LinkposeError("these drives do not determine the scale; measure the length of the line and give it")
    solution = np.linalg.lstsq(scaled, target, rcond=None)[0] / scale
    residual = target - design @ solution
    freedom = len(target) - width
    worse = max(1.0, float(residual @ residual) / freedom) if freedom > 0 else 1.0
    covariance = np.linalg.inv(scaled.T @ scaled) * worse / np.outer(scale, scale)
    return _Fit(mice, design, target, solution, covariance, np.array(equations.owner))


def _add_turn(equations: _Equations, drive: _DriveSums, places: NDArray[np.complex128], own: int) -> None:
    mice, turn = len(places), FULL_TURN * drive.turns
    for i, (c, place) in enumerate(zip(drive.counts.tolist(), places.tolist(), strict=True)):
        at = 2 * mice + 2 * i
        equations.add(
            i, WAY_STD_M * math.sqrt(abs(drive.turns)),
            ((2 * i, c), (2 * i + 1, 1j * c), (own, -1.0), (own + 1, -1j), (own + 2, -1j * place), (at, -1j * turn),
             (at + 1, turn)),
            1j * turn * place,
        )  # fmt: skip
    equations.add_real(-1, CLOSING_STD_RAD, ((own + 2, 1.0),), 0.0)


def _add_line(
    equations: _Equations, drive: _DriveSums, places: NDArray[np.complex128], own: int, length_m: float | None
) -> None:
    for i, (c, place) in enumerate(zip(drive.counts.tolist(), places.tolist(), strict=True)):
        terms = [(2 * i, c), (2 * i + 1, 1j * c), (own, -1j * place)]
        if length_m is None:
            terms.append((-1, -1.0))
        equations.add(i, WAY_STD_M, terms, length_m or 0.0)
    equations.add_real(-1, GYRO_STD_RAD, ((own, 1.0),), drive.turn_rad)


def _without_priors(design: Floats, mice: int, drives: Sequence[_DriveSums]) -> Floats:
    """The design with exact positions and closed turns: what is unknown there is unknown with small errors too."""
    columns, own = list(range(2 * mice)), 4 * mice
    for drive in drives:
        columns += [own, own + 1] if drive.turns else [own]
        own += 3 if drive.turns else 1
    columns += range(own, design.shape[1])
    return np.asarray(design[2 * mice :, columns])


def _check_fit(fit: _Fit) -> None:
    residual = np.abs(fit.residual)
    worst = int(np.argmax(residual))
    if residual[worst] > WORST_MISFIT:
        whose = f", mouse {fit.owner[worst] + 1} most of all" if fit.mice > 2 and fit.owner[worst] >= 0 else ""
        raise LinkposeError(
            f"the {fit.mice} mice contradict one another ({residual[worst]:.0f} standard deviations{whose}): check "
            "their x_m and y_m in the rig file, the --length of the line, and that no mouse slipped or died"
        )


def _scale_disagreement(drives: Sequence[_DriveSums], places: NDArray[np.complex128], fit: _Fit) -> float:
    """By how much the scales of line and turn differ beyond their σ, as a share. Raises LinkposeError for too much."""
    by_turn = _solve(drives, places, None)
    scale, scale_std = _mean_scale(fit)
    turn_scale, turn_std = _mean_scale(by_turn)
    off, std = turn_scale / scale - 1.0, math.hypot(scale_std, turn_std)
    if abs(off) > WORST_SCALE_Z * std:
        raise LinkposeError(
            f"line and turn contradict each other: by the turn, the mice count {100 * abs(off):.1f} % "
            f"{'fewer' if off > 0 else 'more'} per metre than by the line. Check --length and the x_m and y_m of the "
            "mice, and repeat both on a floor on which no mouse slips"
        )
    return math.sqrt(max(0.0, off * off - std * std))


def _mean_scale(fit: _Fit) -> tuple[float, float]:
    """Mean metres per count of all mice, and its standard deviation as a share."""
    g = fit.solution[: 2 * fit.mice].reshape(-1, 2)
    size = np.hypot(*g.T)
    gradient = (g / size[:, None]).ravel() / fit.mice
    mean = float(size.mean())
    variance = float(gradient @ fit.covariance[: 2 * fit.mice, : 2 * fit.mice] @ gradient)
    return mean, math.sqrt(variance) / mean


def _residual_mm(i: int, fit: _Fit, drives: Sequence[_DriveSums]) -> float:
    """The rms (mm) of a mouse's residuals over all drives, with the mouse at its place in the rig file."""
    at_rig = fit.solution.copy()
    at_rig[2 * fit.mice : 4 * fit.mice] = 0.0
    off = fit.target - fit.design @ at_rig
    squares: list[float] = []
    first = 2 * fit.mice  # after the rows of the positions
    for drive in drives:
        std = WAY_STD_M * math.sqrt(max(1, abs(drive.turns)))
        squares += [(std * value) ** 2 for value in off[first + 2 * i : first + 2 * i + 2].tolist()]
        first += 2 * fit.mice + 1
    return 1e3 * math.sqrt(sum(squares) / len(squares))


def _described(
    i: int, places: NDArray[np.complex128], fit: _Fit, drives: Sequence[_DriveSums], common_std: float
) -> MouseCalibration:
    """The result for one mouse; `common_std` is a further error of all scales, as a share."""
    g = complex(*fit.solution[2 * i : 2 * i + 2])
    along = np.array([g.real, g.imag]) / abs(g)
    across = np.array([-along[1], along[0]])
    part = fit.covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2]
    at = 2 * fit.mice + 2 * i
    return MouseCalibration(
        mouse=i + 1,
        counts_per_m=1 / abs(g),
        counts_per_m_std=math.hypot(math.sqrt(along @ part @ along) / abs(g), common_std) / abs(g),
        angle_deg=math.degrees(math.atan2(g.imag, g.real)),
        angle_std_deg=math.degrees(math.sqrt(across @ part @ across) / abs(g)),
        x_m=places[i].real + float(fit.solution[at]),
        y_m=places[i].imag + float(fit.solution[at + 1]),
        position_std_m=math.sqrt(0.5 * float(fit.covariance[at, at] + fit.covariance[at + 1, at + 1])),
        residual_mm=_residual_mm(i, fit, drives),
    )
