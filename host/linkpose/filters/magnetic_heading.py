"""A filter's yaw, held by the magnetometer where the field is undisturbed.

The yaw of an inertial filter drifts by ε. Turned into the filter's axes, the horizontal field of the earth points at

    z = α + ε + c + noise

with the direction of magnetic north α, and c, the error of the calibration, which changes slowly. Once a second, the
mean field of that second updates a Kalman filter of four states: ε, its rate ρ, α and c. The variance of α starts
infinite: the first accepted direction is the reference, and yaw stays relative to the start. ε follows the σ of the
filter's own yaw and never exceeds it, so that a yaw which is known well moves little.

A second counts only if strength and vertical component of its field are those at the reference, and if its direction
agrees with the prediction (χ² gate). Iron or a motor that turns the field is therefore not followed. A field that
disagrees for `_RENEW_S` but is steady becomes a new reference: α starts again and ε is kept. The anchor then only holds
the yaw of that moment, and nothing jumps. If it is the old field but for a small angle, c starts again instead, because
a disturbance below the gates had moved it. A calibration that does not fit shows as a strength that varies with
attitude; this variation is measured and widens c.

A disturbance within the gates that changes slowly would still be taken for a drift. Its component across the field is
not observed, and is assumed to be as large as the two that are: the changes of the horizontal strength and of the
vertical component since the reference. From their variance follows that of the direction, V. V is not averaged over
time, since the disturbance may last; the correction is the part own² / (own² + m + V) of what the directions state,
with σ² = own² of the filter's own yaw and the variance m of the directions. Where the field varies by as much as the
yaw may have drifted, the yaw therefore stays almost as it is. The corrected part of ε grows only as fast as the
directions determine ε: a yaw whose σ is large at first and then falls would otherwise be corrected as a whole before V
has been measured.

Sources: gates of norm and dip and the temporary rejection as in [VQF], section 3.4; ρ and c are first-order
Gauss-Markov processes.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from linkpose.errors import CannotRun, UncalibratedMagnetometer
from linkpose.filters import Filter
from linkpose.rotations import wrapped
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.rig import Mag

_WINDOW_S = 1.0  # whose mean field is one measurement (s): the swing of a hand averages out
_FEWEST = 3  # readings in a window
# Correlation times of the drift's rate and of the calibration's error (s). The former is the gyro bias's; the latter is
# as long as the link keeps its range of attitudes. A c that changes faster would average out and make σ too small.
_RATE_S, _CALIBRATION_S = 200.0, 300.0
_LEAST_ERROR_UT = 0.5  # of a calibration, whatever its residual: hard iron of 1 % of the field
_DIRECTION_RAD = math.radians(0.3)  # white noise of a window's direction: what the mean of some hundred readings leaves
_SWINGS = 3.0  # independent parts of a window, over which the field's scatter averages out
_GATE = 9.0  # χ² with one degree of freedom: three standard deviations
# Difference of strength and vertical component from the reference (share of the field, and multiple of the residual).
# At 4 % (2 µT), a disturbance along the field passes that turns the heading by no more than the gate lets pass.
_FIELD_SHARE, _FIELD_RESIDUALS = 0.04, 3.0
# Share of a difference from the calibrated field that counts as error. Doubled, the field holds half as well.
_FOREIGN_SHARE = 0.5
_PLAUSIBLE_SHARE = 0.5  # of the calibrated strength: beside steel it differs by this
_LEAST_LEVEL_UT = 5.0  # horizontal field below which there is no heading
# Windows on either side of a rejected one that are not used either: the field changed there, below the gates. Doubled,
# a motor that runs every other 8 s leaves nothing.
_NEIGHBOURS = 2
_RENEW_S = 20  # windows of a steady but different field before it becomes the reference
_STRENGTH_S = 60.0  # over which the strength's variation with attitude is measured
_UNKNOWN_RAD2 = 100.0  # variance of an unknown direction
_DRIFT, _RATE, _NORTH, _ERROR = range(4)
# Variance of the disturbance within the gates. Windows closer than this are not independent (s); memory (s).
_INDEPENDENT_S, _VARIATION_S = 30.0, 300.0
# Standard deviation along one axis before it is measured (µT), and how many independent windows this prior counts as.
# Doubled, the first minutes of an undisturbed field hold half as well.
_PRIOR_UT, _PRIOR_WINDOWS = 1.0, 1.0
# Factor of that standard deviation: it is measured from a few independent windows, of which one in ten shows a third of
# the true value. At 1, yaw with the magnetometer is worse than without it in some buildings.
_CAUTION = 3.0
_LEAST_FREE = 0.1  # of the tolerance: beyond it the variance is not observed
_SLEW_S = 20.0  # over which the applied part of the correction follows its value: the yaw does not jump


@dataclass(slots=True)
class FieldRecord:
    """What a run has found of the magnetic field."""

    used_s: float = 0.0
    rejected_s: float = 0.0
    references: int = 0
    largest_disturbance_uT: float = 0.0
    north_deg: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """The entry `mag` of a closing line."""
        return {
            "used_s": round(self.used_s, 3),
            "rejected_s": round(self.rejected_s, 3),
            "references": self.references,
            "largest_disturbance_uT": round(self.largest_disturbance_uT, 3),
            "magnetic_north_deg": None if self.north_deg is None else round(self.north_deg, 3),
        }


class _Variation:
    """Variance of a disturbance along one axis, from the changes of accepted fields."""

    def __init__(self, tolerance_uT: float) -> None:
        self._tolerance_uT = tolerance_uT
        self._sum = self._renewals = 0.0  # squares over independent windows (µT²)
        self._count = 0.0

    def add(self, change_uT: tuple[float, float]) -> None:
        """A window's change of level and vertical component since the reference."""
        keep, weight = math.exp(-_WINDOW_S / _VARIATION_S), _WINDOW_S / _INDEPENDENT_S
        self._sum = keep * self._sum + weight * _mean_square(change_uT)
        self._renewals *= keep
        self._count = keep * self._count + weight

    def renew(self, change_uT: tuple[float, float]) -> None:
        """That of a field which becomes the reference."""
        self._renewals += _mean_square(change_uT)

    @property
    def square_uT2(self) -> float:
        """The variance (µT²).

        Accepted fields lie within the tolerance L of the reference. Of a variance s² they show 1 / (1/s² + 3/L²): for a
        large s that of a uniform distribution.
        """
        count = self._count + _PRIOR_WINDOWS
        seen = (self._sum + _PRIOR_WINDOWS * _PRIOR_UT**2) / count
        free = max(1.0 - 3.0 * seen / self._tolerance_uT**2, _LEAST_FREE)
        return seen / free + self._renewals / count


