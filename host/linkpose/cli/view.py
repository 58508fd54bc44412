"""The live view: each filter's estimate in a table that is redrawn ten times a second."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from linkpose import quantities
from linkpose.cli.live import health_line
from linkpose.device.session import Health
from linkpose.sensors.measurements import Floats

REDRAW_INTERVAL_S = 0.1
# Title of a table -> the filters in it: those that estimate this quantity.
_SUBJECTS = {"height over the joint, live": quantities.HEIGHT, "motion of the robot, live": quantities.HEADING}

# Values of a filter, (value, σ); σ is NaN where the filter gives none.
_Estimates = dict[quantities.Quantity, tuple[float, float]]


class View:
    """A table on stderr. Shows nothing, and imports nothing to show it with, when stderr is no terminal."""

    def __init__(self, columns: Sequence[str], is_shown: bool) -> None:
        self._columns = columns
        self._live: Any = None
        self._shown_s = -1.0
        if is_shown:
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(stderr=True), auto_refresh=False, transient=True)
            self._live.start()

    def show(self, estimates: Floats, health: Callable[[], Health]) -> None:
        """Takes the newest row of estimates (columns,)."""
        time_s = float(estimates[0])
        if self._live is None or 0 <= time_s - self._shown_s < REDRAW_INTERVAL_S:
            return
        self._shown_s = time_s
        self._live.update(self._table(estimates, health_line(health())), refresh=True)

    def _table(self, estimates: Floats, caption: str) -> Any:
        """A table for the link and one for the robot, whichever is estimated."""
        from rich.console import Group

        rows = self._by_filter(estimates)
        sections = [
            _section(title, {name: values for name, values in rows.items() if quantity in values})
            for title, quantity in _SUBJECTS.items()
            if any(quantity in values for values in rows.values())
        ]
        return Group(*sections, caption)

    def _by_filter(self, estimates: Floats) -> dict[str, _Estimates]:
        """The row taken apart: filter -> quantity -> (value, σ)."""
        row = dict(zip(self._columns, estimates.tolist(), strict=True))
        return {
            name: {q: (row[column], row.get(quantities.std_column(column) or "", math.nan)) for q, column in of.items()}
            for name, of in quantities.by_filter(self._columns).items()
        }

    def close(self) -> None:
        """Takes the table off the screen."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def __enter__(self) -> View:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _section(title: str, rows: Mapping[str, _Estimates]) -> Any:
    """The filters in rows, their quantities in columns; σ follows its value."""
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    table.add_column("filter", no_wrap=True)
    shown = [quantity for quantity in quantities.ALL if any(quantity in values for values in rows.values())]
    for quantity in shown:
        unit = f" ({quantity.value.unit})" if quantity.value.unit else ""
        table.add_column(f"{quantity.name}{unit}", justify="right", min_width=8)
    for name, values in rows.items():
        table.add_row(name, *(_text(quantity, values) for quantity in shown))
    return table


def _text(quantity: quantities.Quantity, values: _Estimates) -> str:
    """A value as it is shown; the excluded mice by their numbers."""
    value, std = values.get(quantity, (math.nan, math.nan))
    if math.isnan(value):
        return ""
    if quantity is quantities.EXCLUDED:
        return ", ".join(str(port + 1) for port in range(int(value).bit_length()) if int(value) >> port & 1) or "none"
    _, scale, decimals = quantity.value
    return f"{scale * value:+.{decimals}f}" + ("" if math.isnan(std) else f" ±{scale * std:.{decimals}f}")
