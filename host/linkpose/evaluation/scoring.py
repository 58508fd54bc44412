"""Scores one filter against a reference, over consecutive stretches of time."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import LinkposeError, NoEstimate, TooFewRows
from linkpose.evaluation.errors import COMPONENTS, CommonStart, Drift, Errors, errors_of, scored
from linkpose.evaluation.series import Pair, Series, is_sparser, paired
from linkpose.evaluation.statistics import Collector, Statistics
from linkpose.quantities import ANGLE, BALL_ANGLES, CHAIN_ROTATION, HEIGHT, HEIGHT1, HEIGHT2, PITCH, ROLL, YAW, Quantity
from linkpose.recording.textfile import Part
from linkpose.recording.thinned import Thinner
from linkpose.sensors.measurements import Floats

CHAIN = (ANGLE, *BALL_ANGLES, *CHAIN_ROTATION, HEIGHT1, HEIGHT2)
LINK = (HEIGHT, ROLL, PITCH, YAW, *CHAIN)
_FEWEST = 0.5  # share of a filter's rows that must have a reference

Window = tuple[float, float]  # s, on the estimate's clock


@dataclass(frozen=True, slots=True)
class Compared:
    """What one filter and the reference have in common over a stretch of time."""

    pairs: dict[Quantity, Pair]
    std: dict[Quantity, Series]  # σ of the estimate by quantity, in the column's unit, angles in radians

    @property
    def empty(self) -> set[Quantity]:
        """Quantities of which the estimate or the reference has no value."""
        return {q for q, pair in self.pairs.items() if not all(np.isfinite(of.value).any() for of in pair)}


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


def scores_of(scorers: Iterable[Scorer]) -> tuple[list[Score], list[str]]:
    """The scores of the filters that estimated something, and a sentence for each other one.

    Raises NoEstimate if no filter did; otherwise as `Scorer.score`.
    """
    found, without = [], []
    for scorer in scorers:
        try:
            found.append(scorer.score())
        except NoEstimate as reason:
            without.append(reason)
    if not found:
        raise without[0]
    return found, [str(reason) for reason in without]


class Scorer:
    """Collects the errors of one filter over consecutive stretches of time."""

    def __init__(
        self,
        name: str,
        paths: tuple[Path, Path],
        offset_s: float,
        window: Window,
        most: int,
        empty: Collection[Quantity],
        start: CommonStart | None = None,
        thinner: Thinner | None = None,
    ) -> None:
        """For the filter `name` in the first of the two files, against the second.

        `offset_s` is added to the estimate's clock to get the reference's; there are at most `most` instants. `empty`
        are quantities without any value. `start` is the common start of all stretches; None: it is in the first one.
        `thinner` selects the errors that are kept for pictures; None: all.
        """
        self._name, self._paths, self._offset_s, self._window, self._most = name, paths, offset_s, window, most
        self._empty, self._start, self._thinner = empty, start, thinner
        self._is_planar = True
        self._drift = Drift()
        self._collectors: dict[str, Collector] = {}
        self._last: dict[str, Errors] = {}
        self._kept: list[Part] = []
        self._rows = self._stamps = self._empty_stamps = 0
        self._share = 1.0  # instants for one stamp of the estimate
        self._counted_to_s = -np.inf
        self._common_s: tuple[float, float] | None = None
        self._quantities: tuple[Quantity, ...] = ()

    def add(self, compared: Compared) -> None:
        """The next stretch of time."""
        both = compared.pairs
        self._quantities = tuple(both)
        at = {q: paired(*pair, self._offset_s) for q, pair in both.items()}
        ours, theirs = ({q: values[side] for q, values in at.items()} for side in (0, 1))
        time_s = _instants(*next(iter(both.values())), self._offset_s)
        inside = (time_s >= self._window[0]) & (time_s <= self._window[1])
        errors = errors_of(self._name, ours, theirs, self._start)
        errors = {q: np.where(inside, error, np.nan) for q, error in errors.items() if q not in self._empty}
        self._count(both, time_s, errors)
        if YAW in errors:
            self._drift.add(time_s, errors[YAW])
        self._is_planar = not any(q in LINK for q in both)
        reference = next(iter(both.values()))[1]
        std = {q: paired(sigma, reference, self._offset_s)[0] for q, sigma in compared.std.items()}
        self._collect(time_s, scored(time_s, errors, std, self._is_planar))

    def score(self) -> Score:
        """Of all stretches.

        Raises NoEstimate for a filter whose columns are empty, TooFewRows where less than half of its rows have a
        reference, LinkposeError where none has.
        """
        found = {name: collector.statistics() for name, collector in self._collectors.items() if collector.rows}
        if self._empty_stamps and not self._stamps:
            raise NoEstimate(self._name, self._paths[0], [q.name for q in self._quantities])
        if not found or self._common_s is None:
            raise LinkposeError(
                f"{self._paths[0]} and {self._paths[1]} have no instant in common for {self._name}: "
                "check that they are of the same run"
            )
        # Irregular stamps have no one interval, so that their share is approximate; a compared instant is a known one.
        known = max(self._rows, round(self._share * self._stamps))
        empty = round(self._share * self._empty_stamps)
        if self._rows < _FEWEST * known:
            raise TooFewRows(self._name, self._paths, (self._rows, known), self._common_s)
        kept = {name: np.concatenate([part.columns[name] for part in self._kept]) for name in self._kept[0].columns}
        errors = {
            name: replace(
                self._last[name], time_s=kept["time_s"], error=kept[name], std=kept.get(_std_of(name)), whole=of
            )
            for name, of in found.items()
        }
        drift = self._drift.deg_per_min
        return Score(self._name, self._rows, known, empty, self._offset_s, self._is_planar, errors, drift)

    def _count(self, both: Mapping[Quantity, Pair], time_s: Floats, errors: Mapping[Quantity, Floats]) -> None:
        """Counts instants with an error, and stamps with and without an estimate that were not counted before."""
        common = time_s[_any_finite(errors)] if errors else time_s[:0]
        self._rows += len(common)
        if len(common):
            first = self._common_s[0] if self._common_s else float(common[0])
            self._common_s = first, float(common[-1])
        estimate, reference = next(iter(both.values()))
        stamps = estimate.time_s
        known = np.logical_or.reduce([np.isfinite(ours.value) for ours, _ in both.values()])
        new = (stamps >= self._window[0]) & (stamps <= self._window[1])
        if is_sparser(reference, estimate):
            new &= stamps > self._counted_to_s
            self._counted_to_s = float(stamps[-1]) if len(stamps) else self._counted_to_s
            self._share = estimate.interval_s / reference.interval_s
            self._stamps += len(np.unique(stamps[known & new]))
            self._empty_stamps += len(np.unique(stamps[~known & new]))
        else:
            self._stamps += int((known & new).sum())
            self._empty_stamps += int((~known & new).sum())

    def _collect(self, time_s: Floats, found: dict[str, Errors]) -> None:
        columns = {"time_s": time_s}
        for name, of in found.items():
            if name not in self._collectors:
                self._collectors[name] = Collector(self._most, of.least_std)
            self._collectors[name].add(of.error, of.std)
            columns[name] = of.error
            if of.std is not None:
                columns[_std_of(name)] = of.std
        self._last = found
        part = Part(columns, 1)
        self._kept.append(part if self._thinner is None else self._thinner.thin(part))


def _std_of(name: str) -> str:
    return f"{name} σ"


def _any_finite(errors: Mapping[Quantity, Floats]) -> NDArray[np.bool_]:
    return np.asarray(np.logical_or.reduce([np.isfinite(error) for error in errors.values()]))


def _instants(estimate: Series, reference: Series, offset_s: float) -> Floats:
    """The instants of `paired`, on the estimate's clock."""
    return reference.time_s - offset_s if is_sparser(reference, estimate) else estimate.time_s
