"""Noise of the inertial sensor from a long rest: white noise, bias instability, random walk, and temperature.

The longest rest in the recordings is evaluated (`rests`, `allan`). A recording that is no rest, or too short, is named
as such: a table that vibrates or a sensor that turns slowly would count as noise otherwise.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from linkpose.calibration.allan import NoiseModel, allan_deviation, averaging_counts, fit_noise
from linkpose.calibration.rests import find_rests
from linkpose.errors import LinkposeError
from linkpose.recording.reader import Recording
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Noise, Rig, Vector

# Data sheet of the MPU-6050, 3.1 and 3.2: densities at 10 Hz (rad/s/√Hz, m/s²/√Hz).
DATA_SHEET_GYRO, DATA_SHEET_ACCEL = math.radians(0.005), 400e-6 * STANDARD_GRAVITY
SHORTEST_S = 60.0  # of a rest: its density is known to 4 %; of twice as long a one to 3 %
_LONGEST_GAP_S = 0.5  # without samples, within a rest
_ENOUGH_DENSITY = 0.02  # relative σ of a density that counts as known
_LEAST_RECORD_S = 1800.0  # to ask for, where the bias instability is not reached
# Intervals shorter than this many delays of the low-pass filter contain correlated samples: at 40, by 1 % too little.
_DELAYS = 40.0
_USUAL_DELAY_S = 0.0049  # DLPF 3
# A rest: gravity keeps its direction, slow changes stay below the ones that any working chip has, and no vibration
# exceeds the white noise: standard deviation of a sample over N √rate, which is 1 for white noise and less behind the
# low-pass filter.
_LARGEST_TURN_RAD = math.radians(0.5)
_LARGEST_GYRO_RAD_S, _LARGEST_ACCEL_M_S2 = math.radians(0.2), 0.05  # Allan deviation at 1 s and more
_VIBRATION = 2.0
# Temperature: range below which no coefficient is estimated (°C), and the interval over which readings are averaged.
LEAST_RANGE_DEGC = 1.0
_AVERAGE_S = 10.0


@dataclass(frozen=True, slots=True)
class AxisNoise:
    """One axis of a sensor, in its unit u (rad/s or m/s²)."""

    model: NoiseModel
    sample_std: float  # of one sample, u
    drift: float | None  # change of the bias with temperature, u/°C; None without a change of temperature
    drift_std: float | None
    tau_s: Floats  # (K,)
    deviation: Floats  # (K,) overlapping Allan deviation, u


@dataclass(frozen=True, slots=True)
class NoiseCalibration:
    """Noise by axis, and what the rest was worth."""

    gyro: tuple[AxisNoise, AxisNoise, AxisNoise]
    accel: tuple[AxisNoise, AxisNoise, AxisNoise]
    duration_s: float
    recorded_s: float  # length of the recording that holds the rest
    rate_hz: float
    temperature_range_degC: float | None  # None: the recording has no temperature
    disturbances: tuple[str, ...]  # why this was no rest; empty for a rest

    @property
    def is_rest(self) -> bool:
        """Whether nothing but noise is in the readings."""
        return not self.disturbances

    @property
    def is_long_enough(self) -> bool:
        """Whether densities are known to 2 % and the bias instability of each axis is reached."""
        models = [axis.model for axis in (*self.gyro, *self.accel)]
        return all(m.density_std < _ENOUGH_DENSITY * m.density and not m.instability_is_bound for m in models)

    @property
    def missing_duration_s(self) -> float:
        """Length of a rest that is probably long enough (s)."""
        return max(4 * self.duration_s, _LEAST_RECORD_S)

    @property
    def worse_than_data_sheet(self) -> dict[str, Vector]:
        """Densities over the data sheet's (by axis), for each sensor that exceeds it on an axis by more than 3σ."""
        limits = {"gyro": (self.gyro, DATA_SHEET_GYRO), "accel": (self.accel, DATA_SHEET_ACCEL)}
        return {
            name: _vector(axis.model.density / limit for axis in axes)
            for name, (axes, limit) in limits.items()
            if any(axis.model.density - 3 * axis.model.density_std > limit for axis in axes)
        }

    def as_dict(self) -> dict[str, Any]:
        """The object that `calibrate noise --json` prints. Names of coefficients are the rig file's."""
        result: dict[str, Any] = {
            "duration_s": round(self.duration_s, 3),
            "rate_hz": self.rate_hz,
            "is_rest": self.is_rest,
            "disturbances": list(self.disturbances),
            "is_long_enough": self.is_long_enough,
            "temperature_range_degC": self.temperature_range_degC,
            "worse_than_data_sheet": self.worse_than_data_sheet,
        }
        for sensor, unit, axes in (("gyro", "rad_s", self.gyro), ("accel", "m_s2", self.accel)):
            models = [axis.model for axis in axes]
            result |= {
                f"{sensor}_density_{unit}_sqrtHz": [m.density for m in models],
                f"{sensor}_density_std_{unit}_sqrtHz": [m.density_std for m in models],
                f"{sensor}_instability_{unit}": [m.instability for m in models],
                f"{sensor}_instability_at_s": [m.instability_at_s for m in models],
                f"{sensor}_instability_is_bound": [m.instability_is_bound for m in models],
                f"{sensor}_walk_{unit}_sqrts": [m.walk for m in models],
                f"{sensor}_walk_std_{unit}_sqrts": [m.walk_std for m in models],
                f"{sensor}_drift_{unit}_degC": [axis.drift for axis in axes],
                f"{sensor}_drift_std_{unit}_degC": [axis.drift_std for axis in axes],
                f"{sensor}_sample_std_{unit}": [axis.sample_std for axis in axes],
                f"{sensor}_allan": {
                    "tau_s": axes[0].tau_s.tolist(),
                    f"deviation_{unit}": [axis.deviation.tolist() for axis in axes],
                },
            }
        return result


