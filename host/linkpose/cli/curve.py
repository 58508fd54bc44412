"""A curve drawn with Braille characters, for a terminal that shows numbers and motion at once."""

from __future__ import annotations

import math
from collections.abc import Sequence

from linkpose.presentation import minus

# Bit of each of the 2 × 4 dots of a Braille cell (Unicode, U+2800), by row and column.
_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_BLANK = 0x2800


class Canvas:
    """Dots on a grid of `width` × `height` characters; each character holds 2 × 4 dots."""

    def __init__(self, width: int, height: int) -> None:
        self.columns, self.rows = 2 * width, 4 * height
        self._cells = [[_BLANK] * width for _ in range(height)]

    def dot(self, x: int, y: int) -> None:
        """Sets a dot; (0, 0) is at the top left. A dot outside the grid is left out."""
        if 0 <= x < self.columns and 0 <= y < self.rows:
            self._cells[y // 4][x // 2] |= _DOTS[y % 4][x % 2]

    def line(self, start: tuple[int, int], end: tuple[int, int]) -> None:
        """Sets the dots from one (x, y) to another."""
        (x0, y0), (x1, y1) = start, end
        steps = max(abs(x1 - x0), abs(y1 - y0), 1)
        for step in range(steps + 1):
            self.dot(x0 + round((x1 - x0) * step / steps), y0 + round((y1 - y0) * step / steps))

    def lines(self) -> list[str]:
        """The characters, row by row."""
        return ["".join(map(chr, row)) for row in self._cells]


def curve(
    times: Sequence[float], values: Sequence[float], span_s: float, width: int, height: int, least: float
) -> list[str]:
    """The last `span_s` seconds of a value as lines of text, with its scale on the left.

    `width` and `height` are in characters, the scale included; the vertical range covers the values and at least
    `least`. NaN leaves a gap.
    """
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return [" " * width] * height
    low, step, decimals = _scale(min(known), max(known), least, max(height - 1, 1))
    high = low + step * max(height - 1, 1)
    labels = [minus(f"{high - step * row + 0.0:.{decimals}f}") for row in range(height)]  # + 0.0: no "−0"
    margin = max(map(len, labels))
    canvas = Canvas(max(width - margin - 1, 1), height)
    end = times[-1]
    before: tuple[int, int] | None = None
    for time, value in zip(times, values, strict=True):
        if not math.isfinite(value) or time < end - span_s:
            before = None
            continue
        x = round((1 - (end - time) / span_s) * (canvas.columns - 1))
        # A label stands in the middle of its row of characters, which are four dots high.
        y = round(4 * (high - value) / step + 1.5)
        canvas.line(before or (x, y), (x, y))
        before = x, y
    return [f"{label:>{margin}}┤{line}" for label, line in zip(labels, canvas.lines(), strict=True)]


def time_axis(span_s: float, margin: int, width: int) -> str:
    """The line below a curve: where its time begins, and now; `margin` characters are left of its first dot."""
    line = f"{' ' * margin}└ {span_s:g} s ago"
    return f"{line} {'─' * max(width - len(line) - 6, 0)} now"


def _scale(low: float, high: float, least: float, steps: int) -> tuple[float, float, int]:
    """The lowest label, the step and the decimals of a scale that covers a range of at least `least`.

    Labels have two digits that differ, so that they are short and the curve still fills most of the height.
    """
    if high - low < least:
        low, high = 0.5 * (low + high - least), 0.5 * (low + high + least)
    place = math.floor(math.log10(high - low)) - 1
    unit = 10.0**place
    start = math.floor(low / unit + 1e-6)
    step = math.ceil((high / unit - start) / steps - 1e-6)
    return start * unit, step * unit, max(0, -place)


def path_map(xs: Sequence[float], ys: Sequence[float], width: int, height: int) -> tuple[list[str], str]:
    """A path seen from above as lines of text, x to the right and y upwards, and the line with its scale.

    x and y have one scale; `o` is where the robot is now.
    """
    known = [(x, y) for x, y in zip(xs, ys, strict=True) if math.isfinite(x) and math.isfinite(y)]
    if not known:
        return [" " * width] * height, ""
    canvas = Canvas(width, height)
    lows, highs = ([pick(axis) for axis in zip(*known, strict=True)] for pick in (min, max))
    # Metres a dot; the smallest picture is a metre wide, so that a robot at rest does not jitter over the screen.
    scale = max((highs[0] - lows[0]) / (canvas.columns - 1), (highs[1] - lows[1]) / (canvas.rows - 1), 1 / 100)
    left = 0.5 * (lows[0] + highs[0]) - 0.5 * scale * (canvas.columns - 1)
    top = 0.5 * (lows[1] + highs[1]) + 0.5 * scale * (canvas.rows - 1)
    before: tuple[int, int] | None = None
    for x, y in known:
        here = round((x - left) / scale), round((top - y) / scale)
        canvas.line(before or here, here)
        before = here
    lines = canvas.lines()
    if before is not None:
        column, row = min(before[0] // 2, width - 1), min(before[1] // 4, height - 1)
        lines[row] = lines[row][:column] + "o" + lines[row][column + 1 :]
    return lines, _scale_bar(2 * scale, width)


def _scale_bar(metres: float, width: int) -> str:
    """A bar of a round length, at most a third of `width` characters; `metres` is the width of one of them."""
    longest = metres * width / 3
    decade = 10.0 ** math.floor(math.log10(longest))
    length = max(factor * decade for factor in (1, 2, 5) if factor * decade <= longest)
    return f"├{'─' * (round(length / metres) - 2)}┤ {length:g} m"
