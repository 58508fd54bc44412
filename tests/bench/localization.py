"""Speed of the localization filters against filterpy's UKF with the same models in NumPy.

    python tests/bench/localization.py [--json]

Every row is a ratio of two times taken in turn on this machine: {"bench", "ours_us", "peer", "peer_us", "ratio"}.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from _report import Row, best_of, report
from filterpy.kalman import UnscentedKalmanFilter

from linkpose.localization import models
from linkpose.localization.carmen import BEAM_ANGLES_RAD, FLASER_MAX_RANGE_M
from linkpose.localization.grid import GridMap
from linkpose.localization.kalman import UNICYCLE, KalmanFilter, Measurement
from linkpose.localization.ukf import Transform
from linkpose.simulation.indoor import office_map

POSE = np.array([50.0, 12.0, 0.3])
CONTROL, HOLD_S, STEP_S = np.array([0.8, 0.1]), np.array([0.2, 0.2]), 0.2
P0 = np.diag([0.02, 0.02, 0.001])
Q_ROOT = np.diag([0.05, 0.05])
SIGMA_M = 0.3
STATES, NOISES, BEAMS = 3, 2, len(BEAM_ANGLES_RAD)


class AugmentedPoints:
    """The thesis's 49 sigma points as filterpy takes them: x̄ and x̄ ± √(n + κ) L_i with κ = 0."""

    def __init__(self, size: int) -> None:
        self.n = size
        self.Wm = self.Wc = np.concatenate(([0.0], np.full(2 * size, 0.5 / size)))

    def num_sigmas(self) -> int:
        return 2 * self.n + 1

    def sigma_points(self, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        columns = np.sqrt(self.n) * np.linalg.cholesky(covariance).T
        return np.vstack([mean, mean + columns, mean - columns])


def drive(state: np.ndarray, interval: float) -> np.ndarray:
    """The unicycle on the augmented state (x, y, θ, noises of speed and rate, noises of the beams)."""
    speed, rate = CONTROL + state[3:5]
    turn = rate * interval
    chord = speed * interval * np.sinc(0.5 * turn / np.pi)
    moved = state.copy()
    moved[:3] += chord * np.cos(state[2] + 0.5 * turn), chord * np.sin(state[2] + 0.5 * turn), turn
    return moved


def look(state: np.ndarray, grid: GridMap, steps: np.ndarray) -> np.ndarray:
    """All beams at once: the first blocked cell among points half a cell apart."""
    angles = state[2] + BEAM_ANGLES_RAD
    cell = grid.geometry[0]
    columns = np.floor((state[0] + np.cos(angles)[:, None] * steps) / cell).astype(int)
    rows = np.floor((state[1] + np.sin(angles)[:, None] * steps) / cell).astype(int)
    height, width = grid.blocked.shape
    outside = (columns < 0) | (rows < 0) | (columns >= width) | (rows >= height)
    hit = outside | (grid.blocked[rows.clip(0, height - 1), columns.clip(0, width - 1)] != 0)
    ranges = np.where(hit.any(axis=1), steps[hit.argmax(axis=1)], FLASER_MAX_RANGE_M)
    return ranges + state[5:]


def beams_measurement(grid: GridMap) -> Measurement:
    table = np.zeros((BEAMS, 5))
    table[:, 0], table[:, 4] = BEAM_ANGLES_RAD, FLASER_MAX_RANGE_M
    ranges = np.empty(BEAMS)
    models.predict(models.BEAMS, POSE, table, grid, ranges)
    return Measurement(models.BEAMS, ranges, SIGMA_M**2 * np.eye(BEAMS), table)


def our_step(name: str, grid: GridMap, measurement: Measurement) -> Callable[[], object]:
    """A prediction and a correction from the same state each time."""
    filter_ = KalmanFilter(name, UNICYCLE, POSE, P0, Q_ROOT, None, Transform(), grid)

    def step() -> None:
        filter_.state[:], filter_.covariance[:] = POSE, P0
        filter_.step(STEP_S, CONTROL, HOLD_S, measurement)

    return step


def peer_step(grid: GridMap, measurement: Measurement) -> Callable[[], object]:
    """filterpy on the augmented state: P_a = diag(P, Q, R) anew at every step, no noise besides."""
    size = STATES + NOISES + BEAMS
    steps = np.arange(0.0, FLASER_MAX_RANGE_M, 0.5 * grid.geometry[0])
    points = AugmentedPoints(size)
    look_here = partial(look, grid=grid, steps=steps)
    peer = UnscentedKalmanFilter(dim_x=size, dim_z=BEAMS, dt=STEP_S, hx=look_here, fx=drive, points=points)
    peer.Q, peer.R = np.zeros((size, size)), 1e-9 * np.eye(BEAMS)
    mean = np.concatenate((POSE, np.zeros(NOISES + BEAMS)))
    covariance = np.zeros((size, size))
    covariance[:3, :3], covariance[3:5, 3:5] = P0, Q_ROOT @ Q_ROOT.T
    covariance[5:, 5:] = measurement.covariance

    def step() -> None:
        peer.x, peer.P = mean.copy(), covariance.copy()
        peer.predict()
        peer.update(measurement.values)

    return step


def rows() -> Iterator[Row]:
    grid = office_map()
    measurement = beams_measurement(grid)
    peer_us = best_of(peer_step(grid, measurement), 15)
    for bench, name in (("ukf-49-points-19-beams", "ukf"), ("ekf-19-beams", "ekf")):
        yield Row(bench, best_of(our_step(name, grid, measurement), 1500), "filterpy UKF", peer_us)


def main() -> None:
    report(rows())


if __name__ == "__main__":
    main()
