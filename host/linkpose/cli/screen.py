"""What the live view shows: the best estimate with its σ, its curve over the last seconds, and the other filters.

Text of a given size, which needs no terminal: `linkpose.cli.view` puts it on one.
"""

from __future__ import annotations

import math
import textwrap
from collections import deque
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from linkpose import quantities
from linkpose.cli.curve import curve, path_map, time_axis
from linkpose.device.session import Health
from linkpose.errors import printable
from linkpose.exclusions import Exclusions
from linkpose.filters import required_sensors
from linkpose.presentation import (
    Row,
    RowReader,
    aligned_length,
    angle_with_std,
    best_filter,
    current,
    fault_lines,
    is_stale,
    joint_angle,
    joint_texts,
    length_with_std,
    lost_since,
    minus,
    pose_text,
    signed_angle,
    state_text,
    std_text,
)
from linkpose.quantities import Quantity
from linkpose.sensors.measurements import Floats

if TYPE_CHECKING:
    from rich.text import Text

    from linkpose.extremes import Summary

CURVE_S = 20.0  # of the past that the curve shows
CURVE_ROWS, MAP_ROWS = 5, 8
POINT_INTERVAL_S = 0.05  # between two points of a curve: a column of dots is wider
PATH_POINTS = 4000  # of the map; older ones are thinned out
WIDEST = 78
_LEAST_WIDTH = 20  # of a part of a line
LEAST_HEIGHT_M = 0.02  # that the curve's axis covers: noise does not fill the screen
LEAST_ANGLE_DEG = 5.0  # that the axis of a joint angle covers
_FAULTS, _HEADLINE, _EMPTY = 10, 8, 0  # priorities of sections

Points = deque[tuple[float, float]]  # time (s) and value


