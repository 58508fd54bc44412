"""Paths of robots with what surrounds them, and what belongs to them over time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from linkpose.localization.surroundings import Surroundings
from linkpose.plotting.canvas import AXES_COLOURS, OTHERS, SMALL_LETTERING, TRUTH, finish, line_style
from linkpose.plotting.lines import MOST_POINTS, band, broken, draw
from linkpose.plotting.panels import errors, hides_best, shade_unknown, view_values
from linkpose.plotting.sources import DrawnTrack, Sources
from linkpose.quantities import CHAIN_ROTATION, EXCLUDED, HEADING, HEIGHT, QW, VX, VY, X, Y
from linkpose.rotations import rotation_vectors
from linkpose.sensors.devices import MAX_MICE
from linkpose.sensors.measurements import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from linkpose.localization.grid import GridMap

_MARGIN = 0.1  # of a path's extents: heading ticks at its edge are in view
_MARKS = 12  # heading ticks and ellipses along a path
_TICK_INCHES = 0.22  # length of a heading tick
_TICKS_APART = 1.4  # lengths of a tick between two, at least: those of a robot that moves little hid its path
_MOST_CELLS = 3000  # of a map, along a side
_MAP_COLOURS = ("white", "#707070", "#E8E8E8")  # of cells that are free, occupied, unknown
_WIDE_RATIO = 2.2  # of a path's extents, from which on it is drawn over the whole width

TimePanel = tuple[float, Callable[["Axes"], list[str]]]


def path_panel(sources: Sources, scene: Surroundings | None, wide: bool) -> Callable[[Axes], list[str]] | None:
    """What draws the paths; None where there is none. A link's horizontal motion is no path."""
    tracks = _with_path(sources)
    return (lambda axes: _path(axes, tracks, scene or Surroundings(), wide)) if tracks else None


def is_wide(sources: Sources, scene: Surroundings | None) -> bool:
    """Whether path, map and beacons extend so much further along x than along y that a square would be empty."""
    points = [np.column_stack([track.values[X], track.values[Y]]) for track in _with_path(sources)]
    if scene is not None and points:
        points.append(scene.corners_m())
    known = [point[np.isfinite(point).all(axis=1)] for point in points]
    if not any(map(len, known)):
        return False
    wide, high = np.ptp(np.vstack(known), axis=0)
    return bool(wide > _WIDE_RATIO * high)


def _with_path(sources: Sources) -> list[DrawnTrack]:
    return [track for track in sources.all if track.has(X, Y) and HEIGHT not in track.values]


def time_panels(sources: Sources, wide: bool) -> list[TimePanel]:
    """Error of the position, speed, unwrapped heading and the mice left out, as far as a filter estimates them.

    `wide` is whether the panels take the whole width.
    """
    found: list[TimePanel] = []
    shown = sources.tracks or sources.all
    if any("position" in score.errors for score in sources.scores.values()) and _with_path(sources):
        if hides_best(sources, "position"):
            found.append((1.4, lambda axes: _position_errors(axes, sources, best_only=True)))
        found.append((1.8, lambda axes: _position_errors(axes, sources)))
    if any(track.has(VX) for track in shown):
        found.append((1.8, lambda axes: _over_time(axes, sources, _speed, "speed (m/s)")))
    if any(track.has(HEADING) for track in shown):
        found.append((1.8, lambda axes: _over_time(axes, sources, _heading, "heading (°)")))
    for track in sources.tracks:
        if track.has(EXCLUDED) and bool((track.values[EXCLUDED] > 0).any()):
            found.append((0.9, _mice_panel(track)))
    return found


