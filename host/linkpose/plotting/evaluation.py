"""The plot of an evaluation: errors with ±2σ, the distribution of error/σ, and the table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from linkpose.evaluation.statistics import normalised_errors
from linkpose.plotting.canvas import (
    finish,
    fit_legends,
    label_time,
    legend_above,
    line_style,
    new_figure,
    without_formulas,
)
from linkpose.plotting.lines import band, draw
from linkpose.plotting.panels import bound_view, is_signed, others_hide_best, shade_errors, which_filters
from linkpose.plotting.sources import is_barometric, shortened
from linkpose.presentation import minus, same_digits, with_unit
from linkpose.quantities import HEIGHT, ROTATION, unit_text, words
from linkpose.sensors.measurements import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from linkpose.evaluation.errors import Errors
    from linkpose.evaluation.scores import Evaluation
    from linkpose.evaluation.scoring import Score

_VECTOR_PARTS = {"position": ("x", "y", "z"), "velocity": ("vx", "vy")}
_ROW_INCHES, _TABLE_ROW_INCHES = 1.6, 0.17
_TABLE_LETTERING = 7.0  # points: nine columns
_TABLE_WIDTHS = (0.14, 0.17, *[0.69 / 7] * 7)  # of its columns, as shares
_MOST_DENSITY = 4.0  # times the normal density's peak, at the top of a histogram
_BINS = np.linspace(-4, 4, 41)


def evaluation(found: Evaluation, estimate: str, reference: str) -> Figure:
    """One row for each quantity: errors of the filters over time, and how error/σ is distributed; the table below.

    Some filters are in the table only (`_shown`). Where the errors of others hide the best filter's in the first row, a
    row above it shows the best filter alone.
    """
    shown = _shown(found.scores)
    rows = [(name, shown) for name in _quantities(shown)]
    best_is_apart = bool(rows) and _hides_best(shown, rows[0][0])
    if best_is_apart:
        rows.insert(0, (rows[0][0], shown[:1]))
    has_sigma = any(_has_sigma(score, name) for name, scores in rows for score in scores)
    table_rows = sum(len(score.errors) for score in found.scores)
    table_inches = 0.5 + _TABLE_ROW_INCHES * (table_rows + 1)
    offset = found.scores[0].time_offset_s
    aligned = f"   ·   clocks aligned by {offset:+.4f} s" if offset else ""
    title = f"{shortened(estimate)} against {shortened(reference)}{aligned}"
    figure = new_figure(0.6 + _ROW_INCHES * len(rows) + table_inches, title)
    heights = [_ROW_INCHES] * len(rows) + [table_inches]
    grid = figure.add_gridspec(len(rows) + 1, 2, width_ratios=[2.2, 1], height_ratios=heights)
    last = next((name for name, scores in reversed(rows) if any(_has_sigma(score, name) for score in scores)), "")
    first: Axes | None = None
    for row, (name, scores) in enumerate(rows):
        axes = figure.add_subplot(grid[row, 0] if has_sigma else grid[row, :], sharex=first)
        first = first or axes
        which = which_filters(row == 0, best_is_apart and row < 2)
        _errors(axes, scores, name, which)
        axes.tick_params(labelbottom=row == len(rows) - 1)
        if row == len(rows) - 1:
            label_time(axes)
        if any(_has_sigma(score, name) for score in scores):
            _histogram(figure.add_subplot(grid[row, 1]), scores, name, name == last)
    figure.align_ylabels()
    _table(figure.add_subplot(grid[-1, :]), found.scores)
    return fit_legends(without_formulas(figure))


def _has_sigma(score: Score, name: str) -> bool:
    return name in score.errors and score.errors[name].statistics().nees is not None


def _hides_best(scores: Sequence[Score], name: str) -> bool:
    errors = [score.errors[name] for score in scores if name in score.errors]
    return name in scores[0].errors and others_hide_best(errors)


def _shown(scores: Sequence[Score]) -> list[Score]:
    """The filters that are drawn: no barometric ones, and beside a chain no filters of one of its sensors."""
    if chains := [score for score in scores if ROTATION.name in score.errors]:
        return chains
    quiet = [score for score in scores if not is_barometric(score.filter)]
    return quiet or list(scores)


def _quantities(scores: Sequence[Score]) -> list[str]:
    """Names in the order of the first filter that has them, a vector in place of its components.

    The height of a link is first, and the position of a robot.
    """
    names = list(dict.fromkeys(name for score in scores for name in score.errors))
    for vector, parts in _VECTOR_PARTS.items():
        if vector in names:
            names = [name for name in names if name not in parts]
    if "position" in names and HEIGHT.name not in names:
        names.insert(0, names.pop(names.index("position")))
    return names


def _std(score: Score, name: str) -> Floats | None:
    """σ of a quantity; of a vector, the square root of the sum of its components' variances."""
    std = score.errors[name].std
    parts = [score.errors[part].std for part in _VECTOR_PARTS.get(name, ()) if part in score.errors]
    known = [part for part in parts if part is not None]
    return np.asarray(np.sqrt(np.sum(np.square(known), axis=0))) if std is None and parts and known == parts else std


