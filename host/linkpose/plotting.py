"""Pictures of linkpose's CSV files. matplotlib is an extra, and is asked for here alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.evaluation.series import LONGEST_HOLE, interval
from linkpose.recording.table import Table
from linkpose.sensors.measurements import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# What a column ends with -> the panel in which it is drawn; a longer ending goes before a shorter one.
_PANELS = {
    "_height_std_m": None,
    "height_m": "height (m)",
    "roll_deg": "roll (°)",
    "pitch_deg": "pitch (°)",
    "vx_m_s": "velocity ahead (m/s)",
    "vy_m_s": "velocity to the left (m/s)",
    "wz_rad_s": "turn rate (rad/s)",
    "heading_rad": "heading (rad)",
    "_m_s2": "specific force (m/s²)",
    "_rad_s": "angular rate (rad/s)",
    "pressure_Pa": "pressure (Pa)",
    "_temp_degC": "temperature (°C)",
    "_counts": "mouse (counts)",
}
_TURNS = {"roll_deg": 360.0, "pitch_deg": 360.0, "heading_rad": 2 * np.pi}
_PANEL_INCHES = 2.2


def new_figure(width_inches: float, height_inches: float) -> Figure:
    """An empty figure. Raises LinkposeError without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise LinkposeError("plots need matplotlib; type `pip install linkpose[plot]`") from None
    return Figure(figsize=(width_inches, height_inches), layout="constrained")


def save(figure: Figure, path: Path) -> None:
    """Writes the picture in the form that the file's ending names. Raises LinkposeError where that cannot be."""
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise LinkposeError(f"cannot write {path}: {error}; name a .png in a folder you may write to") from error


def plot_tables(tables: Sequence[Table]) -> Figure:
    """One panel for each quantity over time, and one for the paths of robots, all files together.

    Raises LinkposeError without matplotlib, or for a file that holds nothing to draw.
    """
    panels: dict[str, list[tuple[Table, str]]] = {}
    paths: list[tuple[Table, str]] = []
    for table in tables:
        table.require("time_s")
        before = len(paths) + sum(map(len, panels.values()))
        for column in table.columns:
            panel = _panel_of(column)
            if panel:
                panels.setdefault(panel, []).append((table, column))
            elif column.endswith("x_m") and f"{column[:-3]}y_m" in table.columns:
                paths.append((table, column[:-3]))
        if len(paths) + sum(map(len, panels.values())) == before:
            raise LinkposeError(f"{table.path} holds nothing to draw: it has {', '.join(table.columns)}")
    count = len(panels) + bool(paths)
    figure = new_figure(10.0, 1.0 + _PANEL_INCHES * count)
    axes = np.atleast_1d(figure.subplots(count, 1))
    several = len(tables) > 1
    for place, (panel, columns) in zip(axes, panels.items(), strict=False):
        for table, column in sorted(columns, key=_roughness, reverse=True):  # what is noisy goes behind
            label = _label(table, column, several)
            place.plot(*_line(table, column), linewidth=0.8, label=label)
        _finish(place, "time (s)", panel)
    if paths:
        for table, prefix in paths:
            (_, x), (_, y) = (_line(table, f"{prefix}{axis}_m") for axis in "xy")
            axes[-1].plot(x, y, linewidth=0.8, label=_label(table, prefix or "path", several))
        axes[-1].set_aspect("equal", "datalim")
        _finish(axes[-1], "x (m)", "y (m)")
    return figure


def _panel_of(column: str) -> str | None:
    for ending, panel in _PANELS.items():
        if column.endswith(ending):
            return panel
    return None


def _line(table: Table, column: str) -> tuple[Floats, Floats]:
    """Times and values to draw, with a break (NaN) at gaps in time and where an angle goes once around."""
    time_s, value = table.columns["time_s"], table.columns[column]
    value = np.where(np.isfinite(value), value, np.nan)
    is_break = np.diff(time_s) > LONGEST_HOLE * interval(time_s)
    turn = next((turn for ending, turn in _TURNS.items() if column.endswith(ending)), np.inf)
    at = np.flatnonzero(is_break | (np.abs(np.diff(value)) > turn / 2)) + 1
    return np.insert(time_s, at, time_s[at]), np.insert(value, at, np.nan)


def _roughness(item: tuple[Table, str]) -> float:
    """How much a column jumps from sample to sample."""
    table, column = item
    value = table.columns[column]
    steps = np.abs(np.diff(value[np.isfinite(value)]))
    return float(steps.mean()) if len(steps) else 0.0


def _label(table: Table, column: str, several: bool) -> str:
    name = column.rstrip("_") if column not in _PANELS else table.kind or "reference"
    return f"{table.path.stem}: {name}" if several else name


def _finish(axes: Axes, below: str, beside: str) -> None:
    axes.set_xlabel(below)
    axes.set_ylabel(beside)
    axes.grid(alpha=0.3)
    axes.legend(loc="upper right", fontsize=7, ncols=3)
