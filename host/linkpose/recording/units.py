"""Remarks on values that contradict the unit in their column's name, or each other."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.recording.consistency import contradiction
from linkpose.sensors.conversion import GAP_BEFORE
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY

UNIT_ROWS = 100_000  # by which units are judged: a unit is wrong in all rows or in none
_AIR_PA = 1e5
_ACCEL_UNITS = (
    ("g", f"{STANDARD_GRAVITY}"),
    ("thousandths of g", f"{STANDARD_GRAVITY / 1000:.8f}"),
    ("mm/s²", "0.001"),
)
_GRAVITY_TOLERANCE = 0.2  # the MPU-6050's offset and scale error at the worst: 0.08 g, 3 % (data sheet)
_STILL_RAD_S = (
    0.3  # a hand that holds the sensor; a link that swings through its turning point is slower for 0.1 s only
)
_STILL_M_S2 = 0.5  # deviation within _STILL_S: five times the MPU-6050's noise at its widest bandwidth (data sheet)
_STILL_S = 0.5
_FEWEST_STILL = 2  # stretches of that length
_MMHG = (600.0, 800.0)  # at sea level; as hPa, an altitude of 2 to 4 km
_BLOCK_S = 0.1  # averages out noise and vibration
_FEWEST_BLOCKS = 20
_MOVES_M_S2 = 0.3  # rms of the motion's part of the force; less is too small beside errors of scale and offset (3 %)
# A unit is named for 500 to 1100 hPa; psi and inHg differ by a factor of 2.04.
_PRESSURE_UNITS = (
    *(("hPa", "100"), ("kPa", "1000"), ("psi", "6894.757"), ("inHg", "3386.389"), ("bar", "100000")),
    ("hundredths of Pa", "0.01"),
)
_HEAVIEST = 1.1
_THIN_AIR_PA = 54_000.0  # at 5100 m, where the highest town is
_HOTTEST_DEG_C = 200.0  # beyond the range of any of the chips
_FASTEST_RAD_S = 36.0  # the MPU-6050 reads up to 2000 °/s, 34.9 rad/s
_STRONGEST_M_S2 = 160.0  # the MPU-6050 reads up to 16 g, 156.9 m/s²
_COPIED, _FEWEST_CHANGES = 0.5, 50  # share of the rows that changed, and how many: no chance, and not a part alone
# Readings one row apart to _LAGS rows apart differ by twice their variance, to within this part of it, where they have
# no order. In public recordings of motion, with a machine's vibration too, one row came to 0.23 of it at most. Figures
# of 200 rows err by a tenth. Slower sampling misses fast motion, and a sensor at rest has white noise.
_WHITE, _LAGS, _FEWEST_ORDERED, _ORDERED_S = 0.3, 10, 200, 0.021
_SWINGS_M_S2, _SWINGS_RAD_S = 1.0, 0.3  # rms deviation: ten times the MPU-6050's noise at its widest bandwidth
_UPRIGHT = 0.7  # cosine of the slope of the steepest floor, 45°
_SPIKES = 0.001  # share of readings beyond these that are no wrong unit
_TILTS_RAD_S = 0.1  # rms rate about horizontal axes at which gravity turns through the accelerometer's axes
_LONGEST_STEP_S = 0.5
# Of a sensor whose every reading is new, n changes in N readings have about n²/N right after another change. None at
# all, where so many are expected, means that readings are repeated: chance gives e⁻¹⁰.
_FEWEST_SUCCESSIVE = 10.0


class Suspicion(NamedTuple):
    """What is implausible in a recording: the quantity, as its columns are named, and a sentence with the cure."""

    quantity: str
    sentence: str


def suspicions(measurements: Measurements, rate_hz: float | None = None) -> list[Suspicion]:
    """One for each quantity whose values are implausible in the unit of its column, or beside the others.

    The first UNIT_ROWS samples are judged. `rate_hz` is the sample rate in the file's metadata, if it has one.
    """
    measurements = measurements[:UNIT_ROWS]
    is_next = (measurements.flags[1:] & GAP_BEFORE) == 0  # a step over a gap says nothing of the unit
    time = _time(_median(np.diff(measurements.time_s)[is_next]), rate_hz)
    pressure_pa, is_fresh = measurements.pressure_Pa, measurements.baro_fresh
    found = [
        *_imu(measurements, bool(time)),
        *_second_imu(measurements, bool(time)),
        Suspicion("accel", _upright(measurements)),
        Suspicion("gyro", _disordered(measurements)),
        Suspicion("time", time),
        Suspicion("pressure", _pressure(_median(pressure_pa))),
        Suspicion("pressure", _repeated("baro_fresh", "pressure_Pa", is_fresh, pressure_pa[:, None])),
        Suspicion("mag", _repeated("mag_fresh", "mag_*", measurements.mag_fresh, measurements.mag_uT)),
        Suspicion("imu_temp", _temperature("imu_temp_degC", _median(measurements.imu_temp_degC))),
        Suspicion("baro_temp", _temperature("baro_temp_degC", _median(measurements.baro_temp_degC))),
    ]
    return [suspicion for suspicion in found if suspicion.sentence]


def _imu(measurements: Measurements, is_time_wrong: bool) -> list[Suspicion]:
    """On the accelerometer and on the gyro; an empty sentence for none."""
    force_m_s2 = np.linalg.norm(measurements.accel_m_s2, axis=1)
    unit = _of_usual_size("accel_*", _median(force_m_s2), STANDARD_GRAVITY, _ACCEL_UNITS)
    force = unit or _force(measurements)
    rate = _rate(measurements.gyro_rad_s) or ("" if is_time_wrong or force else contradiction(measurements))
    return [Suspicion("accel", force or _gravity(measurements, force_m_s2)), Suspicion("gyro", rate)]


def _second_imu(measurements: Measurements, is_time_wrong: bool) -> list[Suspicion]:
    """On the second inertial sensor, and on whether it is another one than the first."""
    if not measurements.has_imu2:
        return []
    accel, gyro = measurements.accel2_m_s2, measurements.gyro2_rad_s
    found = _imu(replace(measurements, accel_m_s2=accel, gyro_rad_s=gyro), is_time_wrong)
    return [
        *(Suspicion(f"imu2_{name}", re.sub(r"\b(?=(accel|gyro)_[*xyz])", "imu2_", text)) for name, text in found),
        Suspicion("imu2_accel", _copied("accel", measurements.accel_m_s2, accel)),
        Suspicion("imu2_gyro", _copied("gyro", measurements.gyro_rad_s, gyro)),
    ]


def _upright(measurements: Measurements) -> str:
    """A remark if gravity is not along z on a robot, whose turn rate is read from the gyro's z axis."""
    up, force = _median(measurements.accel_m_s2[:, 2]), _median(np.linalg.norm(measurements.accel_m_s2, axis=1))
    if not np.isfinite(measurements.mice_counts).any() or not up < _UPRIGHT * force:
        return ""
    return (
        f"accel_z is {up:.3g} of {force:.3g} m/s² (medians), and on a robot with mice the z axis of the inertial "
        "sensor points up: check its mounting, and the order and the signs of the columns"
    )


