"""The axis of a hinge in both links, from the relative rotation of two sensors over pieces of a recording.

A hinge keeps its axis in the same direction in both links. The fit minimises the play y = C_1 j_1 − R C_2 j_2 over both
axes j_1, j_2 and over a small rotation of each piece's R; C_k are the rotations of sensor k into its frame at the start
of the piece, R is the rotation between these frames.

Source of the first axes: [Seel2014] (6).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from linkpose.calibration.joint_constraint import cross_matrices
from linkpose.rotations import of_matrices, rotation_vectors
from linkpose.sensors.measurements import Floats

_PLAY_STD_RAD, _PLAY_CORRELATION_S = 0.05, 0.5  # assumed of a hinge while its axis is fitted
AXIS_STEP_S = 0.1  # between two instants of that fit
_AXIS_PRIOR_STD_RAD = 1.0  # of each component of an axis: no knowledge
_AXIS_STARTS, _SEEL_STEPS, _HINGE_STEPS = 12, 10, 10
_LEAST_AXIS_STD_DEG = 0.7  # axes of a gyro: the data sheet allows 2 % between two of them
_SIDE = np.array([1.0, 0.77, 0.61])  # the sense of an axis is arbitrary: j_2 lies on this side, as in the filter


class HingeMotion(NamedTuple):
    """The relative motion of the links, as a hinge explains it."""

    axes: Floats  # (2, 3) j_1 and j_2
    covariance: Floats  # (6, 6) of both, rad²
    turn_deg: float  # rms rotation about the axis
    play_deg: float  # rms angle between R_1 j_1 and R_2 j_2
    drift_deg: float = 0.0  # σ of the play that wrong gyro biases cause

    @property
    def std_deg(self) -> Floats:
        """(2,) σ of each axis in the direction across it that is known least."""
        blocks = (self.covariance[:3, :3], self.covariance[3:, 3:])
        return np.array([max(np.degrees(np.sqrt(np.linalg.eigvalsh(b)[-1])), _LEAST_AXIS_STD_DEG) for b in blocks])


class Rotations(NamedTuple):
    """A piece's rotations into its own frame, at some N instants, and how well R is known."""

    one: Floats  # (N, 3, 3) C_1
    two: Floats  # (N, 3, 3) R C_2
    rates: Floats  # (2, N, 3) rad/s, each in its sensor's axes
    information: Floats  # (3, 3) of R's error, 1/rad²
    common: float  # share of that error's variance that all pieces may have in common


def best_hinge(parts: Sequence[Rotations]) -> HingeMotion:
    """The hinge that explains the relative motion best.

    The prior of each small rotation is what the accelerations show of R. Slow motion does not show the heading of R;
    the axes then determine it.
    """
    found = [_fit_hinge(parts, axes) for axes in _first_axes(parts)]
    return min(found, key=lambda each: each[0])[1]


def _first_axes(parts: Sequence[Rotations]) -> list[Floats]:
    """Axes (2, 3) to start from: where the pieces' rotations hold the axis best, and [Seel2014] (6), which needs none.

    The latter minimises Σ (‖ω_1 × j_1‖ − ‖ω_2 × j_2‖)², from several directions. It does not show the sense of either
    axis, and no axis of a sensor that hardly turns: each axis is paired with its image by the rotations of the piece
    whose R is known best.
    """
    mean = np.mean(np.concatenate([np.einsum("nji,njk->nik", p.one, p.two) for p in parts]), axis=0)
    left, _, right = np.linalg.svd(mean)
    rates = np.concatenate([p.rates for p in parts], axis=1)
    starts = [np.stack(pair) for pair in itertools.product(_directions(_AXIS_STARTS), repeat=2)]
    costs = [float(np.sum(_seel_residual(rates, axes) ** 2)) for axes in starts]
    fitted = [_fit_seel(rates, starts[at]) for at in np.argsort(costs)[:_AXIS_STARTS]]
    one, two = min(fitted, key=lambda axes: float(np.sum(_seel_residual(rates, axes) ** 2)))
    best = max(parts, key=lambda p: float(np.linalg.eigvalsh(p.information)[0]))
    relative = np.einsum("nji,njk->ik", best.one, best.two)
    pairs = [(left[:, 0], right[0]), (one, relative.T @ one), (relative @ two, two)]
    return [np.stack([axis / np.linalg.norm(axis) for axis in pair]) for pair in pairs]


def _directions(count: int) -> Floats:
    """Unit vectors (N, 3) spread over a half sphere (Fibonacci)."""
    z = (np.arange(count) + 0.5) / count
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    wide = np.sqrt(1 - z**2)
    return np.column_stack([wide * np.cos(turn), wide * np.sin(turn), z])


def _seel_residual(rates: Floats, axes: Floats) -> Floats:
    """(N,) ‖ω_1 × j_1‖ − ‖ω_2 × j_2‖."""
    one, two = (np.linalg.norm(np.cross(rates[k], axes[k]), axis=1) for k in range(2))
    return np.asarray(one - two)


def _fit_seel(rates: Floats, axes: Floats) -> Floats:
    """Axes (2, 3) after some Gauss-Newton steps."""
    for _ in range(_SEEL_STEPS):
        columns = []
        for k, sign in enumerate((1.0, -1.0)):
            across = np.cross(rates[k], axes[k])
            unit = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-6)
            columns.append(sign * np.cross(unit, rates[k]))  # d‖ω × j‖ = (u × ω) · dj
        jacobian = np.concatenate(columns, axis=1)
        damped = jacobian.T @ jacobian + 1e-3 * len(jacobian) * np.diag(np.full(6, float(np.mean(rates**2)) + 1e-9))
        step = np.linalg.solve(damped, -jacobian.T @ _seel_residual(rates, axes)).reshape(2, 3)
        axes = axes + step
        axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return axes


