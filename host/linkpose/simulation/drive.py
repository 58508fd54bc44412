"""Where a small robot drives: velocity in its own axes, the way that it has gone, and its pose, at any instant.

Frames: n is the floor's, b the robot's (x ahead, y to the left, z up). With Q(t) = ∫ (v_bx, v_by, ω_b) dt, the way, a
point p of the robot has moved in b by (Q_x − Q_ω p_y, Q_y + Q_ω p_x): that is all that a mouse sees.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SLOT_S = 4.0  # of one manoeuvre
PASSAGE_S = 1.0  # from one velocity to the next
STILL_S = 2.0  # rest before and after a single move, in which the gyro's bias shows
_POSE_STEP_S = 0.001
_POSE_BLOCK = 1000  # steps


class Drive(Protocol):
    """A drive as a function of time; all give (N, 3) at instants (N,)."""

    def twist(self, time_s: Floats) -> Floats:
        """v_bx, v_by (m/s), ω_b (rad/s)."""

    def acceleration(self, time_s: Floats) -> Floats:
        """The twist's derivative (m/s², m/s², rad/s²)."""

    def way(self, time_s: Floats) -> Floats:
        """Q since 0 (m, m, rad)."""


class Steady:
    """One velocity for ever."""

    def __init__(self, twist: tuple[float, float, float]) -> None:
        self._twist = np.array(twist)

    def twist(self, time_s: Floats) -> Floats:
        return np.tile(self._twist, (len(time_s), 1))

    def acceleration(self, time_s: Floats) -> Floats:
        return np.zeros((len(time_s), 3))

    def way(self, time_s: Floats) -> Floats:
        return np.outer(time_s, self._twist)


class Move:
    """A rest, one smooth motion, and a rest."""

    def __init__(self, way: tuple[float, float, float], duration_s: float) -> None:
        """`way` is the whole of it (m, m, rad)."""
        self._way, self._span_s = np.array(way), duration_s - 2 * STILL_S

    def _fraction(self, time_s: Floats) -> Floats:
        return np.clip((time_s - STILL_S) / self._span_s, 0.0, 1.0)

    def twist(self, time_s: Floats) -> Floats:
        u = self._fraction(time_s)
        return np.outer(30 * (u * (1 - u)) ** 2 / self._span_s, self._way)

    def acceleration(self, time_s: Floats) -> Floats:
        u = self._fraction(time_s)
        return np.outer(60 * u * (1 - u) * (1 - 2 * u) / self._span_s**2, self._way)

    def way(self, time_s: Floats) -> Floats:
        return np.outer(_smooth(self._fraction(time_s)), self._way)


class Manoeuvres:
    """Straight on, loops, turns on the spot, sideways, rests: one each SLOT_S, drawn by the seed, up to 1 m/s."""

    def __init__(self, seed: tuple[int, ...], rests: float = 0.05) -> None:
        """`rests` is the share of manoeuvres that are rests."""
        self._seed, self._rests = seed, rests
        self._twists = [np.zeros(3)]  # of each manoeuvre: the first is rest
        self._ways = [np.zeros(3), np.zeros(3)]  # Q at the start of each and at the end of the last

    def _tables(self, time_s: Floats) -> tuple[NDArray[np.int64], Floats, Floats, Floats]:
        """Number of the manoeuvre at each instant, time within it, velocity before it and its own."""
        number = np.floor(time_s / SLOT_S).astype(np.int64)
        while len(self._twists) <= number.max():
            before, after = self._twists[-1], self._draw(len(self._twists))
            self._twists.append(after)
            self._ways.append(self._ways[-1] + before * SLOT_S + (after - before) * (SLOT_S - 0.5 * PASSAGE_S))
        twists = np.array(self._twists)
        return number, time_s - number * SLOT_S, twists[np.maximum(number - 1, 0)], twists[number]

    def _shares(self) -> Floats:
        moves = np.array([0.35, 0.15, 0.15, 0.15, 0.15]) / 0.95
        return np.append((1.0 - self._rests) * moves, self._rests)

    def _draw(self, number: int) -> Floats:
        rng = np.random.default_rng([*self._seed, number])
        side, speed = rng.choice([-1.0, 1.0]), rng.uniform(0.3, 0.95)
        manoeuvres = (
            (speed, 0.0, 0.0),  # straight on
            (0.5 * speed, 0.0, side * 2 * math.pi / SLOT_S),  # a loop
            (0.5 * speed, 0.0, side * 0.8),  # a bend
            (0.0, 0.0, side * rng.uniform(0.8, 1.8)),  # a turn on the spot
            (0.5 * speed, side * 0.5 * speed, 0.0),  # sideways
            (0.0, 0.0, 0.0),
        )
        return np.array(manoeuvres[int(rng.choice(len(manoeuvres), p=self._shares()))])

    def twist(self, time_s: Floats) -> Floats:
        _, within, before, after = self._tables(time_s)
        return before + _smooth(np.minimum(within / PASSAGE_S, 1.0))[:, None] * (after - before)

    def acceleration(self, time_s: Floats) -> Floats:
        _, within, before, after = self._tables(time_s)
        u = np.minimum(within / PASSAGE_S, 1.0)
        return np.asarray((30 * (u * (1 - u)) ** 2 / PASSAGE_S)[:, None] * (after - before))

    def way(self, time_s: Floats) -> Floats:
        number, within, before, after = self._tables(time_s)
        u = np.minimum(within / PASSAGE_S, 1.0)
        passed = PASSAGE_S * (u**6 - 3 * u**5 + 2.5 * u**4) + np.maximum(within - PASSAGE_S, 0.0)  # ∫ of the passage
        return np.asarray(np.array(self._ways)[number] + before * within[:, None] + (after - before) * passed[:, None])


