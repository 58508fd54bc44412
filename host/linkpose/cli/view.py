"""The live view: each filter's estimate in a table that is redrawn ten times a second."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from linkpose.cli.live import health_line
from linkpose.device.session import Health
from linkpose.filters import NAMES
from linkpose.sensors.measurements import Floats

REDRAW_INTERVAL_S = 0.1


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
        from rich.table import Table

        rows = self._by_filter(estimates)
        table = Table(title=_title(rows), caption=caption, title_justify="left")
        quantities = list(dict.fromkeys(name for values in rows.values() for name in values))
        table.add_column("filter")
        for quantity in quantities:
            table.add_column(quantity, justify="right", min_width=9)
        for name, values in rows.items():
            table.add_row(name, *(_text(q, values[q]) if q in values else "" for q in quantities))
        return table

    def _by_filter(self, estimates: Floats) -> dict[str, dict[str, float]]:
        """The row taken apart: filter -> quantity with its unit -> value."""
        prefixes = {name.replace("-", "_") + "_": name for name in sorted(NAMES, key=len, reverse=True)}
        rows: dict[str, dict[str, float]] = {}
        for column, value in zip(self._columns[1:], estimates[1:].tolist(), strict=True):
            prefix = next(p for p in prefixes if column.startswith(p))
            rows.setdefault(prefixes[prefix], {})[column.removeprefix(prefix)] = value
        return rows

    def close(self) -> None:
        """Takes the table off the screen."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def __enter__(self) -> View:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _title(rows: Mapping[str, Mapping[str, float]]) -> str:
    """What the filters on show are about."""
    quantities = {name for values in rows.values() for name in values}
    subjects = {"height_m": "height over the joint centre", "x_m": "the robot's motion"}
    return " and ".join(text for name, text in subjects.items() if name in quantities) + ", live"


def _text(quantity: str, value: float) -> str:
    """A value as it is shown; the excluded mice by their numbers."""
    if quantity != "excluded":
        return f"{value:+.4f}"
    return ", ".join(str(port + 1) for port in range(int(value).bit_length()) if int(value) >> port & 1) or "none"