class _Step(NamedTuple):
    """Normal equations of one piece at the present axes, with the rotation of R eliminated: turn = −(own + mixed a)."""

    normal: Floats  # (6, 6)
    gradient: Floats  # (6,) downhill
    mixed: Floats  # (3, 6)
    own: Floats  # (3,)
    cost: float


def _fit_hinge(parts: Sequence[Rotations], axes: Floats) -> tuple[float, HingeMotion]:
    """Gauss-Newton for both axes and the small rotations of the pieces' R. Returns the cost and the motion."""
    turns = [np.eye(3)] * len(parts)
    for _ in range(_HINGE_STEPS):
        steps = [_hinge_step(part, turn, axes) for part, turn in zip(parts, turns, strict=True)]
        normal = sum((step.normal for step in steps), np.eye(6) / _AXIS_PRIOR_STD_RAD**2)
        across = np.zeros((6, 4))  # changes of the axes across them; along them, only their length would change
        for k in range(2):
            across[3 * k : 3 * k + 3, 2 * k : 2 * k + 2] = np.linalg.svd(axes[k][None])[2][1:].T
        inverse = across @ np.linalg.inv(across.T @ normal @ across) @ across.T
        change = inverse @ sum((step.gradient for step in steps), np.zeros(6))
        turns = [_small_turn(-(s.own + s.mixed @ change)) @ turn for s, turn in zip(steps, turns, strict=True)]
        axes = axes + change.reshape(2, 3)
        axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    pulls = np.array([step.gradient for step in steps])
    covariance = inverse @ (pulls.T @ pulls) @ inverse + inverse + _common_turns(parts, steps, inverse)
    sense = 1.0 if axes[1] @ _SIDE >= 0 else -1.0
    found = HingeMotion(sense * axes, covariance, *_turn_and_play(parts, turns, axes))
    return sum(step.cost for step in steps), found


def _hinge_step(part: Rotations, turn: Floats, axes: Floats) -> _Step:
    seen = turn @ (part.two @ axes[1])[:, :, None]
    seen = seen[:, :, 0]
    play = part.one @ axes[0] - seen
    by_axes = np.concatenate([part.one, -turn @ part.two], axis=2)  # (N, 3, 6)
    by_turn = cross_matrices(seen)  # −(δ × T R C_2 j_2)
    weight = AXIS_STEP_S / _PLAY_CORRELATION_S / _PLAY_STD_RAD**2
    away = rotation_vectors(of_matrices(turn[None]))[0]
    inner = weight * np.einsum("nia,nib->ab", by_turn, by_turn) + part.information
    mixed = weight * np.einsum("nia,nip->ap", by_turn, by_axes)
    pull = weight * np.einsum("nia,ni->a", by_turn, play) + part.information @ away
    solved = np.linalg.solve(inner, np.column_stack([mixed, pull]))
    return _Step(
        weight * np.einsum("nip,niq->pq", by_axes, by_axes) - mixed.T @ solved[:, :6],
        -(weight * np.einsum("nip,ni->p", by_axes, play) - mixed.T @ solved[:, 6]),
        solved[:, :6],
        solved[:, 6],
        weight * float(np.sum(play**2)) + float(away @ part.information @ away),
    )


def _common_turns(parts: Sequence[Rotations], steps: Sequence[_Step], inverse: Floats) -> Floats:
    """What the covariance (6, 6) of the axes lacks if the common errors of all R have the worst signs.

    `inverse` counts the errors of the pieces' R as independent. An accelerometer's error stays the same over the
    recording and may turn every R to the same side, about the direction that the forces show least: the vertical.
    """
    shifts = np.empty((len(parts), 6))
    for shift, part, step in zip(shifts, parts, steps, strict=True):
        values, vectors = np.linalg.eigh(part.information)
        shift[:] = np.sqrt(part.common * values[0]) * (inverse @ step.mixed.T @ vectors[:, 0])
    squares = shifts.T @ shifts
    total = np.sign(shifts @ np.linalg.eigh(squares)[1][:, -1]) @ shifts
    return np.asarray(np.outer(total, total) - squares)


def _turn_and_play(parts: Sequence[Rotations], turns: Sequence[Floats], axes: Floats) -> tuple[float, float]:
    """Rms of the rotation about the axis and of the angle between its two directions, degrees."""
    (side1, across1), (side2, _) = (np.linalg.svd(axis[None])[2][1:] for axis in axes)
    across1 = np.cross(axes[0], side1)
    vectors, play = [], []
    for part, turn in zip(parts, turns, strict=True):
        two = turn @ part.two
        relative = np.einsum("nji,nj->ni", part.one, two @ side2)
        vectors.append(relative @ side1 + 1j * (relative @ across1))
        play.append(np.linalg.norm(part.one @ axes[0] - two @ axes[1], axis=1))
    unit = np.concatenate(vectors) / np.maximum(np.abs(np.concatenate(vectors)), 1e-9)
    turn_rad = np.sqrt(-2 * np.log(max(float(np.abs(unit.mean())), 1e-6)))  # circular standard deviation
    return float(np.degrees(turn_rad)), float(np.degrees(np.sqrt(np.mean(np.concatenate(play) ** 2))))


def _small_turn(vector: Floats) -> Floats:
    """The rotation matrix (3, 3) of a rotation vector (rad)."""
    angle = float(np.linalg.norm(vector))
    cross = cross_matrices((vector / max(angle, 1e-12))[None])[0]
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
