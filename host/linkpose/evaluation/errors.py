"""Errors of one filter's quantities, at instants that estimate and reference share."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from linkpose import filters
from linkpose.evaluation.statistics import Statistics
from linkpose.quantities import CHAIN_ROTATION, HEADING, POSE, ROTATION, VX, VY, WZ, YAW, Quantity, X, Y, Z
from linkpose.rotations import wrapped
from linkpose.sensors.measurements import Floats

Values = Mapping[Quantity, Floats]  # (N,) each; angles in radians
_Place = Mapping[Quantity, float]  # at one instant

COMPONENTS = (X, Y, Z, VX, VY)  # of vectors, whose RMSE is that of the vector


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of one quantity, in the unit of its scores."""

    time_s: Floats  # (N,) on the estimate's clock
    error: Floats  # (N,) estimate − reference; NaN where either is unknown
    std: Floats | None  # (N,) σ of the estimate; None where the file has none
    unit: str  # as JSON keys write it: cm, deg, m_s
    label: str
    least_std: float = 0.0  # resolution of σ in the file
    whole: Statistics | None = None  # of all instants, where these are some of them

    def statistics(self) -> Statistics:
        """Of all instants."""
        return self.whole or Statistics.of(self.error, self.std, self.least_std)


class CommonStart:
    """The first instant at which estimate and reference are known, for what a filter counts from an arbitrary origin.

    A pose without an absolute origin is compared after moving it as a whole to agree with the reference at that
    instant: odometry in position and heading, a link without compass about the vertical only.
    """

    def __init__(self, name: str, quantities: Collection[Quantity]) -> None:
        """For a filter of this name that estimates these quantities."""
        needs = filters.capabilities(name)
        is_odometric = needs is not None and needs.is_odometric
        self._needed = {
            POSE: is_odometric and all(q in quantities for q in POSE),
            (YAW,): YAW in quantities,
        }
        self.pose: tuple[_Place, _Place] | None = None  # the estimate there, and its error
        self.yaw_error: float | None = None

    @property
    def is_found(self) -> bool:
        """Whether nothing is left to be found."""
        return not any(self._needed.values())

    def find(self, ours: Values, errors: Values) -> None:
        """Looks for what was not found yet in the next instants, (N,) each."""
        for wanted in [wanted for wanted, is_needed in self._needed.items() if is_needed]:
            first = _first_common(errors, wanted)
            if first is None:
                continue
            self._needed[wanted] = False
            if wanted == POSE:
                at, error = ({q: float(values[q][first]) for q in POSE} for values in (ours, errors))
                self.pose = at, error
            else:
                self.yaw_error = float(errors[YAW][first])


def errors_of(name: str, ours: Values, theirs: Values, start: CommonStart | None = None) -> dict[Quantity, Floats]:
    """Estimate − reference of each quantity, angles within ±π, of the filter `name`.

    `start` is the common start of all instants where these are some of them; None: it is looked for in these.
    The four numbers of a quaternion give one error: the angle of the rotation between the two.
    """
    errors = {q: _difference(q, ours[q], theirs[q]) for q in ours if q not in CHAIN_ROTATION}
    start = start or CommonStart(name, ours)
    start.find(ours, errors)
    if start.pose is not None:
        errors |= _from_common_start(ours, errors, *start.pose)
    if start.yaw_error is not None:
        errors |= _from_common_yaw(ours, theirs, errors, start.yaw_error)
    if all(q in ours for q in CHAIN_ROTATION):
        errors[ROTATION] = _rotation_between(ours, theirs)
    return errors


def scored(time_s: Floats, errors: Values, std: Values, is_planar: bool) -> dict[str, Errors]:
    """By name, in the units of the scores; the errors of position and velocity as vectors come after the components."""
    found = {}
    for quantity, error in errors.items():
        unit = "cm" if quantity in (X, Y, Z) and not is_planar else quantity.error.unit
        scale = _in_score_unit(unit)
        sigma = scale * std[quantity] if quantity in std else None
        least = scale * quantity.radians * 10.0**-quantity.decimals
        found["rate" if quantity is WZ else quantity.name] = Errors(
            time_s, scale * error, sigma, unit, quantity.label, least
        )
    place = [q for q in (X, Y, Z) if q in errors]
    if place[:2] == [X, Y]:
        found["position"] = _vector(time_s, errors, place, "m" if is_planar else "cm", "position")
    if VX in errors and VY in errors:
        found["velocity"] = _vector(time_s, errors, [VX, VY], "m_s", "velocity")
    return found


