"""The plot of any of linkpose's CSV files: a link, a chain, a robot, or the readings of a recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.localization.surroundings import Surroundings
from linkpose.plotting import panels, readings, robots
from linkpose.plotting.canvas import (
    SMALL_LETTERING,
    WIDTH_INCHES,
    fit_legends,
    label_time,
    legend_of_new,
    new_figure,
    without_formulas,
    wrapped,
)
from linkpose.plotting.sources import Sources, gather, is_recording, title
from linkpose.quantities import (
    ANGLE,
    BALL_ANGLES,
    CHAIN_ROTATION,
    HEIGHT,
    HEIGHT1,
    HEIGHT2,
    PITCH,
    ROLL,
    ROTATION,
    YAW,
    Quantity,
    split,
)
from linkpose.recording.table import Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

_INCHES = 0.8  # per unit of height
_WIDE_PATH = 3.6  # height of a path above the panels


@dataclass(frozen=True, slots=True)
class PlotPanel:
    """One panel over time: its share of the height, and what draws it and returns its labels, the best filter first."""

    share: float
    draw: Callable[[Axes], list[str]]


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the figure: panels with a common time axis, and for a robot a path beside or above them."""

    panels: list[PlotPanel]
    path: Callable[[Axes], list[str]] | None = None
    is_wide: bool = False  # the path lies above the panels, over the whole width

    @property
    def height(self) -> float:
        """Of the section, in units of _INCHES."""
        over_time = sum(panel.share for panel in self.panels)
        if self.is_wide:
            return over_time + _WIDE_PATH
        return max(over_time, 5.5) if self.path else over_time


def plot_tables(
    tables: Sequence[Table], wanted: Sequence[str] = (), scene: Surroundings | None = None
) -> tuple[Figure, list[str]]:
    """Recordings, estimates and references in one figure, and remarks on what it leaves out.

    `wanted` names the filters to draw; without it, barometric filters are left out. `scene` is drawn under a robot's
    path. Raises LinkposeError for a file that holds nothing to draw.
    """
    for table in tables:
        table.require("time_s")
    sources = gather([table for table in tables if not is_recording(table)], wanted)
    sections = [section for section in (_robot(sources, scene), _chain(sources), _link(sources)) if section]
    sections += [section for table in tables if is_recording(table) and (section := _readings(table))]
    if not sections:
        if any(split(column) for column in tables[0].columns):
            raise LinkposeError(f"{tables[0].path} holds nothing to draw: its quantities are empty in all rows")
        raise LinkposeError(f"{tables[0].path} holds nothing to draw: it has {', '.join(tables[0].columns)[:300]}")
    figure = new_figure(0.7 + _INCHES * sum(section.height for section in sections), title(tables))
    parts = figure.subfigures(len(sections), 1, squeeze=False, height_ratios=[s.height for s in sections])
    for part, section in zip(parts[:, 0], sections, strict=True):
        _lay_out(part, section)
    note = panels.note_hidden(sources)
    if note:
        lines = wrapped(note, WIDTH_INCHES, SMALL_LETTERING)
        figure.supxlabel(lines, fontsize=SMALL_LETTERING, x=0.01, ha="left", color="#555555")
    return fit_legends(without_formulas(figure)), [*sources.remarks, *([note] if note else [])]


def _lay_out(part: SubFigure, section: Section) -> None:
    """Panels below each other with one time axis; a path to the left of them or above.

    A panel has a legend where it shows what no legend above or beside has named.
    """
    named: set[str] = set()
    rows = len(section.panels)
    grid: Any
    below_each_other: list[Axes] = []
    shares = [panel.share for panel in section.panels]
    above = int(section.is_wide)
    if section.path is not None and above:
        grid = part.add_gridspec(rows + 1, 1, height_ratios=[_WIDE_PATH, *shares])
        below_each_other.append(part.add_subplot(grid[0, 0]))
        legend_of_new(below_each_other[0], named, section.path(below_each_other[0]))
    elif section.path is not None:
        beside = part.add_gridspec(1, 2, width_ratios=[1.2, 1.0]) if rows else part.add_gridspec(1, 1)
        axes = part.add_subplot(beside[0, 0])
        legend_of_new(axes, named, section.path(axes))
        # A grid of its own: in a common one, all panels would be as far apart as the legends of one of them need.
        grid = beside[0, -1].subgridspec(max(rows, 1), 1, height_ratios=shares or [1.0])
    else:
        grid = part.add_gridspec(rows, 1, height_ratios=shares)
    first: Any = None
    for row, panel in enumerate(section.panels):
        axes = part.add_subplot(grid[row + above, 0], sharex=first)
        first = first or axes
        below_each_other.append(axes)
        legend_of_new(axes, named, panel.draw(axes))
        axes.tick_params(labelbottom=row == rows - 1)
    if first is not None:
        label_time(axes)
        part.align_ylabels(below_each_other)


