"""Signs that an estimate and a reference do not belong together: other runs, frames, units or signs."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

import numpy as np

from linkpose.evaluation.scoring import LINK, Compared
from linkpose.evaluation.series import Pair, interval, paired
from linkpose.evaluation.takes import MOTION_CAPTURE
from linkpose.quantities import (
    ANGLE,
    CHAIN_ROTATION,
    HEADING,
    PITCH,
    ROLL,
    VX,
    VY,
    WZ,
    YAW,
    Quantity,
    X,
    Y,
    by_filter,
    unit_text,
)
from linkpose.recording.table import Table
from linkpose.sensors.measurements import Floats

_UNRELATED = 0.9  # share of the reference's motion that remains when even the best filter's is subtracted
_SAME_TILT_DEG = 30.0
_MIRRORED = 0.8  # correlation, negated
# Two columns in different units or of different sign move alike: their correlation is above _ALIKE, and the ratio of
# their motions is within _NEAR of one of _UNITS. Errors of estimates by a tenth change the correlation by 0.005.
_ALIKE = 0.98
_NEAR = 0.05
_FOOT, _INCH, _DEGREE = 0.3048, 0.0254, np.pi / 180
_UNITS = (0.5, 2.0, _DEGREE, 1 / _DEGREE, 0.001, 1000.0, 0.01, 100.0, _FOOT, 1 / _FOOT, _INCH, 1 / _INCH, -1.0)
_LENGTH, _FEW_OUTSIDE = 0.01, 0.9  # of a quaternion: files with 3 decimals are off by 0.001; share of rows within
_TIME_UNITS = (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))
# By how much the spans of a run's two files may differ, and a step that is too long for a motion: runs that are sampled
# so seldom, and whose spans differ by a factor of 900 to 1100, are rare.
_SAME_SPAN, _LONG_STEP_S = 0.1, 0.5
_OTHER_UNITS = ("m", "cm", "mm", "km", "ft", "in", "deg", "rad", "cm_s", "mm_s", "km_h", "deg_s", "rad_s")
_STILL = 1e-3  # share of the estimate's motion; errors of a still reference are far below it
_FEWEST = 20  # instants; fewer correlate by chance
_MOVES_RAD, _MOVES_M = 0.1, 0.05  # standard deviations (rad; m, m/s or rad/s) of estimates that are no error alone


def mismatches(
    estimate: Table, reference: Table, compared: Mapping[str, Compared], offset_s: float, residual: float
) -> list[str]:
    """Evidence that the files are of different runs or frames, or have columns in different units.

    `compared` has the filters by name; `offset_s` and `residual` are those of `common_offset`.
    """
    if times := _of_times(estimate, reference):
        return times
    units = [
        *_of_quaternions(estimate, reference, compared),
        *_of_units(estimate, reference, compared, offset_s),
    ]
    found = [*_of_frames(estimate, reference, compared.values(), offset_s), *units]
    if not found:  # motions in other units have little in common, too
        found = _of_runs(estimate, reference, compared.values(), residual)
    return [*found, *_of_reflections(reference, compared, offset_s), *_of_names(estimate, reference)]


def _of_frames(estimate: Table, reference: Table, compared: Collection[Compared], offset_s: float) -> list[str]:
    both_files = f"{estimate.path} and {reference.path}"
    tilts = [both.pairs for both in compared if ROLL in both.pairs and PITCH in both.pairs]
    apart = min((_tilt_apart_deg(both, offset_s) for both in tilts), default=0.0)
    if apart > _SAME_TILT_DEG:
        cure = (
            "try the other axis with --up y or z, and check the order of the markers"
            if reference.kind == MOTION_CAPTURE
            else "are they of the same run, and of the same axes?"
        )
        return [f"{both_files} have their tilts {apart:.0f}° apart (median, the nearest filter's): {cure}"]
    if any(_is_mirrored(both.pairs[ANGLE]) for both in compared if ANGLE in both.pairs):
        return [
            f"{both_files} count the joint angle in opposite senses: the sense of an axis that a filter finds is "
            "arbitrary; negate axis1 and axis2 in the rig file and estimate again"
        ]
    velocities = [both.pairs[q] for both in compared for q in (VX, VY, WZ) if q in both.pairs]
    unrelated = [found for pair in velocities if (found := _is_unrelated(pair, offset_s)) is not None]
    if unrelated and all(unrelated):
        return [f"{both_files} have hardly any motion in common: are they of the same run, and their times in seconds?"]
    return []


def _of_runs(estimate: Table, reference: Table, compared: Collection[Compared], residual: float) -> list[str]:
    both_files = f"{estimate.path} and {reference.path}"
    is_link = any(quantity in LINK for both in compared for quantity in both.pairs)  # odometry may count from elsewhere
    if is_link and _UNRELATED < residual < np.inf:
        return [f"{both_files} have hardly any motion in common, whatever the offset: are they of the same run?"]
    return []


def _is_unrelated(pair: Pair, offset_s: float) -> bool | None:
    """Whether the difference of two velocities varies as much as each of them; None where the estimate is steady."""
    moved = _moved(pair, offset_s)
    if moved is None or np.std(moved[0]) < _MOVES_M:
        return None
    ours, theirs = moved
    return bool(np.std(ours - theirs) > _UNRELATED * max(np.std(ours), np.std(theirs)))


def _of_units(estimate: Table, reference: Table, compared: Mapping[str, Compared], offset_s: float) -> Iterator[str]:
    """One sentence for each quantity in which estimate and reference move alike, but to another extent."""
    for quantity in dict.fromkeys(q for both in compared.values() for q in both.pairs):
        ratios = {
            name: ratio
            for name, both in compared.items()
            if quantity in both.pairs and (ratio := _ratio(quantity, both, offset_s)) is not None
        }
        wrong = {name: near for name, ratio in ratios.items() if (near := _wrong_unit(ratio)) is not None}
        if -1.0 in wrong.values() and quantity in (X, Y, ANGLE):  # a frame turned by half a turn; see _is_mirrored
            continue
        if wrong:
            name = next(iter(wrong))
            yield (
                f"{reference.path}: {quantity.column} moves like the estimate of {name} in {estimate.path}, times "
                f"{wrong[name]:.4g}: check its unit and its sign in both files"
            )
        elif any(_is_still(both.pairs[quantity], offset_s) for both in compared.values() if quantity in both.pairs):
            yield (
                f"{reference.path}: {quantity.column} is the same wherever the estimates move: check the column and "
                "the times"
            )


def _of_times(estimate: Table, reference: Table) -> list[str]:
    """One sentence if the two files span about the same time, but for the unit of one of them."""
    for one, other in ((reference, estimate), (estimate, reference)):
        spans = [float(np.ptp(table.columns["time_s"])) for table in (one, other)]
        for unit, factor in _TIME_UNITS:
            is_near = abs(spans[0] - factor * spans[1]) < _SAME_SPAN * factor * spans[1]
            if is_near and interval(one.columns["time_s"]) > _LONG_STEP_S:
                return [
                    f"{one.path}: time_s spans {spans[0]:.4g} s, and in {other.path} {spans[1]:.4g} s: is it in "
                    f"{unit}? divide it by {factor:.0f}"
                ]
    return []


def _of_reflections(reference: Table, compared: Mapping[str, Compared], offset_s: float) -> Iterator[str]:
    """A sentence if the reference's path is the mirror image of an estimate's: axes exchanged, or one reversed."""
    for name, both in compared.items():
        moved = [_moved(both.pairs[q], offset_s) for q in (X, Y) if q in both.pairs]
        if len(moved) < 2 or moved[0] is None or moved[1] is None or len(moved[0][0]) != len(moved[1][0]):
            continue
        (our_x, their_x), (our_y, their_y) = moved[0], moved[1]
        ours, theirs = our_x + 1j * our_y, their_x + 1j * their_y
        sizes = float(np.linalg.norm(ours) * np.linalg.norm(theirs))
        if abs(ours @ theirs) > _ALIKE * sizes > 0 and abs(np.conj(ours) @ theirs) < _UNRELATED * sizes:
            yield (
                f"{reference.path}: the path is the mirror image of that of {name}: were x_m and y_m exchanged, or is "
                "the sign of one of them wrong?"
            )
            return


def _of_names(estimate: Table, reference: Table) -> Iterator[str]:
    """One sentence for each column of the reference that has the name of an estimated quantity, and another unit."""
    for quantity in dict.fromkeys(q for of in by_filter(estimate.columns).values() for q in of):
        for name in reference.columns:
            base, _, unit = name.rpartition(f"{quantity.name}_")
            if not base and unit in _OTHER_UNITS and quantity.column not in reference.columns and unit != quantity.unit:
                yield (
                    f"{reference.path}: {name} is not compared: state it in {unit_text(quantity.unit)}, in a column "
                    f"{quantity.column}"
                )


def _of_quaternions(estimate: Table, reference: Table, compared: Mapping[str, Compared]) -> Iterator[str]:
    """One sentence for each file whose quaternions are no rotations: the error angle would be of their direction."""
    for number, table in enumerate((estimate, reference)):
        for name, both in compared.items():
            parts = [both.pairs[q][number].value for q in CHAIN_ROTATION if q in both.pairs]
            lengths = np.sqrt(np.sum(np.square(parts), axis=0)) if len(parts) == len(CHAIN_ROTATION) else np.empty(0)
            known = lengths[np.isfinite(lengths)]
            if len(known) and np.quantile(np.abs(known - 1), _FEW_OUTSIDE) > _LENGTH:
                columns = f"{name}_qw to {name}_qz" if number == 0 else "qw to qz"
                yield f"{table.path}: {columns} are no rotation, whose length is 1: check these columns"
                break


def _ratio(quantity: Quantity, both: Compared, offset_s: float) -> float | None:
    """By how much the reference moves more than the estimate, about the medians; None if they do not move alike.

    Where a yaw may count from elsewhere, x and y may point elsewhere; their distance from the middle is compared then.
    """
    if quantity in CHAIN_ROTATION:
        return None
    is_turned = quantity in (X, Y) and (YAW in both.pairs or HEADING in both.pairs)
    axes = [both.pairs[q] for q in ((X, Y) if is_turned else (quantity,)) if q in both.pairs]
    moved = [found for pair in axes if (found := _moved(pair, offset_s)) is not None]
    if not moved or len({len(ours) for ours, _ in moved}) > 1:
        return None
    ratio = _ratio_of(*(np.linalg.norm(moved, axis=0) if is_turned else moved[0]))
    if ratio is None and not is_turned and axes[0][0].is_angle:  # in radians, a jump by a whole turn is no whole turn
        ours, theirs = moved[0]
        ratio = _ratio_of(ours, _DEGREE * np.unwrap(theirs / _DEGREE))
    return ratio


def _ratio_of(ours: Floats, theirs: Floats) -> float | None:
    sizes = np.linalg.norm(ours), np.linalg.norm(theirs)
    if not min(sizes) > 0 or abs(ours @ theirs) < _ALIKE * sizes[0] * sizes[1]:
        return None
    return float(ours @ theirs / (ours @ ours))


def _wrong_unit(ratio: float) -> float | None:
    """The factor of a unit or a sign that this ratio is near to."""
    return next((factor for factor in _UNITS if abs(ratio / factor - 1) < _NEAR), None)


def _is_still(pair: Pair, offset_s: float) -> bool:
    """Whether the reference is as good as constant while the estimate moves further than errors do."""
    moved = _moved(pair, offset_s)
    if moved is None or np.std(moved[1]) > _STILL * np.std(moved[0]):
        return False
    return bool(np.std(moved[0]) > (_MOVES_RAD if pair[0].is_angle else _MOVES_M))


def _moved(pair: Pair, offset_s: float) -> tuple[Floats, Floats] | None:
    """Estimate and reference (N,) without their medians where both are known; None for fewer than _FEWEST instants."""
    ours, theirs = np.array(paired(*pair, offset_s))
    known = np.isfinite(ours) & np.isfinite(theirs)
    if np.count_nonzero(known) < _FEWEST:
        return None
    ours, theirs = (np.unwrap(angle[known]) if pair[0].is_angle else angle[known] for angle in (ours, theirs))
    return ours - np.median(ours), theirs - np.median(theirs)


def _is_mirrored(pair: Pair) -> bool:
    """Whether an angle and its reference turn in opposite senses, on the clocks as they are."""
    ours, theirs = np.array(paired(*pair, 0.0))
    known = np.isfinite(ours) & np.isfinite(theirs)
    if known.sum() < 3:
        return False
    turned = [angle[known] - np.median(angle[known]) for angle in (ours, theirs)]
    return bool(turned[0] @ turned[1] < -_MIRRORED * np.linalg.norm(turned[0]) * np.linalg.norm(turned[1]))


def _tilt_apart_deg(both: Mapping[Quantity, Pair], offset_s: float) -> float:
    """Median angle between the two verticals, in the sensor's axes; 0 without an instant in common."""
    roll, pitch = (np.array(paired(*both[quantity], offset_s)) for quantity in (ROLL, PITCH))
    z = np.stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])  # (3, 2, N)
    angle = np.arccos(np.clip((z[:, 0] * z[:, 1]).sum(axis=0), -1.0, 1.0))
    return float(np.degrees(np.median(angle[np.isfinite(angle)]))) if np.isfinite(angle).any() else 0.0
