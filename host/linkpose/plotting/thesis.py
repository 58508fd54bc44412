"""The figures of chapter 3 of [Thesis] by number, from the runs of `linkpose.experiments`.

host/docs/thesis.md describes what each figure shows and what our copy of the thesis lacks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from linkpose.plotting.canvas import (
    BAND_ALPHA,
    LETTERING,
    OTHERS,
    SMALL_LETTERING,
    TRUTH,
    WIDTH_INCHES,
    finish,
    legend_above,
    line_style,
    new_figure,
    wrapped,
)
from linkpose.plotting.lines import MOST_POINTS
from linkpose.plotting.robots import draw_map
from linkpose.sensors.measurements import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from linkpose.experiments.indoor import DrawnDrive
    from linkpose.experiments.paths import ComparedPath, WaySection
    from linkpose.experiments.underwater import Dive
    from linkpose.localization.grid import GridMap
    from linkpose.localization.tables import Beacons

INDOOR_FIGURES = ("3.1", "3.2", "3.3", "3.4", "3.5", "3.6")
UNDERWATER_FIGURES = ("3.7", "3.8", "3.9", "3.10")
_SECTIONS = 3  # of Figure 3.4
_SECTION_M = 10.0  # length of each
_BESIDE = 0.4  # of the width of a figure: panels over time beside a path
_HEADROOM = 1.5  # of an axis over the error that 99 % do not exceed
_UNDER_TRUTH = {"linewidth": 2.6}  # of an estimated path, which the dashed truth covers


def indoor_figures(drive: DrawnDrive) -> dict[str, Figure]:
    """Figures 3.1 to 3.6 by number: map and path, four estimates with their errors, and where errors are large."""
    from linkpose.experiments.paths import large

    largest = large(list(drive.paths.values()))
    figures = {"3.1": _map_and_path(drive), "3.4": _large_errors(drive)}
    for number, path in drive.paths.items():
        figures[number] = _estimate(number, path, drive.grid, largest)
    return {number: figures[number] for number in INDOOR_FIGURES}


def underwater_figures(dive: Dive, beacons: Beacons) -> dict[str, Figure]:
    """Figures 3.7 to 3.10 by number: command and motion, estimates from sets of measurements, EKF, UKF."""
    from linkpose.experiments.paths import large

    largest = large([*dive.sets, *dive.paths.values()])
    figures = {"3.7": _command_and_motion(dive, beacons)}
    figures["3.8"] = _sets_of_measurements(dive.sets, beacons, largest)
    for number, path in dive.paths.items():
        figures[number] = _dive_estimate(number, path, beacons, largest)
    return figures


def _titled(height_inches: float, number: str, words: str) -> Figure:
    return new_figure(height_inches, f"Figure {number}  {words}")


def _summary(path: ComparedPath) -> str:
    return f"{100 * path.rms_m:.1f} cm rms, {100 * path.error_m.max():.0f} cm at most"


def _plot(axes: Axes, points: Floats, **style: object) -> None:
    """A path (N, 2 or 3) from above."""
    keep = slice(None, None, max(1, len(points) // MOST_POINTS))
    axes.plot(points[keep, 0], points[keep, 1], **style)  # type: ignore[arg-type]


def _start(axes: Axes, point: Floats) -> None:
    axes.plot(point[0], point[1], "o", color="black", markersize=6, markerfacecolor="white", label="start", zorder=6)


def _from_above(axes: Axes) -> None:
    """x and y in the same scale, with their names; it begins where panels below or beside it begin."""
    axes.set_aspect("equal", "box")
    axes.set_anchor("NW")
    axes.set_xlabel("x (m)")
    finish(axes, "y (m)")
    axes.margins(0.05)


def _map_and_path(drive: DrawnDrive) -> Figure:
    """Figure 3.1."""
    figure = _titled(3.6, "3.1", "Map and path of the robot (simulated)")
    axes = figure.add_subplot()
    draw_map(axes, drive.grid)
    _plot(axes, drive.odometry_m, color=OTHERS[0], linewidth=1.2, label="odometry alone")
    _plot(axes, drive.truth_m, label="truth", **TRUTH)
    _start(axes, drive.truth_m[0])
    _from_above(axes)
    legend_above(axes)
    return figure


def _estimate(number: str, path: ComparedPath, grid: GridMap, largest: tuple[float, float]) -> Figure:
    """Figures 3.2, 3.3, 3.5, 3.6: the path on the map over its errors along the way."""
    figure = _titled(6.4, number, f"{path.label}, simulated: position error {_summary(path)}")
    above, position, heading = figure.subplots(3, 1, height_ratios=[3.2, 1.5, 1.5])
    draw_map(above, grid)
    _plot(above, path.position_m, label=path.filter, **line_style(path.filter) | _UNDER_TRUTH)
    _plot(above, path.truth_m, label="truth", **TRUTH)
    _start(above, path.truth_m[0])
    _from_above(above)
    legend_above(above)
    _errors(position, heading, path, path.way_m, largest)
    heading.set_xlabel("distance travelled (m)")
    figure.align_ylabels([position, heading])
    return figure


def _errors(position: Axes, heading: Axes, path: ComparedPath, along: Floats, largest: tuple[float, float]) -> None:
    """Errors of position and heading with 2σ, along the way or over time."""
    style = line_style(path.filter) | {"linewidth": 0.9}
    _position_error(position, path, along, largest)
    off = np.degrees(2 * path.heading_std_rad)
    heading.fill_between(along, -off, off, color=style["color"], alpha=BAND_ALPHA, linewidth=0)
    heading.plot(along, np.degrees(path.heading_error_rad), **style)
    finish(heading, "heading error (°)")
    most = np.degrees(_HEADROOM * largest[1])
    heading.set_ylim(-most, most)
    heading.sharex(position)
    position.tick_params(labelbottom=False)
    legend_above(position)


def _position_error(axes: Axes, path: ComparedPath, along: Floats, largest: tuple[float, float]) -> None:
    style = line_style(path.filter) | {"linewidth": 0.9}
    within = 100 * np.mean(path.error_m <= 2 * path.std_m)
    label = f"2σ ({within:.0f} % within)"
    axes.fill_between(along, 0.0, 200 * path.std_m, label=label, color=style["color"], alpha=BAND_ALPHA, linewidth=0)
    axes.plot(along, 100 * path.error_m, label=path.filter, **style)
    axes.set_ylim(0.0, 100 * _HEADROOM * largest[0])
    finish(axes, "position error (cm)")


def _large_errors(drive: DrawnDrive) -> Figure:
    """Figure 3.4: where the errors with a fixed R are largest, with the adaptive R beside it."""
    from linkpose.experiments.paths import worst_sections

    fixed, adaptive = drive.paths["3.2"], drive.paths["3.3"]
    sections = worst_sections(fixed, _SECTIONS, _SECTION_M)
    figure = _titled(6.4, "3.4", f"Where the position error with the {fixed.label}, is largest (simulated)")
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.25, 1.0])[:, 0]
    axes = upper.add_subplot()
    draw_map(axes, drive.grid)
    _plot(axes, drive.truth_m, label="truth", **TRUTH)
    for i, section in enumerate(sections, 1):
        inside = (fixed.way_m >= section.start_m) & (fixed.way_m <= section.end_m)
        _plot(axes, fixed.truth_m[inside], color=OTHERS[3], linewidth=7.0, alpha=0.6, label="large errors")
        place = _middle(fixed, section)
        axes.annotate(str(i), place, xytext=(0, 8), textcoords="offset points", fontsize=LETTERING, fontweight="bold")
    _from_above(axes)
    legend_above(axes)
    details = np.atleast_1d(lower.subplots(1, len(sections), sharey=True))
    for i, (place, section) in enumerate(zip(details, sections, strict=True), 1):
        _detail(place, i, section, (fixed, adaptive))
    finish(details[0], "position error (cm)")
    lines, labels = details[0].get_legend_handles_labels()
    lower.legend(lines, labels, loc="outside upper left", ncols=2, frameon=False, fontsize=SMALL_LETTERING)
    return figure


def _middle(path: ComparedPath, section: WaySection) -> Floats:
    at = int(np.searchsorted(path.way_m, 0.5 * (section.start_m + section.end_m)))
    return path.truth_m[min(at, len(path.way_m) - 1), :2]


def _detail(axes: Axes, number: int, section: WaySection, paths: Sequence[ComparedPath]) -> None:
    """The errors along a section, with both R."""
    from linkpose.experiments.paths import rms_within

    for i, path in enumerate(paths):
        inside = (path.way_m >= section.start_m) & (path.way_m <= section.end_m)
        style = line_style(path.filter, len(paths) - 1 - i) | {"linewidth": 1.5}
        axes.plot(path.way_m[inside], 100 * path.error_m[inside], label=path.label, **style)
    errors = " and ".join(f"{100 * rms_within(path, section):.1f}" for path in paths)
    axes.set_title(f"{number}: {errors} cm rms", fontsize=SMALL_LETTERING, loc="left")
    axes.set_xlabel("distance travelled (m)")
    finish(axes, "")


def _beside(figure: Figure, count: int) -> tuple[Axes, list[Axes]]:
    """Axes for a path on the left, and as many over time to the right of it."""
    halves = figure.add_gridspec(1, 2, width_ratios=[1.0, 1.15])
    over_time = halves[0, 1].subgridspec(count, 1)
    return figure.add_subplot(halves[0, 0]), [figure.add_subplot(over_time[i, 0]) for i in range(count)]


def _command_and_motion(dive: Dive, beacons: Beacons) -> Figure:
    """Figure 3.7: the path that the command describes, and the one that the vehicle takes."""
    apart = np.linalg.norm(dive.truth_m - dive.command_m, axis=1)
    figure = _titled(4.6, "3.7", f"Commanded and true path, {apart[-1]:.2f} m apart at the end (simulated)")
    above, (depth, distance) = _beside(figure, 2)
    distance.sharex(depth)
    _plot(above, dive.command_m, color=OTHERS[2], linewidth=1.4, label="command")
    _plot(above, dive.truth_m, label="truth", **TRUTH)
    _start(above, dive.truth_m[0])
    _draw_beacons(above, beacons)
    depth.plot(dive.time_s, -dive.command_m[:, 2], color=OTHERS[2], linewidth=1.4)
    depth.plot(dive.time_s, -dive.truth_m[:, 2], **TRUTH)
    finish(depth, "depth (m)")
    depth.invert_yaxis()
    distance.plot(dive.time_s, apart, color=OTHERS[2], linewidth=1.4)
    finish(distance, "command to truth (m)")
    distance.set_xlabel("time (s)")
    depth.tick_params(labelbottom=False)
    figure.align_ylabels([depth, distance])
    _from_above(above)
    legend_above(above)
    return figure


def _draw_beacons(axes: Axes, beacons: Beacons) -> None:
    places = np.array(list(beacons.values()))
    axes.plot(places[:, 0], places[:, 1], "^", color="black", markersize=6, label="beacons", linestyle="none", zorder=4)
    for name, place in zip(beacons, places, strict=True):
        axes.annotate(name, place[:2], xytext=(5, 3), textcoords="offset points", fontsize=SMALL_LETTERING)


def _sets_of_measurements(paths: Sequence[ComparedPath], beacons: Beacons, largest: tuple[float, float]) -> Figure:
    """Figure 3.8: the path from the complete set, and the errors with each set."""
    figure = _titled(
        5.6, "3.8", f"{paths[0].filter.upper()} on sets of simulated measurements, all with Gaussian noise"
    )
    above, errors = _beside(figure, len(paths))
    _from_above_among_beacons(above, paths[-1], beacons)
    for axes, path in zip(errors, paths, strict=True):
        if axes is not errors[0]:
            axes.sharex(errors[0])
        _position_error(axes, path, path.time_s, largest)
        heading = wrapped(f"{path.label}: {_summary(path)}", _BESIDE * WIDTH_INCHES, SMALL_LETTERING)
        axes.set_title(heading, fontsize=SMALL_LETTERING, loc="left", pad=16 if axes is errors[0] else 4)
        axes.tick_params(labelbottom=path is paths[-1])
    legend_above(errors[0])
    errors[-1].set_xlabel("time (s)")
    return figure


def _from_above_among_beacons(axes: Axes, path: ComparedPath, beacons: Beacons) -> None:
    _plot(axes, path.position_m, label=path.filter, **line_style(path.filter) | _UNDER_TRUTH)
    _plot(axes, path.truth_m, label="truth", **TRUTH)
    _start(axes, path.truth_m[0])
    _draw_beacons(axes, beacons)
    _from_above(axes)
    legend_above(axes)


def _dive_estimate(number: str, path: ComparedPath, beacons: Beacons, largest: tuple[float, float]) -> Figure:
    """Figures 3.9 and 3.10: the path from above, the depth, and the errors over time."""
    figure = _titled(5.2, number, f"{path.label}, simulated: position error {_summary(path)}")
    above, (depth, position, heading) = _beside(figure, 3)
    _from_above_among_beacons(above, path, beacons)
    depth.plot(path.time_s, -path.position_m[:, 2], **line_style(path.filter) | _UNDER_TRUTH)
    depth.plot(path.time_s, -path.truth_m[:, 2], **TRUTH)
    finish(depth, "depth (m)")
    depth.invert_yaxis()
    depth.sharex(position)
    depth.tick_params(labelbottom=False)
    if len(path.rejected_s):
        marks = np.zeros(len(path.rejected_s))
        position.plot(path.rejected_s, marks, "|", color=OTHERS[3], label="rejected", clip_on=False)
    _errors(position, heading, path, path.time_s, largest)
    heading.set_xlabel("time (s)")
    figure.align_ylabels([depth, position, heading])
    return figure
