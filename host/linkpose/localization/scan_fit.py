"""Fits a whole laser scan to a map's distance field: robust Gauss-Newton from a given pose, compiled.

The fitted pose minimises

    Σ c²/(2 σ²) ln(1 + d(p_i)²/c²)  +  ½ (x − x̄)ᵀ P⁻¹ (x − x̄)

where d(p_i) is the distance from the end of beam i to the nearest wall, σ the deviation of a beam's end, and c the
scale of the Cauchy loss (Zhang, "Parameter estimation techniques", Image and Vision Computing 15, 1997, Table 1). The
second term is the prediction of the Kalman filter.
"""

from __future__ import annotations

import math

import numpy as np

from linkpose.compiling import compiled
from linkpose.localization.distance_field import Field, distance_at
from linkpose.localization.linalg import Floats, lower_cholesky, wrap_angle

# The fit ends when a step is smaller than this (m, and rad): a tenth of what a laser scanner resolves.
SMALL_STEP = 1e-4
MOST_STEPS = 20
# Steps longer than this (m) are cut: beyond it the linearised field has nothing to do with the scan.
LONGEST_STEP_M = 0.5
LONGEST_TURN_RAD = 0.2


@compiled
def scan_cost(counts: Field, geometry: Floats, points: Floats, pose: Floats, scale: float) -> float:
    """Σ c² ln(1 + d²/c²) / 2 (m²) of beam ends `points` (n, 2) in the robot's axes, seen from `pose`."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    at = np.empty(3)
    total = 0.0
    for i in range(points.shape[0]):
        px, py = points[i, 0], points[i, 1]
        distance_at(counts, geometry, pose[0] + c * px - s * py, pose[1] + s * px + c * py, at)
        total += math.log1p(at[0] * at[0] / (scale * scale))
    return 0.5 * scale * scale * total


@compiled
def normal_equations(
    counts: Field, geometry: Floats, points: Floats, pose: Floats, scale: float, hessian: Floats, slope: Floats
) -> None:
    """Fills Σ w J Jᵀ (3, 3) and Σ w J d (3,) at `pose`, with the Cauchy weight w = 1 / (1 + d²/c²)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    at, row = np.empty(3), np.empty(3)
    hessian[:] = 0.0
    slope[:] = 0.0
    for i in range(points.shape[0]):
        rx, ry = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1]
        distance_at(counts, geometry, pose[0] + rx, pose[1] + ry, at)
        weight = 1.0 / (1.0 + at[0] * at[0] / (scale * scale))
        row[0], row[1], row[2] = at[1], at[2], at[2] * rx - at[1] * ry
        for j in range(3):
            slope[j] += weight * row[j] * at[0]
            for k in range(3):
                hessian[j, k] += weight * row[j] * row[k]


@compiled
def fit_scan(
    counts: Field,
    geometry: Floats,
    points: Floats,
    scale: float,
    information: float,
    mean: Floats,
    prior: Floats,
    pose: Floats,
    hessian: Floats,
) -> float:
    """Improves `pose` (3,) in place and fills `hessian` (3, 3) with Σ w J Jᵀ there; returns the cost.

    `information` is 1/σ² (1/m²); `mean` (3,) and `prior` (3, 3) are the prediction and its information P⁻¹. The cost is
    the function above.
    """
    slope, step, trial = np.empty(3), np.empty(3), np.empty(3)
    matrix, lower = np.empty((3, 3)), np.empty((3, 3))
    cost = _cost(counts, geometry, points, scale, information, mean, prior, pose)
    damping = 0.0
    for _ in range(MOST_STEPS):
        normal_equations(counts, geometry, points, pose, scale, hessian, slope)
        for j in range(3):
            step[j] = -information * slope[j]
            for k in range(3):
                off = mean[k] - pose[k]
                step[j] += prior[j, k] * (wrap_angle(off) if k == 2 else off)
                matrix[j, k] = information * hessian[j, k] + prior[j, k]
            matrix[j, j] *= 1.0 + damping
        if not lower_cholesky(matrix, lower) or lower[0, 0] == 0.0 or lower[1, 1] == 0.0 or lower[2, 2] == 0.0:
            break
        _solve(lower, step)
        shrink = min(1.0, LONGEST_STEP_M / (math.hypot(step[0], step[1]) + 1e-12))
        shrink = min(shrink, LONGEST_TURN_RAD / (abs(step[2]) + 1e-12))
        for j in range(3):
            trial[j] = pose[j] + shrink * step[j]
        trial_cost = _cost(counts, geometry, points, scale, information, mean, prior, trial)
        if trial_cost > cost:
            damping = 10.0 * damping + 0.1
            if damping > 1e3:
                break
            continue
        damping *= 0.1
        cost = trial_cost
        for j in range(3):
            pose[j] = trial[j]
        if abs(step[0]) + abs(step[1]) + abs(step[2]) < SMALL_STEP:
            break
    pose[2] = wrap_angle(pose[2])
    normal_equations(counts, geometry, points, pose, scale, hessian, slope)
    return cost


@compiled
def _cost(
    counts: Field,
    geometry: Floats,
    points: Floats,
    scale: float,
    information: float,
    mean: Floats,
    prior: Floats,
    pose: Floats,
) -> float:
    off = np.empty(3)
    for k in range(3):
        off[k] = pose[k] - mean[k]
    off[2] = wrap_angle(off[2])
    total = information * scan_cost(counts, geometry, points, pose, scale)
    for j in range(3):
        for k in range(3):
            total += 0.5 * off[j] * prior[j, k] * off[k]
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
