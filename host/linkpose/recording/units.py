"""Remarks on values that look like another unit than the column's name says."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from linkpose.sensors.measurements import Floats, Measurements

_G_M_S2 = 9.80665
_FASTEST_RAD_S = 36.0  # the MPU-6050 reads up to 2000 °/s, 34.9 rad/s
_LONGEST_STEP_S = 0.5


def suspicions(path: Path, measurements: Measurements) -> list[str]:
    """What the values of a recording look like, and the cure; nothing where they can be in SI units."""
    found = [
        _acceleration(_median(np.linalg.norm(measurements.accel_m_s2, axis=1))),
        _rate(measurements.gyro_rad_s),
        _time(_median(np.diff(measurements.time_s))),
        _pressure(_median(measurements.pressure_Pa)),
    ]
    return [f"{path}: {suspicion}" for suspicion in found if suspicion]


def _median(values: Floats) -> float:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else float("nan")


def _acceleration(median_m_s2: float) -> str:
    said = f"accel_* are {median_m_s2:.3g} m/s² long (median), and gravity alone is {_G_M_S2:.2f}"
    if 0.5 < median_m_s2 < 2.0:
        return f"{said}: are they in g? multiply them by {_G_M_S2}"
    if 500.0 < median_m_s2 < 2000.0:
        return f"{said}: are they in thousandths of g? multiply them by {_G_M_S2 / 1000:.8f}"
    return ""


def _rate(gyro_rad_s: Floats) -> str:
    rates = np.abs(gyro_rad_s[np.isfinite(gyro_rad_s)])
    if np.count_nonzero(rates > _FASTEST_RAD_S) <= 0.001 * len(rates):  # a spike is none
        return ""
    return (
        f"gyro_* reach {rates.max():.0f} rad/s, more than the sensor reads: are they in °/s? "
        f"multiply them by {np.pi / 180:.7f}"
    )


def _time(median_step_s: float) -> str:
    if not median_step_s > _LONGEST_STEP_S:
        return ""
    unit, factor = ("milliseconds", 1000) if median_step_s < 1000 * _LONGEST_STEP_S else ("microseconds", 1_000_000)
    return f"time_s goes in steps of {median_step_s:g} s (median): is it in {unit}? divide it by {factor}"


def _pressure(median_pa: float) -> str:
    said = f"pressure_Pa is {median_pa:.1f} (median), and the air's is about 100000"
    if 300.0 < median_pa < 1100.0:
        return f"{said}: is it in hPa? multiply it by 100"
    if 30.0 < median_pa < 110.0:
        return f"{said}: is it in kPa? multiply it by 1000"
    return ""