class Hastened:
    """Another drive, `factor` times as fast, from its instant `start_s` on: a robot that is already moving."""

    def __init__(self, drive: Drive, factor: float, start_s: float = 0.0) -> None:
        self._drive, self._factor, self._start_s = drive, factor, start_s

    def _instants(self, time_s: Floats) -> Floats:
        return np.asarray(self._start_s + self._factor * np.asarray(time_s))

    def twist(self, time_s: Floats) -> Floats:
        return np.asarray(self._factor * self._drive.twist(self._instants(time_s)))

    def acceleration(self, time_s: Floats) -> Floats:
        return np.asarray(self._factor**2 * self._drive.acceleration(self._instants(time_s)))

    def way(self, time_s: Floats) -> Floats:
        before = self._drive.way(np.array([self._start_s]))
        return np.asarray(self._drive.way(self._instants(time_s)) - before)


class DrivenPath:
    """The pose that a drive leads to, from (0, 0, 0) on."""

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        self._places = [np.zeros(2)]  # at the start of each block

    def pose(self, time_s: Floats) -> Floats:
        """x, y (m) and heading (rad, not wrapped) in n at instants (N,): (N, 3)."""
        time_s = np.maximum(time_s, 0.0)
        blocks = np.floor(time_s / (_POSE_STEP_S * _POSE_BLOCK)).astype(np.int64)
        out = np.empty((len(time_s), 3))
        out[:, 2] = self._drive.way(time_s)[:, 2]
        for block in np.unique(blocks):
            while len(self._places) <= block:
                self._places.append(self._places[-1] + self._steps(len(self._places) - 1)[-1])
            path = self._places[block] + self._steps(int(block))
            at = time_s[blocks == block] / _POSE_STEP_S - block * _POSE_BLOCK
            steps = np.arange(_POSE_BLOCK + 1)
            out[blocks == block, :2] = np.column_stack([np.interp(at, steps, path[:, j]) for j in range(2)])
        return out

    def _steps(self, block: int) -> Floats:
        """The way in n within a block: (_POSE_BLOCK + 1, 2), by Simpson's rule."""
        half: Floats = (2 * block * _POSE_BLOCK + np.arange(2 * _POSE_BLOCK + 1, dtype=np.float64)) * 0.5 * _POSE_STEP_S
        twist, heading = self._drive.twist(half), self._drive.way(half)[:, 2]
        c, s = np.cos(heading), np.sin(heading)
        velocity = np.column_stack([c * twist[:, 0] - s * twist[:, 1], s * twist[:, 0] + c * twist[:, 1]])
        steps = _POSE_STEP_S / 6 * (velocity[:-2:2] + 4 * velocity[1::2] + velocity[2::2])
        return np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])


def _smooth(u: Floats) -> Floats:
    """From 0 to 1 with two continuous derivatives, for u within 0 and 1."""
    return np.asarray(u**3 * (10 - 15 * u + 6 * u**2))
