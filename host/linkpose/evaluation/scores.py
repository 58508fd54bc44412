"""Scores of the filters in an estimate file against a reference."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from linkpose.errors import LinkposeError, TooFewRows
from linkpose.evaluation.errors import COMPONENTS, Errors, errors_of, scored, yaw_drift_deg_per_min
from linkpose.evaluation.series import Series, find_offset, is_sparser, paired
from linkpose.evaluation.statistics import Statistics
from linkpose.evaluation.takes import MOTION_CAPTURE
from linkpose.quantities import (
    ANGLE,
    CHAIN_ROTATION,
    HEADING,
    HEIGHT,
    HEIGHT1,
    HEIGHT2,
    PITCH,
    ROLL,
    ROTATION,
    VX,
    VY,
    WZ,
    YAW,
    Quantity,
    X,
    Y,
    Z,
    by_filter,
    std_column,
)
from linkpose.recording.table import Table
from linkpose.sensors.measurements import Floats

_CHAIN = (ANGLE, *CHAIN_ROTATION, HEIGHT1, HEIGHT2)
_LINK = (HEIGHT, ROLL, PITCH, YAW, *_CHAIN)
_SCORED = (*_LINK, VX, VY, WZ, X, Y, HEADING, Z)
_UNRELATED = 0.9  # share of the reference's motion that remains when even the best filter's is subtracted
_SAME_TILT_DEG = 30.0
_FEWEST = 0.5  # share of a filter's rows that must have a reference

Pair = tuple[Series, Series]  # estimate, reference
Window = tuple[float, float]  # s, on the estimate's clock


@dataclass(frozen=True, slots=True)
class Score:
    """Errors of one filter, only of quantities that the reference has."""

    filter: str
    rows: int  # instants that were compared
    known_rows: int  # instants at which the filter has an estimate
    empty_rows: int  # instants at which it has none yet: left out, not scored
    time_offset_s: float  # added to the estimate's clock to get the reference's
    is_planar: bool
    errors: dict[str, Errors] = field(default_factory=dict)  # by name: height, roll, position, ...
    yaw_drift_deg_per_min: float | None = None

    def statistics(self) -> dict[str, Statistics]:
        """By quantity."""
        return {name: errors.statistics() for name, errors in self.errors.items()}

    def as_dict(self) -> dict[str, Any]:
        """The object that `evaluate --json` prints.

        The RMSE of a vector is one figure; its components have only NEES and share within 2σ.
        """
        found = self.statistics()
        components = {q.name for q in COMPONENTS}
        row: dict[str, Any] = {"filter": self.filter, "rows": self.rows}
        for name, value in found.items():
            if name not in components:
                row[f"{name}_rmse_{self.errors[name].unit}"] = value.rmse
        if self.yaw_drift_deg_per_min is not None:
            row["yaw_drift_deg_per_min"] = self.yaw_drift_deg_per_min
        if not self.is_planar:
            row["time_offset_s"] = round(self.time_offset_s, 6)
        row |= {"known_rows": self.known_rows, "empty_rows": self.empty_rows}
        for name, value in found.items():
            if value.nees is not None:
                row |= {f"{name}_nees": value.nees, f"{name}_within_2sigma": value.within_2sigma}
        row["quantities"] = {name: _details(self.errors[name].unit, value) for name, value in found.items()}
        return row


def _details(unit: str, value: Statistics) -> dict[str, Any]:
    details: dict[str, Any] = {"unit": unit, "rows": value.rows, "rmse": value.rmse, "mean": value.mean}
    details |= {"worst": value.worst, "p95": value.p95}
    if value.nees is not None:
        details |= {"nees": value.nees, "within_2sigma": value.within_2sigma}
    return details


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The scores of all filters in a file, in its order."""

    scores: list[Score]
    remarks: list[str]  # why the comparison itself may be doubtful


def evaluate(estimate: Table, reference: Table, from_s: float | None = None, to_s: float | None = None) -> Evaluation:
    """Compares all filters of the estimate with the reference, with one common offset between the two clocks.

    `from_s` and `to_s` limit the comparison on the estimate's clock (s). The offset, and the common start of poses
    without an absolute origin, come from the whole files. Raises LinkposeError where the files have nothing in common
    (no filter, no quantity, no time), or where less than half of a filter's rows have a reference.
    """
    estimate.require("time_s")
    reference.require("time_s")
    compared = _pairs(estimate, reference)
    offset_s, residual = _common_offset(compared.values())
    window = (-np.inf if from_s is None else from_s, np.inf if to_s is None else to_s)
    scores = [_score(estimate, reference, name, both, offset_s, window) for name, both in compared.items()]
    return Evaluation(scores, _mismatches(estimate, reference, compared.values(), offset_s, residual))


