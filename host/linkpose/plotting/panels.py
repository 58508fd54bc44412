"""Panels over time that several plots have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from linkpose.plotting.canvas import TRUTH, finish, line_style
from linkpose.plotting.lines import band, draw, shade
from linkpose.plotting.sources import DrawnTrack, Sources, is_barometric, pairs
from linkpose.presentation import with_unit
from linkpose.quantities import QW, YAW, Quantity, unit_text, words
from linkpose.sensors.measurements import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from linkpose.evaluation.errors import Errors

UNSETTLED = 5.0  # times the median σ, from which on errors do not set the scale: they flattened all that follows
MOST_RATIO = 4.0  # of two filters' errors in one panel: the smaller one still takes a quarter of the height


def has(sources: Sources, *wanted: Quantity) -> bool:
    """Whether any filter, or where there is none the reference, has one of these quantities."""
    return any(track.has(q) for track in sources.tracks or sources.all for q in wanted)


def shade_unknown(axes: Axes, drawn: Sequence[tuple[DrawnTrack, Floats]]) -> None:
    """Shades gaps of the first file, and where none of its filters has a value of what the panel shows."""
    first = [(track.time_s, value) for track, value in drawn if track.file == drawn[0][0].file]
    if first:
        known = np.logical_or.reduce([np.isfinite(value) for _, value in first])
        shade(axes, first[0][0], ~np.asarray(known, dtype=np.bool_))


def values(axes: Axes, sources: Sources, quantity: Quantity, period: float | None = None) -> list[str]:
    """A quantity of all filters with the reference; ±2σ of the best filter. Worse filters lie behind better ones.

    Returns the labels for the legend, the best first, as the other panels do.
    """
    drawn = list(pairs(sources.tracks, quantity))
    for track, value in reversed(drawn):
        draw(axes, track.time_s, value, period, label=track.label, **line_style(track.name, track.file))
    if drawn and quantity in drawn[0][0].std:
        best, value = drawn[0]
        colour = str(line_style(best.name)["color"])
        band(axes, best.time_s, value, best.std[quantity], colour, f"±2σ {best.label}")
    if sources.reference is not None and sources.reference.has(quantity):
        track = sources.reference
        value = track.values[quantity]
        if quantity is YAW:
            value = _from_start_of(drawn[0][0], track) if drawn else _from_start(value)
        draw(axes, track.time_s, value, period, label=track.label, **TRUTH)
    view_values(axes, [value for _, value in drawn] + _reference_beside(sources, quantity, drawn))
    shade_unknown(axes, drawn)
    finish(axes, quantity.axis_label)
    return [track.label for track, _ in drawn]


def _reference_beside(sources: Sources, quantity: Quantity, drawn: Sequence[tuple[DrawnTrack, Floats]]) -> list[Floats]:
    """The reference's values within the time of the filters, which are in view also where no filter has a value."""
    track = sources.reference
    if track is None or not track.has(quantity) or quantity is YAW or not drawn:
        return []
    first, last = drawn[0][0].time_s[[0, -1]]
    return [track.values[quantity][(track.time_s >= first) & (track.time_s <= last)]]


def _from_start(yaw: Floats) -> Floats:
    """Yaw (°) since its first value."""
    known = yaw[np.isfinite(yaw)]
    return np.asarray((yaw - known[0] + 180.0) % 360.0 - 180.0) if len(known) else yaw


def _from_start_of(estimate: DrawnTrack, reference: DrawnTrack) -> Floats:
    """The reference's yaw, turned to agree with the estimate's where both begin: no filter measures north."""
    ours, theirs = estimate.values[YAW], reference.values[YAW]
    known = np.flatnonzero(np.isfinite(ours))
    seen = np.flatnonzero(np.isfinite(theirs))
    if not len(known) or not len(seen):
        return theirs
    at = seen[np.argmin(np.abs(reference.time_s[seen] - estimate.time_s[known[0]]))]
    return np.asarray((theirs - theirs[at] + ours[known[0]] + 180.0) % 360.0 - 180.0)


def view_values(axes: Axes, values_drawn: Sequence[Floats]) -> None:
    """Limits the y axis to the values: ±2σ of a filter that has just started is wider than all motion."""
    known = [value[np.isfinite(value)] for value in values_drawn]
    together = np.concatenate([k for k in known if len(k)]) if any(len(k) for k in known) else np.zeros(0)
    if len(together) and together.max() > together.min():
        low, high = np.quantile(together, [0.0005, 0.9995])
        margin = 0.08 * (high - low)
        axes.set_ylim(low - margin, high + margin)


def errors(axes: Axes, sources: Sources, name: str, best_only: bool = False) -> list[str]:
    """Errors of a scored quantity with ±2σ about zero; the legend gives each filter's RMSE.

    A distance, which is never negative, has 2σ above zero.
    """
    unit, order = "", list[str]()
    drawn: list[Floats] = []
    stds: list[Floats] = []
    scored = _scored(sources, name)[:1] if best_only else _scored(sources, name)
    for track, of in scored:
        unit = unit_text(of.unit)
        text = f"{track.label} {with_unit(f'{of.statistics().rmse:.3g}', unit)} rms"
        draw(axes, of.time_s, of.error, label=text, **line_style(track.name, track.file))
        drawn.append(of.error)
        if of.std is not None and not order:
            stds.append(np.where(np.isfinite(of.error), of.std, np.nan))
            colour = str(line_style(track.name)["color"])
            sign = "±" if is_signed(of.error) else ""
            band(axes, of.time_s, np.zeros(len(of.time_s)), stds[0], colour, f"{sign}2σ {track.label}")
        order.append(text)
    axes.axhline(0.0, color="black", linewidth=0.6)
    bound_view(axes, drawn, stds)
    shade_errors(axes, [of for track, of in scored if track.file == scored[0][0].file])
    finish(axes, f"{words(name)} error ({unit}){which_filters(best_only, hides_best(sources, name))}")
    return order


