"""Counts of optical mice under a robot, and the rate of its gyro, written without linkpose's simulation.

A leg is (seconds, m/s ahead, rad/s); both velocities change within 0.3 s between two legs. Positions are sums over
1 ms. A mouse accumulates the motion of its place in its own axes and gives the whole counts, every 10 ms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Mouse, Rig

STEP_S, STEPS_PER_SAMPLE = 0.001, 10
TRIANGLE = ((0.12, 0.0), (-0.08, 0.11), (-0.08, -0.11))
COUNTS_PER_M = 8000.0
DEG = np.pi / 180
BIAS_DEG_S, WHITE_DEG_S = 0.4, 0.07

LEGS = (
    (2.0, 0.0, 0.0), (2.5, 0.4, 0.0), (2.0, 0.3, 0.9), (2.5, 0.5, 0.0), (1.5, 0.0, -1.5), (3.0, 0.3, 0.0),
    (1.5, 0.0, 0.0), (3.0, 0.5, -0.5), (2.5, 0.25, 0.0), (2.0, 0.2, 1.0), (3.0, 0.45, 0.0), (2.0, 0.0, 1.2),
    (2.5, 0.35, 0.0), (1.5, 0.0, 0.0), (2.5, 0.4, -0.7), (3.5, 0.3, 0.0),
)  # fmt: skip


def drawn_legs(seed: int) -> tuple[tuple[float, float, float], ...]:
    """Legs for 60 s: rests, straights, arcs and turns on the spot, from a rest of 2 s on."""
    rng = np.random.default_rng([seed, 78])
    legs = [(2.0, 0.0, 0.0)]
    while sum(seconds for seconds, _, _ in legs) < 62.0:
        kind, seconds = rng.random(), rng.uniform(1.5, 3.5)
        speed = rng.uniform(0.2, 0.5) if 0.15 < kind < 0.9 else 0.0
        turn_rate = rng.choice([-1, 1]) * rng.uniform(0.3, 1.5) if kind > 0.5 else 0.0
        legs.append((seconds, speed, turn_rate))
    return tuple(legs)


@dataclass(frozen=True)
class Robot:
    """Speed ahead (m/s) and turn rate (rad/s) each millisecond; pose (N, 3) at the samples: x, y (m), heading (rad)."""

    speed: np.ndarray
    turn_rate: np.ndarray
    time_s: np.ndarray
    pose: np.ndarray
    seed: int


def robot(seed: int = 0, legs: tuple[tuple[float, float, float], ...] = LEGS) -> Robot:
    window = np.ones(300) / 300
    speed, turn_rate = (
        np.convolve(np.concatenate([np.full(int(leg[0] / STEP_S), leg[k]) for leg in legs]), window)[:-299]
        for k in (1, 2)
    )
    heading = np.cumsum(turn_rate) * STEP_S
    x, y = (np.cumsum(speed * f(heading)) * STEP_S for f in (np.cos, np.sin))
    at = slice(None, None, STEPS_PER_SAMPLE)
    return Robot(speed, turn_rate, np.arange(len(speed))[at] * STEP_S, np.column_stack([x, y, heading])[at], seed)


def gyro(run: Robot) -> np.ndarray:
    """Rate (rad/s) at the samples, with the noise of a real MPU-6050."""
    noise = np.random.default_rng([run.seed, 1]).standard_normal(len(run.time_s))
    return run.turn_rate[::STEPS_PER_SAMPLE] + DEG * (BIAS_DEG_S + WHITE_DEG_S * noise)


def counts(
    run: Robot,
    places: tuple[tuple[float, float], ...] = TRIANGLE,
    counts_per_m: float = COUNTS_PER_M,
    seen: np.ndarray | None = None,
    limit: int | None = None,
) -> np.ndarray:
    """(N, M, 2): each mouse sees the share `seen` (steps, M) of its motion; `limit` cuts the counts of a sample off."""
    rng = np.random.default_rng([run.seed, 2])
    out = np.zeros((len(run.time_s), len(places), 2))
    for i, (x, y) in enumerate(places):
        motion = (run.speed - run.turn_rate * y) + 1j * run.turn_rate * x
        motion = motion + 0.003 * np.abs(motion) * (rng.standard_normal((len(motion), 2)) @ [1, 1j])
        if seen is not None:
            motion = motion * seen[:, i]
        way = np.cumsum(motion) * STEP_S * counts_per_m
        whole = np.floor(np.column_stack([way.real, way.imag]) + rng.uniform(0, 1, 2))[::STEPS_PER_SAMPLE]
        out[1:, i] = np.diff(whole, axis=0)
    return out if limit is None else np.clip(out, -limit, limit)


def rig(places: tuple[tuple[float, float], ...] = TRIANGLE, counts_per_m: float = COUNTS_PER_M) -> Rig:
    return Rig(mouse=tuple(Mouse(x, y, 0.0, counts_per_m) for x, y in places))


def forces(run: Robot, tilt_deg: float, offset_m_s2: float, place_m: float, turned_deg: float) -> np.ndarray:
    """(N, 2): an accelerometer on a tilted floor, `place_m` ahead of the centre, turned about the vertical."""
    rng = np.random.default_rng([run.seed, 3])
    force = np.gradient(run.speed, STEP_S) + 1j * run.turn_rate * run.speed
    force += place_m * (1j * np.gradient(run.turn_rate, STEP_S) - run.turn_rate**2)
    force = np.convolve(force, np.ones(10) / 10)[: len(force) : STEPS_PER_SAMPLE]  # the sensor's low-pass filter
    down, offset = np.exp(1j * rng.uniform(0, 6, 2))
    force += 9.81 * np.sin(tilt_deg * DEG) * down * np.exp(-1j * run.pose[:, 2]) + offset_m_s2 * offset
    vibration = 0.04 + 0.2 * (np.abs(run.speed[::STEPS_PER_SAMPLE]) > 0.01)
    force += vibration * (rng.standard_normal((len(force), 2)) @ [1, 1j])
    force *= np.exp(1j * turned_deg * DEG)
    return np.column_stack([force.real, force.imag])


def measurements(
    run: Robot, mice_counts: np.ndarray, rate_rad_s: np.ndarray, force: np.ndarray | None = None
) -> Measurements:
    """Without `force` (N, 2; m/s²) the accelerometer repeats one value."""
    zero = np.zeros(len(run.time_s))
    level = np.zeros((len(run.time_s), 2)) if force is None else force
    specific_force = np.column_stack([level, zero + 9.81])
    block = Measurements.from_imu(run.time_s, specific_force, np.column_stack([zero, zero, rate_rad_s]))
    return replace(block, mice_counts=mice_counts)
