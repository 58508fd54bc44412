"""What a plot draws: the filters of the estimates, the reference, and how they are named."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from linkpose import filters
from linkpose.errors import LinkposeError, printable
from linkpose.evaluation.scores import evaluate
from linkpose.evaluation.scoring import Score
from linkpose.evaluation.series import interval
from linkpose.evaluation.takes import MOTION_CAPTURE
from linkpose.plotting.canvas import REFERENCES
from linkpose.plotting.lines import gaps, is_regular, lost_samples
from linkpose.presentation import counted
from linkpose.quantities import HEADING, HEIGHT, QW, ROLL, Quantity, by_filter, split, std_column
from linkpose.recording.table import Table
from linkpose.sensors.measurements import Floats

_LONGEST_NAME = 61  # characters; the rest of the title takes as many
_THINNED = "the picture shows the extremes of each part, and figures beside lines are of the rows shown"


@dataclass(frozen=True, slots=True)
class DrawnTrack:
    """The quantities of one filter, or of the reference, in the units in which they are shown."""

    name: str  # the filter; "" of the reference
    label: str
    file: int  # number of its file among the estimates
    time_s: Floats  # (N,)
    values: dict[Quantity, Floats]  # (N,) each
    std: dict[Quantity, Floats]
    mice: int = 0  # of the rig; 0 where the file does not state it

    def has(self, *wanted: Quantity) -> bool:
        """Whether all of these have a value somewhere."""
        return all(q in self.values and bool(np.isfinite(self.values[q]).any()) for q in wanted)


@dataclass(frozen=True, slots=True)
class Sources:
    """Everything that one plot draws."""

    tracks: list[DrawnTrack]  # of filters, best first
    reference: DrawnTrack | None  # on the clock of the first estimate
    scores: dict[tuple[int, str], Score]  # by file and filter; empty without a reference
    hidden: list[str]  # filters that are not drawn although the user chose none
    remarks: list[str]

    @property
    def all(self) -> list[DrawnTrack]:
        """The filters, then the reference."""
        return [*self.tracks, *([self.reference] if self.reference else [])]


def is_recording(table: Table) -> bool:
    """Whether it holds readings of sensors."""
    parts = [split(column) for column in table.columns]
    return table.kind == "recording" or any(part is not None and part.quantity.is_reading for part in parts)


def is_reference(table: Table) -> bool:
    """Whether it holds quantities of no filter."""
    return table.kind in ("truth", MOTION_CAPTURE) or not by_filter(table.columns)


def gather(tables: Sequence[Table], wanted: Sequence[str]) -> Sources:
    """Of estimates and references.

    Without `wanted`, the filters whose height comes from the air pressure are hidden, beside a robot's path the filters
    that estimate its tilt alone, and beside a chain the filters of one of its sensors.

    Raises LinkposeError where a wanted filter is in no file.
    """
    estimates = [table for table in tables if not is_reference(table)]
    references = [table for table in tables if is_reference(table)]
    found = [name for table in estimates for name in by_filter(table.columns)]
    missing = [name for name in wanted if name not in found]
    if missing:
        raise LinkposeError(f"no file has the filter {', '.join(missing)}; there are {', '.join(dict.fromkeys(found))}")
    shown = _shown(list(dict.fromkeys(found)), wanted)
    if not wanted and any(_has(table, HEADING) for table in estimates):
        shown = [name for name in shown if not all(_is_tilt_alone(table, name) for table in estimates)]
    if not wanted and any(_has(table, QW) for table in estimates):
        shown = [name for name in shown if any(_has(table, QW, name) for table in estimates)]
    tracks = [
        _track(table, name, columns, i, len(estimates) > 1)
        for i, table in enumerate(estimates)
        for name, columns in by_filter(table.columns).items()
        if name in shown
    ]
    tracks.sort(key=lambda track: (_rank(track.name), track.file))
    scores, offset_s, remarks = _scores(estimates, references[0]) if references else ({}, 0.0, [])
    remarks += [f"{table.path} has {table.whole.rows} rows: {_THINNED}" for table in tables if table.whole]
    reference = _reference(references[0], offset_s) if references else None
    hidden = [] if wanted else [name for name in dict.fromkeys(found) if name not in shown]
    return Sources(tracks, reference, scores, hidden, remarks)


def _shown(found: list[str], wanted: Sequence[str]) -> list[str]:
    """The wanted filters; without any, all but the barometric ones, unless there are no others."""
    if wanted:
        return list(wanted)
    return [name for name in found if not is_barometric(name)] or found


def is_barometric(name: str) -> bool:
    """Whether a filter's height comes from the air pressure."""
    return bool((of := filters.capabilities(name)) and of.is_barometric)


def _has(table: Table, quantity: Quantity, name: str | None = None) -> bool:
    """Whether this filter, or any, has a value of a quantity somewhere."""
    return any(
        quantity in of and bool(np.isfinite(table.columns[of[quantity]]).any())
        for each, of in by_filter(table.columns).items()
        if name in (None, each)
    )


