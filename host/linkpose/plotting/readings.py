"""The readings of a recording over time, one panel for each kind and sensor."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from linkpose.plotting.canvas import AXES_COLOURS, OTHERS, finish
from linkpose.plotting.lines import draw, shade
from linkpose.quantities import Column, split
from linkpose.recording.table import Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SENSORS = {"": "", "imu2": " of sensor 2"}


def time_panels(table: Table) -> list[tuple[float, Callable[[Axes], list[str]]]]:
    """Share of the height and what draws it, of each panel that has a reading."""
    panels: dict[str, list[tuple[str, Column]]] = {}
    for column, value in table.columns.items():
        part = split(column)
        if part is None or not part.quantity.is_reading or not np.isfinite(value).any():
            continue
        panels.setdefault(f"{part.quantity.panel}{_SENSORS.get(part.prefix, '')}", []).append((column, part))
    return [(1.8, _panel(table, name, columns)) for name, columns in panels.items()]


def _panel(table: Table, name: str, columns: list[tuple[str, Column]]) -> Callable[[Axes], list[str]]:
    return lambda axes: _draw(axes, table, name, columns)


def _draw(axes: Axes, table: Table, name: str, columns: list[tuple[str, Column]]) -> list[str]:
    """Draws the readings; the labels for the legend, none for a panel of one line, which its axis names."""
    time_s = table.columns["time_s"]
    unknown = np.ones(len(time_s), np.bool_)
    labels: list[str] = []
    mice = list(dict.fromkeys(part.prefix for _, part in columns))
    for i, (column, part) in enumerate(columns):
        label, colour, dashes = part.quantity.label, AXES_COLOURS.get(part.quantity.label, OTHERS[i % len(OTHERS)]), "-"
        if part.prefix not in _SENSORS:  # a mouse, whose two directions have its colour
            label, colour = f"{part.prefix} {label}", OTHERS[mice.index(part.prefix) % len(OTHERS)]
            dashes = "-" if columns[i - 1][1].prefix != part.prefix or i == 0 else ":"
        value = table.columns[column] * part.quantity.value.scale
        unknown &= ~np.isfinite(value)
        labels += [label] * (len(columns) > 1)
        draw(axes, time_s, value, label=labels[-1] if labels else None, color=colour, linewidth=0.8, linestyle=dashes)
    shade(axes, time_s, unknown)
    finish(axes, f"{name} ({columns[0][1].quantity.value.unit})")
    return labels