def calibrate_noise(recordings: Sequence[Recording]) -> NoiseCalibration:
    """Noise from the longest rest in the recordings. Raises LinkposeError where no rest is long enough for a figure."""
    rests = [(r, r.measurements[part]) for r in recordings for part in _unbroken_rests(r.measurements)]
    names = ", ".join(str(r.path) for r in recordings)
    if not rests:
        raise LinkposeError(f"{names}: there is no rest; lay the sensor on a firm table, and record it untouched")
    recording, rest = max(rests, key=lambda pair: _span(pair[1]))
    span = _span(rest)
    if span < SHORTEST_S:
        raise LinkposeError(
            f"{names}: the longest rest lasts {span:.0f} s, and noise needs {SHORTEST_S:.0f} s or more (an hour for "
            "the random walk); record the sensor lying untouched for longer"
        )
    rate_hz = (len(rest) - 1) / span
    delay_s = recording.imu_delay_s or _USUAL_DELAY_S
    gyro, accel = (_three(rest, values, rate_hz, _DELAYS * delay_s) for values in (rest.gyro_rad_s, rest.accel_m_s2))
    temperature = rest.imu_temp_degC[np.isfinite(rest.imu_temp_degC)]
    return NoiseCalibration(
        gyro,
        accel,
        span,
        _span(recording.measurements),
        rate_hz,
        float(np.ptp(_averages(temperature, rate_hz))) if len(temperature) > _AVERAGE_S * rate_hz else None,
        _disturbances(rest, gyro, accel, rate_hz),
    )


def with_calibration(rig: Rig, found: NoiseCalibration) -> Rig:
    """The rig with the noise; everything else as it was.

    A sample's noise in [imu] is that of a white sequence of the same density, or the sample's own standard deviation
    where that is larger. A coefficient that one axis does not show is left out.
    """

    def by_axis(values: Sequence[float | None]) -> Vector | None:
        known = [v for v in values if v is not None]
        return _vector(known) if len(known) == 3 else None

    def noise(sensor: tuple[AxisNoise, AxisNoise, AxisNoise]) -> float:
        squares = [max(a.sample_std, a.model.density * math.sqrt(found.rate_hz)) ** 2 for a in sensor]
        return _digits(math.sqrt(sum(squares) / 3))

    coefficients: list[Vector | None] = []
    for sensor in (found.gyro, found.accel):
        coefficients += [
            _vector(a.model.density for a in sensor),
            _vector(a.model.instability for a in sensor),
            by_axis([a.model.walk for a in sensor]),
            by_axis([a.drift for a in sensor]),
        ]
    imu = replace(rig.imu, gyro_noise_rad_s=noise(found.gyro), accel_noise_m_s2=noise(found.accel))
    return replace(rig, imu=imu, noise=Noise(*coefficients))