def _disordered(measurements: Measurements) -> str:
    """A remark if the readings have no order in time, as where rows were shuffled and the times were not."""
    for values, moves in ((measurements.accel_m_s2, _SWINGS_M_S2), (measurements.gyro_rad_s, _SWINGS_RAD_S)):
        known = values[np.isfinite(values).all(axis=1)]
        variance = np.sum(known.var(axis=0)) if len(known) >= _FEWEST_ORDERED else 0.0
        if not moves**2 < variance < np.inf or not _usual_step(measurements) <= _ORDERED_S:
            return ""
        changes = [np.sum(np.mean((known[lag:] - known[:-lag]) ** 2, axis=0)) for lag in range(1, _LAGS + 1)]
        if np.abs(np.array(changes) / (2 * variance) - 1).max() > _WHITE:
            return ""
    return (
        "accel_* and gyro_* change from row to row as much as over the whole recording: were the rows brought out of "
        "order, and time_s not? Restore their order"
    )


def _copied(name: str, first: Floats, second: Floats) -> str:
    """A remark if two sensors read the same to the last digit, in rows in which the readings change."""
    known = np.isfinite(first + second).all(axis=1)
    first, second = first[known], second[known]
    changed = (np.diff(first, axis=0) != 0).any(axis=1)
    same = changed & (first[1:] == second[1:]).all(axis=1)
    if np.count_nonzero(changed) < _FEWEST_CHANGES or np.count_nonzero(same) < _COPIED * np.count_nonzero(changed):
        return ""
    return (
        f"imu2_{name}_* equals {name}_* in {np.count_nonzero(same)} of {len(first)} rows, which no two sensors do: "
        "were the columns copied?"
    )


