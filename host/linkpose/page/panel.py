"""The panel of the page: headline, health, charts with ±2σ, choice of the filter, and buttons."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from linkpose import quantities
from linkpose.page.changes import Changes, Nullable
from linkpose.presentation import Row, angle_with_std, joint_texts, length_with_std, pose_text
from linkpose.quantities import (
    HEADING,
    HEIGHT,
    PITCH,
    ROLL,
    YAW,
    Quantity,
)
from linkpose.sensors.measurements import Floats

if TYPE_CHECKING:
    import viser

GAP_S = 0.5  # the shortest gap of a curve
BEST = "best"  # the choice that follows the best filter
_BAND, _LINE, _REFERENCE = "rgba(0, 114, 178, 0.22)", "#0072B2", "#222222"
_CHART_HEIGHT = {HEIGHT: 150}  # pixels; the height is the largest
_OTHER_HEIGHT = 105
_CHART_PADDING = (10, 14, 0, 0)  # pixels above, right, below, left: the outermost labels are not cut
_LABEL_SPACE = 18  # pixels between two labels of the y axis, at least; with uPlot's 30 a low chart has a single label
_OK, _FAULT = "#2b8a3e", "#c92a2a"


class Panel:
    """The elements of the panel, and how they are brought up to date."""

    def __init__(
        self,
        server: viser.ViserServer,
        changes: Changes,
        columns: Sequence[str],
        charted: Sequence[Quantity],
        on_choice: Callable[[], None],
    ) -> None:
        """`charted` are the quantities with a chart if a filter estimates them.

        Texts and curves go into `changes`. `on_choice` is called when another filter is chosen.
        """
        gui, self._changes = server.gui, changes
        self._gui = gui
        self._columns = {column: at for at, column in enumerate(columns)}
        self._of_filter = quantities.by_filter(columns)
        self._health = gui.add_html("")
        self._headline = gui.add_html("")
        able = {quantity for of in self._of_filter.values() for quantity in of}
        self._choice = gui.add_dropdown("filter", [BEST, *self._of_filter]) if len(self._of_filter) > 1 else None
        if self._choice is not None:
            self._choice.on_update(lambda _: on_choice())
        self._shown = [quantity for quantity in charted if quantity in able]
        self._charts: dict[Quantity, viser.GuiUplotHandle] = {}
        self._charted = ""  # the filter whose charts are visible

    def add_charts(self) -> None:
        """Adds the charts below what the panel has already."""
        self._charts = {quantity: self._chart(self._gui, quantity) for quantity in self._shown}

    @property
    def chosen(self) -> str | None:
        """The filter that the user has chosen; None: the best one."""
        return None if self._choice is None or self._choice.value == BEST else self._choice.value

    def _chart(self, gui: viser.GuiApi, quantity: Quantity) -> viser.GuiUplotHandle:
        from viser import uplot

        series = [
            uplot.Series(label="time (s)"),
            uplot.Series(label="−2σ", width=0, points={"show": False}),
            uplot.Series(label="+2σ", width=0, points={"show": False}),
            uplot.Series(label=quantity.name, stroke=_LINE, width=2, points={"show": False}),
        ]
        if quantity.column in self._columns:
            series.append(
                uplot.Series(label="reference", stroke=_REFERENCE, width=1, dash=(5, 4), points={"show": False})
            )
        return gui.add_uplot(
            tuple(np.zeros(1) for _ in series),
            tuple(series),
            title=quantity.axis_label,
            bands=(uplot.Band(series=(2, 1), fill=_BAND),),
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)},
            axes=(uplot.Axis(size=26), uplot.Axis(size=48, space=_LABEL_SPACE)),
            legend=uplot.Legend(show=False),
            height=_CHART_HEIGHT.get(quantity, _OTHER_HEIGHT),
            padding=_CHART_PADDING,
        )

    def draw_charts(self, window: Floats, name: str) -> None:
        """Draws the rows (N, columns) of the last seconds as the filter `name` estimates them."""
        rows = with_gap_rows(window)
        columns = self._of_filter.get(name, {})
        if name != self._charted:
            self._charted = name
            for quantity, chart in self._charts.items():
                chart.visible = quantity in columns
        for quantity, chart in self._charts.items():
            if quantity in columns:
                self._changes.plot(chart, self._chart_data(rows, quantity, columns[quantity]))

    def _chart_data(self, rows: Floats, quantity: Quantity, column: str) -> tuple[Nullable, ...]:
        """Time, value − 2σ, value + 2σ, value, and the reference if there is one, with None in gaps."""
        scale = quantity.value.scale
        value = rows[:, self._columns[column]] * scale
        if quantity.period is not None:
            known = np.isfinite(value)
            period = quantity.period * scale
            if (np.abs(np.diff(value[known])) > 0.5 * period).any():
                value[known] = np.unwrap(value[known], period=period)
        std_at = self._columns.get(quantities.std_column(column) or "")
        std = rows[:, std_at] * scale if std_at is not None else np.zeros(len(rows))
        std = np.where(np.isfinite(std), std, 0.0)
        low, high = _bounds(value, std)
        data = [np.clip(value - 2 * std, low, high), np.clip(value + 2 * std, low, high), value]
        if quantity.column in self._columns:
            data.append(rows[:, self._columns[quantity.column]] * scale)
        return (rows[:, 0].copy(), *map(_nullable, data))

    def draw_health(self, title: str, summary: str, working: Sequence[str], faults: Sequence[str]) -> None:
        """Shows which sensors work, in green, and each fault as a red line."""
        pills = "".join(_pill(f"{name} ok", _OK) for name in working)
        alarms = "".join(_alarm(line) for line in faults)
        self._changes.write(
            self._health,
            f"<div style='padding:4px 12px'><div style='font-size:12px;color:#666'>{html.escape(title)}</div>"
            f"<div style='font-size:12px;color:#666;white-space:pre-wrap'>{html.escape(summary)}</div>"
            f"<div style='margin-top:4px'>{pills}</div>{alarms}</div>",
        )

    def draw_headline(self, row: Row, name: str) -> None:
        """Shows the newest values of the filter `name`."""
        values = row.get(name, {})
        angles = joint_texts(values)
        if HEIGHT in values:
            first, lines = length_with_std(*values[HEIGHT]), [_angles(values)]
            caption = "height over the joint"
        elif angles:
            first, *lines = angles
            caption = "joint"
        elif HEADING in values:
            first, *lines = pose_text(values)
            caption = "place and heading"
        else:
            first, lines, caption = _angles(values), [], "attitude"
        below = "".join(f"<div>{html.escape(line)}</div>" for line in lines)
        self._changes.write(
            self._headline,
            f"<div style='padding:2px 12px'><div style='font-size:12px;color:#666'>{caption}, {html.escape(name)}</div>"
            f"<div style='font-size:26px;font-weight:600;font-variant-numeric:tabular-nums'>{html.escape(first)}</div>"
            f"<div style='font-variant-numeric:tabular-nums;white-space:pre-wrap'>{below}</div></div>",
        )


def _angles(values: Mapping[Quantity, tuple[float, float]]) -> str:
    """Roll, pitch and yaw side by side; no line ends within one of them."""
    parts = [f"{q.name} {angle_with_std(*values[q])}" for q in (ROLL, PITCH, YAW) if q in values]
    return "   ".join(part.replace(" ", "\N{NO-BREAK SPACE}") for part in parts)


def with_gap_rows(rows: Floats) -> Floats:
    """Rows (N, columns) by time, with a row of NaN inside each gap.

    A gap is longer than three usual intervals and than GAP_S: live rows are the last ones of blocks of any length.
    """
    if len(rows) < 3:
        return rows
    step = np.diff(rows[:, 0])
    if step.max() <= GAP_S:
        return rows
    at = np.flatnonzero(step > max(3.0 * float(np.median(step)), GAP_S))
    if not len(at):
        return rows
    between = np.full((len(at), rows.shape[1]), np.nan)
    between[:, 0] = 0.5 * (rows[at, 0] + rows[at + 1, 0])
    return np.insert(rows, at + 1, between, axis=0)


def _bounds(value: Floats, std: Floats) -> tuple[float, float]:
    """Limits of what a chart shows: ±2σ of a filter that has just started would flatten all motion."""
    known = np.isfinite(value)
    if not known.any():
        return -np.inf, np.inf
    low, high = float(value[known].min()), float(value[known].max())
    middle = np.count_nonzero(known) // 2
    margin = max(0.3 * (high - low), 3 * float(np.partition(std[known], middle)[middle]))
    return low - margin, high + margin


def _nullable(values: Floats) -> Nullable:
    if np.isfinite(values).all():
        return values
    return [value if value == value else None for value in values.tolist()]


def _pill(text: str, colour: str) -> str:
    return (
        f"<span style='display:inline-block;margin:2px 4px 2px 0;padding:1px 8px;border-radius:9px;font-size:12px;"
        f"color:white;background:{colour}'>{html.escape(text)}</span>"
    )


def _alarm(text: str) -> str:
    return (
        f"<div role='alert' style='margin-top:4px;padding:4px 8px;border-radius:4px;font-weight:600;color:white;"
        f"background:{_FAULT}'>{html.escape(text)}</div>"
    )
