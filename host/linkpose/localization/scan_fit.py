"""Fits a whole laser scan to a map's distance field: robust Gauss-Newton from a given pose, compiled.

The fitted pose minimises

    Σ c²/(2 σ²) ln(1 + w_i d_i²/c²)  +  ½ (x − x̄)ᵀ P⁻¹ (x − x̄)

where d_i is the distance from the end of beam i to the wall that it sees, σ²/w_i the variance of that distance, and c
the scale of the Cauchy loss (Zhang, "Parameter estimation techniques", Image and Vision Computing 15, 1997, Table 1).
The second term is the prediction of the Kalman filter.

A scan is an array (n, 5) of beams: end x, y in the robot's axes (m), direction x, y in them, and range (m).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from linkpose.compiling import compiled
from linkpose.localization.distance_field import Cells, Field, distance_at, seen_distance
from linkpose.localization.linalg import Floats, lower_cholesky, wrap_angle

# The fit ends when a step is smaller than this (m, and rad): a tenth of what a laser scanner resolves.
SMALL_STEP = 1e-4
MOST_STEPS = 20
# Steps longer than this (m) are cut: beyond it the linearised field has nothing to do with the scan.
LONGEST_STEP_M = 0.5
LONGEST_TURN_RAD = 0.2
# A wall nearer to the laser than this (m) is not one that a beam has crossed: the pose is wrong by as much.
CLEAR_M = 0.3


class Walls(NamedTuple):
    """A map's distance field and the cells around each that are clear of negative ones, how far (m) a beam may end
    behind the face that it sees, and the distance (m) below which a point is in a wall.
    """

    counts: Field
    clear: Cells
    geometry: Floats
    reach: float
    inside: float


class Weighted(NamedTuple):
    """A scan (n, 5), the weights w (n,) of its beams, 1/σ² (1/m²), and the scale c (m) of the loss."""

    beams: Floats
    weights: Floats
    information: float
    scale: float


class Prior(NamedTuple):
    """The prediction: x, y, θ (3,) and its information P⁻¹ (3, 3)."""

    mean: Floats
    information: Floats


@compiled
def beam_weights(walls: Walls, beams: Floats, pose: Floats, growth: float, std: float, weights: Floats) -> None:
    """Fills w_i = σ² / (σ² + (k r_i cos β_i)²) for ranges r_i whose deviation grows by k (m/m); σ is `std` (m).

    β_i is the angle between the beam and the normal of its wall, seen from `pose`: an error along a beam that grazes a
    wall moves its end along the wall.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    at = np.empty(3)
    for i in range(beams.shape[0]):
        rx, ry = c * beams[i, 0] - s * beams[i, 1], s * beams[i, 0] + c * beams[i, 1]
        ux, uy = c * beams[i, 2] - s * beams[i, 3], s * beams[i, 2] + c * beams[i, 3]
        seen_distance(walls.counts, walls.clear, walls.geometry, pose[0] + rx, pose[1] + ry, ux, uy, walls.reach, at)
        across = growth * beams[i, 4] * (at[1] * ux + at[2] * uy) / std
        weights[i] = 1.0 / (1.0 + across * across)


@compiled
def drop_short(walls: Walls, beams: Floats, pose: Floats, beside: float, weights: Floats) -> None:
    """Sets the weights of beams to 0 that end in free space.

    Such a beam ends farther than `beside` (m) from all walls and has crossed none: a person, a new piece of furniture
    or dust is before the wall. Where it ends does not depend on the pose.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    cell = walls.geometry[0]
    at = np.empty(3)
    for i in range(beams.shape[0]):
        ux, uy = c * beams[i, 2] - s * beams[i, 3], s * beams[i, 2] + c * beams[i, 3]
        x = pose[0] + c * beams[i, 0] - s * beams[i, 1]
        y = pose[1] + s * beams[i, 0] + c * beams[i, 1]
        seen_distance(walls.counts, walls.clear, walls.geometry, x, y, ux, uy, walls.reach, at)
        if abs(at[0]) <= beside:
            continue
        left, crosses = beams[i, 4] - CLEAR_M, False  # m of the beam before its end
        while left > beside and not crosses:
            distance_at(walls.counts, walls.geometry, x - left * ux, y - left * uy, at)
            crosses = at[0] < walls.inside
            left -= max(at[0] - cell, 0.5 * cell)
        if not crosses:
            weights[i] = 0.0


@compiled
def bounded_cost(walls: Walls, scan: Weighted, prior: Prior, pose: Floats) -> float:
    """Both sums above, but a beam costs c²/(2 σ²) w d² / (c² + w d²), the loss of Geman and McClure (the same table).

    A beam that ends far from all walls then costs the same at each pose. With the Cauchy loss, many of them together
    prefer a pose that is nearer to them by decimetres.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    beams, scale2 = scan.beams, scan.scale * scan.scale
    at = np.empty(3)
    total = 0.0
    for i in range(beams.shape[0]):
        rx, ry = c * beams[i, 0] - s * beams[i, 1], s * beams[i, 0] + c * beams[i, 1]
        ux, uy = c * beams[i, 2] - s * beams[i, 3], s * beams[i, 2] + c * beams[i, 3]
        seen_distance(walls.counts, walls.clear, walls.geometry, pose[0] + rx, pose[1] + ry, ux, uy, walls.reach, at)
        square = scan.weights[i] * at[0] * at[0]
        total += square / (scale2 + square)
    return 0.5 * scan.information * scale2 * total + _prior_cost(prior, pose)


