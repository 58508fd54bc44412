"""Remarks on values that look like another unit than the column's name says."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from linkpose.sensors.measurements import Floats, Measurements

_GRAVITY_M_S2 = 9.8
_AIR_PA = 1e5
_ACCEL_UNITS = (("g", "9.80665"), ("thousandths of g", "0.00980665"))
_PRESSURE_UNITS = (("hPa", "100"), ("kPa", "1000"))
_FASTEST_RAD_S = 36.0  # the MPU-6050 reads up to 2000 °/s, 34.9 rad/s
_LONGEST_STEP_S = 0.5


def suspicions(path: Path, measurements: Measurements) -> list[str]:
    """What the values of a recording look like, and the cure; nothing where they can be in SI units."""
    force_m_s2 = np.linalg.norm(measurements.accel_m_s2, axis=1)
    found = [
        _of_usual_size("accel_*", _median(force_m_s2), _GRAVITY_M_S2, _ACCEL_UNITS),
        _rate(measurements.gyro_rad_s),
        _time(_median(np.diff(measurements.time_s))),
        _of_usual_size("pressure_Pa", _median(measurements.pressure_Pa), _AIR_PA, _PRESSURE_UNITS),
    ]
    return [f"{path}: {suspicion}" for suspicion in found if suspicion]


def _median(values: Floats) -> float:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else float("nan")


def _rate(gyro_rad_s: Floats) -> str:
    rates = np.abs(gyro_rad_s[np.isfinite(gyro_rad_s)])
    if np.count_nonzero(rates > _FASTEST_RAD_S) <= 0.001 * len(rates):  # a spike is none
        return ""
    return (
        f"gyro_* is up to {rates.max():.0f} rad/s, more than the sensor reads: is it in °/s? "
        f"multiply it by {np.pi / 180:.7f}"
    )


def _time(median_step_s: float) -> str:
    if not median_step_s > _LONGEST_STEP_S:
        return ""
    unit, factor = ("milliseconds", 1000) if median_step_s < 1000 * _LONGEST_STEP_S else ("microseconds", 1_000_000)
    return f"time_s goes in steps of {median_step_s:g} s (median): is it in {unit}? divide it by {factor}"


def _of_usual_size(name: str, median: float, usual: float, units: Sequence[tuple[str, str]]) -> str:
    """Names the unit, of (name, factor to the column's), that would bring the median to about its usual value."""
    for unit, factor in units:
        if 0.5 < median * float(factor) / usual < 2.0:
            return f"{name} is {median:.4g} (median), not about {usual:g}: is it in {unit}? multiply it by {factor}"
    return ""