def _mean_square(change_uT: tuple[float, float]) -> float:
    return 0.5 * (change_uT[0] ** 2 + change_uT[1] ** 2)


@dataclass(frozen=True, slots=True)
class _Window:
    """The mean field of a window in the filter's axes (Z up), and what it is worth."""

    time_s: float  # of its last reading
    field_uT: Floats  # (3,)
    strength_uT: float  # mean of the readings' strengths
    strength_square: float  # mean square of their difference from the reference's (µT²); 0 without a reference
    scatter_uT: float  # of the horizontal components
    yaw_std_rad: float
    tilt_std_rad: float

    @property
    def level_uT(self) -> float:
        """Strength of the horizontal component."""
        return math.hypot(self.field_uT[0], self.field_uT[1])

    @property
    def direction_rad(self) -> float:
        return math.atan2(self.field_uT[1], self.field_uT[0])


class MagneticHeading:
    """A filter with a yaw whose drift the magnetometer bounds; one more column is the magnetic disturbance (µT)."""

    def __init__(self, inner: Filter, mag: Mag) -> None:
        """Raises UncalibratedMagnetometer, and CannotRun where the filter estimates no yaw."""
        if mag.hard_iron_uT is None:
            raise UncalibratedMagnetometer()
        prefix = inner.name.replace("-", "_")
        places = {name.removeprefix(f"{prefix}_"): at for at, name in enumerate(inner.columns)}
        if not has_yaw(inner):
            raise CannotRun(f"{inner.name} estimates no yaw that a magnetometer could hold")
        self.inner = inner
        self.columns = (*inner.columns, f"{prefix}_mag_disturbance_uT")
        self.found = FieldRecord()
        self._angles = [places[f"{name}_deg"] for name in ("roll", "pitch", "yaw")]
        self._stds = [places[f"{name}_std_deg"] for name in ("roll", "pitch", "yaw")]
        self._level = [places[name] for name in ("x_m", "y_m", "x_std_m", "y_std_m") if name in places]
        self._hard_iron = np.array(mag.hard_iron_uT)
        self._matrix = np.array([mag.matrix_x, mag.matrix_y, mag.matrix_z])
        self._calibrated_uT, self._dip_deg = mag.field_uT, mag.dip_deg
        self._residual_uT = max(mag.residual_uT, _LEAST_ERROR_UT)
        self._tolerance_uT = max(_FIELD_RESIDUALS * self._residual_uT, _FIELD_SHARE * mag.field_uT)
        self._strength_square = 0.0
        self._variation = _Variation(self._tolerance_uT)
        self._disturbance_rad2 = 0.0  # V
        self._applied = 0.0  # part of the estimated drift that is removed
        self._index = -math.inf  # of the window that is being filled
        self._readings: list[Floats] = []  # its rows of time, field (3), angles (3), their σ (3)
        self._unlike: list[Floats] = []  # fields of the last windows, all rejected
        self._waiting: list[_Window] = []  # the last accepted windows; the first _NEIGHBOURS of them are not to be used
        self._disturbance_uT = math.nan
        self._begun_s = math.nan
        self._time_s = math.nan  # of mean and covariance; NaN before the first reference
        self._yaw_std = 0.0  # of the filter's own yaw at that time (rad)
        self._reference_uT = (math.nan, math.nan)  # strength, vertical component
        self._mean, self._covariance = np.zeros(4), np.zeros((4, 4))

    @property
    def name(self) -> str:
        """The inner filter's name."""
        return self.inner.name

    @property
    def rejected(self) -> int:
        """The inner filter's rejected samples."""
        return self.inner.rejected

    def process(self, block: Measurements) -> Floats:
        """The inner filter's estimates with the anchored yaw, x and y: (N, len(columns))."""
        estimates = np.column_stack([self.inner.process(block), np.full(len(block), np.nan)])
        windows = np.floor(block.time_s / _WINDOW_S)
        edges = [0, *(np.flatnonzero(np.diff(windows)) + 1).tolist(), len(block)]
        for first, last in itertools.pairwise(edges):
            if first == last:
                continue
            if windows[first] != self._index:
                self._close_window()
                self._index = float(windows[first])
            rows = estimates[first:last]
            self._readings.append(self._usable(block[first:last], rows))
            self._anchor(block.time_s[first:last], rows)
        return estimates

    # ---- rows ----

    def _usable(self, block: Measurements, rows: Floats) -> Floats:
        """(n, 10) time, calibrated field (µT), roll, pitch, yaw and their σ (rad) of the samples with a new reading."""
        kept = block.mag_fresh & np.isfinite(block.mag_uT).all(axis=1) & np.isfinite(rows[:, self._angles]).all(axis=1)
        field = (block.mag_uT[kept] - self._hard_iron) @ self._matrix.T
        angles = np.radians(rows[kept][:, self._angles + self._stds])
        return np.column_stack([block.time_s[kept], field, angles])

    def _anchor(self, time_s: Floats, rows: Floats) -> None:
        """Remove the estimated drift from yaw, x and y of these rows, in place."""
        rows[:, -1] = self._disturbance_uT
        if math.isnan(self._time_s):
            return
        ahead, p = time_s - self._time_s, self._covariance
        drift = self._mean[_DRIFT] + ahead * self._mean[_RATE]
        variance = p[_DRIFT, _DRIFT] + ahead * (2 * p[_DRIFT, _RATE] + ahead * p[_RATE, _RATE])
        _, _, yaw = self._angles
        own = np.radians(rows[:, self._stds[2]])
        drift, variance = self._applied * drift, self._remaining(np.minimum(np.maximum(variance, 0.0), own**2), own**2)
        rows[:, yaw] = (rows[:, yaw] - np.degrees(drift) + 180.0) % 360.0 - 180.0
        rows[:, self._stds[2]] = np.degrees(np.sqrt(variance))
        if self._level:
            self._turn_position(rows, drift, own**2 - variance)

    def _remaining(self, variance: Floats, own: Floats) -> Floats:
        """Variance (rad²) of the yaw less the applied part of the drift.

        `variance` is that of the drift without V, `own` that of the filter's own yaw. The directions z with variance m
        and the gain G = own / (own + m) give the drift G z; the applied part A G z leaves (1 − A G)² own + (A G)²
        (m + V).
        """
        gain = self._applied * (1.0 - variance / np.maximum(own, 1e-12))
        directions = gain * self._applied * variance + gain**2 * self._disturbance_rad2
        return np.minimum((1.0 - gain) ** 2 * own + directions, own)

    def _follow_applied(self, window: _Window) -> None:
        """Let the applied part follow (own + m) / (own + m + V).

        Without information in the directions that is 1, which tells nothing of the field: the part rises in proportion
        to own / (own + m), and falls at once.
        """
        level = max(window.level_uT, _LEAST_LEVEL_UT)
        self._disturbance_rad2 = 2.0 * (_CAUTION / level) ** 2 * self._variation.square_uT2  # at the reference, and now
        own, variance = window.yaw_std_rad**2, float(self._covariance[_DRIFT, _DRIFT])
        share = max(1.0 - variance / max(own, 1e-12), 0.0)  # of own in own + m
        wanted = own / (own + share * self._disturbance_rad2) if own > 0.0 else 0.0
        pace = share if wanted > self._applied else 1.0
        self._applied += pace * _WINDOW_S / _SLEW_S * (wanted - self._applied)

    def _turn_position(self, rows: Floats, drift: Floats, gained: Floats) -> None:
        """x and y turned by −drift; their σ less the variance of the yaw that the anchor has `gained` (rad²)."""
        at_x, at_y, std_x, std_y = self._level
        x, y, cos, sin = rows[:, at_x].copy(), rows[:, at_y].copy(), np.cos(drift), np.sin(drift)
        rows[:, at_x], rows[:, at_y] = cos * x + sin * y, cos * y - sin * x
        for std, across in ((std_x, rows[:, at_y]), (std_y, rows[:, at_x])):
            whole = rows[:, std] ** 2
            rows[:, std] = np.sqrt(np.maximum(whole - across**2 * gained, whole * 1e-4))

    # ---- windows ----

    def _close_window(self) -> None:
        """Use the mean field of the window that has ended."""
        readings = np.concatenate(self._readings) if self._readings else np.empty((0, 10))
        self._readings = []
        if len(readings) < _FEWEST:
            return
        window = self._window(readings)
        if math.isnan(self._begun_s):
            self._begun_s = float(readings[0, 0])
        is_used = self._consider(window)
        self._follow_applied(window)
        span = min(_WINDOW_S, float(readings[-1, 0] - readings[0, 0]))
        self.found.used_s += span * is_used
        self.found.rejected_s += span * (not is_used)
        self._disturbance_uT = self._disturbance(window)
        if not math.isnan(self._disturbance_uT):
            self.found.largest_disturbance_uT = max(self.found.largest_disturbance_uT, self._disturbance_uT)

    def _window(self, readings: Floats) -> _Window:
        field = _level_axes(readings[:, 1:4], *readings[:, 4:7].T)
        strength = np.sqrt((field**2).sum(axis=1))
        reference = self._reference_uT[0]
        off = 0.0 if math.isnan(reference) else float(np.mean((strength - reference) ** 2))
        mean, stds = field.mean(axis=0), readings[:, 7:].mean(axis=0)
        scatter = math.sqrt(float(((field[:, :2] - mean[:2]) ** 2).sum()) / len(field))
        tilt_std = math.hypot(stds[0], stds[1]) / math.sqrt(2)
        return _Window(float(readings[-1, 0]), mean, float(strength.mean()), off, scatter, float(stds[2]), tilt_std)

    @property
    def _foreign_uT(self) -> float:
        """By how much strength or vertical component of the reference differ from the calibrated ones, beyond the
        tolerance.
        """
        strength, vertical = self._reference_uT
        apart = abs(strength - self._calibrated_uT)
        if self._dip_deg is not None:
            apart = max(apart, abs(vertical + self._calibrated_uT * math.sin(math.radians(self._dip_deg))))
        return max(apart - self._tolerance_uT, 0.0)

    def _error_std(self, window: _Window) -> float:
        """σ of c (rad).

        A field that is not the calibrated one shows a calibration that does not fit, or iron so near that the field
        varies with the sensor's place: c may be as large as the share of it that counts.
        """
        error = max(self._residual_uT, math.sqrt(self._strength_square), _FOREIGN_SHARE * self._foreign_uT)
        return error / max(window.level_uT, _LEAST_LEVEL_UT)

    def _rate_std(self, window: _Window) -> float:
        """σ of ρ (rad/s): the mean rate that takes the filter's yaw to its σ since the start."""
        return window.yaw_std_rad / max(window.time_s - self._begun_s, _WINDOW_S)

    def _predict(self, window: _Window) -> None:
        """Propagate to the window's time.

        A change of the yaw's own σ that ρ does not explain is a step of the filter: it widens ε, whichever its sign.
        """
        h, p = window.time_s - self._time_s, self._covariance
        keep_rate, keep_error = math.exp(-h / _RATE_S), math.exp(-h / _CALIBRATION_S)
        f = np.diag([1.0, keep_rate, 1.0, keep_error])
        f[_DRIFT, _RATE] = h
        self._mean = f @ self._mean
        p = f @ p @ f.T
        p[_RATE, _RATE] += (1 - keep_rate**2) * self._rate_std(window) ** 2
        p[_ERROR, _ERROR] += (1 - keep_error**2) * self._error_std(window) ** 2
        before = self._yaw_std
        grown = before * (window.time_s - self._begun_s) / max(self._time_s - self._begun_s, _WINDOW_S)
        own = window.yaw_std_rad
        p[_DRIFT, _DRIFT] += max(own**2 - grown**2, before**2 - own**2, 0.0)
        self._covariance, self._time_s, self._yaw_std = p, window.time_s, own
        if p[_DRIFT, _DRIFT] > own**2 > 0:  # the filter itself states that ε is 0 ± σ
            self._correct(np.eye(4)[_DRIFT], -float(self._mean[_DRIFT]), 1 / (1 / own**2 - 1 / p[_DRIFT, _DRIFT]))

    def _consider(self, window: _Window) -> bool:
        """Use a window whose field is accepted, unless its neighbours' are not. False where it is rejected."""
        is_plausible = abs(window.strength_uT - self._calibrated_uT) < _PLAUSIBLE_SHARE * self._calibrated_uT
        is_usable = is_plausible and window.level_uT >= _LEAST_LEVEL_UT
        if math.isnan(self._time_s):
            if is_usable:
                self._begin(window)
            return is_usable
        is_same = is_usable and self._is_same_field(window)
        if is_same and self._agrees(window, _GATE):
            self._unlike = []
            self._waiting.append(window)
            if len(self._waiting) > 2 * _NEIGHBOURS:
                self._apply(self._waiting.pop(_NEIGHBOURS))
            return True
        self._waiting = []
        self._predict(window)
        self._unlike = [*self._unlike, window.field_uT] if is_usable else []
        if self._is_steady():
            self._accept_again(window, is_same)
        return False

    def _apply(self, window: _Window) -> None:
        """Update the state by the window's direction."""
        self._predict(window)
        innovation, measured, variance = self._innovation(window)
        self._correct(measured, innovation, variance)
        self._variation.add(self._change(window))
        self._strength_square += _WINDOW_S / _STRENGTH_S * (window.strength_square - self._strength_square)
        if self._foreign_uT == 0.0:
            self.found.north_deg = math.degrees(wrapped(float(self._mean[_NORTH])))

    def _accept_again(self, window: _Window, is_same: bool) -> None:
        """Take a field that was rejected but is steady: the old one but for a small angle, or a new reference."""
        if not is_same:
            self._variation.renew(self._change(window))
            self._reference_uT = (window.strength_uT, float(window.field_uT[2]))
        self._forget(_ERROR, self._error_std(window) ** 2)
        if not is_same or not self._agrees(window, 2 * _GATE):
            self._renew(window)
        self._unlike = []

    def _change(self, window: _Window) -> tuple[float, float]:
        """Changes of level and vertical component since the reference (µT)."""
        strength, vertical = self._reference_uT
        level = math.sqrt(max(strength**2 - vertical**2, 0.0))
        return window.level_uT - level, float(window.field_uT[2]) - vertical

    def _begin(self, window: _Window) -> None:
        """The first reference: ε is what the filter states, c what the calibration leaves."""
        self._time_s, self._yaw_std = window.time_s, window.yaw_std_rad
        self._reference_uT = (window.strength_uT, float(window.field_uT[2]))
        variances = [window.yaw_std_rad**2, self._rate_std(window) ** 2, 0.0, self._error_std(window) ** 2]
        self._covariance = np.diag(variances)
        self._renew(window)

    def _renew(self, window: _Window) -> None:
        """Take the window's field as the reference; nothing is known of its direction."""
        self._forget(_NORTH, _UNKNOWN_RAD2)
        self._mean[_NORTH] = window.direction_rad - self._mean[_DRIFT] - self._mean[_ERROR]
        self.found.references += 1

    def _forget(self, state: int, variance: float) -> None:
        """Start a state again: zero, with this variance, independent of the others."""
        self._mean[state] = 0.0
        self._covariance[state] = self._covariance[:, state] = 0.0
        self._covariance[state, state] = variance

    def _is_same_field(self, window: _Window) -> bool:
        """Whether strength and vertical component are those of the reference."""
        strength, vertical = self._reference_uT
        most = self._tolerance_uT
        if abs(window.strength_uT - strength) > most:
            return False
        return bool(abs(window.field_uT[2] - vertical) <= most + 3.0 * window.level_uT * window.tilt_std_rad)

    def _agrees(self, window: _Window, gate: float) -> bool:
        """Whether the direction is the predicted one, within this χ²."""
        innovation, measured, variance = self._innovation(window)
        return bool(innovation**2 <= gate * (measured @ self._covariance @ measured + variance))

    def _is_steady(self) -> bool:
        """Whether the last windows, all of them rejected, had one field."""
        if len(self._unlike) < _RENEW_S:
            return False
        del self._unlike[:-_RENEW_S]
        fields = np.array(self._unlike)
        apart = np.sqrt(((fields - fields.mean(axis=0)) ** 2).sum(axis=1))
        return bool(apart.max() <= self._tolerance_uT)

    def _innovation(self, window: _Window) -> tuple[float, Floats, float]:
        """Innovation (rad), its measurement row, and the variance of its white noise (rad²).

        An error of the tilt turns the direction by the tangent of the dip.
        """
        measured = np.array([1.0, 0.0, 1.0, 1.0])
        innovation = wrapped(window.direction_rad - float(measured @ self._mean))
        tilt = window.field_uT[2] / window.level_uT * window.tilt_std_rad
        scatter = window.scatter_uT / window.level_uT
        return innovation, measured, _DIRECTION_RAD**2 + float(tilt) ** 2 + scatter**2 / _SWINGS

    def _correct(self, measured: Floats, innovation: float, variance: float) -> None:
        """Kalman update by one number, in Joseph's form."""
        p = self._covariance
        gain = p @ measured / (measured @ p @ measured + variance)
        self._mean = self._mean + gain * innovation
        left = np.eye(4) - np.outer(gain, measured)
        self._covariance = left @ p @ left.T + variance * np.outer(gain, gain)

    def _disturbance(self, window: _Window) -> float:
        """Distance of the field from the calibrated one in strength and dip, and from the reference in direction (µT).

        Without a calibrated dip, the reference's counts.
        """
        if math.isnan(self._time_s):
            return math.nan
        strength, vertical = self._reference_uT
        if self._dip_deg is not None:
            strength, vertical = self._calibrated_uT, -self._calibrated_uT * math.sin(math.radians(self._dip_deg))
        level = math.sqrt(max(strength**2 - vertical**2, 0.0))
        turned = wrapped(window.direction_rad - float(self._mean[_DRIFT] + self._mean[_NORTH]))
        aside, along = window.level_uT * math.sin(turned), window.level_uT * math.cos(turned)
        return math.sqrt(aside**2 + (along - level) ** 2 + float(window.field_uT[2] - vertical) ** 2)


def has_yaw(f: Filter) -> bool:
    """Whether the filter estimates a yaw since the start with its σ."""
    return f"{f.name.replace('-', '_')}_yaw_std_deg" in f.columns


def _level_axes(field: Floats, roll: Floats, pitch: Floats, yaw: Floats) -> Floats:
    """R_z(yaw) R_y(pitch) R_x(roll) field, of N rows (N, 3); angles in rad."""
    x, y, z = field.T
    across = np.cos(roll) * y - np.sin(roll) * z
    up = np.sin(roll) * y + np.cos(roll) * z
    ahead = np.cos(pitch) * x + np.sin(pitch) * up
    vertical = np.cos(pitch) * up - np.sin(pitch) * x
    return np.column_stack(
        [np.cos(yaw) * ahead - np.sin(yaw) * across, np.sin(yaw) * ahead + np.cos(yaw) * across, vertical]
    )
