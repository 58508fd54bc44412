"""What disturbs the earth's magnetic field near a sensor: iron that moves, motors, and buildings and vehicles.

Every field is a function of kind, seed and time, so that any instant may be evaluated, in any order. Strengths (µT) are
those that a magnetometer shows about half a metre from the iron.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from linkpose.simulation.mag import axes
from linkpose.simulation.motion import Kinematics

Floats = NDArray[np.float64]
Field = Callable[[Floats], Floats]  # of times (N,): east, north, up (N, 3), or the sensor's axes of a motor

KINDS = {
    "desk": "a steel desk is rolled near and stays",
    "desks": "the sensor is carried from one steel desk to the next",
    "motor": "a motor on the link switches on and off",
    "iron": "somebody walks past with iron, once in a minute",
    "building": "the sensor is carried through a building, whose field varies within a minute",
    "floor": "the sensor is carried over a floor with steel, whose field varies within seconds",
    "lift": "the sensor rides in a lift, once in two minutes",
    "car": "the sensor is in a car, whose iron turns with it",
}
_BEGINS_S = 20.0  # of disturbances that arrive
_ROLLING_S = 3.0  # of a desk, or from one desk to the next
DESK_UT = np.array([9.0, 14.0, -8.0])
_DESKS_UT, _AT_DESK_S = 8.0, (10.0, 60.0)  # standard deviation along each axis; time at one
_MOTOR_UT, _MOTOR_PERIOD_S, _MOTOR_RIPPLE_HZ = np.array([6.0, -9.0, 4.0]), 16.0, 7.0
_IRON_UT, _WALK_PERIOD_S, _WALK_S = 25.0, 60.0, 2.5
# Standard deviation along each axis, and correlation time (s).
_BUILDING_UT, _BUILDING_S = (2.0, 6.0), 60.0
_FLOOR_UT, _FLOOR_S = (3.0, 8.0), 5.0
_LIFT_PERIOD_S, _RIDE_S, _CABIN_UT, _SHAFT_UT, _SHAFT_S = 120.0, 40.0, 10.0, 6.0, 3.0
_CAR_UT, _CAR_TURN_S, _CAR_STRAIGHT_S, _CAR_WANDER_UT, _CAR_WANDER_S = (8.0, 15.0), 6.0, (15.0, 60.0), 1.0, 10.0
_TONES = 24  # of a wander
_HIGHEST = 6.0  # frequency of a tone, in half-widths of the spectrum
_LONGEST_S = 7200.0  # over which steps and turns are drawn; afterwards the last one stays


class Disturbance:
    """One kind of disturbance for one seed."""

    def __init__(self, kind: str, seed: int) -> None:
        """`kind` is a key of KINDS."""
        rng = np.random.default_rng([seed, list(KINDS).index(kind)])
        self._is_on_link = kind == "motor"
        self._field = _FIELDS[kind](rng)

    def field(self, moving: Kinematics, time_s: Floats) -> Floats:
        """Field of the disturbance (N, 3) in the sensor's axes, µT."""
        found = self._field(time_s)
        if self._is_on_link:
            return found
        east, north, up = found.T
        x, y, z = axes(moving)
        return np.asarray(north[:, None] * x + east[:, None] * y + up[:, None] * z)


def _turned(rng: np.random.Generator, vector: Floats) -> Floats:
    """The vector at another heading."""
    return _about_z(vector, rng.uniform(0, 2 * np.pi))


def _about_z(vector: Floats, angle: float | Floats) -> Floats:
    """The vector (3,) turned about the third axis: (…, 3) for angles (…)."""
    x, y, z = vector
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * x - s * y, s * x + c * y, np.broadcast_to(z, np.shape(c))], axis=-1)


def _wander(rng: np.random.Generator, std_uT: float, correlation_s: float) -> Field:
    """Three independent components with an exponential correlation: tones whose frequencies have its spectrum."""
    width = 1 / (2 * np.pi * correlation_s)
    place = (np.arange(_TONES) + rng.uniform(0, 1, (3, _TONES))) / _TONES
    frequency = width * np.minimum(np.tan(0.5 * np.pi * np.minimum(place, 0.999)), _HIGHEST)
    phase = rng.uniform(0, 2 * np.pi, (3, _TONES))
    scale = std_uT * np.sqrt(2 / _TONES)

    def at(time_s: Floats) -> Floats:
        tones = zip(frequency, phase, strict=True)
        components = [np.cos(np.outer(time_s, 2 * np.pi * f) + p).sum(axis=1) for f, p in tones]
        return np.asarray(scale * np.column_stack(components))

    return at