def _errors(axes: Axes, scores: Sequence[Score], name: str, which: str) -> None:
    """Errors of the filters over time, with 2σ of the best; `which` says which filters, where that needs saying."""
    unit, drawn, stds, order = "", list[Floats](), list[Floats](), list[str]()
    for score in scores:
        of = score.errors.get(name)
        if of is None:
            continue
        unit = unit_text(of.unit)
        label = f"{score.filter} {with_unit(f'{of.statistics().rmse:.3g}', unit)} rms"
        order.append(label)
        draw(axes, of.time_s, of.error, label=label, **line_style(score.filter))
        drawn.append(of.error)
        if not stds and (std := _std(score, name)) is not None:
            stds.append(np.where(np.isfinite(of.error), std, np.nan))
            colour = str(line_style(score.filter)["color"])
            sign = "±" if is_signed(of.error) else ""
            band(axes, of.time_s, np.zeros(len(of.time_s)), stds[0], colour, f"{sign}2σ {score.filter}")
    shade_errors(axes, [score.errors[name] for score in scores if name in score.errors])
    axes.axhline(0.0, color="black", linewidth=0.6)
    bound_view(axes, drawn, stds)
    finish(axes, f"{words(name)} error ({unit}){which}")
    legend_above(axes, order)


def _histogram(axes: Axes, scores: Sequence[Score], name: str, is_last: bool) -> None:
    """Density of error/σ of each filter beside the normal one."""
    for score in scores:
        of = score.errors.get(name)
        if of is None or of.std is None:
            continue
        share = of.statistics().within_2sigma
        values = _normalised(of)
        if share is None or not len(values):
            continue
        density = np.histogram(np.clip(values, _BINS[0], _BINS[-1]), _BINS, density=True)[0]
        style = line_style(score.filter)
        axes.stairs(
            density,
            _BINS,
            color=style["color"],
            linewidth=style["linewidth"],
            label=f"{score.filter} {100 * share:.0f} %",
        )
    at = np.linspace(_BINS[0], _BINS[-1], 200)
    normal = np.exp(-0.5 * at**2) / np.sqrt(2 * np.pi)
    if all(is_signed(score.errors[name].error) for score in scores if name in score.errors):
        axes.plot(at, normal, color="black", linestyle="--", linewidth=0.9)
    axes.axvspan(-2, 2, color="black", alpha=0.06, linewidth=0)
    # Errors far smaller than σ make a peak, under which those of the other filters would be flat lines.
    axes.set_ylim(0.0, min(axes.get_ylim()[1], _MOST_DENSITY * normal.max()))
    finish(axes, "density")
    if is_last:
        axes.set_xlabel("error / σ; legend: share\nwithin ±2σ (95 % expected)", fontsize=_TABLE_LETTERING)
    legend_above(axes)


def _normalised(of: Errors) -> Floats:
    std = of.std if of.std is not None else np.full(len(of.error), np.nan)
    return normalised_errors(of.error, std, of.least_std)


def _table(axes: Axes, scores: Sequence[Score]) -> None:
    rows, colours = [], []
    for score in scores:
        for name, value in score.statistics().items():
            unit = unit_text(score.errors[name].unit)
            figures = map(minus, same_digits(value.rmse, value.mean, value.worst, value.p95))
            sigma = ["", ""]
            if value.nees is not None and value.within_2sigma is not None:
                sigma = [f"{value.nees:.3g}", f"{100 * value.within_2sigma:.0f} %"]
            rows.append([score.filter, f"{words(name)} ({unit})", *figures, *sigma, str(value.rows)])
            colours.append(str(line_style(score.filter)["color"]))
    head = ["filter", "quantity", "RMSE", "mean", "worst", "95 %", "NEES", "within ±2σ", "rows"]
    axes.axis("off")
    table = axes.table(rows, colLabels=head, colWidths=_TABLE_WIDTHS, loc="upper center", cellLoc="right", edges="open")
    table.auto_set_font_size(False)
    table.set_fontsize(_TABLE_LETTERING)
    for row, colour in enumerate(colours, 1):
        table[row, 0].get_text().set_color(colour)
    for (row, column), cell in table.get_celld().items():
        cell.set_height(1.0 / (len(rows) + 1))
        cell.visible_edges = "B" if row == 0 else ""
        cell.set_text_props(ha="left" if column < 2 else "right", va="center_baseline")
        cell.PAD = 0.02
