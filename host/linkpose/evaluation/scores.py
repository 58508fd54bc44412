"""Scores of the filters in an estimate file against a reference."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from linkpose.errors import LinkposeError, listed
from linkpose.evaluation.mismatches import mismatches
from linkpose.evaluation.scoring import CHAIN, LINK, Compared, Score, Scorer, Window, scores_of
from linkpose.evaluation.series import Lag, Pair, Series, find_offset
from linkpose.quantities import (
    CHAIN_ROTATION,
    HEADING,
    HEIGHT,
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

SCORED = (*LINK, VX, VY, WZ, X, Y, HEADING, Z)


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The scores of all filters in a file, in its order."""

    scores: list[Score]
    remarks: list[str]  # why the comparison itself may be unreliable


def evaluate(estimate: Table, reference: Table, from_s: float | None = None, to_s: float | None = None) -> Evaluation:
    """Compares all filters of the estimate with the reference, with one common offset between the two clocks.

    `from_s` and `to_s` limit the comparison on the estimate's clock (s). The offset, and the common start of poses
    without an absolute origin, come from the whole files. Raises LinkposeError where the files have nothing in common
    (no filter, no quantity, no time), or where less than half of a filter's rows have a reference.
    """
    estimate.require("time_s")
    reference.require("time_s")
    compared = pairs_of(estimate, reference)
    offset_s, residual = common_offset(compared.values())
    scorers = []
    for name, both in compared.items():
        most = max(len(estimate), len(reference))
        paths = estimate.path, reference.path
        scorers.append(Scorer(name, paths, offset_s, window_of(from_s, to_s), most, both.empty))
        scorers[-1].add(both)
    scores, without = scores_of(scorers)
    return Evaluation(scores, mismatches(estimate, reference, compared, offset_s, residual) + without)


def window_of(from_s: float | None, to_s: float | None) -> Window:
    """From where to where errors are scored, s; None: from the start, to the end."""
    return -np.inf if from_s is None else from_s, np.inf if to_s is None else to_s


# ---- what can be compared ----


def pairs_of(estimate: Table, reference: Table) -> dict[str, Compared]:
    """What each filter and the reference have in common. Raises LinkposeError where it is nothing."""
    found = _filters(estimate)
    known = {q: column for q in SCORED if (column := _reference_column(reference, q))}
    if not known:
        raise LinkposeError(
            f"{reference.path} is no reference: it has {listed(reference.columns)}, "
            f"and none of {', '.join(q.column for q in SCORED)}"
        )
    compared: dict[str, Compared] = {}
    theirs = {q: _series(reference, column, q) for q, column in known.items()}
    for name, columns in found.items():
        ours = {q: column for q, column in columns.items() if q in known}
        if not all(q in ours for q in CHAIN_ROTATION):
            ours = {q: column for q, column in ours.items() if q not in CHAIN_ROTATION}
        if ours:
            pairs = {q: (_series(estimate, column, q), theirs[q]) for q, column in ours.items()}
            compared[name] = Compared(pairs, _std(estimate, ours))
    if not compared:
        raise LinkposeError(
            f"{reference.path} has {', '.join(known.values())}, and no filter in {estimate.path} estimates any of it"
        )
    return compared


def _std(estimate: Table, columns: Mapping[Quantity, str]) -> dict[Quantity, Series]:
    """σ of each quantity that has one, in the column's unit, angles in radians."""
    found = {}
    for quantity, column in columns.items():
        sigma = std_column(column) or ""
        if sigma in estimate.columns:
            if (estimate.columns[sigma] < 0).any():
                raise LinkposeError(
                    f"{estimate.path}: {sigma} is negative, which no standard deviation is: remove the column"
                )
            of = ROTATION if quantity in CHAIN_ROTATION else quantity
            found[of] = _signal(estimate, estimate.columns[sigma] * of.radians)
    return found


def _filters(estimate: Table) -> dict[str, dict[Quantity, str]]:
    """Filter -> quantity that can be scored -> column."""
    found = {}
    for name, columns in by_filter(estimate.columns).items():
        kept = {q: column for q, column in columns.items() if q in SCORED}
        if kept:
            found[name] = kept
    if not found:
        raise LinkposeError(
            f"{estimate.path} holds no estimates: type `linkpose estimate {estimate.path} -o ESTIMATE.csv` first"
            if estimate.kind == "recording"
            else f"{estimate.path} holds no estimates: no column is named like joint_height_m or mice_vx_m_s; the "
            "estimate comes first, then the reference"
        )
    return found


def _reference_column(reference: Table, quantity: Quantity) -> str | None:
    """The reference's column of a quantity. A chain's column may have the filter's prefix; z is the height."""
    names = [quantity.column]
    names += [f"chain_{quantity.column}"] if quantity in CHAIN else []
    names += [HEIGHT.column] if quantity is Z else []
    return next((name for name in names if name in reference.columns), None)


def _series(table: Table, column: str, quantity: Quantity) -> Series:
    """The column as a signal; angles in radians, a quaternion's numbers with the signs that make it continuous."""
    value = table.columns[column]
    if quantity.radians != 1.0:
        value = value * quantity.radians
    if quantity in CHAIN_ROTATION:
        prefix = column.removesuffix(quantity.column)
        value = value * _continuous_sign(np.stack([table.columns[f"{prefix}{q.column}"] for q in CHAIN_ROTATION]))
    return _signal(table, value, quantity.is_angle)


def _signal(table: Table, value: Floats, is_angle: bool = False) -> Series:
    """These values at the table's stamps."""
    time_s = table.columns["time_s"]
    stamped = np.isfinite(time_s[[0, -1]])  # the times increase
    if not stamped.all():
        stamped = np.isfinite(time_s)
        time_s, value = time_s[stamped], value[stamped]
    return Series(time_s, value, is_angle, table.whole.interval_s if table.whole else None)


def _continuous_sign(q: Floats) -> Floats:
    """Signs (N,) that keep neighbours of the quaternions (4, N) in one hemisphere: q and −q are one rotation."""
    known = np.flatnonzero(np.isfinite(q).all(axis=0))
    sign = np.ones(q.shape[1])
    if len(known):
        seen = q[:, known]
        turned = np.where((seen[:, 1:] * seen[:, :-1]).sum(axis=0) < 0, -1.0, 1.0)
        sign[known] = np.concatenate([[1.0], np.cumprod(turned)])
    return sign


def common_offset(compared: Iterable[Compared], near: Lag | None = None) -> tuple[float, float]:
    """The offset (s) of the filter that fits best, and its residual; `near` as for `find_offset`."""
    offsets = [find_offset(pairs, near) for both in compared if (pairs := comparable(both))]
    return min(offsets, key=lambda found: found[1]) if offsets else (0.0, np.inf)


def comparable(both: Compared) -> list[Pair]:
    """The pairs that move alike. A link's x and y do not where the two count yaw from different directions."""
    unaligned = (YAW, *CHAIN_ROTATION, *((X, Y) if YAW in both.pairs else ()))
    return [pair for q, pair in both.pairs.items() if q not in unaligned]
