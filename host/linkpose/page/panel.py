"""The panel of the page: headline, health, charts with ±2σ, choice of the filter, and buttons."""

from __future__ import annotations

import html
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose import quantities
from linkpose.page.changes import Changes
from linkpose.presentation import angle_with_std, joint_texts, length_with_std, pose_text
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
_LABEL_WIDTH = 66  # pixels of the y axis: uPlot cuts a longer label at its start, where the sign is; -0.0025 fits
_NOWHERE = 0  # in place of a column that is missing: that of the time
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
        self._names = {name: html.escape(name) for name in self._of_filter}
        self._health = gui.add_html("")
        self._headline, self._details = gui.add_html(""), gui.add_html("")
        able = {quantity for of in self._of_filter.values() for quantity in of}
        self._choice = gui.add_dropdown("filter", [BEST, *self._of_filter]) if len(self._of_filter) > 1 else None
        if self._choice is not None:
            self._choice.on_update(lambda _: self._choose(on_choice))
        self.chosen: str | None = None  # the filter that the user has chosen; None: the best one
        self._shown = [quantity for quantity in charted if quantity in able]
        self._charts: dict[Quantity, viser.GuiUplotHandle] = {}
        self._curves: dict[str, _Curves] = {}
        self._charted = ""  # the filter whose charts are visible
        self._due: deque[tuple[Quantity, Floats, NDArray[np.float32]]] = deque()  # charts with their time and lines

    def add_charts(self) -> None:
        """Adds the charts below what the panel has already."""
        self._charts = {quantity: self._chart(self._gui, quantity) for quantity in self._shown}

    def _choose(self, on_choice: Callable[[], None]) -> None:
        assert self._choice is not None
        self.chosen = None if self._choice.value == BEST else self._choice.value
        on_choice()

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
            axes=(uplot.Axis(size=26), uplot.Axis(size=_LABEL_WIDTH, space=_LABEL_SPACE)),
            legend=uplot.Legend(show=False),
            height=_CHART_HEIGHT.get(quantity, _OTHER_HEIGHT),
            padding=_CHART_PADDING,
        )

    def renew_charts(self, window: Floats, name: str) -> None:
        """Computes the charts of the rows (N, columns) of the last seconds as the filter `name` estimates them."""
        if name not in self._curves:
            self._curves[name] = self._curves_of(name)
        curves = self._curves[name]
        if name != self._charted:
            self._charted = name
            for quantity, chart in self._charts.items():
                chart.visible = quantity in curves.quantities
        self._due.clear()
        if not curves.quantities:
            return
        rows = with_gap_rows(window)
        time, lines = rows[:, 0].copy(), curves.lines(rows)
        self._due.extend(zip(curves.quantities, (time for _ in lines), lines, strict=True))

    @property
    def has_due_charts(self) -> bool:
        """Whether charts are computed and not drawn yet."""
        return bool(self._due)

    def draw_charts(self, is_whole: bool) -> None:
        """Draws one of the charts that are due, or with `is_whole` all of them.

        A browser takes some milliseconds for one, after which it shows the newest row.
        """
        for _ in range(len(self._due) if is_whole else min(1, len(self._due))):
            quantity, time, lines = self._due.popleft()
            count = 3 + (quantity.column in self._columns)
            data = [self._changes.array(at) if np.isfinite(at).all() else _with_gaps(at) for at in lines[:count]]
            self._changes.plot(self._charts[quantity], [self._changes.array(time), *data])

    def _curves_of(self, name: str) -> _Curves:
        columns = self._of_filter.get(name, {})
        shown = [quantity for quantity in self._charts if quantity in columns]

        def at(names: Iterable[str | None]) -> list[int]:
            return [self._columns.get(column or "", _NOWHERE) for column in names]

        return _Curves(
            shown,
            at(columns[quantity] for quantity in shown),
            at(quantities.std_column(columns[quantity]) for quantity in shown),
            at(quantity.column for quantity in shown),
            np.array([quantity.value.scale for quantity in shown]),
        )

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

    def draw_headline(self, values: Mapping[Quantity, tuple[float, float]], name: str) -> None:
        """Shows what matters most of the newest values of the filter `name`."""
        caption, first = _headline(values)
        caption = f"{caption}, {self._names[name]}"
        self._changes.write(
            self._headline,
            f"<div style='padding:2px 12px 0'><div style='font-size:12px;color:#666'>{caption}</div>"
            f"<div style='font-size:26px;font-weight:600;font-variant-numeric:tabular-nums'>{first}</div></div>",
        )

    def draw_details(self, values: Mapping[Quantity, tuple[float, float]]) -> None:
        """Shows the other values below the headline."""
        lines = "".join(f"<div>{line}</div>" for line in _details(values))
        self._changes.write(
            self._details,
            f"<div style='padding:0 12px 2px;font-variant-numeric:tabular-nums;white-space:pre-wrap'>{lines}</div>",
        )