def _is_tilt_alone(table: Table, name: str) -> bool:
    """Whether a filter has roll and pitch, no heading, and no value of the height, which needs J2S."""
    of = by_filter(table.columns).get(name, {})
    height = table.columns[of[HEIGHT]] if HEIGHT in of else np.empty(0)
    return not of or (ROLL in of and HEADING not in of and not np.isfinite(height).any())


def _rank(name: str) -> int:
    """Place among the filters, the best first."""
    return filters.NAMES.index(name) if name in filters.NAMES else len(filters.NAMES)


def _track(table: Table, name: str, columns: dict[Quantity, str], file: int, several: bool) -> DrawnTrack:
    values = {q: _shown_value(table, column, q) for q, column in columns.items()}
    std = {}
    for q, column in columns.items():
        sigma = std_column(column)
        if sigma in table.columns and not q.std:
            std[q] = _shown_value(table, sigma or "", q)
    label = f"{name} ({table.path.stem})" if several else name
    return DrawnTrack(name, label, file, table.columns["time_s"], values, std, _mice(table))


def _mice(table: Table) -> int:
    """How many mice the rig of an estimate has."""
    rig = table.metadata.get("rig")
    mice = rig.get("mouse") if isinstance(rig, dict) else None
    return len(mice) if isinstance(mice, list) else 0


def _shown_value(table: Table, column: str, quantity: Quantity) -> Floats:
    value = table.columns[column]
    return np.where(np.isfinite(value), value * quantity.value.scale, np.nan)


def _reference(table: Table, offset_s: float) -> DrawnTrack:
    values = {}
    for column in table.columns:
        part = split(column)
        if part is not None and not part.is_std and part.prefix in ("", "chain"):
            values[part.quantity] = _shown_value(table, column, part.quantity)
    label = REFERENCES[0] if table.kind == "truth" else REFERENCES[1]
    return DrawnTrack("", label, 0, table.columns["time_s"] - offset_s, values, {})


def _scores(estimates: Sequence[Table], reference: Table) -> tuple[dict[tuple[int, str], Score], float, list[str]]:
    """Scores of all estimates, the reference's offset to the first one's clock, and why there are none."""
    found: dict[tuple[int, str], Score] = {}
    offset_s, remarks = 0.0, []
    if any(table.whole for table in (*estimates, reference)):
        names = f"{estimates[0].path} {reference.path}" if estimates else "ESTIMATE REFERENCE"
        return {}, 0.0, [f"no errors are drawn of files of this length: type linkpose evaluate {names}"]
    for i, table in enumerate(estimates):
        try:
            scores = evaluate(table, reference).scores
        except LinkposeError as reason:
            remarks.append(f"no errors are drawn: {reason}")
            continue
        offset_s = scores[0].time_offset_s if i == 0 else offset_s
        found |= {(i, score.filter): score for score in scores}
    return found, offset_s, remarks


def title(tables: Sequence[Table]) -> str:
    """File, length, rate and losses of each file but references that come with an estimate."""
    named = [table for table in tables if not is_reference(table)] or list(tables)
    return "\n".join(_describe(table) for table in named)


def _describe(table: Table) -> str:
    time_s, whole = table.columns["time_s"], table.whole
    step = whole.interval_s if whole else interval(time_s)
    length = float(time_s[-1] - time_s[0]) if len(time_s) else 0.0
    words = [shortened(table.path.name), _length(length)]
    lost = (table.closing or {}).get("lost")
    if whole is None and lost is None and not is_regular(time_s):
        return "   ·   ".join([*words, counted(len(time_s), "row")])
    words.append(f"{1 / step:.4g} Hz" if step > 0 else "")
    holes = whole.gaps if whole else len(gaps(time_s))
    if not isinstance(lost, int) or (holes and not lost):  # rows were taken out of the file afterwards
        lost = whole.lost if whole else lost_samples(time_s)
    words.append("no samples lost" if not (lost or holes) else f"{lost} samples lost in {counted(holes, 'gap')}")
    return "   ·   ".join(word for word in words if word)


def shortened(name: str) -> str:
    """A file's name as a picture can show it, without its middle if the title would not fit the figure."""
    name = printable(name)
    if len(name) <= _LONGEST_NAME:
        return name
    half = (_LONGEST_NAME - 1) // 2
    return f"{name[:half]}…{name[-half:]}"


def _length(seconds: float) -> str:
    if seconds < 600:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.2f} h"


def pairs(tracks: Sequence[DrawnTrack], quantity: Quantity) -> Iterator[tuple[DrawnTrack, Floats]]:
    """The tracks that have the quantity somewhere."""
    for track in tracks:
        if track.has(quantity):
            yield track, track.values[quantity]
