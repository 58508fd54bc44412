"""Figures 2 and 3 of [Mice], and its claim: how much redundant mice reduce the velocity's error."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from linkpose.filters.mice import MiceFilter, MiceParameters
from linkpose.sensors.measurements import Floats
from linkpose.simulation.mice import PAPER_ERRORS, PAPER_NOISE_M_S, PAPER_SIDE_M, MiceRun, ring

QUANTITIES = ("vx", "vy", "wz")
COUNTS_PER_M = 1e6  # the paper's mice give velocities, not counts: fine enough that rounding is negligible
RADIUS_M = PAPER_SIDE_M / math.sqrt(3)
DURATION_S = 20.0


@dataclass(frozen=True, slots=True)
class Redundancy:
    """The noise of one quantity with several mice and with one: standard deviations in m/s or rad/s."""

    quantity: str
    mice: int
    single_std: float
    fused_std: float
    theory_ratio: float

    @property
    def ratio(self) -> float:
        """Noise of the velocity from all mice, divided by the noise from one mouse."""
        return self.fused_std / self.single_std


@dataclass(frozen=True, slots=True)
class PaperRun:
    """The paper's case with one seed.

    Each mouse alone gives (v_ix, v_iy, w_i); w_i of equation (17) is the turn rate that its velocity
    across p_i implies.
    """

    time_s: Floats  # (N,)
    single: Floats  # (N, mice, 3) of each mouse alone: m/s, m/s, rad/s
    fused: Floats  # (N, 3) of the filter
    truth: Floats  # (3,)


def paper_run(mice: int, seed: int) -> PaperRun:
    """The robot of the paper's chapter 4 at (1, 1) cm/s, each mouse with an error within ±0.25 cm/s."""
    placed = ring(mice, RADIUS_M, COUNTS_PER_M)
    run = MiceRun(seed, DURATION_S, mice=placed, path="paper", errors="none", mouse_errors=PAPER_ERRORS)
    measurements = run.measurements()
    parameters = MiceParameters(scatter=0.0, floor=0.0, mismatch=0.0, noise_m_s=PAPER_NOISE_M_S / math.sqrt(3))
    fused = MiceFilter(run.rig, parameters).process(measurements)[1:, :3]
    velocity = measurements.mice_counts[1:] / COUNTS_PER_M * run.rate_hz
    place = np.array([(mouse.x_m, mouse.y_m) for mouse in run.mice]) / RADIUS_M**2
    rate = place[:, 0] * velocity[..., 1] - place[:, 1] * velocity[..., 0]
    truth = run.at(measurements.time_s[:1])
    return PaperRun(
        measurements.time_s[1:],
        np.concatenate([velocity, rate[..., None]], axis=2),
        fused,
        np.array([truth.vx_m_s[0], truth.vy_m_s[0], truth.wz_rad_s[0]]),
    )


def redundancy(mice: int, seeds: int) -> list[Redundancy]:
    """Noise of v_x, v_y, ω with `mice` on a ring and with each of them alone, over seeds 0 … seeds − 1.

    The theoretical ratio follows from equation (12): the square roots of the diagonal of (AᵀA)⁻¹ over those of one
    mouse alone.
    """
    runs = [paper_run(mice, seed) for seed in range(seeds)]
    # Equation (17) assumes that the robot's centre is at rest. Here it moves steadily: the mean removes that part.
    single = np.concatenate([run.single - run.single.mean(axis=0) for run in runs])
    fused = np.concatenate([run.fused - run.truth for run in runs])
    theory = _theory(mice)
    return [
        Redundancy(name, mice, float(single[..., j].std()), float(fused[:, j].std()), theory[j])
        for j, name in enumerate(QUANTITIES)
    ]


def _theory(mice: int) -> list[float]:
    """σ(ẋ) over the σ of one mouse (1, 1 and 1/d), for mice of equal noise."""
    rows = [row for m in ring(mice, RADIUS_M) for row in ((1.0, 0.0, -m.y_m), (0.0, 1.0, m.x_m))]
    a = np.array(rows)
    fused = np.sqrt(np.diag(np.linalg.inv(a.T @ a)))
    return [float(value) for value in fused / np.array([1.0, 1.0, 1.0 / RADIUS_M])]
