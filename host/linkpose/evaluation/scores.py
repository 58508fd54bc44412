"""Scores of the filters in an estimate file against a reference."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.evaluation.series import Series, difference, find_offset, paired
from linkpose.recording.table import Table
from linkpose.sensors.measurements import Floats

# What an estimate's column ends with is what the reference's column is called. Longest first: `_vx_m_s` is not `_x_m`.
_LINK = ("height_m", "roll_deg", "pitch_deg")
_PLANAR = ("vx_m_s", "vy_m_s", "wz_rad_s", "x_m", "y_m", "heading_rad")
_POSE = ("x_m", "y_m", "heading_rad")
_ODOMETRIC = ("mice", "planar-ekf", "planar-ukf")  # their poses count from where the robot stood at their first sample
_UNRELATED = 0.9  # share of the reference's motion that is left when even the best filter's is taken away
_SAME_TILT_DEG = 30.0
_ANGLES = {"roll_deg": np.pi / 180, "pitch_deg": np.pi / 180, "heading_rad": 1.0}  # radians in a unit


@dataclass(frozen=True, slots=True)
class Score:
    """Root mean square errors of one filter; only of what the reference has."""

    filter: str
    rows: int  # instants that were compared
    errors: dict[str, float]  # by the names of the JSON keys, in their units
    time_offset_s: float  # added to the estimate's clock to have the reference's
    is_planar: bool

    def as_dict(self) -> dict[str, str | int | float]:
        """The object that `evaluate --json` prints."""
        offset = {} if self.is_planar else {"time_offset_s": round(self.time_offset_s, 6)}
        return {"filter": self.filter, "rows": self.rows, **self.errors, **offset}


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The scores of all filters in a file, in its order."""

    scores: list[Score]
    remarks: list[str]  # what makes the comparison itself doubtful


def evaluate(estimate: Table, reference: Table) -> Evaluation:
    """Compares all filters of the estimate with the reference, on one common offset between the two clocks.

    Raises LinkposeError where the files have nothing in common: no filter, no quantity, no time.
    """
    estimate.require("time_s")
    reference.require("time_s")
    found = _filters(estimate)
    known = [q for q in (*_LINK, *_PLANAR) if q in reference.columns]
    if not known:
        raise LinkposeError(
            f"{reference.path} is no reference: it has {', '.join(reference.columns)}, "
            f"and none of {', '.join((*_LINK, *_PLANAR))}"
        )
    truth = {q: _series(reference, q, q) for q in known}
    pairs = {}
    for name, columns in found.items():
        both = {q: (_series(estimate, column, q), truth[q]) for q, column in columns.items() if q in truth}
        if both:
            pairs[name] = both
    if not pairs:
        raise LinkposeError(
            f"{reference.path} has {', '.join(known)}, and no filter in {estimate.path} estimates any of it"
        )
    offsets = [find_offset(list(both.values())) for both in pairs.values()]
    offset_s, residual = min(offsets, key=lambda found: found[1])
    scores = [_score(estimate, reference, name, both, offset_s) for name, both in pairs.items()]
    return Evaluation(scores, _doubts(estimate, reference, pairs.values(), offset_s, residual))


def _doubts(
    estimate: Table,
    reference: Table,
    compared: Collection[Mapping[str, tuple[Series, Series]]],
    offset_s: float,
    residual: float,
) -> list[str]:
    """What speaks against one run, or one frame, in both files."""
    both_files = f"{estimate.path} and {reference.path}"
    tilts = [both for both in compared if "roll_deg" in both and "pitch_deg" in both]
    apart = min((_tilt_apart_deg(both, offset_s) for both in tilts), default=0.0)
    if apart > _SAME_TILT_DEG:
        cure = (
            "try the other axis with --up y or z, and check the order of the markers"
            if reference.kind == "motive"
            else "are they of the same run, and of the same axes?"
        )
        return [f"{both_files} have their tilts {apart:.0f}° apart (median, the nearest filter's): {cure}"]
    is_link = any(quantity in _LINK for both in compared for quantity in both)  # odometry may count from elsewhere
    if is_link and _UNRELATED < residual < np.inf:
        return [f"{both_files} have hardly any motion in common, whatever the offset: are they of the same run?"]
    return []