# ---- what can be compared ----


def _pairs(estimate: Table, reference: Table) -> dict[str, dict[Quantity, Pair]]:
    """Filter -> quantity -> (estimate, reference)."""
    found = _filters(estimate)
    known = {q: column for q in _SCORED if (column := _reference_column(reference, q))}
    if not known:
        raise LinkposeError(
            f"{reference.path} is no reference: it has {', '.join(reference.columns)}, "
            f"and none of {', '.join(q.column for q in _SCORED)}"
        )
    pairs: dict[str, dict[Quantity, Pair]] = {}
    for name, columns in found.items():
        both = {
            q: (_series(estimate, column, q), _series(reference, known[q], q))
            for q, column in columns.items()
            if q in known
        }
        if not all(q in both for q in CHAIN_ROTATION):
            both = {q: pair for q, pair in both.items() if q not in CHAIN_ROTATION}
        if both:
            pairs[name] = both
    if not pairs:
        raise LinkposeError(
            f"{reference.path} has {', '.join(known.values())}, and no filter in {estimate.path} estimates any of it"
        )
    return pairs


def _filters(estimate: Table) -> dict[str, dict[Quantity, str]]:
    """Filter -> quantity that can be scored -> column."""
    found = {}
    for name, columns in by_filter(estimate.columns).items():
        kept = {q: column for q, column in columns.items() if q in _SCORED}
        if kept:
            found[name] = kept
    if not found:
        raise LinkposeError(
            f"{estimate.path} holds no estimates: type `linkpose estimate {estimate.path} -o ESTIMATE.csv` first"
            if estimate.kind == "recording"
            else f"{estimate.path} holds no estimates: no column is named like joint_height_m or mice_vx_m_s"
        )
    return found


def _reference_column(reference: Table, quantity: Quantity) -> str | None:
    """The reference's column of a quantity. A chain's column may have the filter's prefix; z is the height."""
    names = [quantity.column]
    names += [f"chain_{quantity.column}"] if quantity in _CHAIN else []
    names += [HEIGHT.column] if quantity is Z else []
    return next((name for name in names if name in reference.columns), None)


def _series(table: Table, column: str, quantity: Quantity) -> Series:
    """The column as a signal; angles in radians, a quaternion's numbers with the signs that make it continuous."""
    value = table.columns[column] * quantity.radians
    if quantity in CHAIN_ROTATION:
        prefix = column.removesuffix(quantity.column)
        value = value * _continuous_sign(np.stack([table.columns[f"{prefix}{q.column}"] for q in CHAIN_ROTATION]))
    stamped = np.isfinite(table.columns["time_s"])
    return Series(table.columns["time_s"][stamped], value[stamped], quantity.is_angle)


def _continuous_sign(q: Floats) -> Floats:
    """Signs (N,) that keep neighbours of the quaternions (4, N) in one hemisphere: q and −q are one rotation."""
    known = np.flatnonzero(np.isfinite(q).all(axis=0))
    sign = np.ones(q.shape[1])
    if len(known):
        seen = q[:, known]
        turned = np.where((seen[:, 1:] * seen[:, :-1]).sum(axis=0) < 0, -1.0, 1.0)
        sign[known] = np.concatenate([[1.0], np.cumprod(turned)])
    return sign


def _common_offset(compared: Iterable[Mapping[Quantity, Pair]]) -> tuple[float, float]:
    """The offset (s) of the filter that fits best, and its residual."""
    offsets = [find_offset(pairs) for both in compared if (pairs := _comparable(both))]
    return min(offsets, key=lambda found: found[1]) if offsets else (0.0, np.inf)


def _comparable(both: Mapping[Quantity, Pair]) -> list[Pair]:
    """The pairs that move alike. A link's x and y do not where the two count yaw from different directions."""
    unaligned = (YAW, *CHAIN_ROTATION, *((X, Y) if YAW in both else ()))
    return [pair for q, pair in both.items() if q not in unaligned]


# ---- signs of a mismatch ----


