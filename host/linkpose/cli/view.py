"""The live view on a terminal: the best estimate with its σ, its curve over the last seconds, and the other filters."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click

from linkpose import quantities
from linkpose.cli.curve import curve, path_map
from linkpose.device.session import Health
from linkpose.presentation import (
    Exclusions,
    Row,
    RowReader,
    best_filter,
    fault_lines,
    number_text,
    pose_text,
    signed_angle,
    std_text,
    with_std,
)
from linkpose.sensors.measurements import Floats

if TYPE_CHECKING:
    from rich.text import Text

REDRAW_INTERVAL_S = 0.1
CURVE_S = 20.0  # of the past that the curve shows
CURVE_ROWS, MAP_ROWS = 5, 8
POINT_INTERVAL_S = 0.05  # between two points of a curve: a column of dots is wider
PATH_POINTS = 4000  # of the map; older ones are thinned out
WIDEST = 78
LEAST_HEIGHT_M = 0.02  # that the curve's axis covers: noise does not fill the screen


class View:
    """The live view on stderr. If stderr is not a terminal it shows nothing, and imports nothing to show it with."""

    def __init__(self, columns: Sequence[str], is_shown: bool, title: str) -> None:
        """`title` names the port and the settings worth a glance, such as J2S."""
        self._rows = RowReader(columns)
        self._screen = Screen(title, self._rows.filters)
        self._live: Any = None
        self._drawn_at = -math.inf
        if is_shown:
            from rich.console import Console
            from rich.live import Live

            # Results go to stdout untouched: rich must not take it for its own.
            self._live = Live(
                console=Console(stderr=True), auto_refresh=False, transient=True,
                redirect_stdout=False, redirect_stderr=False,
            )  # fmt: skip
            self._live.start()

    @property
    def is_shown(self) -> bool:
        """Whether the view is on the screen."""
        return self._live is not None

    def say(self, text: str) -> None:
        """Prints a line above the view, or where the view was."""
        if self._live is None:
            click.echo(text, err=True)
        else:
            self._live.console.print(text, markup=False, highlight=False)

    def show(self, estimates: Floats, health: Callable[[], Health], status: str = "") -> None:
        """Takes the newest row of estimates (columns,), and redraws a few times a second.

        `status` is a line on what is not ready yet, such as filters that are being compiled.
        """
        if self._live is None:
            return
        self._screen.add(float(estimates[0]), self._rows.read(estimates.tolist()))
        self.redraw(health, status)

    def redraw(self, health: Callable[[], Health], status: str = "") -> None:
        """Redraws when it is time to, also while no estimates arrive."""
        now = time.perf_counter()
        if self._live is None or now - self._drawn_at < REDRAW_INTERVAL_S:
            return
        self._drawn_at = now
        console = self._live.console
        self._live.update(self._screen.render(health(), console.width, console.height, status), refresh=True)

    def close(self) -> None:
        """Takes the view off the screen."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def __enter__(self) -> View:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Screen:
    """What the view shows, as text of a given size: no terminal is needed to test it."""

    def __init__(self, title: str, filters: Sequence[str]) -> None:
        self._title, self._filters = title, list(filters)
        self._time_s = 0.0
        self._row: Row = {}
        self._heights: deque[tuple[float, float]] = deque(maxlen=round(CURVE_S / POINT_INTERVAL_S) + 1)
        self._path: list[tuple[float, float]] = []
        self._exclusions = Exclusions()

    def add(self, time_s: float, row: Row) -> None:
        """Takes a row of estimates."""
        self._time_s, self._row = time_s, row
        link = best_filter(self._row, self._filters, quantities.HEIGHT)
        robot = best_filter(self._row, self._filters, quantities.X)
        if link is not None and (not self._heights or time_s - self._heights[-1][0] >= POINT_INTERVAL_S):
            self._heights.append((time_s, row[link][quantities.HEIGHT][0]))
        if robot is not None and quantities.HEADING in row[robot]:
            self._path.append((row[robot][quantities.X][0], row[robot][quantities.Y][0]))
            if len(self._path) > PATH_POINTS:
                self._path = self._path[::2]
        self._exclusions.follow(time_s, row)

    def render(self, health: Health, width: int, height: int, status: str = "") -> Text:
        """The screen in at most `width` × `height` characters. Faults and exclusions are never cut."""
        from rich.text import Text

        width = min(width, WIDEST)
        text = Text(no_wrap=True, overflow="crop")
        for line, style in self._fit(self._sections(health, width, status), height - 1):
            text.append(line[:width] + "\n", style=style)
        text.rstrip()
        return text

    @staticmethod
    def _fit(sections: list[tuple[int, list[tuple[str, str]]]], height: int) -> list[tuple[str, str]]:
        """The lines of the sections; those of the lowest priority go first when there are too many."""
        kept = list(sections)
        while sum(len(lines) for _, lines in kept) > height and len(kept) > 1:
            kept.remove(min(kept, key=lambda section: section[0]))
        return [line for _, lines in kept for line in lines]

    def _sections(self, health: Health, width: int, status: str) -> list[tuple[int, list[tuple[str, str]]]]:
        """(priority, [(line, style), …]) from top to bottom."""
        faults = [(line[:width], "bold red") for line in fault_lines(health)]
        faults += [(line, "bold red") for line in self._exclusions.lines()]
        sections = [(9, [(self._head(health, width), "bold")]), (10, faults)]
        link = best_filter(self._row, self._filters, quantities.HEIGHT)
        robot = best_filter(self._row, self._filters, quantities.HEADING)
        if link is not None:
            times, values = [time for time, _ in self._heights], [value for _, value in self._heights]
            lines = curve(times, values, CURVE_S, width, CURVE_ROWS, LEAST_HEIGHT_M)
            sections += [
                (8, [(self._headline(link), "")]),
                (7, [(line, "cyan") for line in lines]),
                (5, self._height_table(link, width)),
            ]
        if robot is not None:
            xs, ys = [x for x, _ in self._path], [y for _, y in self._path]
            lines = path_map(xs, ys, min(width, 60), MAP_ROWS)
            sections += [(8, [("   ".join(pose_text(self._row[robot])), "")]), (6, [(line, "cyan") for line in lines])]
            sections += [(4, self._pose_table())]
        if status:
            sections.append((9, [(status, "yellow")]))
        return [section for section in sections if section[1]]

    def _head(self, health: Health, width: int) -> str:
        sensors = " ".join(
            f"{name.upper()} {of['state'] if of['state'] != 'ok' else 'ok'}"
            for name, of in health.sensors.items()
            if of.get("state") != "absent"
        )
        right = f"{self._time_s:.1f} s  {health.rate_hz:.0f} Hz  {health.lost} lost"
        parts = [f"linkpose  {self._title}", right, sensors]
        line = "  ".join(filter(None, parts))
        if len(line) > width:  # the title is the slowest to change
            line = "  ".join(filter(None, parts[1:]))
        return line

    def _headline(self, name: str) -> str:
        values = self._row[name]
        parts = [f"HEIGHT over joint   {with_std(*values[quantities.HEIGHT], 'm', 4)}"]
        for quantity in (quantities.ROLL, quantities.PITCH, quantities.YAW):
            if quantity in values:
                parts.append(f"{quantity.name} {signed_angle(values[quantity][0])}")
        return "   ".join(parts)

    def _height_table(self, best: str, width: int) -> list[tuple[str, str]]:
        """One line per filter: height, σ, difference from the best; narrow screens drop the difference first."""
        reference = self._row[best][quantities.HEIGHT][0]
        head = f"  {'filter':<16} {'height':>10} {'σ':>9}   difference from best"
        lines = [(head if width >= 60 else head[:40], "dim")]
        for name in self._filters:
            if quantities.HEIGHT not in self._row.get(name, {}):
                continue
            value, std = self._row[name][quantities.HEIGHT]
            line = f"{'▸' if name == best else ' '} {name:<16} {number_text(value, 'm', 4):>10} {std_text(std):>9}"
            if name != best and width >= 60 and math.isfinite(value - reference):
                line += f"   {_signed_length(value - reference)}"
            lines.append((line, "bold" if name == best else ""))
        return lines

    def _pose_table(self) -> list[tuple[str, str]]:
        rows = [(name, self._row[name]) for name in self._filters if quantities.HEADING in self._row.get(name, {})]
        if len(rows) < 2:
            return []
        lines = [(f"  {'filter':<16} {'x':>9} {'y':>9} {'heading':>9}", "dim")]
        for name, values in rows:
            x, y, heading = (values[q][0] for q in (quantities.X, quantities.Y, quantities.HEADING))
            angle = f"{math.degrees(heading):+.1f}°" if math.isfinite(heading) else "–"
            lines.append((f"  {name:<16} {number_text(x, 'm', 3):>9} {number_text(y, 'm', 3):>9} {angle:>9}", ""))
        return lines