def _link(sources: Sources) -> Section | None:
    """Height (largest), its error, roll, pitch, yaw."""
    if not panels.has(sources, HEIGHT, ROLL, PITCH):
        return None
    found = []
    if panels.has(sources, HEIGHT):
        found.append(PlotPanel(3.0, _values(sources, HEIGHT)))
        if _scored(sources, HEIGHT):
            if panels.hides_best(sources, "height"):
                found.append(PlotPanel(1.9, lambda axes: panels.errors(axes, sources, "height", best_only=True)))
            found.append(PlotPanel(1.9, lambda axes: panels.errors(axes, sources, "height")))
        elif _estimated(sources, HEIGHT):
            if panels.differences_hide_best(sources, HEIGHT):
                found.append(PlotPanel(1.3, lambda axes: panels.from_best(axes, sources, HEIGHT, best_only=True)))
            found.append(PlotPanel(1.9, lambda axes: panels.from_best(axes, sources, HEIGHT)))
    found += [PlotPanel(1.5, _values(sources, q)) for q in (ROLL, PITCH, YAW) if panels.has(sources, q)]
    return Section(found)


def _chain(sources: Sources) -> Section | None:
    """Angle of a hinge (largest) and its error, or the angles of a ball joint; error of the rotation; heights."""
    found = []
    if panels.has(sources, ANGLE):
        found.append(PlotPanel(3.0, _values(sources, ANGLE)))
        if _scored(sources, ANGLE):
            found.append(PlotPanel(1.9, lambda axes: panels.errors(axes, sources, "angle")))
    found += [PlotPanel(2.2, _values(sources, q)) for q in BALL_ANGLES if panels.has(sources, q)]
    if any(track.has(*CHAIN_ROTATION) for track in sources.tracks or sources.all):
        if not found:
            found.append(PlotPanel(3.0, lambda axes: robots.rotation(axes, sources)))
        if _scored(sources, ROTATION):
            found.append(PlotPanel(1.9, lambda axes: panels.errors(axes, sources, "rotation")))
    found += [PlotPanel(1.5, _values(sources, q)) for q in (HEIGHT1, HEIGHT2) if panels.has(sources, q)]
    return Section(found) if found else None


def _robot(sources: Sources, scene: Surroundings | None) -> Section | None:
    """The path, then speed, heading and the mice left out over time."""
    wide = robots.is_wide(sources, scene)
    path = robots.path_panel(sources, scene, wide)
    over_time = [PlotPanel(share, draw) for share, draw in robots.time_panels(sources, wide)]
    return Section(over_time, path, wide) if path or over_time else None


def _readings(table: Table) -> Section | None:
    found = [PlotPanel(share, draw) for share, draw in readings.time_panels(table)]
    return Section(found) if found else None


def _values(sources: Sources, quantity: Quantity) -> Callable[[Axes], list[str]]:
    return lambda axes: panels.values(axes, sources, quantity, _wrap(quantity))


def _wrap(quantity: Quantity) -> float | None:
    """Period of an angle in the unit in which it is shown."""
    return quantity.period * quantity.value.scale if quantity.period is not None else None


def _scored(sources: Sources, quantity: Quantity) -> bool:
    shown = {(track.file, track.name) for track in sources.tracks}
    return any(quantity.name in score.errors for key, score in sources.scores.items() if key in shown)


def _estimated(sources: Sources, quantity: Quantity) -> bool:
    """Whether a filter shows more than its line: σ, or another filter to compare with."""
    tracks = [track for track in sources.tracks if track.has(quantity) and track.file == 0]
    return len(tracks) > 1 or any(bool(np.isfinite(t.std[quantity]).any()) for t in tracks if quantity in t.std)