class Drift:
    """The slope of an angle's error over time, by least squares, collected block by block."""

    def __init__(self) -> None:
        self._sums: Floats = np.zeros(5)  # of 1, t, t², e, t e over the known instants
        self._first: tuple[float, float] | None = None  # time and error from which t and e count
        self._last = 0.0  # error, unwrapped (rad)

    def add(self, time_s: Floats, error_rad: Floats) -> None:
        """The next instants (N,) and errors (N,), NaN where unknown."""
        known = np.isfinite(error_rad)
        if not known.any():
            return
        t, error = time_s[known], error_rad[known]
        if self._first is None:
            self._first = float(t[0]), float(error[0])
            self._last = self._first[1]
        error = np.unwrap(np.concatenate([[self._last], error]))[1:]
        self._last = float(error[-1])
        t, error = t - self._first[0], error - self._first[1]
        self._sums += [len(t), t.sum(), t @ t, error.sum(), t @ error]

    @property
    def deg_per_min(self) -> float | None:
        """Magnitude; None of fewer than two instants."""
        n, t, tt, e, te = self._sums.tolist()
        spread = n * tt - t * t
        return float(abs(np.degrees(60.0 * (n * te - t * e) / spread))) if spread > 0 else None


def _in_score_unit(unit: str) -> float:
    """Units of a score in one SI unit."""
    return {"cm": 100.0, "deg": 180.0 / np.pi}.get(unit, 1.0)


def _vector(time_s: Floats, errors: Values, parts: list[Quantity], unit: str, label: str) -> Errors:
    size = np.sqrt(sum((errors[q] ** 2 for q in parts), np.zeros(len(time_s))))
    return Errors(time_s, _in_score_unit(unit) * size, None, unit, label)


def _difference(quantity: Quantity, ours: Floats, theirs: Floats) -> Floats:
    error = ours - theirs
    return wrapped(error) if quantity.is_angle else error


def _first_common(errors: Values, needed: tuple[Quantity, ...]) -> int | None:
    """The first instant at which all of these are known."""
    both: NDArray[np.intp] = np.flatnonzero(np.logical_and.reduce([np.isfinite(errors[q]) for q in needed]))
    return int(both[0]) if len(both) else None


def _from_common_start(ours: Values, errors: Values, start: _Place, start_error: _Place) -> dict[Quantity, Floats]:
    """Errors of a pose moved as a whole to agree with the reference at the common start."""
    turn = -start_error[HEADING]
    x, y = (ours[q] - start[q] for q in (X, Y))
    moved_x, moved_y = np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y
    return {
        X: moved_x - x + errors[X] - start_error[X],
        Y: moved_y - y + errors[Y] - start_error[Y],
        HEADING: wrapped(errors[HEADING] + turn),
    }


def _from_common_yaw(ours: Values, theirs: Values, errors: Values, start_error: float) -> dict[Quantity, Floats]:
    """Errors of a link's yaw and horizontal position, turned to agree in yaw at the common start."""
    turn = -start_error
    turned: dict[Quantity, Floats] = {YAW: wrapped(errors[YAW] + turn)}
    if X in ours and Y in ours:
        x, y = ours[X], ours[Y]
        turned[X] = np.cos(turn) * x - np.sin(turn) * y - theirs[X]
        turned[Y] = np.sin(turn) * x + np.cos(turn) * y - theirs[Y]
    return turned


def _rotation_between(ours: Values, theirs: Values) -> Floats:
    """Angle (rad) between two rotations given as quaternions, not necessarily of unit length."""
    a, b = (np.stack([of[q] for q in CHAIN_ROTATION]) for of in (ours, theirs))
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.abs((a * b).sum(axis=0)) / np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
    return np.asarray(2 * np.arccos(np.clip(cosine, -1.0, 1.0)))