def is_negated(measurements: Measurements, j2s_m: Sequence[float]) -> bool:
    """Whether the specific force fits the motion about the joint only with its sign reversed.

    At `j2s_m` from a fixed joint, the specific force is the reaction to gravity plus ω × (ω × J2S) + dω/dt × J2S
    ([Link]). Without this second part, it has the size of gravity.
    """
    step_s = _usual_step(measurements)
    size = max(1, round(_BLOCK_S / step_s)) if np.isfinite(step_s) else 1
    if len(measurements) // size < _FEWEST_BLOCKS or step_s * size > 2 * _BLOCK_S:
        return False
    accel, gyro = _averaged(measurements, size)
    joint = np.asarray(j2s_m, dtype=np.float64)
    change = np.gradient(gyro, size * step_s, axis=0)
    motion = np.cross(gyro, np.cross(gyro, joint)) + np.cross(change, joint)
    as_is, reversed_ = (np.linalg.norm(accel - sign * motion, axis=1) - STANDARD_GRAVITY for sign in (1, -1))
    known = np.isfinite(as_is) & np.isfinite(reversed_)
    if np.count_nonzero(known) < _FEWEST_BLOCKS or _rms(motion[known]) < _MOVES_M_S2:
        return False
    return _rms(reversed_[known]) < 0.5 * _rms(as_is[known])


def _force(measurements: Measurements) -> str:
    """A remark if the accelerometer reads more than its range, or the same in all rows while the sensor tilts."""
    known = np.isfinite(measurements.accel_m_s2).all(axis=1) & np.isfinite(measurements.gyro_rad_s).all(axis=1)
    accel, gyro = measurements.accel_m_s2[known], measurements.gyro_rad_s[known]
    if not len(accel):
        return ""
    sizes = np.abs(accel)
    if np.count_nonzero(sizes.max(axis=1) > _STRONGEST_M_S2) > _SPIKES * len(sizes):
        return (
            f"accel_* is up to {sizes.max():.0f} m/s², more than the sensor reads: check the unit of each axis, which "
            "is m/s²"
        )
    same = np.ptp(accel, axis=0) == 0
    if same.any() and not same.all() and np.ptp(gyro, axis=0).all():  # without noise in either, a simulation of a plane
        names = " and ".join(f"accel_{'xyz'[i]}" for i in np.flatnonzero(same))
        values = " and ".join(dict.fromkeys(f"{accel[0, i] + 0.0:g}" for i in np.flatnonzero(same)))
        return f"{names} is {values} in all rows: the accelerometer gives no reading there"
    force = np.linalg.norm(accel[0])
    if force > 0 and not np.ptp(accel, axis=0).any() and _rms(np.cross(gyro, accel[0] / force)) > _TILTS_RAD_S:
        return "accel_* is the same in all rows while the sensor tilts: the accelerometer gives no reading there"
    return ""


def _gravity(measurements: Measurements, force_m_s2: Floats) -> str:
    """A remark if the specific force at rest is not gravity. A factor of two means that another range was in force."""
    step_s = _usual_step(measurements)
    size = round(_STILL_S / step_s) if step_s > 0 else 0
    if size < 2:
        return ""
    stretches = len(force_m_s2) // size
    turning = np.linalg.norm(measurements.gyro_rad_s, axis=1)[: stretches * size].reshape(stretches, size)
    forces = force_m_s2[: stretches * size].reshape(stretches, size)
    scale = np.median(forces, axis=1, keepdims=True) / STANDARD_GRAVITY  # a wrong range scales the noise too
    still = (turning.max(axis=1) < _STILL_RAD_S) & (forces.std(axis=1) < _STILL_M_S2 * np.maximum(scale[:, 0], 0.1))
    if np.count_nonzero(still) < _FEWEST_STILL:
        return ""
    force = float(np.median(forces[still]))
    if abs(force / STANDARD_GRAVITY - 1) < _GRAVITY_TOLERANCE:
        return ""
    return (
        f"accel_* is {force:.3g} m/s² while the sensor is still, and gravity is {STANDARD_GRAVITY:.2g}: check the "
        "range (accel_range_g) and the unit, or the sensor is faulty"
    )


