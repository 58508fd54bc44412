"""Finds the poses of a whole map from which a laser scan fits: a coarse grid of poses, compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled
from linkpose.localization.distance_field import Field, distance_at
from linkpose.localization.grid import FREE, GridMap
from linkpose.localization.linalg import Floats
from linkpose.rotations import wrapped

# Spacing of the grid of poses. A beam of 5 m then ends within 0.3 m + 5 m x 0.065 rad of where it ends from the nearest
# grid pose, well inside the distance field. Halving both takes eight times as long and finds the same poses.
SPACING_M, HEADINGS = 0.4, 48
# Upper bound on the poses that are tried; a larger map gets a wider spacing.
MOST_POSES = 3_000_000
MOST_BEAMS = 40  # of the scan that take part
# Distances are cut off here (m) when a pose is scored: an end 1 m from a wall is as wrong as one 3 m away.
CUT_M = 1.0
# Poses nearer to a better one than this are the same place for the fit that follows.
SAME_PLACE_M, SAME_HEADING_RAD = 0.7, 0.3
# The search around a prediction that has failed: wheels have slipped by up to this much since the last scan. In the
# public log of the Intel laboratory the worst slip is 0.9 m, 0.9 rad.
NEAR_M, NEAR_RAD, NEAR_SPACING_M, NEAR_SPACING_RAD = 1.2, 1.2, 0.2, 0.1


def likely_poses(grid: GridMap, counts: Field, points: Floats, most: int) -> Floats:
    """The (≤ most, 3) poses x, y (m), heading (rad) of the map whose beam ends lie nearest to walls, best first.

    `points` (n, 2) are the ends of the beams in the robot's axes (m). Only poses in free cells are tried.
    """
    cell = float(grid.geometry[0])
    stride = max(1, math.ceil(SPACING_M / cell))
    free = int(np.count_nonzero(grid.blocked[::stride, ::stride] == FREE))
    stride *= max(1, math.ceil(math.sqrt(free * HEADINGS / MOST_POSES)))
    used = np.ascontiguousarray(points[:: max(1, math.ceil(len(points) / MOST_BEAMS))])
    rows, columns = np.nonzero(grid.blocked[stride // 2 :: stride, stride // 2 :: stride] == FREE)
    places = np.empty((len(rows), 2))
    u, v = (columns * stride + stride // 2 + 0.5) * cell, (rows * stride + stride // 2 + 0.5) * cell
    c, s = math.cos(grid.geometry[3]), math.sin(grid.geometry[3])
    places[:, 0], places[:, 1] = grid.geometry[1] + c * u - s * v, grid.geometry[2] + s * u + c * v
    headings = 2.0 * math.pi * np.arange(HEADINGS) / HEADINGS - math.pi
    scores = np.empty((len(places), HEADINGS), np.float32)
    score_poses(counts, grid.geometry, used, places, headings, scores)
    return _separate(places, headings, scores, most)


@compiled
def score_poses(
    counts: Field, geometry: Floats, points: Floats, places: Floats, headings: Floats, scores: NDArray[np.float32]
) -> None:
    """Fills `scores` (places, headings) with the mean distance (m) of the beam ends from walls, cut off at CUT_M."""
    at = np.empty(3)
    for j in range(scores.shape[1]):
        c, s = math.cos(headings[j]), math.sin(headings[j])
        for i in range(places.shape[0]):
            total = 0.0
            for k in range(points.shape[0]):
                px, py = points[k, 0], points[k, 1]
                distance_at(counts, geometry, places[i, 0] + c * px - s * py, places[i, 1] + s * px + c * py, at)
                total += min(abs(at[0]), CUT_M)
            scores[i, j] = total / max(points.shape[0], 1)


def nearby_poses(geometry: Floats, counts: Field, points: Floats, centre: Floats, most: int) -> Floats:
    """As `likely_poses`, but within NEAR_M and NEAR_RAD of the pose `centre` (3,), and on a finer grid."""
    used = np.ascontiguousarray(points[:: max(1, math.ceil(len(points) / MOST_BEAMS))])
    steps = np.arange(-NEAR_M, NEAR_M + 1e-9, NEAR_SPACING_M)
    places = centre[:2] + np.array([(x, y) for x in steps for y in steps])
    headings = centre[2] + np.arange(-NEAR_RAD, NEAR_RAD + 1e-9, NEAR_SPACING_RAD)
    scores = np.empty((len(places), len(headings)), np.float32)
    score_poses(counts, geometry, used, places, headings, scores)
    return _separate(places, headings, scores, most)


def _separate(places: Floats, headings: Floats, scores: NDArray[np.float32], most: int) -> Floats:
    """The best poses that lie apart from each other."""
    flat = scores.ravel()
    count = min(20 * most, len(flat))
    best = np.argpartition(flat, count - 1)[:count] if count else np.empty(0, np.int64)
    best = best[np.argsort(flat[best], kind="stable")]
    chosen = np.empty((0, 3))
    for index in best:
        place, heading = divmod(int(index), len(headings))
        pose = np.array([*places[place], headings[heading]])
        turned = np.abs(wrapped(chosen[:, 2] - pose[2]))
        near = np.hypot(chosen[:, 0] - pose[0], chosen[:, 1] - pose[1]) < SAME_PLACE_M
        if not (near & (turned < SAME_HEADING_RAD)).any():
            chosen = np.vstack((chosen, pose))
            if len(chosen) == most:
                break
    return chosen
