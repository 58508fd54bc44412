"""An inertial filter whose yaw drifts, its magnetometer, and its yaw as `MagneticHeading` holds it.

The tests and the benchmark of the magnetometer share it.
"""

from __future__ import annotations

import math

import numpy as np

from linkpose.filters.magnetic_heading import MagneticHeading
from linkpose.sensors.measurements import Measurements
from linkpose.simulation import mag as mag_model
from linkpose.simulation import mag_disturbances
from linkpose.simulation.motion import HandMotion

HZ, MINUTES = 10, 10
CALIBRATED = mag_model.calibration("calibrated")


class Drifting:
    """An inertial filter's roll, pitch and yaw with their σ; the yaw drifts by a rate that walks."""

    name, rejected = "inertial", 0
    columns = tuple(f"inertial_{name}_deg" for name in ("roll", "pitch", "yaw", "roll_std", "pitch_std", "yaw_std"))

    def __init__(self, tilt, yaw_rad, drift_deg, std_deg) -> None:
        roll, pitch = np.arctan2(tilt[:, 1], tilt[:, 2]), np.arcsin(-tilt[:, 0])
        tilt_std = np.full(len(tilt), 0.05)
        self.rows = np.column_stack([*np.degrees([roll, pitch, yaw_rad]), tilt_std, tilt_std, std_deg])
        self.rows[:, 2] += drift_deg
        self._at = 0

    def process(self, block):
        self._at += len(block)
        return self.rows[self._at - len(block) : self._at].copy()


def run(seed: int, disturbance: str | None, *, hard_iron_uT=0.5, drift_deg_s=0.01, minutes=MINUTES):
    """A hand-moved sensor: the filter that drifts, its measurements, and the error of its yaw (°)."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(60 * minutes * HZ)) / HZ
    moving = HandMotion(rng, 1.0, None).at(t)
    walk = np.cumsum(rng.standard_normal(len(t))) * drift_deg_s / math.sqrt(len(t))
    rate = drift_deg_s * rng.standard_normal() + walk
    drift = np.cumsum(rate) / HZ
    field = mag_model.field(moving) + hard_iron_uT * rng.uniform(-1, 1, 3) + 0.2 * rng.standard_normal((len(t), 3))
    if disturbance:
        field = field + mag_disturbances.Disturbance(disturbance, seed).field(moving, t)
    gravity = 9.80665 * moving.tilt
    inner = Drifting(moving.tilt, moving.yaw_rad, drift, 0.1 + 1.2 * drift_deg_s * t)
    return inner, Measurements.from_imu(t, gravity, moving.rate_rad_s, mag_uT=field), drift


def held(inner, block, drift, mag=CALIBRATED):
    """Error of the held yaw (°), its σ (°), the estimates, and the wrapper."""
    own = inner.rows[:, 2] - drift
    f = MagneticHeading(inner, mag)
    out = f.process(block)
    return (out[:, 2] - own + 180) % 360 - 180, out[:, 5], out, f
