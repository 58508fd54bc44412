"""Signals as lines: with breaks at gaps, in as few points as a picture shows, and shades where nothing is known."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from linkpose.evaluation.series import interval
from linkpose.recording.table import LONGEST_HOLE
from linkpose.sensors.measurements import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_POINTS = 4000  # of a line: more than a picture has columns of pixels
# Three of four steps of a recording with a rate are shorter than so many usual ones, even if many samples are lost. In
# the public log of the Intel laboratory it is 2.3. Without a rate, this share of the steps is ordinary.
_REGULAR, _ORDINARY = 1.5, 0.95
_GAP, _UNKNOWN = "#555555", "#E8B04B"


def is_regular(time_s: Floats) -> bool:
    """Whether samples have a rate. A log that is written as a robot moves, or by several sensors, has none."""
    return len(time_s) < 3 or bool(np.quantile(np.diff(time_s), 0.75) <= _REGULAR * interval(time_s))


def longest_step(time_s: Floats) -> float:
    """The longest step between two samples that is no gap (s)."""
    step = interval(time_s) if is_regular(time_s) else float(np.quantile(np.diff(time_s), _ORDINARY))
    return LONGEST_HOLE * step


def gaps(time_s: Floats) -> list[tuple[float, float]]:
    """From and to of each stretch without a sample."""
    at = np.flatnonzero(np.diff(time_s) > longest_step(time_s))
    return [(float(time_s[i]), float(time_s[i + 1])) for i in at]


def lost_samples(time_s: Floats) -> int:
    """Samples that the gaps would hold."""
    step = interval(time_s)
    return sum(max(1, round((end - start) / step) - 1) for start, end in gaps(time_s)) if step > 0 else 0


def broken(time_s: Floats, *values: Floats, period: float | None = None) -> tuple[Floats, ...]:
    """Times and values with NaN at each gap, and where the first value, an angle, passes from one end to the other."""
    clean = [np.where(np.isfinite(value), value, np.nan) for value in values]
    is_break = np.diff(time_s) > longest_step(time_s)
    if period is not None:
        with np.errstate(invalid="ignore"):
            is_break = is_break | (np.abs(np.diff(clean[0])) > period / 2)
    at = np.flatnonzero(is_break) + 1
    return np.insert(time_s, at, time_s[at - 1]), *(np.insert(value, at, np.nan) for value in clean)


def decimated(time_s: Floats, *values: Floats) -> tuple[Floats, ...]:
    """At most some MOST_POINTS of the samples: the extremes of the first value in each of equal parts, and breaks."""
    if len(time_s) <= MOST_POINTS:
        return time_s, *values
    size = -(-len(time_s) // (MOST_POINTS // 3))
    keep: NDArray[np.bool_] = np.zeros(len(time_s), np.bool_)
    value = values[0]
    for first in range(0, len(time_s), size):
        part = value[first : first + size]
        known = np.isfinite(part)
        if known.any():
            keep[first + int(np.argmin(np.where(known, part, np.inf)))] = True
            keep[first + int(np.argmax(np.where(known, part, -np.inf)))] = True
        if not known.all():
            keep[first + int(np.argmin(known))] = True
    return time_s[keep], *(v[keep] for v in values)


def draw(axes: Axes, time_s: Floats, value: Floats, period: float | None = None, **style: Any) -> None:
    """A line over time, broken at gaps and where an angle wraps."""
    times, values = decimated(*broken(time_s, value, period=period))
    axes.plot(times, values, **style)
    alone = _alone(values)
    if alone.any():
        dots = style | {"label": None, "linestyle": "none"}
        axes.plot(times[alone], values[alone], marker=".", markersize=4, **dots)


def _alone(values: Floats) -> NDArray[np.bool_]:
    """Values between two that are missing: no line and no band has one point."""
    known = np.concatenate([[False], np.isfinite(values), [False]])
    return np.asarray(known[1:-1] & ~known[:-2] & ~known[2:])


def band(axes: Axes, time_s: Floats, middle: Floats, std: Floats, colour: str, label: str | None = None) -> None:
    """±2σ about a line, as a band: σ is never a curve of its own."""
    from linkpose.plotting.canvas import BAND_ALPHA

    t, mean, sigma = decimated(*broken(time_s, middle, std))
    axes.fill_between(
        t, mean - 2 * sigma, mean + 2 * sigma, color=colour, alpha=BAND_ALPHA, linewidth=0, label=label, zorder=1
    )
    alone = _alone(mean - sigma)
    if alone.any():
        low, high = (mean + factor * sigma for factor in (-2.0, 2.0))
        axes.vlines(t[alone], low[alone], high[alone], color=colour, alpha=BAND_ALPHA, linewidth=5.0, zorder=1)


def shade(axes: Axes, time_s: Floats, unknown: NDArray[np.bool_] | None) -> None:
    """Shades gaps, and stretches in which nothing is known (invalid samples, no estimate)."""
    spans = gaps(time_s)
    if spans:
        _spans(axes, spans, _GAP, 0.22, "gap")
    if unknown is not None and unknown.any():
        edges = np.flatnonzero(np.diff(np.concatenate([[False], unknown, [False]]).astype(np.int8)))
        last = len(time_s) - 1
        stretches = [(float(time_s[a]), float(time_s[min(b, last)])) for a, b in edges.reshape(-1, 2)]
        _spans(axes, stretches, _UNKNOWN, 0.30, "no valid value")


def _spans(axes: Axes, spans: list[tuple[float, float]], colour: str, alpha: float, label: str) -> None:
    axes.broken_barh(
        [(start, end - start) for start, end in spans], (0, 1), transform=axes.get_xaxis_transform(), color=colour,
        alpha=alpha, linewidth=0, label=label, zorder=0,
    )  # fmt: skip
