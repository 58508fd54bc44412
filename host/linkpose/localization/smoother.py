"""Smooths a filter's whole path afterwards: the Rauch-Tung-Striebel pass over its predictions and corrections.

Source: Rauch, Tung and Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA Journal 3 (1965),
pages 1445-1450, with the motion's Jacobian at the filtered state, for either filter.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from linkpose.localization import models
from linkpose.localization.kalman import KalmanFilter
from linkpose.localization.linalg import Floats, wrap_angle


@dataclass(slots=True)
class _Step:
    """One prediction and its correction. `slopes` is F, ∂prediction/∂state before."""

    slopes: Floats
    predicted: Floats
    predicted_covariance: Floats
    state: Floats
    covariance: Floats
    is_new_start: bool = False  # the pose was found again here, so that it carries no information on the steps before


@dataclass(slots=True)
class FilterPass:
    """What the backward pass needs of a filter."""

    steps: list[_Step] = field(default_factory=list)

    def predict(self, run: KalmanFilter, interval_s: float, control: Floats, hold_s: Floats) -> None:
        """Moves the filter on, and keeps the prediction."""
        n = len(run.state)
        slopes = np.eye(n)
        if interval_s > 0.0:
            slopes = np.zeros((n, n))
            by_noise = np.zeros((n, len(run.noise_root)))
            models.motion_jacobians(run.motion.model, run.state, control, interval_s, slopes, by_noise)
            if run.drifts is not None:
                slopes *= np.exp(-run.drifts[:, :1] * interval_s)
            run.step(interval_s, control, hold_s)
        state, covariance = run.state.copy(), run.covariance.copy()
        self.steps.append(_Step(slopes, state, covariance, state, covariance))

    def correct(self, run: KalmanFilter, known: bool, relocated: bool = False) -> None:
        """Keeps the filter after a correction; a pose that is not known yet is kept as NaN."""
        step = self.steps[-1]
        step.is_new_start = relocated
        step.state, step.covariance = run.state.copy(), run.covariance.copy()
        if not known:
            step.state[:] = np.nan

    def smooth(self, is_angle: NDArray[np.bool_]) -> list[tuple[Floats, Floats]]:
        """State and covariance after each step, given all measurements."""
        out = [(step.state, step.covariance) for step in self.steps]
        for i in range(len(self.steps) - 2, -1, -1):
            now, after = self.steps[i], self.steps[i + 1]
            if after.is_new_start or np.isnan(now.state).any() or np.isnan(out[i + 1][0]).any():
                continue
            later, later_covariance = out[i + 1]
            gain = np.linalg.lstsq(after.predicted_covariance, after.slopes @ now.covariance, rcond=1e-12)[0].T
            shift = later - after.predicted
            shift[is_angle] = [wrap_angle(float(value)) for value in shift[is_angle]]
            covariance = now.covariance + gain @ (later_covariance - after.predicted_covariance) @ gain.T
            if (np.diagonal(covariance) < 0.0).any():  # rounding, where the next step adds next to nothing
                covariance = now.covariance
            state = now.state + gain @ shift
            state[is_angle] = [wrap_angle(float(value)) for value in state[is_angle]]
            out[i] = state, 0.5 * (covariance + covariance.T)
        return out
