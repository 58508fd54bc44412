"""What a recording holds: duration, gaps, the sensors that gave values, and their noise at rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.conversion import GAP_BEFORE
from linkpose.sensors.measurements import Floats, Measurements

MOST_GAPS = 20  # listed; all are counted
_GAP_PERIODS = 1.5  # a longer step has lost a sample; jitter of the clock fit is below 0.1 periods
# A window of 1 s is at rest where its readings deviate less than this: about ten times the MPU-6050's noise (data
# sheet: 0.05 °/s rms; 400 µg/√Hz, at 94 Hz of bandwidth 0.005 g). Doubling it accepts slow motion as rest.
_WINDOW_S = 1.0
_REST_GYRO_RAD_S = 0.01
_REST_ACCEL_M_S2 = 0.5
# Of the windows at rest, those within this factor of the quietest twentieth show the sensor rather than the table.
_QUIET_SHARE, _QUIET_FACTOR = 0.05, 1.5
_FEWEST_WINDOWS = 2


@dataclass(frozen=True, slots=True)
class RecordedGap:
    """A stretch without samples."""

    time_s: float  # of the last sample before it
    duration_s: float
    lost: int


class Survey:
    """Collects facts over the consecutive blocks of a recording."""

    def __init__(self, rate_hz: float) -> None:
        self.rows = 0
        self.first_s = self.last_s = 0.0
        self.gaps: list[RecordedGap] = []  # the first ones
        self.gap_count = self.lost = 0
        self.seen: set[str] = set()  # sensors that gave a value, usable or not
        self.has_gyro = self.has_gyro2 = self.has_pressure = self.has_mag = False  # a usable value
        self.mice = 0  # ports up to the last that gave a count
        self._rate_hz = rate_hz
        self._rest = _Rest(max(2, round(_WINDOW_S * rate_hz)))

    def add(self, raw: Measurements, checked: Measurements) -> None:
        """The next block, as it was recorded and with NaN for unusable readings."""
        if not len(raw):
            return
        self._add_times(raw)
        counted = np.isfinite(raw.mice_counts).any(axis=(0, 2))
        self.mice = max(self.mice, int(np.flatnonzero(counted).max(initial=-1)) + 1)
        self.seen |= {f"mouse{port + 1}" for port in np.flatnonzero(counted).tolist()}
        present = {
            "imu": raw.accel_m_s2, "imu2": raw.gyro2_rad_s, "baro": raw.pressure_Pa, "mag": raw.mag_uT,
        }  # fmt: skip
        self.seen |= {name for name, values in present.items() if name not in self.seen and np.isfinite(values).any()}
        self.has_gyro = self.has_gyro or bool(np.isfinite(checked.gyro_rad_s).any())
        self.has_gyro2 = self.has_gyro2 or checked.has_imu2
        self.has_pressure = self.has_pressure or bool(checked.baro_fresh.any())
        self.has_mag = self.has_mag or bool(checked.mag_fresh.any())
        self._rest.add(checked)

    @property
    def duration_s(self) -> float:
        """From the first sample to the end of the last one's interval."""
        return self.last_s - self.first_s + 1.0 / self._rate_hz if self.rows else 0.0

    @property
    def measured_rate_hz(self) -> float:
        """Samples per second where none is missing."""
        present_s = self.last_s - self.first_s - self.lost / self._rate_hz
        return (self.rows - 1) / present_s if present_s > 0 else self._rate_hz

    def noise_at_rest(self) -> dict[str, Any] | None:
        """Standard deviation of each axis at rest, and for how long the sensor rested; None if it never did."""
        return self._rest.noise()

    def _add_times(self, raw: Measurements) -> None:
        time_s = raw.time_s
        if not self.rows:
            self.first_s = float(time_s[0])
        before = self.last_s if self.rows else time_s[0]
        steps = np.diff(time_s, prepend=before)
        is_gap = (steps * self._rate_hz > _GAP_PERIODS) | ((raw.flags & GAP_BEFORE) != 0)
        is_gap[0] &= self.rows > 0
        at = np.flatnonzero(is_gap)
        lost = np.maximum(np.rint(steps[at] * self._rate_hz).astype(np.int64) - 1, 0)
        self.gap_count += len(at)
        self.lost += int(lost.sum())
        for i, count in zip(at[: MOST_GAPS - len(self.gaps)].tolist(), lost.tolist(), strict=False):
            self.gaps.append(RecordedGap(float(time_s[i] - steps[i]), float(steps[i]), count))
        self.rows += len(raw)
        self.last_s = float(time_s[-1])


class _Rest:
    """Standard deviations in windows of equal length, of which those at rest show the sensors' noise."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._left: NDArray[np.float64] = np.empty((0, 7))  # samples that do not fill a window yet
        self._std: list[Floats] = []  # (windows, 7) of accel x y z, gyro x y z, pressure

    def add(self, block: Measurements) -> None:
        values = np.column_stack([block.accel_m_s2, block.gyro_rad_s, block.pressure_Pa])
        values = np.concatenate([self._left, values])
        whole = len(values) // self._size
        self._left = values[whole * self._size :]
        windows = values[: whole * self._size].reshape(whole, self._size, 7)
        self._std.append(windows.std(axis=1))

    def noise(self) -> dict[str, Any] | None:
        std = np.concatenate(self._std) if self._std else np.empty((0, 7))
        accel, gyro = std[:, :3].max(axis=1), std[:, 3:6].max(axis=1)
        rest = std[(accel < _REST_ACCEL_M_S2) & (gyro < _REST_GYRO_RAD_S)]
        if len(rest) < _FEWEST_WINDOWS:
            return None
        turning = rest[:, 3:6].max(axis=1)
        rest = rest[turning <= _QUIET_FACTOR * np.quantile(turning, _QUIET_SHARE)]
        middle = np.median(rest, axis=0)
        return {
            "seconds": len(rest) * _WINDOW_S,
            "accel_m_s2": [round(value, 5) for value in middle[:3].tolist()],
            "gyro_rad_s": [round(value, 6) for value in middle[3:6].tolist()],
            "pressure_Pa": None if np.isnan(middle[6]) else round(float(middle[6]), 2),
        }
