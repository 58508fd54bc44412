"""One extended and one unscented Kalman filter over a motion model and measurement models."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import LinkposeError, NotPositiveDefinite
from linkpose.localization import models
from linkpose.localization.drift import drift
from linkpose.localization.ekf import ekf_step
from linkpose.localization.gate import chi_square_quantile
from linkpose.localization.grid import GridMap, no_map
from linkpose.localization.linalg import Floats, lower_cholesky
from linkpose.localization.steps import Correction, Gaussian, Prediction
from linkpose.localization.ukf import Transform, ukf_step

FilterName = Literal["ekf", "ukf"]
Bools = NDArray[np.bool_]
# Standard deviations beyond which a linearised filter gains nothing from being wider.
WIDEST = {"x_m": 50.0, "y_m": 50.0, "heading_rad": 1.0}


@dataclass(frozen=True, slots=True)
class MotionModel:
    """A motion model's form: its number, its states with their units in the name, and how many controls and noises it
    takes.
    """

    model: int
    states: tuple[str, ...]
    controls: int
    noises: int

    @property
    def is_angle(self) -> Bools:
        """Which states live on the circle: the headings."""
        return np.array([name.startswith("heading") for name in self.states])

    def extended(self, constants: tuple[str, ...]) -> MotionModel:
        """With constants to estimate after its own states."""
        return MotionModel(self.model, self.states + constants, self.controls, self.noises)


UNICYCLE = MotionModel(models.UNICYCLE, ("x_m", "y_m", "heading_rad"), 2, 2)
CONSTANT_VELOCITY = MotionModel(models.CONSTANT_VELOCITY, ("x_m", "y_m", "x_rate_m_s", "y_rate_m_s"), 1, 4)
HOLONOMIC = MotionModel(models.HOLONOMIC, ("x_m", "y_m", "heading_rad"), 3, 3)
SUBMERSIBLE = MotionModel(models.SUBMERSIBLE, ("x_m", "y_m", "z_m", "heading_rad", "wz_rad_s"), 5, 4)
SUBMERSIBLE_IN_CURRENT = MotionModel(
    models.SUBMERSIBLE_IN_CURRENT, (*SUBMERSIBLE.states, "x_current_m_s", "y_current_m_s"), 5, 4
)


@dataclass(frozen=True, slots=True)
class Measurement:
    """What a sensor read at one instant.

    `values` (m,) with covariance R (m, m); `parameters` is the model's table. The rows belong together in blocks of
    `block`: a block is gated as one, with `block` degrees of freedom. `angles` marks the rows that are angles.
    """

    model: int
    values: Floats
    covariance: Floats
    parameters: Floats
    block: int = 1
    angles: tuple[bool, ...] = ()

    def __post_init__(self) -> None:
        """Raises ValueError for a table of another width: the compiled models do not check their indices."""
        if self.parameters.shape[1] != models.COLUMNS[self.model]:
            raise ValueError(f"model {self.model} takes {models.COLUMNS[self.model]} parameters a row")


@dataclass(slots=True)
class KalmanFilter:
    """A filter under way. `state` (n,) and `covariance` (n, n) are of the instant up to which it was stepped.

    `noise_root` (q, q) is the lower Cholesky factor of Q, the covariance of the motion model's noises over one control
    sample. `gate` is the probability that a good measurement passes; None takes all.
    """

    name: FilterName
    motion: MotionModel
    state: Floats
    covariance: Floats
    noise_root: Floats
    gate: float | None = None
    transform: Transform = field(default_factory=Transform)
    grid: GridMap = field(default_factory=no_map)
    drifts: Floats | None = None  # (n, 2) as in `drift`; None: no state drifts
    d2: Floats = field(init=False, default_factory=lambda: np.empty(0))  # νᵀ S⁻¹ ν of the last step's blocks
    _angle_rows: dict[tuple[tuple[bool, ...], int], Bools] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.state = np.array(self.state, dtype=np.float64)
        self.covariance = np.array(self.covariance, dtype=np.float64)
        if self.name == "ukf":
            self.transform.check()

    def step(self, interval_s: float, control: Floats, hold_s: Floats, measurement: Measurement | None = None) -> Bools:
        """Moves on by `interval_s` under `control` (controls,), then corrects with the measurement. Returns which
        blocks passed the gate.

        `hold_s` (q,) is how long each noise keeps its value: a control sample is one draw of Q, which the parts of its
        interval share. Raises LinkposeError when the covariance has ceased to be positive definite.
        """
        root = self.noise_root
        if interval_s > 0.0:
            root = root * np.sqrt(hold_s / interval_s)[:, np.newaxis]
            if self.drifts is not None:
                drift(Gaussian(self.state, self.covariance), interval_s, self.drifts)
        if measurement is None:
            measurement = _NOTHING
        blocks = len(measurement.values) // measurement.block
        d2 = np.empty(blocks)
        threshold = np.inf if self.gate is None or not blocks else chi_square_quantile(self.gate, measurement.block)
        estimate = Gaussian(self.state, self.covariance)
        prediction = Prediction(self.motion.model, control, root, interval_s)
        correction = Correction(
            measurement.model,
            measurement.values,
            measurement.covariance,
            measurement.parameters,
            self._angles_of(measurement),
            threshold,
            d2,
        )
        # Readings of states are linear: at one instant both filters' corrections are equal, and the extended one also
        # works for a heading whose sigma points spread around the circle.
        is_linear = interval_s == 0.0 and measurement.model == models.DIRECT
        if self.name == "ekf" or is_linear:
            sound = ekf_step(estimate, prediction, correction, self.grid)
        else:
            sound = ukf_step(estimate, prediction, correction, self.grid, self.transform)
        if not sound:
            raise NotPositiveDefinite("covariance", f"the filter {self.name}")
        self.d2 = d2
        return np.asarray(d2 <= threshold)

    def predict_linearised(self, interval_s: float, control: Floats, hold_s: Floats) -> None:
        """Moves on as `step` does, by the model's Jacobians, whatever the filter."""
        name, self.name = self.name, "ekf"
        self.step(interval_s, control, hold_s)
        self.name = name

    def copy(self) -> KalmanFilter:
        """A filter with the same state that goes on by itself."""
        return replace(self)

    @property
    def pose_indices(self) -> NDArray[np.intp]:
        """Where x, y and heading are in the state."""
        return np.array([self.motion.states.index(name) for name in ("x_m", "y_m", "heading_rad")])

    def place(self, at: NDArray[np.intp], values: Floats, covariance: Floats) -> None:
        """Sets the states `at` (p,) to `values` with `covariance` (p, p), uncorrelated with the other states."""
        self.state[at] = values
        self.covariance[at, :] = 0.0
        self.covariance[:, at] = 0.0
        self.covariance[np.ix_(at, at)] = covariance

    def _angles_of(self, measurement: Measurement) -> Bools:
        """Which of the states, and after them of the measurement's rows, are angles."""
        key = measurement.angles, len(measurement.values)
        if key not in self._angle_rows:
            rows = np.resize(measurement.angles, key[1]) if measurement.angles else np.zeros(key[1])
            self._angle_rows[key] = np.concatenate((self.motion.is_angle, rows.astype(np.bool_)))
        return self._angle_rows[key]

    def widen(self, factor: float) -> None:
        """Multiplies the standard deviations of x, y and heading, at most up to WIDEST. The covariance stays positive
        definite.
        """
        std = np.sqrt(np.diag(self.covariance))
        grow = np.ones(len(std))
        for i, name in enumerate(self.motion.states):
            if name in WIDEST:
                grow[i] = max(1.0, min(factor, WIDEST[name] / std[i]))
        self.covariance *= np.outer(grow, grow)


_NOTHING = Measurement(models.DIRECT, np.empty(0), np.empty((0, 0)), np.empty((0, 2)))


def covariance_root(covariance: Floats, name: str) -> Floats:
    """The lower Cholesky factor. Raises LinkposeError naming the matrix when it is not positive definite."""
    root = np.zeros_like(covariance)
    if not lower_cholesky(np.ascontiguousarray(covariance, dtype=np.float64), root):
        raise LinkposeError(
            f"{name} is not positive definite, so it has no Cholesky factor; "
            "lower its correlations or raise its variances"
        )
    return root
