"""States that drift: first-order Gauss-Markov processes beside the motion, such as the error of one beacon's ranges.

Source: Gelb, Applied Optimal Estimation, MIT Press 1974, section 3.8, "exponentially correlated random variable".
"""

from __future__ import annotations

import math

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats
from linkpose.localization.steps import Gaussian


@compiled
def drift(estimate: Gaussian, interval_s: float, drifts: Floats) -> None:
    """Moves the states with a rate above 0 on by `interval_s`, in place: x ← φ x, P ← Φ P Φ + σ² (1 − φ²), where
    φ = exp(−rate · interval). `drifts` (n, 2) holds each state's rate (1/s) and variance σ² in the long run.
    """
    mean, covariance = estimate
    n = mean.shape[0]
    for i in range(n):
        if drifts[i, 0] > 0.0:
            factor = math.exp(-drifts[i, 0] * interval_s)
            mean[i] *= factor
            for j in range(n):
                covariance[i, j] *= factor
                covariance[j, i] *= factor
            covariance[i, i] += drifts[i, 1] * (1.0 - factor * factor)