def _unbroken_rests(block: Measurements) -> list[slice]:
    """Rests without a gap in the samples."""
    parts = []
    for rest in find_rests(block):
        breaks = rest.start + 1 + np.flatnonzero(np.diff(block.time_s[rest]) > _LONGEST_GAP_S)
        edges = [rest.start, *breaks.tolist(), rest.stop]
        parts += [slice(a, b) for a, b in itertools.pairwise(edges) if b - a > 1]
    return parts


def _span(block: Measurements) -> float:
    return float(block.time_s[-1] - block.time_s[0])


def _three(
    rest: Measurements, values: Floats, rate_hz: float, least_tau_s: float
) -> tuple[AxisNoise, AxisNoise, AxisNoise]:
    counts = averaging_counts(len(rest), rate_hz)
    temperature = _averages(rest.imu_temp_degC, rate_hz)
    x, y, z = (
        AxisNoise(
            fit_noise(axis, rate_hz, least_tau_s),
            _short_std(axis, rate_hz),
            *_drift(temperature, _averages(axis, rate_hz)),
            counts / rate_hz,
            allan_deviation(axis, counts),
        )
        for axis in values.T
    )
    return x, y, z


def _short_std(values: Floats, rate_hz: float) -> float:
    """Standard deviation of a sample about the mean of its two seconds: a drift is not in it."""
    width = max(round(2 * rate_hz), 2)
    pieces = values[: len(values) // width * width].reshape(-1, width)
    return float(np.sqrt(pieces.var(axis=1, ddof=1).mean()))


def _averages(values: Floats, rate_hz: float) -> Floats:
    """Means over ten seconds each."""
    width = max(round(_AVERAGE_S * rate_hz), 1)
    means: Floats = values[: len(values) // width * width].reshape(-1, width).mean(axis=1)
    return means


def _drift(temperature: Floats, bias: Floats) -> tuple[float | None, float | None]:
    """Slope of the bias over the temperature and its σ; None where the temperature stays the same.

    What the line leaves over is correlated, so σ counts only as many independent residuals as their first
    autocorrelation ρ leaves: a share of (1 − ρ) / (1 + ρ).
    """
    if len(bias) < 6 or not np.isfinite(temperature).all() or np.ptp(temperature) < LEAST_RANGE_DEGC:
        return None, None
    apart = temperature - temperature.mean()
    slope = float(apart @ bias / (apart @ apart))
    left = bias - bias.mean() - slope * apart
    square = float(left @ left)
    correlation = min(max(float(left[1:] @ left[:-1]) / square, 0.0), 0.95) if square > 0 else 0.0
    inflation = (1 + correlation) / (1 - correlation)
    return slope, math.sqrt(square / (len(bias) - 2) / float(apart @ apart) * inflation)


def _disturbances(
    rest: Measurements, gyro: Sequence[AxisNoise], accel: Sequence[AxisNoise], rate_hz: float
) -> tuple[str, ...]:
    """Why this was no rest, in sentences."""
    found = []
    tenth = len(rest) // 10
    first, last = (rest.accel_m_s2[rows].mean(axis=0) for rows in (slice(None, tenth), slice(-tenth, None)))
    turned = math.atan2(float(np.linalg.norm(np.cross(first, last))), float(first @ last))
    if turned > _LARGEST_TURN_RAD:
        found.append(f"the sensor tilted by {math.degrees(turned):.1f}° from the start to the end")
    for name, axes, largest in (("gyro", gyro, _LARGEST_GYRO_RAD_S), ("accelerometer", accel, _LARGEST_ACCEL_M_S2)):
        if any(a.deviation[a.tau_s >= 1.0].max(initial=0.0) > largest for a in axes):
            found.append(f"the {name} changed by more within seconds than a sensor at rest does")
        elif any(a.sample_std > _VIBRATION * a.model.density * math.sqrt(rate_hz) for a in axes):
            found.append(f"the {name} shows vibration (a motor, a fan or footsteps?)")
    return tuple(found)


def _digits(value: float) -> float:
    """Five significant digits."""
    return float(f"{value:.4e}")


def _vector(values: Any) -> Vector:
    x, y, z = (_digits(float(value)) for value in values)
    return x, y, z