@compiled
def normal_equations(walls: Walls, scan: Weighted, pose: Floats, hessians: Floats, slope: Floats) -> float:
    """Fills Σ v w J Jᵀ and Σ v J Jᵀ (2, 3, 3), and Σ v w J d (3,), at `pose`, with the Cauchy weight v = 1 / (1 + w
    d²/c²). Returns the first sum above.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    beams, scale2 = scan.beams, scan.scale * scan.scale
    at, row = np.empty(3), np.empty(3)
    hessians[:] = 0.0
    slope[:] = 0.0
    total = 0.0
    for i in range(beams.shape[0]):
        rx, ry = c * beams[i, 0] - s * beams[i, 1], s * beams[i, 0] + c * beams[i, 1]
        ux, uy = c * beams[i, 2] - s * beams[i, 3], s * beams[i, 2] + c * beams[i, 3]
        seen_distance(walls.counts, walls.clear, walls.geometry, pose[0] + rx, pose[1] + ry, ux, uy, walls.reach, at)
        weight = scan.weights[i]
        square = weight * at[0] * at[0]
        robust = 1.0 / (1.0 + square / scale2)
        total += math.log1p(square / scale2)
        row[0], row[1], row[2] = at[1], at[2], at[2] * rx - at[1] * ry
        for j in range(3):
            slope[j] += robust * weight * row[j] * at[0]
            for k in range(j + 1):
                hessians[0, j, k] += robust * weight * row[j] * row[k]
                hessians[1, j, k] += robust * row[j] * row[k]
    for j in range(3):
        for k in range(j):
            hessians[0, k, j], hessians[1, k, j] = hessians[0, j, k], hessians[1, j, k]
    return 0.5 * scan.information * scale2 * total


@compiled
def range_equations(walls: Walls, scan: Weighted, pose: Floats, hessian: Floats, slope: Floats) -> None:
    """Fills Σ v w K Kᵀ (5, 5) and Σ v w K d (5,) at `pose`, where K has the slopes by the pose, by a share of which the
    ranges are too short, and by a length (m).
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    beams, scale2 = scan.beams, scan.scale * scan.scale
    at, row = np.empty(3), np.empty(5)
    hessian[:] = 0.0
    slope[:] = 0.0
    for i in range(beams.shape[0]):
        rx, ry = c * beams[i, 0] - s * beams[i, 1], s * beams[i, 0] + c * beams[i, 1]
        ux, uy = c * beams[i, 2] - s * beams[i, 3], s * beams[i, 2] + c * beams[i, 3]
        seen_distance(walls.counts, walls.clear, walls.geometry, pose[0] + rx, pose[1] + ry, ux, uy, walls.reach, at)
        weight = scan.weights[i] / (1.0 + scan.weights[i] * at[0] * at[0] / scale2)
        row[0], row[1], row[2] = at[1], at[2], at[2] * rx - at[1] * ry
        row[4] = at[1] * ux + at[2] * uy
        row[3] = beams[i, 4] * row[4]
        for j in range(5):
            slope[j] += weight * row[j] * at[0]
            for k in range(5):
                hessian[j, k] += weight * row[j] * row[k]