class Screen:
    """The content of the view, as text of a given size."""

    def __init__(self, title: str, columns: Sequence[str], keys: str = "") -> None:
        """`columns` are those of the estimates; `keys` is the line about keys."""
        self._rows, self._columns = RowReader(columns), columns
        self._title, self._filters, self._keys = title, self._rows.filters, keys
        self._time_s = 0.0
        self._newest: Row = {}
        self._row: Row = {}  # the newest as it is shown
        self._chosen: str | None = None  # None: the best filter
        self.forget()

    def forget(self) -> None:
        """Removes all rows, and with them the curves and paths."""
        # By filter: the curve of one filter shows no jump where another one was the best before.
        self._heights: dict[str, Points] = {}
        self._has_height = False  # ever; without J2S, a link's filters have a height without a value
        self._angles: dict[str, Points] = {}  # of a chain's joint
        self._paths: dict[str, list[tuple[float, float]]] = {}
        self._exclusions = Exclusions(self._columns)

    def next_filter(self) -> None:
        """Shows the next filter of the table; after the last one, the best one again."""
        shown = quantities.HEIGHT if self._shows_height else quantities.HEADING
        able = [name for name in self._filters if shown in self._newest.get(name, {})]
        later = able[able.index(self._shown(shown) or able[-1]) + 1 :] if able else []
        self._chosen = later[0] if later else None

    @property
    def _shows_height(self) -> bool:
        """Whether a height is shown; a robot has one only where J2S is known."""
        is_robot = self._shown(quantities.HEADING) is not None
        return self._shown(quantities.HEIGHT) is not None and (self._has_height or not is_robot)

    def add(self, rows: Floats) -> None:
        """Adds rows (N ≥ 1, columns) of estimates."""
        times = rows[:, 0].tolist()
        self._time_s, self._newest = times[-1], self._rows.read(rows[-1].tolist())
        for name, values in self._rows.series(rows).items():
            if quantities.HEIGHT in values:
                heights_m = values[quantities.HEIGHT]
                self._has_height |= bool(np.isfinite(heights_m).any())
                _add_points(self._heights, name, times, heights_m)
            if (angles_deg := joint_angle(values)) is not None:
                _add_points(self._angles, name, times, angles_deg)
            if quantities.HEADING in values and quantities.X in values and quantities.Y in values:
                self._add_places(name, values[quantities.X], values[quantities.Y])
        self._exclusions.follow(rows)

    def _add_places(self, name: str, x_m: Floats, y_m: Floats) -> None:
        path = self._paths.setdefault(name, [])
        path.extend(zip(x_m.tolist(), y_m.tolist(), strict=True))
        while len(path) > PATH_POINTS:
            del path[::2]

    def _shown(self, quantity: Quantity) -> str | None:
        """The filter whose value of this quantity is shown: the chosen one if it has it, otherwise the best one."""
        if self._chosen is not None and quantity in self._row.get(self._chosen, {}):
            return self._chosen
        return best_filter(self._row, self._filters, quantity)

    def render(self, health: Health, width: int, height: int, status: str = "") -> Text:
        """The screen in at most `width` × `height` characters. Faults and exclusions are never cut."""
        from rich.text import Text

        width = min(width, WIDEST)
        text = Text(no_wrap=True, overflow="crop")
        for line, style in self._fit(self._sections(health, width, status), height - 1):
            text.append(printable(line)[:width] + "\n", style=style)
        text.rstrip()
        return text

    def line(self, health: Health, width: int) -> str:
        """Time, faults and headlines, as far as they fit one line of at most `width` characters."""
        text, width = f"{self._time_s:.1f} s", min(width, WIDEST)
        for wanted in (_FAULTS, _HEADLINE):
            for priority, lines in self._sections(health, max(width - len(text) - 3, _LEAST_WIDTH), ""):
                if priority == wanted:
                    text += f"   {lines[0][0]}"
        return text[:width]

    @staticmethod
    def _fit(sections: list[tuple[int, list[tuple[str, str]]]], height: int) -> list[tuple[str, str]]:
        """The lines of the sections; those of the lowest priority go first when there are too many."""
        kept = list(sections)
        while sum(len(lines) for _, lines in kept) > height and len(kept) > 1:
            kept.remove(min(kept, key=lambda section: section[0]))
        return [line for _, lines in kept for line in lines]

    def _sections(self, health: Health, width: int, status: str) -> list[tuple[int, list[tuple[str, str]]]]:
        """(priority, [(line, style), …]) from top to bottom."""
        self._row = current(self._newest, health, required_sensors)
        self._end_curves(health)
        found = fault_lines(health, self._exclusions)
        faults = [(part, "bold red") for line in found for part in textwrap.wrap(line, width)]
        sections = [(9, [(line, "bold") for line in self._head(health, width)]), (_FAULTS, faults)]
        chain = next((name for name in self._filters if joint_angle(self._row.get(name, {})) is not None), None)
        link, robot = self._shown(quantities.HEIGHT), self._shown(quantities.HEADING)
        if chain is not None:
            sections += self._chain_sections(chain, width)
        if link is not None and self._shows_height:
            sections += self._link_sections(link, width)
        if robot is not None:
            sections += self._robot_sections(robot, width)
        sections += [(9, [(status, "bold")] if status else []), (1, [(self._keys, "dim")] if self._keys else [])]
        return [section for section in sections if section[1]]

    def _end_curves(self, health: Health) -> None:
        """Takes off the curves what filters predicted since they lost a sensor: in numbers, it is blank too."""
        for curves in (self._heights, self._angles):
            for name, points in curves.items():
                lost_s = lost_since(name, health, required_sensors)
                while points and points[-1][0] >= lost_s:
                    points.pop()

    def _link_sections(self, name: str, width: int) -> list[tuple[int, list[tuple[str, str]]]]:
        points = self._heights.get(name, ())
        table = (5, self._height_table(name, width))
        return [
            (_HEADLINE, [(self._headline(name, width), "")]),
            *_curve_sections(6, points, width, LEAST_HEIGHT_M),
            table,
        ]

    def _robot_sections(self, name: str, width: int) -> list[tuple[int, list[tuple[str, str]]]]:
        path = self._paths.get(name, ())
        lines, scale = path_map([x for x, _ in path], [y for _, y in path], min(width, 60), MAP_ROWS)
        head = (_HEADLINE, [(line, "") for line in _packed(pose_text(self._row[name]), width)])
        return [head, (6, [(line, "") for line in lines]), (2, [(scale, "dim")]), (4, self._pose_table(name))]

    def _chain_sections(self, name: str, width: int) -> list[tuple[int, list[tuple[str, str]]]]:
        """The joint's angles, both heights (narrow screens drop the last ones), and the curve of the first angle."""
        values = self._row[name]
        parts = joint_texts(values)
        for number, quantity in enumerate((quantities.HEIGHT1, quantities.HEIGHT2), 1):
            if quantity in values:
                parts.append(f"height {number} {length_with_std(*values[quantity])}")
        while len(parts) > 1 and len("   ".join(parts)) > width:
            parts.pop()
        curve_below = _curve_sections(7, self._angles.get(name, ()), width, LEAST_ANGLE_DEG)
        return [(_HEADLINE, [("   ".join(parts), "")]), *curve_below]

    def _head(self, health: Health, width: int) -> list[str]:
        """Title, time, rate, losses and the state of the sensors.

        Narrow screens drop the title, then rate and time; the state of a sensor, unknown without samples, is never cut.
        """
        states = [
            f"{name.upper()} {'–' if is_stale(health) else state_text(of)}"
            for name, of in health.sensors.items()
            if of.get("state") != "absent"
        ]
        sensors = " ".join(states)
        lost = f"{health.lost} lost"
        parts = [f"linkpose  {self._title}", f"{self._time_s:.1f} s", f"{health.rate_hz:.0f} Hz", lost, sensors]
        for slow in (parts[0], parts[2], parts[1]):  # the slowest to change goes first
            if len("  ".join(filter(None, parts))) > width:
                parts.remove(slow)
        line = "  ".join(filter(None, parts))
        return [line] if len(line) <= width else _packed([lost, *states], width)

    def _headline(self, name: str, width: int) -> str:
        """Height, and roll, pitch and yaw as far as they are known; narrow screens drop the last ones."""
        values = self._row[name]
        parts = [f"HEIGHT over joint   {length_with_std(*values[quantities.HEIGHT])}"]
        for quantity in (quantities.ROLL, quantities.PITCH, quantities.YAW):
            if quantity in values and math.isfinite(values[quantity][0]):
                parts.append(f"{quantity.name} {signed_angle(values[quantity][0])}")
        while len(parts) > 1 and len("   ".join(parts)) > width:
            parts.pop()
        if len(parts[0]) > width:
            parts[0] = f"HEIGHT {length_with_std(*values[quantities.HEIGHT])}"
        return "   ".join(parts)

    def _height_table(self, best: str, width: int) -> list[tuple[str, str]]:
        """One line per filter: height, σ, difference from the best; narrow screens drop the difference first."""
        reference = self._row[best][quantities.HEIGHT][0]
        short = f"  {'filter':<16} {'height':>10} {'σ':>9}"
        head = f"{short}   difference from best"
        has_difference = len(head) <= width
        lines = [(head if has_difference else short, "dim")]
        for name in self._filters:
            if quantities.HEIGHT not in self._row.get(name, {}):
                continue
            value, std = self._row[name][quantities.HEIGHT]
            line = f"{'▸' if name == best else ' '} {name:<16} {aligned_length(value, std):>10} {std_text(std):>9}"
            if name != best and has_difference and math.isfinite(value - reference):
                line += f"   {_signed_length(value - reference)}"
            lines.append((line, "bold" if name == best else ""))
        return lines

    def _pose_table(self, shown: str) -> list[tuple[str, str]]:
        rows = [(name, self._row[name]) for name in self._filters if quantities.HEADING in self._row.get(name, {})]
        if len(rows) < 2:
            return []
        lines = [(f"  {'filter':<16} {'x':>10} {'y':>10} {'heading':>9}", "dim")]
        for name, values in rows:
            x, y = (aligned_length(*values[q]) for q in (quantities.X, quantities.Y))
            heading = values[quantities.HEADING][0]
            angle = signed_angle(math.degrees(heading)) if math.isfinite(heading) else "–"
            line = f"{x:>10} {y:>10} {angle:>9}"
            lines.append((f"{'▸' if name == shown else ' '} {name:<16} {line}", "bold" if name == shown else ""))
        return lines


