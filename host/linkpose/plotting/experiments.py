"""The papers' figures, from `linkpose.experiments`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from linkpose.plotting.canvas import OTHERS, TRUTH, finish, legend_above, line_style, new_figure
from linkpose.plotting.lines import draw
from linkpose.sensors.measurements import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

    from linkpose.experiments.link import Traces
    from linkpose.experiments.mice import PaperRun
    from linkpose.experiments.variants import Variant

_SHOWN_S = (30.0, 35.0)  # the five seconds of Figure 2 (a) and (b)
_WHOLE = 3  # Figure 2 shows the whole run of this Test
_MICE_SHOWN_S = 4.0
_VARIANT_LETTERING = 7.0  # points: names of variants beside their errors
_APART = 0.4  # rows between two filters in one row


def paper_figure_2(runs: Sequence[Traces]) -> Figure:
    """Heights of all methods on Tests 1 to 3, as Figure 2 of [Link]: five seconds of Tests 1 and 2, all of Test 3.

    The axes are scaled to the truth and the inertial filters; barometric heights leave the picture where they are off.
    """
    from linkpose.experiments.link import title

    figure = new_figure(7.0, "Height of the sensor over the joint ([Link], Figure 2), simulated, seed 0")
    for axes, run in zip(figure.subplots(len(runs), 1), runs, strict=True):
        best_first = ["joint-inertial", "joint", "tilt", "imu-baro", "baro"]
        for name in reversed(best_first):
            style = line_style(name) | ({"alpha": 0.4, "linewidth": 0.7} if name == "baro" else {})
            draw(axes, run.time_s, 100 * run.height_m[name], label=title(name), **style)
        draw(axes, run.time_s, 100 * run.truth_m, label="truth", **TRUTH)
        finish(axes, f"Test {run.test}: height (cm)")
        inside = np.full(len(run.time_s), True)
        if run.test != _WHOLE:
            axes.set_xlim(*_SHOWN_S)
            inside = (run.time_s >= _SHOWN_S[0]) & (run.time_s <= _SHOWN_S[1])
        _scale_to(axes, 100 * np.concatenate([run.truth_m[inside], run.height_m["tilt"][inside]]))
        if run is runs[0]:
            legend_above(axes, [title(name) for name in best_first])
    figure.axes[-1].set_xlabel("time (s)")
    return figure


def _scale_to(axes: Axes, values: Floats) -> None:
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    margin = max(0.6 * (high - low), 1.0)
    axes.set_ylim(low - margin, high + margin)


def redundant_mice(run: PaperRun) -> Figure:
    """Velocity of each mouse and of all together, as Figures 2 and 3 of [Mice]."""
    figure = new_figure(5.6)
    axes = figure.subplots(3, 2, sharex=True, sharey="row")
    labels = ("$v_x$ (cm/s)", "$v_y$ (cm/s)", "ω (rad/s)")
    fused_style = line_style("planar-ekf")
    for j, (label, scale) in enumerate(zip(labels, (100.0, 100.0, 1.0), strict=True)):
        single = run.single[..., j] - (run.single[..., j].mean(axis=0) - run.truth[j] if j == 2 else 0.0)
        for mouse in range(run.single.shape[1]):
            style = {"color": OTHERS[mouse % len(OTHERS)], "linewidth": 0.7}
            axes[j, 0].plot(run.time_s, scale * single[:, mouse], label=f"mouse {mouse + 1}", **style)
        axes[j, 1].plot(run.time_s, scale * run.fused[:, j], color=fused_style["color"], linewidth=1.0, label="fused")
        for place in axes[j]:
            place.axhline(scale * run.truth[j], label="truth", **TRUTH)
            finish(place, "")
        axes[j, 0].set_ylabel(label)
    figure.draw_without_rendering()  # lays the axes out: the entries of a legend fit in one row just so
    for place, title in zip(axes[0], ("Each mouse alone (Figure 2)", "Least squares (Figure 3)"), strict=True):
        legend_above(place, title=title)
    for place in axes[-1]:
        place.set_xlabel("time (s)")
        place.set_xlim(0, _MICE_SHOWN_S)
    return figure


def variants(title: str, compared: Sequence[Variant], labels: Sequence[tuple[str, str]]) -> Figure:
    """Position error of each variant: a dot for each seed, a bar for the mean.

    `labels` are the conditions and the settings of each. Variants of the same conditions stand together, and those of
    the same settings in one row, a filter above the other.
    """
    rows = _rows_of_variants(labels)
    figure = new_figure(1.2 + 0.17 * len(rows), title)
    axes = figure.add_subplot()
    names = list(dict.fromkeys(variant.filter for variant in compared))
    for variant, of in zip(compared, labels, strict=True):
        errors = [score.position_rmse_m for score in variant.scores]
        row = rows.index(of) + _APART * (names.index(variant.filter) - 0.5 * (len(names) - 1))
        colour = line_style(variant.filter)["color"]
        axes.plot(errors, [row] * len(errors), "o", color=colour, alpha=0.5, markersize=3, label=variant.filter)
        axes.plot([variant.position_rmse_m()], [row], "|", color=colour, markersize=6, markeredgewidth=2)
    axes.plot([], [], "|", color="black", markersize=6, markeredgewidth=2, label="mean of the runs")
    axes.set_yticks(range(len(rows)), [settings or conditions for conditions, settings in rows])
    axes.set_xscale("log")
    _label_plainly(axes.xaxis)
    axes.set_xlabel("position error, rms of a run (m)")
    finish(axes, "")
    for text, (_, settings) in zip(axes.get_yticklabels(), rows, strict=True):
        text.set_fontsize(_VARIANT_LETTERING)
        text.set_fontweight("normal" if settings else "bold")
    axes.tick_params(axis="y", length=0)
    axes.margins(x=0.05)
    axes.set_ylim(len(rows), -1)
    legend_above(axes, [*names, "mean of the runs"])
    return figure


def _rows_of_variants(labels: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Conditions and settings, from top to bottom; the heading of a group of rows has no settings."""
    groups: dict[str, dict[str, None]] = {}
    for conditions, settings in labels:
        groups.setdefault(conditions, {})[settings] = None
    return [(conditions, of) for conditions, settings in groups.items() for of in ("", *settings)]


def _label_plainly(axis: Axis) -> None:
    """Labels a logarithmic axis with plain numbers: 0.05, not 5×10⁻². Within a decade, 1, 2, 5 may all lie outside."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

    low, high = axis.get_view_interval()
    axis.set_major_locator(MaxNLocator(6) if high < 10 * low else LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())