def _headline(values: Mapping[Quantity, tuple[float, float]]) -> tuple[str, str]:
    """Caption and large line; like `_details`, without characters that HTML would have to escape."""
    if HEIGHT in values:
        return "height over the joint", length_with_std(*values[HEIGHT])
    if HEADING in values:
        return "place and heading", pose_text(values)[0]
    if angles := joint_texts(values):
        return "joint", angles[0]
    return "attitude", _angles(values)


def _details(values: Mapping[Quantity, tuple[float, float]]) -> list[str]:
    """The lines below the headline."""
    if HEIGHT in values:
        return [_angles(values)]
    return pose_text(values)[1:] if HEADING in values else joint_texts(values)[1:]


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


class _Curves(NamedTuple):
    """What the charts draw of one filter: k quantities, and where their columns are."""

    quantities: list[Quantity]
    value_at: list[int]
    std_at: list[int]
    reference_at: list[int]
    scale: Floats  # (k,), to the unit of the chart

    def lines(self, rows: Floats) -> NDArray[np.float32]:
        """Value − 2σ, value + 2σ, value and reference (k, 4, N) of rows (N, columns); NaN where there is none."""
        values = self._unwrapped(rows[:, self.value_at] * self.scale)
        std = rows[:, self.std_at] * self.scale
        std[~np.isfinite(std) | (np.array(self.std_at) == _NOWHERE)] = 0.0
        low, high = _bounds(values, std)
        lines = np.empty((len(self.quantities), 4, len(rows)), np.float32)  # of a screen's precision
        lines[:, 0], lines[:, 1] = np.clip(values - 2 * std, low, high).T, np.clip(values + 2 * std, low, high).T
        lines[:, 2], lines[:, 3] = values.T, (rows[:, self.reference_at] * self.scale).T
        return lines

    def _unwrapped(self, values: Floats) -> Floats:
        """Values (N, k) without the steps of angles by a whole turn."""
        for at, quantity in enumerate(self.quantities):
            if quantity.period is not None:
                known, period = np.isfinite(values[:, at]), quantity.period * float(self.scale[at])
                if (np.abs(np.diff(values[known, at])) > 0.5 * period).any():
                    values[known, at] = np.unwrap(values[known, at], period=period)
        return values


def _bounds(values: Floats, std: Floats) -> tuple[Floats, Floats]:
    """Limits (k,) of what charts show of values (N, k): ±2σ of a filter that just started would flatten all motion."""
    known = np.isfinite(values)
    count = np.count_nonzero(known, axis=0)
    low = np.where(count, np.where(known, values, np.inf).min(axis=0), 0.0)
    high = np.where(count, np.where(known, values, -np.inf).max(axis=0), 0.0)
    median = np.sort(np.where(known, std, np.inf), axis=0)[count // 2, np.arange(len(count))]
    margin = np.maximum(0.3 * (high - low), 3 * median)
    return low - margin, high + margin


def _with_gaps(values: NDArray[np.float32]) -> list[float | None]:
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