@compiled
def misfit(walls: Walls, scan: Weighted, pose: Floats, lag: int, pull: Floats) -> float:
    """Σ v_i v_j √(w_i w_j) d_i d_j / Σ v_i v_j (m²) over the beams i and j = i − lag, seen from `pose`.

    With a lag of 0, it is the mean square of the distances from the walls that beams hit. With a lag of 1, it is the
    part that neighbouring beams share: the error of the wall that both hit, without the noise of the beams. It may be
    negative.

    Fills `pull` (3,) with Σ ±v J, where the sign turns each wall's normal to the laser: how the walls move the pose
    when all of them are nearer than in the map.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    beams, scale2 = scan.beams, scan.scale * scan.scale
    at = np.empty(3)
    pull[:] = 0.0
    total, weights = 0.0, 1e-12
    distances, robusts = np.empty(beams.shape[0]), np.empty(beams.shape[0])
    for i in range(beams.shape[0]):
        rx, ry = c * beams[i, 0] - s * beams[i, 1], s * beams[i, 0] + c * beams[i, 1]
        ux, uy = c * beams[i, 2] - s * beams[i, 3], s * beams[i, 2] + c * beams[i, 3]
        seen_distance(walls.counts, walls.clear, walls.geometry, pose[0] + rx, pose[1] + ry, ux, uy, walls.reach, at)
        square = scan.weights[i] * at[0] * at[0]
        robust = 1.0 / (1.0 + square / scale2)
        facing = robust if at[1] * ux + at[2] * uy < 0.0 else -robust
        pull[0] += facing * at[1]
        pull[1] += facing * at[2]
        pull[2] += facing * (at[2] * rx - at[1] * ry)
        distances[i], robusts[i] = math.sqrt(scan.weights[i]) * at[0], robust
        if i >= lag:
            total += robust * robusts[i - lag] * distances[i] * distances[i - lag]
            weights += robust * robusts[i - lag]
    return total / weights


@compiled
def fit_scan(walls: Walls, scan: Weighted, prior: Prior, pose: Floats, hessians: Floats) -> None:
    """Improves `pose` (3,) in place and fills `hessians` as `normal_equations` does there."""
    slope, step, trial = np.empty(3), np.empty(3), np.empty(3)
    trial_hessians, trial_slope = np.empty((2, 3, 3)), np.empty(3)
    matrix, lower = np.empty((3, 3)), np.empty((3, 3))
    cost = normal_equations(walls, scan, pose, hessians, slope) + _prior_cost(prior, pose)
    damping = 0.0
    for _ in range(MOST_STEPS):
        for j in range(3):
            step[j] = -scan.information * slope[j]
            for k in range(3):
                off = prior.mean[k] - pose[k]
                step[j] += prior.information[j, k] * (wrap_angle(off) if k == 2 else off)
                matrix[j, k] = scan.information * hessians[0, j, k] + prior.information[j, k]
            matrix[j, j] *= 1.0 + damping
        if not lower_cholesky(matrix, lower) or lower[0, 0] == 0.0 or lower[1, 1] == 0.0 or lower[2, 2] == 0.0:
            break
        _solve(lower, step)
        shrink = min(1.0, LONGEST_STEP_M / (math.hypot(step[0], step[1]) + 1e-12))
        shrink = min(shrink, LONGEST_TURN_RAD / (abs(step[2]) + 1e-12))
        for j in range(3):
            trial[j] = pose[j] + shrink * step[j]
        trial_cost = normal_equations(walls, scan, trial, trial_hessians, trial_slope) + _prior_cost(prior, trial)
        if trial_cost > cost:
            damping = 10.0 * damping + 0.1
            if damping > 1e3:
                break
            continue
        damping *= 0.1
        cost = trial_cost
        pose[:], slope[:], hessians[:] = trial, trial_slope, trial_hessians
        if abs(step[0]) + abs(step[1]) + abs(step[2]) < SMALL_STEP:
            break
    pose[2] = wrap_angle(pose[2])


@compiled
def _prior_cost(prior: Prior, pose: Floats) -> float:
    """The second sum above."""
    off = np.empty(3)
    for k in range(3):
        off[k] = pose[k] - prior.mean[k]
    off[2] = wrap_angle(off[2])
    total = 0.0
    for j in range(3):
        for k in range(3):
            total += 0.5 * off[j] * prior.information[j, k] * off[k]
    return total


@compiled
def _solve(lower: Floats, vector: Floats) -> None:
    """vector ← (L Lᵀ)⁻¹ vector, in place."""
    n = vector.shape[0]
    for i in range(n):
        for k in range(i):
            vector[i] -= lower[i, k] * vector[k]
        vector[i] /= lower[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            vector[i] -= lower[k, i] * vector[k]
        vector[i] /= lower[i, i]
