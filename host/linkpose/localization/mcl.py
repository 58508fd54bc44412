"""Monte-Carlo localization, the peer that the Kalman filters are compared with: `--filter mcl`.

Models as published: `sample_motion_model_odometry` and `likelihood_field_range_finder_model` of Thrun, Burgard and Fox,
Probabilistic Robotics, MIT Press 2005, Tables 5.6 and 6.3 (`likelihood_field_prob` in ROS's AMCL), low-variance
resampling from Table 4.4, with AMCL's default parameters. All draws come from one seeded generator: the
same seed gives the same path.
"""

from __future__ import annotations

import math

import numpy as np

from linkpose.compiling import compiled
from linkpose.errors import MissingStart
from linkpose.localization import models
from linkpose.localization.distance_field import DistanceField, Field, distance_at
from linkpose.localization.events import Event, Log, Scan
from linkpose.localization.grid import GridMap
from linkpose.localization.linalg import Floats, wrap_angle
from linkpose.localization.scan_matching import beams_of
from linkpose.localization.settings import Settings
from linkpose.localization.track import Track
from linkpose.localization.vehicle import first_pose
from linkpose.rotations import wrapped

# AMCL's defaults: odom_alpha1..4, laser_z_hit, laser_z_rand, laser_sigma_hit, laser_likelihood_max_dist,
# laser_max_beams, update_min_d, update_min_a.
ALPHA = (0.2, 0.2, 0.2, 0.2)
Z_HIT, Z_RAND, SIGMA_HIT_M, LONGEST_DISTANCE_M = 0.95, 0.05, 0.2, 2.0
BEAMS = 30
UPDATE_M, UPDATE_RAD = 0.2, math.pi / 6


def localize_mcl(log: Log, settings: Settings, grid: GridMap) -> Track:
    """Runs a particle filter over the odometry and the scans of a log. Raises MissingStart."""
    prior = first_pose(log)
    start = settings.start or (prior.values if prior else None)
    if start is None:
        raise MissingStart
    rng = np.random.default_rng(settings.seed)
    spread = (settings.start_std[0], settings.start_std[0], settings.start_std[1])
    particles = np.asarray(start, dtype=np.float64) + rng.normal(0.0, spread, (settings.particles, 3))
    weights = np.full(settings.particles, 1.0 / settings.particles)
    field = DistanceField.of(grid)
    # The published model has the distance to the nearest wall on either side of it; `weigh` takes that in a drawn wall
    # for 0.
    counts = field.counts if field.is_drawn else np.abs(field.counts)
    odometry, updated, seen = np.zeros(3), np.zeros(3), False
    control, now = np.zeros(2), log[0].time_s
    rows: list[tuple[float, Floats, Floats]] = []
    applied = 0
    for event in log:
        moved = np.empty(3)
        models.propagate(models.UNICYCLE, odometry, control, np.zeros(2), event.time_s - now, moved)
        odometry, now = moved, event.time_s
        if isinstance(event, Scan):
            step = _between(updated, odometry)
            if not seen or step[1] > UPDATE_M or abs(step[0] + step[2]) > UPDATE_RAD:
                _move(particles, step, rng)
                updated, seen = odometry.copy(), True
                points = beams_of(event)
                points = np.ascontiguousarray(points[:: max(1, math.ceil(len(points) / BEAMS))])
                weigh(counts, field.geometry, points, particles, weights)
                applied += len(points)
                mean, covariance = _moments(particles, weights)
                particles = particles[_low_variance(weights, rng.random())]
                weights[:] = 1.0 / len(weights)
        elif isinstance(event, Event) and event.kind == "odometry":
            control = np.array(event.values)
        if not seen:
            mean, covariance = _moments(particles, weights)
        state = _compose(mean, updated, odometry)
        if rows and rows[-1][0] == now:
            rows.pop()
        rows.append((now, state, covariance))
    return Track(
        ("x_m", "y_m", "heading_rad"),
        np.array([row[0] for row in rows]),
        np.array([row[1] for row in rows]),
        np.array([row[2] for row in rows]),
        applied,
        0,
        frozenset(),
        0,
    )