def _mismatches(
    estimate: Table,
    reference: Table,
    compared: Collection[Mapping[Quantity, Pair]],
    offset_s: float,
    residual: float,
) -> list[str]:
    """Evidence that the files are of different runs or frames."""
    both_files = f"{estimate.path} and {reference.path}"
    tilts = [both for both in compared if ROLL in both and PITCH in both]
    apart = min((_tilt_apart_deg(both, offset_s) for both in tilts), default=0.0)
    if apart > _SAME_TILT_DEG:
        cure = (
            "try the other axis with --up y or z, and check the order of the markers"
            if reference.kind == MOTION_CAPTURE
            else "are they of the same run, and of the same axes?"
        )
        return [f"{both_files} have their tilts {apart:.0f}° apart (median, the nearest filter's): {cure}"]
    is_link = any(quantity in _LINK for both in compared for quantity in both)  # odometry may count from elsewhere
    if is_link and _UNRELATED < residual < np.inf:
        return [f"{both_files} have hardly any motion in common, whatever the offset: are they of the same run?"]
    return []


def _tilt_apart_deg(both: Mapping[Quantity, Pair], offset_s: float) -> float:
    """Median angle between the two verticals, in the sensor's axes; 0 without an instant in common."""
    roll, pitch = (np.array(paired(*both[quantity], offset_s)) for quantity in (ROLL, PITCH))
    z = np.stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])  # (3, 2, N)
    angle = np.arccos(np.clip((z[:, 0] * z[:, 1]).sum(axis=0), -1.0, 1.0))
    return float(np.degrees(np.median(angle[np.isfinite(angle)]))) if np.isfinite(angle).any() else 0.0


# ---- one filter ----


def _score(
    estimate: Table,
    reference: Table,
    name: str,
    both: Mapping[Quantity, Pair],
    offset_s: float,
    window: Window,
) -> Score:
    at = {q: paired(*pair, offset_s) for q, pair in both.items()}
    ours, theirs = ({q: values[side] for q, values in at.items()} for side in (0, 1))
    time_s = _instants(*next(iter(both.values())), offset_s)
    inside = (time_s >= window[0]) & (time_s <= window[1])
    errors = {q: np.where(inside, error, np.nan) for q, error in errors_of(name, ours, theirs).items()}
    errors = {q: error for q, error in errors.items() if np.isfinite(error).any()}
    if not errors:
        raise LinkposeError(
            f"{estimate.path} and {reference.path} have no instant in common for {name}: "
            "check that they are of the same run"
        )
    rows = int(np.logical_or.reduce([np.isfinite(error) for error in errors.values()]).sum())
    known, empty = _known_rows(both, window)
    if rows < _FEWEST * known:
        common = time_s[_any_finite(errors)]
        raise TooFewRows(name, (estimate.path, reference.path), (rows, known), (float(common[0]), float(common[-1])))
    is_planar = not any(q in _LINK for q in both)
    std = _std(estimate, name, both, offset_s)
    drift = yaw_drift_deg_per_min(time_s, errors[YAW]) if YAW in errors else None
    return Score(name, rows, known, empty, offset_s, is_planar, scored(time_s, errors, std, is_planar), drift)


def _any_finite(errors: Mapping[Quantity, Floats]) -> Any:
    return np.logical_or.reduce([np.isfinite(error) for error in errors.values()])


def _instants(estimate: Series, reference: Series, offset_s: float) -> Floats:
    """The instants of `paired`, on the estimate's clock."""
    return reference.time_s - offset_s if is_sparser(reference, estimate) else estimate.time_s


def _std(estimate: Table, name: str, both: Mapping[Quantity, Pair], offset_s: float) -> dict[Quantity, Floats]:
    """σ of each quantity that has one, at the instants of `paired`, in the column's unit, angles in radians."""
    columns, found = _filters(estimate)[name], {}
    for quantity, pair in both.items():
        column = std_column(columns[quantity]) or ""
        if column in estimate.columns:
            of = ROTATION if quantity in CHAIN_ROTATION else quantity
            value = estimate.columns[column][np.isfinite(estimate.columns["time_s"])] * of.radians
            found[of] = paired(Series(pair[0].time_s, value), pair[1], offset_s)[0]
    return found


def _known_rows(both: Mapping[Quantity, Pair], window: Window) -> tuple[int, int]:
    """How many instants of the comparison have an estimate, and how many have none, inside the window."""
    estimate, reference = next(iter(both.values()))
    known = np.logical_or.reduce([np.isfinite(ours.value) for ours, _ in both.values()])
    inside = (estimate.time_s >= window[0]) & (estimate.time_s <= window[1])
    if not is_sparser(reference, estimate):
        return int((known & inside).sum()), int((~known & inside).sum())
    share = estimate.interval_s / reference.interval_s
    stamps, empty = (len(np.unique(estimate.time_s[part & inside])) for part in (known, ~known))
    return round(share * stamps), round(share * empty)