def _packed(parts: Iterable[str], width: int) -> list[str]:
    """Texts side by side, on as many lines of this width as they need."""
    lines: list[str] = []
    for part in parts:
        if lines and len(f"{lines[-1]}   {part}") <= width:
            lines[-1] += f"   {part}"
        else:
            lines.append(part)
    return lines


def _add_points(curves: dict[str, Points], name: str, times: Sequence[float], values: Floats) -> None:
    """Adds points to a filter's curve, except those that are close to the one before."""
    points = curves.setdefault(name, deque(maxlen=round(CURVE_S / POINT_INTERVAL_S) + 1))
    last_s = points[-1][0] if points else -math.inf
    for time_s, value in zip(times, values.tolist(), strict=True):
        # A stamp lies a little before or after its tick: some slack keeps the points evenly spaced.
        if time_s - last_s >= 0.9 * POINT_INTERVAL_S:
            points.append((time_s, value))
            last_s = time_s


def _curve_sections(
    priority: int, points: Iterable[tuple[float, float]], width: int, least: float
) -> list[tuple[int, list[tuple[str, str]]]]:
    """The curve of the last seconds, whose axis covers at least `least`, and its time axis, which goes sooner."""
    times, values = [time for time, _ in points], [value for _, value in points]
    lines = curve(times, values, CURVE_S, width, CURVE_ROWS, least)
    priority = priority if any(map(math.isfinite, values)) else _EMPTY
    axis = time_axis(CURVE_S, lines[0].find("┤"), width) if "┤" in lines[0] else ""
    return [(priority, [(line, "") for line in lines]), (2, [(axis, "dim")] if axis else [])]