def _changes(rng: np.random.Generator, apart_s: tuple[float, float]) -> Floats:
    """Times (M,) of changes with distances between the shortest and the longest of `apart_s`."""
    between = rng.uniform(*apart_s, int(_LONGEST_S / apart_s[0]))
    return np.asarray(np.cumsum(between))


def _ramps(at_s: Floats, levels: Floats, ramp_s: float) -> Field:
    """Levels (M + 1, K), each followed by the next one from one of the times (M,) on, within `ramp_s`."""
    times = np.column_stack([at_s, at_s + ramp_s]).ravel()
    values = np.concatenate([levels[:1], np.repeat(levels[1:-1], 2, axis=0), levels[-1:]])
    return lambda time_s: np.column_stack([np.interp(time_s, times, column) for column in values.T])


def _desk(rng: np.random.Generator) -> Field:
    field = _turned(rng, DESK_UT)
    return lambda time_s: np.outer(np.clip((time_s - _BEGINS_S) / _ROLLING_S, 0.0, 1.0), field)


def _desks(rng: np.random.Generator) -> Field:
    at_s = _changes(rng, _AT_DESK_S)
    return _ramps(at_s, _DESKS_UT * rng.standard_normal((len(at_s) + 1, 3)), _ROLLING_S)


def _motor(rng: np.random.Generator) -> Field:
    field = _turned(rng, _MOTOR_UT)

    def at(time_s: Floats) -> Floats:
        since = time_s - _BEGINS_S
        runs = (since > 0) & (since % _MOTOR_PERIOD_S < _MOTOR_PERIOD_S / 2)
        return np.outer(runs * (1.0 + 0.5 * np.sin(2 * np.pi * _MOTOR_RIPPLE_HZ * time_s)), field)

    return at


def _iron(rng: np.random.Generator) -> Field:
    heading = rng.uniform(0, 2 * np.pi)

    def at(time_s: Floats) -> Floats:
        since = np.maximum(time_s - _BEGINS_S, 0.0)
        phase = (since + _WALK_PERIOD_S / 2) % _WALK_PERIOD_S - _WALK_PERIOD_S / 2
        strength = (since > 0) * _IRON_UT / (1 + (phase / _WALK_S) ** 2) ** 1.5
        angle = np.arctan2(phase, _WALK_S) + heading
        return np.column_stack([strength * np.cos(angle), strength * np.sin(angle), -0.3 * strength])

    return at


def _building(rng: np.random.Generator) -> Field:
    return _wander(rng, rng.uniform(*_BUILDING_UT), _BUILDING_S)


def _floor(rng: np.random.Generator) -> Field:
    return _wander(rng, rng.uniform(*_FLOOR_UT), _FLOOR_S)


def _lift(rng: np.random.Generator) -> Field:
    cabin, shaft = _CABIN_UT * rng.standard_normal(3), _wander(rng, _SHAFT_UT, _SHAFT_S)

    def at(time_s: Floats) -> Floats:
        phase = (time_s - _BEGINS_S) % _LIFT_PERIOD_S
        inside = np.clip(np.minimum(phase, _RIDE_S - phase) / _ROLLING_S, 0.0, 1.0) * (time_s > _BEGINS_S)
        return np.asarray(inside[:, None] * (cabin + shaft(time_s)))

    return at


def _car(rng: np.random.Generator) -> Field:
    """Quarter turns to either side. The sensor in these runs does not turn with the car."""
    at_s = _changes(rng, _CAR_STRAIGHT_S)
    iron = _turned(rng, rng.uniform(*_CAR_UT) * np.array([0.9, 0.0, 0.4]))
    headings = np.cumsum(np.concatenate([[0.0], 0.5 * np.pi * rng.choice([-1, 1], len(at_s))]))
    heading = _ramps(at_s, headings[:, None], _CAR_TURN_S)
    wander = _wander(rng, _CAR_WANDER_UT, _CAR_WANDER_S)
    return lambda time_s: _about_z(iron, heading(time_s)[:, 0]) + wander(time_s)


_FIELDS: dict[str, Callable[[np.random.Generator], Field]] = {
    "desk": _desk,
    "desks": _desks,
    "motor": _motor,
    "iron": _iron,
    "building": _building,
    "floor": _floor,
    "lift": _lift,
    "car": _car,
}