def _path(axes: Axes, tracks: Sequence[DrawnTrack], scene: Surroundings, wide: bool) -> list[str]:
    _draw_scene(axes, scene)
    for track in reversed(tracks):
        style = line_style(track.name, track.file) if track.name else TRUTH
        _, x, y = broken(track.time_s, track.values[X], track.values[Y])
        keep = slice(None, None, max(1, len(x) // MOST_POINTS))
        axes.plot(x[keep], y[keep], label=track.label, **style)
    for track in reversed(tracks):
        _mark(axes, track, str((line_style(track.name, track.file) if track.name else TRUTH)["color"]))
    axes.set_aspect("equal", "datalim")
    if not wide:
        axes.set_box_aspect(1.0)
    axes.set_xlabel("x (m)")
    finish(axes, "y (m)")
    axes.set_anchor("N")  # its top is that of the panels beside it
    axes.margins(_MARGIN)
    return [f"{band}{track.label}" for band in ("", "±2σ ") for track in tracks]


def _draw_scene(axes: Axes, scene: Surroundings) -> None:
    if scene.grid is not None:
        draw_map(axes, scene.grid)
    if scene.beacons:
        places = np.array([list(place)[:2] for place in scene.beacons.values()])
        axes.plot(*places.T, "^", color="black", markersize=6, label="beacons", linestyle="none", zorder=4)
        for name, place in zip(scene.beacons, places, strict=True):
            axes.annotate(name, place, xytext=(4, 4), textcoords="offset points", fontsize=SMALL_LETTERING)
    if scene.rejected_xy_m is not None and len(scene.rejected_xy_m):
        axes.plot(*scene.rejected_xy_m.T, "x", color=OTHERS[3], markersize=4, label="measurement rejected", zorder=4)


def draw_map(axes: Axes, grid: GridMap) -> None:
    """Walls in grey, and what nobody has seen in light grey. Its own axes may be turned against those of the path."""
    from matplotlib.colors import ListedColormap
    from matplotlib.transforms import Affine2D

    _, x, y, turn = grid.geometry.tolist()
    width, height = grid.size_m
    cells = grid.blocked[:: _stride(grid.blocked.shape[0]), :: _stride(grid.blocked.shape[1])]
    limits = axes.dataLim.frozen()
    image = axes.imshow(
        cells, cmap=ListedColormap(_MAP_COLOURS), vmin=0, vmax=2, extent=(0, width, 0, height), origin="lower",
        interpolation="nearest",
    )  # fmt: skip
    image.set_zorder(0)
    axes.dataLim.set(limits)  # matplotlib takes the extent for the place
    placed = Affine2D().rotate(turn).translate(x, y)
    image.set_transform(placed + axes.transData)
    corners = placed.transform(np.array([(0, 0), (width, 0), (width, height), (0, height)]))
    axes.update_datalim(corners)


def _stride(cells: int) -> int:
    """Of a map that is larger than any picture, every n-th cell."""
    return max(1, cells // _MOST_CELLS)


def _mark(axes: Axes, track: DrawnTrack, colour: str) -> None:
    """Start, heading ticks and ±2σ ellipses along a path."""
    from matplotlib.patches import Ellipse

    x, y = track.values[X], track.values[Y]
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    axes.plot(x[known[0]], y[known[0]], "o", color=colour, markersize=6, markerfacecolor="white", zorder=6)
    if not track.name:
        return
    at = known[np.linspace(0, len(known) - 1, min(_MARKS, len(known))).astype(int)]
    tick_m = _TICK_INCHES * _metres_an_inch(axes)
    at = at[_apart(np.column_stack([x[at], y[at]]), _TICKS_APART * tick_m)]
    if HEADING in track.values:
        angle = np.radians(track.values[HEADING][at])
        axes.update_datalim(np.column_stack([x[at] + tick_m * np.cos(angle), y[at] + tick_m * np.sin(angle)]))
        axes.quiver(
            x[at],
            y[at],
            np.cos(angle),
            np.sin(angle),
            color=colour,
            angles="xy",
            units="inches",
            width=0.025,
            scale_units="inches",
            scale=1 / _TICK_INCHES,
            zorder=4,
        )
    if X in track.std and Y in track.std:
        for i in at:
            sx, sy = float(track.std[X][i]), float(track.std[Y][i])
            if np.isfinite(sx) and np.isfinite(sy):
                axes.add_patch(
                    Ellipse((x[i], y[i]), 4 * sx, 4 * sy, facecolor=colour, edgecolor=colour, alpha=0.25, zorder=2)
                )
        axes.fill([], [], color=colour, alpha=0.25, label=f"±2σ {track.label}")


def _metres_an_inch(axes: Axes) -> float:
    """Of axes with equal scales, before their limits are set: the scale at which all data have room."""
    box, inch = axes.get_window_extent(), axes.figure.dpi
    data = axes.dataLim
    return (1 + 2 * _MARGIN) * inch * max(float(data.width / box.width), float(data.height / box.height))


def _apart(places: Floats, least: float) -> list[int]:
    """Indices of places (N, 2), each at least so far from the one before."""
    kept = [0]
    for at in range(1, len(places)):
        if np.linalg.norm(places[at] - places[kept[-1]]) >= least:
            kept.append(at)
    return kept


def _position_errors(axes: Axes, sources: Sources, best_only: bool = False) -> list[str]:
    """Distances from the true position, and the best filter's 2σ of x and y together."""
    order = errors(axes, sources, "position", best_only)
    best = next((track for track in sources.tracks if X in track.std and Y in track.std), None)
    if best is not None:
        std = np.hypot(best.std[X], best.std[Y])
        colour = str(line_style(best.name, best.file)["color"])
        band(axes, best.time_s, np.zeros(len(std)), std, colour, f"2σ {best.label}")
        known = std[np.isfinite(std)]
        top = axes.get_ylim()[1]
        axes.set_ylim(0.0, max(top, 2.2 * float(np.quantile(known, 0.9))) if len(known) else top)
    return order


def _speed(track: DrawnTrack) -> tuple[Floats, Floats | None] | None:
    """Speed, and its σ along the motion."""
    if not track.has(VX):
        return None
    if not track.has(VY):
        return np.abs(track.values[VX]), track.std.get(VX)
    return np.hypot(track.values[VX], track.values[VY]), track.std.get(VX)


def _heading(track: DrawnTrack) -> tuple[Floats, Floats | None] | None:
    if not track.has(HEADING):
        return None
    heading = track.values[HEADING].copy()
    known = np.isfinite(heading)
    heading[known] = np.unwrap(heading[known], period=360.0)
    return heading, track.std.get(HEADING)


def _over_time(
    axes: Axes, sources: Sources, of: Callable[[DrawnTrack], tuple[Floats, Floats | None] | None], label: str
) -> list[str]:
    """A quantity of all tracks; ±2σ of the best."""
    drawn = [(track, found) for track in sources.tracks if (found := of(track)) is not None]
    for track, (value, _) in reversed(drawn):
        draw(axes, track.time_s, value, label=track.label, **line_style(track.name, track.file))
    for track, (value, std) in drawn[:1]:
        if std is not None:
            band(axes, track.time_s, value, std, str(line_style(track.name)["color"]), f"±2σ {track.label}")
    reference = of(sources.reference) if sources.reference is not None else None
    if reference is not None and sources.reference is not None:
        draw(axes, sources.reference.time_s, reference[0], label=sources.reference.label, **TRUTH)
    view_values(axes, [value for _, (value, _) in drawn])
    shade_unknown(axes, [(track, value) for track, (value, _) in drawn])
    finish(axes, label)
    return [track.label for track, _ in drawn]


def _mice_panel(track: DrawnTrack) -> Callable[[Axes], list[str]]:
    return lambda axes: _mice(axes, track)


def _mice(axes: Axes, track: DrawnTrack) -> list[str]:
    """A bar for each stretch in which a mouse was left out."""
    bits = np.nan_to_num(track.values[EXCLUDED]).astype(np.int64)
    shown = min(max(int(bits.max()).bit_length(), track.mice), MAX_MICE)
    for mouse in range(shown):
        out = (bits >> mouse & 1).astype(np.int8)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], out, [0]]))).reshape(-1, 2)
        last = len(out) - 1
        bars = [(track.time_s[a], track.time_s[min(b, last)] - track.time_s[a]) for a, b in edges.tolist()]
        axes.broken_barh(bars, (mouse + 0.6, 0.8), color=line_style(track.name)["color"])
    axes.set_yticks(range(1, shown + 1), [f"mouse {mouse}" for mouse in range(1, shown + 1)])
    axes.set_ylim(shown + 0.6, 0.4)  # mouse 1 at the top
    finish(axes, f"left out by {track.label}")
    return []


def rotation(axes: Axes, sources: Sources) -> list[str]:
    """The rotation of a ball joint as a rotation vector (°): its direction is the axis, its length the angle."""
    for track in sources.all:
        if not track.has(*CHAIN_ROTATION):
            continue
        vectors = np.degrees(rotation_vectors(np.column_stack([track.values[q] for q in CHAIN_ROTATION])))
        for axis, value in zip("xyz", vectors.T, strict=True):
            style: dict[str, Any] = {"color": AXES_COLOURS[axis], "linewidth": 1.6}
            label = f"{track.label} {axis}"
            if not track.name:
                style, label = dict(TRUTH), track.label
            draw(axes, track.time_s, value, 360.0, label=label, **style)
    shade_unknown(axes, [(track, track.values[QW]) for track in sources.tracks if track.has(*CHAIN_ROTATION)])
    finish(axes, "rotation of the joint (°)")
    return []