def _tilt_apart_deg(both: Mapping[str, tuple[Series, Series]], offset_s: float) -> float:
    """Median angle between the two verticals, seen by the sensor; 0 without an instant in common."""
    roll, pitch = (np.array(paired(*both[quantity], offset_s)) for quantity in ("roll_deg", "pitch_deg"))
    z = np.stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])  # (3, 2, N)
    angle = np.arccos(np.clip((z[:, 0] * z[:, 1]).sum(axis=0), -1.0, 1.0))
    return float(np.degrees(np.median(angle[np.isfinite(angle)]))) if np.isfinite(angle).any() else 0.0


def _filters(table: Table) -> dict[str, dict[str, str]]:
    """Filter -> quantity -> column."""
    found: dict[str, dict[str, str]] = {}
    for column in table.columns:
        for quantity in (*_LINK, *_PLANAR):
            if column.endswith("_" + quantity):
                name = column.removesuffix("_" + quantity).replace("_", "-")
                found.setdefault(name, {})[quantity] = column
                break
    if not found:
        raise LinkposeError(
            f"{table.path} holds no estimates: type `linkpose estimate {table.path} -o ESTIMATE.csv` first"
            if table.kind == "recording"
            else f"{table.path} holds no estimates: no column is named like joint_height_m or mice_vx_m_s"
        )
    return found


def _series(table: Table, column: str, quantity: str) -> Series:
    value = table.columns[column]
    return Series(table.columns["time_s"], value * _ANGLES.get(quantity, 1.0), quantity in _ANGLES)


def _score(
    estimate: Table, reference: Table, name: str, both: Mapping[str, tuple[Series, Series]], offset_s: float
) -> Score:
    errors = {quantity: difference(ours, theirs, offset_s) for quantity, (ours, theirs) in both.items()}
    is_planar = not any(quantity in _LINK for quantity in errors)
    if name in _ODOMETRIC and all(quantity in errors for quantity in _POSE):
        errors |= _from_common_start({q: paired(*both[q], offset_s)[0] for q in _POSE}, errors)
    compared = np.logical_or.reduce([np.isfinite(error) for error in errors.values()])
    if not compared.any():
        raise LinkposeError(
            f"{estimate.path} and {reference.path} have no instant in common for {name}: "
            "check that they are of the same run"
        )
    errors = {quantity: error for quantity, error in errors.items() if np.isfinite(error).any()}
    rms = _planar(errors) if is_planar else _link(errors)
    return Score(name, int(compared.sum()), rms, offset_s, is_planar)


def _from_common_start(pose: Mapping[str, Floats], errors: Mapping[str, Floats]) -> dict[str, Floats]:
    """Errors of a pose (x, y, heading) moved as a whole to agree with the reference at the first common instant."""
    both = np.flatnonzero(np.logical_and.reduce([np.isfinite(errors[quantity]) for quantity in _POSE]))
    if not len(both):
        return {}
    first = both[0]
    turn = -errors["heading_rad"][first]
    x, y = (pose[quantity] - pose[quantity][first] for quantity in ("x_m", "y_m"))
    moved_x, moved_y = np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y
    return {
        "x_m": moved_x - x + errors["x_m"] - errors["x_m"][first],
        "y_m": moved_y - y + errors["y_m"] - errors["y_m"][first],
        "heading_rad": (errors["heading_rad"] + turn + np.pi) % (2 * np.pi) - np.pi,
    }


def _link(errors: Mapping[str, Floats]) -> dict[str, float]:
    units = {"height_m": ("height_rmse_cm", 100.0), "roll_deg": ("roll_rmse_deg", 180 / np.pi)}
    units["pitch_deg"] = ("pitch_rmse_deg", 180 / np.pi)
    return {key: scale * _rms(errors[q]) for q, (key, scale) in units.items() if q in errors}


def _planar(errors: Mapping[str, Floats]) -> dict[str, float]:
    rms: dict[str, float] = {}
    if "vx_m_s" in errors and "vy_m_s" in errors:
        rms["velocity_rmse_m_s"] = _rms(np.hypot(errors["vx_m_s"], errors["vy_m_s"]))
    if "wz_rad_s" in errors:
        rms["rate_rmse_rad_s"] = _rms(errors["wz_rad_s"])
    if "x_m" in errors and "y_m" in errors:
        rms["position_rmse_m"] = _rms(np.hypot(errors["x_m"], errors["y_m"]))
    if "heading_rad" in errors:
        rms["heading_rmse_rad"] = _rms(errors["heading_rad"])
    return rms


def _rms(error: Floats) -> float:
    return float(np.sqrt(np.nanmean(error**2)))