def _between(before: Floats, after: Floats) -> tuple[float, float, float]:
    """First turn, way and second turn (rad, m, rad) of the odometry, Table 5.6."""
    dx, dy = float(after[0] - before[0]), float(after[1] - before[1])
    way = math.hypot(dx, dy)
    first = wrap_angle(math.atan2(dy, dx) - float(before[2])) if way > 0.01 else 0.0
    return first, way, wrap_angle(float(after[2] - before[2]) - first)


def _move(particles: Floats, step: tuple[float, float, float], rng: np.random.Generator) -> None:
    """sample_motion_model_odometry; a robot that drives backwards does not turn twice by 180 degrees, as in AMCL."""
    first, way, second = step
    a1, a2, a3, a4 = ALPHA
    near_first = min(abs(first), abs(wrap_angle(first - math.pi)))
    near_second = min(abs(second), abs(wrap_angle(second - math.pi)))
    count = len(particles)
    turn1 = first - rng.normal(0.0, 1.0, count) * math.sqrt(a1 * near_first**2 + a2 * way**2)
    moved = way - rng.normal(0.0, 1.0, count) * math.sqrt(a3 * way**2 + a4 * (near_first**2 + near_second**2))
    turn2 = second - rng.normal(0.0, 1.0, count) * math.sqrt(a1 * near_second**2 + a2 * way**2)
    particles[:, 0] += moved * np.cos(particles[:, 2] + turn1)
    particles[:, 1] += moved * np.sin(particles[:, 2] + turn1)
    particles[:, 2] += turn1 + turn2


@compiled
def weigh(counts: Field, geometry: Floats, points: Floats, particles: Floats, weights: Floats) -> None:
    """The product of the beams' likelihoods, Table 6.3, on beam ends (n, 2); weights sum to 1."""
    at = np.empty(3)
    total = 0.0
    for i in range(particles.shape[0]):
        c, s = math.cos(particles[i, 2]), math.sin(particles[i, 2])
        likelihood = 0.0
        for k in range(points.shape[0]):
            px, py = points[k, 0], points[k, 1]
            distance_at(counts, geometry, particles[i, 0] + c * px - s * py, particles[i, 1] + s * px + c * py, at)
            distance = min(max(at[0], 0.0), LONGEST_DISTANCE_M)
            p = Z_HIT * math.exp(-0.5 * (distance / SIGMA_HIT_M) ** 2) + Z_RAND / 80.0
            likelihood += math.log(p)
        weights[i] *= math.exp(likelihood)
        total += weights[i]
    for i in range(weights.shape[0]):
        weights[i] /= total


def _low_variance(weights: Floats, draw: float) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Indices of the resampled particles, Table 4.4."""
    count = len(weights)
    edges = np.cumsum(weights)
    edges[-1] = 1.0
    return np.searchsorted(edges, (draw + np.arange(count)) / count)


def _moments(particles: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Weighted mean (3,) and covariance (3, 3), headings on the circle."""
    heading = math.atan2(float(weights @ np.sin(particles[:, 2])), float(weights @ np.cos(particles[:, 2])))
    mean = np.array([weights @ particles[:, 0], weights @ particles[:, 1], heading])
    off = particles - mean
    off[:, 2] = wrapped(off[:, 2])
    return mean, (off.T * weights) @ off


def _compose(pose: Floats, before: Floats, after: Floats) -> Floats:
    """The pose moved by what the odometry has moved since."""
    turn = float(pose[2] - before[2])
    c, s = math.cos(turn), math.sin(turn)
    dx, dy = after[0] - before[0], after[1] - before[1]
    return np.array([pose[0] + c * dx - s * dy, pose[1] + s * dx + c * dy, wrap_angle(turn + float(after[2]))])
