"""The Kalman filter of a tag without odometry: a sum of Gaussians while its position is not known well."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from linkpose.errors import NotPositiveDefinite
from linkpose.localization import models
from linkpose.localization.gaussian_sum import (
    MOST,
    OUTLIERS,
    Mixture,
    RangeRow,
    collapse,
    correct_sum,
    expected,
    is_bent,
    predict_sum,
    single,
)
from linkpose.localization.kalman import Bools, KalmanFilter, Measurement
from linkpose.localization.linalg import Floats, keep_positive_definite
from linkpose.localization.steps import Prediction
from linkpose.localization.tables import Beacons


def outlier_density(beacons: Beacons) -> float:
    """Density (1/m) of ranges that are outliers: as far off as half of the beacons' largest distance."""
    places = np.array(list(beacons.values()))
    extent = float(np.linalg.norm(np.ptp(places, axis=0))) if len(places) > 1 else 0.0
    return OUTLIERS / max(0.5 * extent, 1.0)


@dataclass(slots=True)
class GaussianSumFilter(KalmanFilter):
    """`state` and `covariance` are those of the whole sum. Outliers have this `outliers` density (1/m)."""

    outliers: float = 0.0
    mixture: Mixture | None = field(init=False, default=None)

    def step(self, interval_s: float, control: Floats, hold_s: Floats, measurement: Measurement | None = None) -> Bools:
        """As `KalmanFilter.step`. Ranges with correlated errors are corrected by one Gaussian."""
        if interval_s > 0.0:
            self._predict(interval_s, control, hold_s)
        rows = self._rows(measurement)
        if self.mixture is None:
            if not any(is_bent(self.state, self.covariance, row) for row in rows):
                return KalmanFilter.step(self, 0.0, control, hold_s, measurement)
            self.mixture = single(self.state, self.covariance)
        elif not rows:
            if measurement is not None:
                self.mixture = None  # the sum goes on as one Gaussian, for which other sensors are linear
            return KalmanFilter.step(self, 0.0, control, hold_s, measurement)
        sound = np.empty(len(rows))
        self.d2 = np.empty(len(rows))
        for i, row in enumerate(rows):
            innovation, variance = expected(self.mixture, row)
            self.d2[i] = innovation**2 / variance
            self.mixture, _, sound[i] = correct_sum(self.mixture, row, MOST)
        self._collapse()
        return np.asarray(sound > 0.5)

    def place(self, at: np.ndarray, values: Floats, covariance: Floats) -> None:
        """As `KalmanFilter.place`; one Gaussian is left."""
        self.mixture = None
        KalmanFilter.place(self, at, values, covariance)

    def widen(self, factor: float) -> None:
        """As `KalmanFilter.widen`; one Gaussian is left."""
        self.mixture = None
        KalmanFilter.widen(self, factor)

    def _predict(self, interval_s: float, control: Floats, hold_s: Floats) -> None:
        if self.mixture is None:
            KalmanFilter.step(self, interval_s, control, hold_s)
            return
        root = self.noise_root * np.sqrt(hold_s / interval_s)[:, np.newaxis]
        drifts = np.zeros((len(self.state), 2)) if self.drifts is None else self.drifts
        prediction = Prediction(self.motion.model, control, root, interval_s)
        self.mixture = predict_sum(self.mixture, prediction, drifts)
        self._collapse()

    def _collapse(self) -> None:
        """State and covariance of the sum. One Gaussian that is left goes on as the filter by name."""
        if self.mixture is None:
            return
        collapse(self.mixture, self.state, self.covariance)
        if not np.isfinite(self.covariance).all() or not keep_positive_definite(self.covariance):
            raise NotPositiveDefinite("covariance", f"the filter {self.name}")
        if len(self.mixture.weights) == 1:
            self.mixture = None

    def _rows(self, measurement: Measurement | None) -> list[RangeRow]:
        """The ranges of a measurement; none where their errors are correlated or the sensor is another."""
        if measurement is None or measurement.model != models.BEACON_RANGE:
            return []
        variances = np.diag(measurement.covariance)
        if np.count_nonzero(measurement.covariance) > len(variances):
            return []
        outliers = self.outliers if self.gate is not None else 0.0
        return [
            RangeRow(float(value), float(variance), parameters, outliers)
            for value, variance, parameters in zip(
                measurement.values, variances, np.asarray(measurement.parameters, dtype=np.float64), strict=True
            )
        ]