def final_table(summary: Mapping[str, tuple[float, float, float]]) -> list[str]:
    """The lines that stay after the end: filter -> (lowest, highest height, RMS of σ), m."""
    lines = [f"  {'filter':<16} {'lowest':>10} {'highest':>10} {'rms σ':>9}"]
    for name, (low, high, std) in summary.items():
        lines.append(f"  {name:<16} {number_text(low, 'm', 4):>10} {number_text(high, 'm', 4):>10} {std_text(std):>9}")
    return lines if summary else []


class Extremes:
    """Lowest and highest height and the RMS of σ of each filter, over all blocks."""

    def __init__(self, columns: Sequence[str]) -> None:
        at = {column: index for index, column in enumerate(columns)}
        self._of = {
            name: (at[found[quantities.HEIGHT]], at.get(quantities.std_column(found[quantities.HEIGHT]) or "", -1))
            for name, found in quantities.by_filter(columns).items()
            if quantities.HEIGHT in found
        }
        self._low = dict.fromkeys(self._of, math.inf)
        self._high = dict.fromkeys(self._of, -math.inf)
        self._squares = dict.fromkeys(self._of, 0.0)
        self._count = dict.fromkeys(self._of, 0)

    def add(self, estimates: Floats) -> None:
        """Takes a block of estimates (N, columns)."""
        import numpy as np

        for name, (value_at, std_at) in self._of.items():
            known = np.isfinite(estimates[:, value_at])
            if not known.any():
                continue
            self._low[name] = min(self._low[name], float(estimates[known, value_at].min()))
            self._high[name] = max(self._high[name], float(estimates[known, value_at].max()))
            if std_at >= 0:
                self._squares[name] += float(np.nansum(estimates[known, std_at] ** 2))
                self._count[name] += int(known.sum())

    def summary(self) -> dict[str, tuple[float, float, float]]:
        """Filter -> (lowest, highest, RMS of σ), of filters that knew a height."""
        return {
            name: (
                low,
                self._high[name],
                math.sqrt(self._squares[name] / self._count[name]) if self._count[name] else math.nan,
            )
            for name, low in self._low.items()
            if math.isfinite(low)
        }


def _signed_length(metres: float) -> str:
    size = abs(metres)
    if size < 0.01:
        return f"{1e3 * metres:+.1f} mm"
    return f"{1e2 * metres:+.1f} cm" if size < 1 else f"{metres:+.2f} m"
