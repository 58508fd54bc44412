"""Errors of one filter's quantities, at instants that estimate and reference share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from linkpose import filters
from linkpose.evaluation.statistics import Statistics
from linkpose.quantities import CHAIN_ROTATION, HEADING, POSE, ROTATION, VX, VY, WZ, YAW, Quantity, X, Y, Z
from linkpose.sensors.measurements import Floats

Values = Mapping[Quantity, Floats]  # (N,) each; angles in radians

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

    def statistics(self) -> Statistics:
        """Of all instants."""
        return Statistics.of(self.error, self.std, self.least_std)


def errors_of(name: str, ours: Values, theirs: Values) -> dict[Quantity, Floats]:
    """Estimate − reference of each quantity, angles within ±π.

    A pose without an absolute origin is compared after moving it as a whole to agree with the reference at the first
    common instant: odometry in position and heading, a link without compass about the vertical only.
    The four numbers of a quaternion give one error: the angle of the rotation between the two.
    """
    errors = {q: _difference(q, ours[q], theirs[q]) for q in ours if q not in CHAIN_ROTATION}
    needs = filters.capabilities(name)
    if needs is not None and needs.is_odometric and all(q in errors for q in POSE):
        errors |= _from_common_start(ours, errors)
    if YAW in errors:
        errors |= _from_common_yaw(ours, theirs, errors)
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


def yaw_drift_deg_per_min(time_s: Floats, error_rad: Floats) -> float | None:
    """Magnitude of the slope of the yaw's error, by least squares; None of fewer than two instants."""
    known = np.isfinite(error_rad)
    t = time_s[known]
    if len(t) < 2 or not t[-1] > t[0]:
        return None
    t = t - t.mean()
    unwrapped = np.unwrap(error_rad[known])
    return float(abs(np.degrees(60.0 * (t @ unwrapped) / (t @ t))))


def _in_score_unit(unit: str) -> float:
    """Units of a score in one SI unit."""
    return {"cm": 100.0, "deg": 180.0 / np.pi}.get(unit, 1.0)


def _vector(time_s: Floats, errors: Values, parts: list[Quantity], unit: str, label: str) -> Errors:
    size = np.sqrt(sum((errors[q] ** 2 for q in parts), np.zeros(len(time_s))))
    return Errors(time_s, _in_score_unit(unit) * size, None, unit, label)


def _wrapped(angle: Floats) -> Floats:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _difference(quantity: Quantity, ours: Floats, theirs: Floats) -> Floats:
    error = ours - theirs
    return _wrapped(error) if quantity.is_angle else error


def _first_common(errors: Values, needed: tuple[Quantity, ...]) -> int | None:
    """The first instant at which all of these are known."""
    both: NDArray[np.intp] = np.flatnonzero(np.logical_and.reduce([np.isfinite(errors[q]) for q in needed]))
    return int(both[0]) if len(both) else None


def _from_common_start(ours: Values, errors: Values) -> dict[Quantity, Floats]:
    """Errors of a pose moved as a whole to agree with the reference at the first common instant."""
    first = _first_common(errors, POSE)
    if first is None:
        return {}
    turn = -errors[HEADING][first]
    x, y = (ours[q] - ours[q][first] for q in (X, Y))
    moved_x, moved_y = np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y
    return {
        X: moved_x - x + errors[X] - errors[X][first],
        Y: moved_y - y + errors[Y] - errors[Y][first],
        HEADING: _wrapped(errors[HEADING] + turn),
    }


def _from_common_yaw(ours: Values, theirs: Values, errors: Values) -> dict[Quantity, Floats]:
    """Errors of a link's yaw and horizontal position, turned to agree in yaw at the first common instant."""
    first = _first_common(errors, (YAW,))
    if first is None:
        return {}
    turn = -errors[YAW][first]
    turned: dict[Quantity, Floats] = {YAW: _wrapped(errors[YAW] + turn)}
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