def _averaged(measurements: Measurements, size: int) -> tuple[Floats, Floats]:
    """Specific force and angular rate (blocks, 3), each the mean of `size` samples."""
    blocks = len(measurements) // size
    accel, gyro = (
        values[: blocks * size].reshape(blocks, size, 3).mean(axis=1)
        for values in (measurements.accel_m_s2, measurements.gyro_rad_s)
    )
    return accel, gyro


def _usual_step(measurements: Measurements) -> float:
    steps = np.diff(measurements.time_s)
    return _median(steps[steps > 0])


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _pressure(median_pa: float) -> str:
    if _MMHG[0] < median_pa < _MMHG[1]:
        return (
            f"pressure_Pa is {median_pa:.4g} (median): is it in mmHg? multiply it by 133.322. If it is in hPa, at 2 to "
            "4 km of altitude, multiply it by 100"
        )
    if 0.5 * _AIR_PA < median_pa < _THIN_AIR_PA:
        return f"pressure_Pa is {median_pa:.0f} (median), as above 5100 m of altitude: check its unit and the sensor"
    return _of_usual_size("pressure_Pa", median_pa, _AIR_PA, _PRESSURE_UNITS, _HEAVIEST)


def _repeated(flag: str, column: str, fresh: NDArray[np.bool_], values: Floats) -> str:
    """A remark if readings are marked as new that repeat the one before: filters would count each of them again."""
    readings = values[fresh & np.isfinite(values).all(axis=1)]
    changes = (np.diff(readings, axis=0) != 0).any(axis=1)
    count = np.count_nonzero(changes)
    if count**2 <= _FEWEST_SUCCESSIVE * len(changes) or (changes[1:] & changes[:-1]).any():
        return ""
    return (
        f"{flag} is 1 in {np.count_nonzero(fresh)} rows, and {column} changes in {count} of them: the others repeat a "
        f"reading. Delete the column {flag}; each change then counts as a reading"
    )


def _temperature(name: str, median_deg_c: float) -> str:
    """A remark where 24.900 °C became 24900: a spreadsheet with decimal commas takes the point for a thousands mark."""
    if not abs(median_deg_c) > _HOTTEST_DEG_C:
        return ""
    return (
        f"{name} is {median_deg_c:.6g} (median), which no sensor measures: has a spreadsheet taken the decimal point "
        "for a separator of thousands? Import the table again with English numbers"
    )


def _median(values: Floats) -> float:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else float("nan")


def _rate(gyro_rad_s: Floats) -> str:
    rates = np.abs(gyro_rad_s[np.isfinite(gyro_rad_s)])
    if np.count_nonzero(rates > _FASTEST_RAD_S) <= _SPIKES * len(rates):
        return ""
    return (
        f"gyro_* is up to {rates.max():.0f} rad/s, more than the sensor reads: is it in °/s? "
        f"multiply it by {np.pi / 180:.7f}"
    )


def _time(median_step_s: float, rate_hz: float | None) -> str:
    steps = f"time_s goes in steps of {median_step_s:g} s (median)"
    if median_step_s > _LONGEST_STEP_S:
        unit, factor = ("milliseconds", 1000) if median_step_s < 1000 * _LONGEST_STEP_S else ("microseconds", 1_000_000)
        if rate_hz is None or 0.5 < median_step_s * rate_hz / factor < 2.0:
            return f"{steps}: is it in {unit}? divide it by {factor}"
    if rate_hz and median_step_s > 0 and not 0.5 < median_step_s * rate_hz < 2.0:
        return (
            f"{steps}, and the file's rate is {rate_hz:g} Hz: multiply time_s by {1 / (median_step_s * rate_hz):.3g}, "
            "or correct sample_rate_hz in line 2"
        )
    return ""


def _of_usual_size(
    name: str, median: float, usual: float, units: Sequence[tuple[str, str]], largest: float = 2.0
) -> str:
    """Names the unit, of (name, factor to the column's), that would bring the median to about its usual value.

    That is, to between half of it and `largest` times it.
    """
    for unit, factor in units:
        if 0.5 < median * float(factor) / usual < largest:
            return f"{name} is {median:.4g} (median), not about {usual:g}: is it in {unit}? multiply it by {factor}"
    return ""