def final_table(summary: Summary, width: int) -> list[str]:
    """The lines that stay after the end: the extremes and the median σ of each quantity.

    The last column is left out where the lines would be wider than `width` characters.
    """
    rows = [("filter", "lowest", "highest", "median σ")]
    for (name, quantity), (low, high, std) in summary.items():
        title = name if quantity == quantities.HEIGHT else f"{name} {quantities.words(quantity.name)}"
        if quantity.is_angle:
            low, high, std = (quantity.value.scale * value for value in (low, high, std))
            lowest, _, bound = angle_with_std(low, std).partition(" ±")
            shown = lowest, angle_with_std(high, std).partition(" ±")[0], bound or "–"
        else:
            shown = aligned_length(low, std), aligned_length(high, std), std_text(std)
        rows.append((title, *shown))
    if not summary:
        return []
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    columns = 4 if sum(widths) + 2 * len(widths) <= width else 3
    return [
        f"  {title:<{widths[0]}}"
        + "".join(f"  {value:>{w}}" for value, w in zip(values, widths[1:columns], strict=False))
        for title, *values in rows
    ]


def _signed_length(metres: float) -> str:
    size = abs(metres)
    if size < 5e-5:
        return " 0.0 mm"  # without a sign, as an angle
    if size < 0.01:
        return minus(f"{1e3 * metres:+.1f} mm")
    return minus(f"{1e2 * metres:+.1f} cm" if size < 1 else f"{metres:+.2f} m")