def shade_errors(axes: Axes, found: Sequence[Errors]) -> None:
    """Shades gaps, and where no filter has an error of what the panel shows."""
    known = np.logical_or.reduce([np.isfinite(of.error) for of in found])
    shade(axes, found[0].time_s, ~np.asarray(known, dtype=np.bool_))


def which_filters(best_only: bool, best_is_apart: bool) -> str:
    """Second line of the label of each of two panels of one quantity, of which one shows the best filter enlarged."""
    return ("\nbest filter" if best_only else "\nall filters") if best_is_apart else ""


def is_signed(error: Floats) -> bool:
    """Whether errors lie on both sides of zero: those of a rotation or of a position are distances."""
    return bool((error < 0.0).any())


def _scored(sources: Sources, name: str) -> list[tuple[DrawnTrack, Errors]]:
    """The drawn filters that have errors of a quantity, best first."""
    scored = ((track, sources.scores.get((track.file, track.name))) for track in sources.tracks)
    return [(track, score.errors[name]) for track, score in scored if score and name in score.errors]


def hides_best(sources: Sources, name: str) -> bool:
    """Whether the errors of other filters are so much larger that the best filter's ±2σ would look like a line."""
    return others_hide_best([of for _, of in _scored(sources, name)])


def others_hide_best(found: Sequence[Errors]) -> bool:
    """Whether errors of one quantity, the best filter's first, differ so much in size that they need two panels."""
    limits = [error_limit([of.error], [of.std] if of.std is not None else []) for of in found]
    return len(limits) > 1 and max(limits) > MOST_RATIO * limits[0] > 0.0


def differences_hide_best(sources: Sources, quantity: Quantity) -> bool:
    """Whether the other filters differ so much from the best that its ±2σ would look like a line."""
    drawn = [(track, value) for track, value in pairs(sources.tracks, quantity) if track.file == 0]
    best, middle = drawn[0]
    others = error_limit([value - middle for _, value in drawn[1:]], [])
    return others > MOST_RATIO * error_limit([], [best.std[quantity]] if quantity in best.std else []) > 0.0


def from_best(axes: Axes, sources: Sources, quantity: Quantity, best_only: bool = False) -> list[str]:
    """Without a reference: differences from the best filter, and its ±2σ, in the unit of errors."""
    drawn = [(track, value) for track, value in pairs(sources.tracks, quantity) if track.file == 0]
    best, middle = drawn[0]
    scale, unit = quantity.error.scale / quantity.value.scale, unit_text(quantity.error.unit)
    is_alone = best_only or len(drawn) == 1
    order = [best.label if is_alone else f"{best.label} (best)"]
    differences: list[Floats] = []
    draw(axes, best.time_s, 0 * middle, label=order[0], **line_style(best.name))
    for track, value in [] if is_alone else drawn[1:]:
        difference = scale * (value - middle)
        differences.append(difference)
        rms = float(np.sqrt(np.nanmean(difference**2))) if np.isfinite(difference).any() else np.nan
        order.append(f"{track.label} {with_unit(f'{rms:.3g}', unit)} rms from it")
        draw(axes, track.time_s, difference, label=order[-1], **line_style(track.name))
    if quantity in best.std:
        colour = str(line_style(best.name)["color"])
        band(axes, best.time_s, 0 * middle, scale * best.std[quantity], colour, f"±2σ {best.label}")
    stds = [scale * best.std[quantity]] if quantity in best.std else []
    bound_view(axes, differences, stds)
    shade_unknown(axes, drawn[:1] if is_alone else drawn)
    finish(axes, f"±2σ ({unit})" if is_alone else f"from best ({unit})")
    return order


def bound_view(axes: Axes, errors: Sequence[Floats], stds: Sequence[Floats]) -> None:
    """Limits the y axis to `error_limit` on both sides of zero, or above it for errors that are distances."""
    limit = error_limit(errors, stds)
    if limit > 0:
        are_signed = any(map(is_signed, errors)) if errors else bool(stds)
        axes.set_ylim(-limit if are_signed else 0.0, limit)


def _settled(error: Floats, std: Floats) -> Floats:
    """The errors but those of a filter that reports itself to be lost: as it starts, or without its sensor."""
    known = std[np.isfinite(std)]
    return error[~(std > UNSETTLED * np.median(known))] if len(known) and len(std) == len(error) else error


def error_limit(errors: Sequence[Floats], stds: Sequence[Floats]) -> float:
    """Largest value to show: 99.5 % of the errors and 90 % of ±2σ, so that a short transient flattens nothing.

    `stds` has the σ of the first of the errors, if any.
    """
    seen = [_settled(error, std) for error, std in zip(errors[:1], stds, strict=False)]
    seen += errors[len(seen) :]
    sizes = [np.quantile(known, 0.995) for value in seen if len(known := np.abs(value[np.isfinite(value)]))]
    sizes += [2 * np.quantile(known, 0.9) for std in stds if len(known := std[np.isfinite(std)])]
    return 1.2 * max(map(float, sizes), default=0.0)


def note_hidden(sources: Sources) -> str:
    """What the plot leaves out, and how it is drawn; "" where nothing is left out."""
    barometric = [name for name in sources.hidden if is_barometric(name)]
    others = [name for name in sources.hidden if name not in barometric]
    reasons = (
        (barometric, "not drawn, because air pressure noise hides the height"),
        (others, f"not drawn beside a {'chain' if any(track.has(QW) for track in sources.tracks) else 'path'}"),
    )
    return "; ".join(f"{why}: {', '.join(names)} (add --filter {names[0]})" for names, why in reasons if names)
