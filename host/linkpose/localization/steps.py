"""The arguments of the compiled steps, shared by the extended and the unscented filter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.localization.linalg import Floats


class Gaussian(NamedTuple):
    """A state estimate, which the steps change in place: mean (n,) and covariance (n, n)."""

    mean: Floats
    covariance: Floats


class Prediction(NamedTuple):
    """How the state moves before a measurement.

    `model` is the motion model's number, `control` (c,) its input, `noise_root` (q, q) the lower Cholesky factor of Q,
    and `interval_s` the time; 0 leaves the state where it is.
    """

    model: int
    control: Floats
    noise_root: Floats
    interval_s: float


class Correction(NamedTuple):
    """A measurement to correct with.

    `model` is the measurement model's number, `values` (m,) with covariance R (m, m); m = 0 is no measurement.
    `parameters` is the model's table. `is_angle` (n + m,) marks the states and the rows of the measurement that are
    angles. `d2` (one element for each block of equal size) receives νᵀ S⁻¹ ν; the step leaves out a block above
    `threshold`.
    """

    model: int
    values: Floats
    covariance: Floats
    parameters: Floats
    is_angle: NDArray[np.bool_]
    threshold: float
    d2: Floats
