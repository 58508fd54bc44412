"""Gyro bias, accelerometer offset and scale, and the sensors' noise, from rests.

At rest the gyro reads its bias, and the accelerometer a vector of length g. Rests in six attitudes or more determine
the offset o and the scale k of each axis: ‖(s_A − o) / k‖ = g at every rest, by Gauss-Newton.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from linkpose.calibration.rests import find_rests, stillness
from linkpose.errors import LinkposeError
from linkpose.recording.reader import Recording
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Rig, to_vector
from linkpose.wire.messages import SampleFlags

FEWEST_ATTITUDES = 6
_APART_COSINE = np.cos(np.radians(20.0))  # attitudes nearer to each other than this count as one
LARGEST_OFFSET_M_S2, LARGEST_SCALE = 2.0, 0.1  # beyond these the sensor is no MPU-6050
_LARGEST_BIAS_RAD_S = 0.7  # 40 °/s: twice the data sheet's
_FACING = np.cos(np.radians(45.0))  # an axis within 45° of the vertical points up or down
_MOST_CONDITION = 300.0  # of the equations of offset and scale
# What a calibration leaves, however exact the fit: the zero-rate output of an MPU-6050 returns to 0.05 °/s after it was
# switched off, its zero-g output to 1 mg. Doubled, filters start with twice the uncertainty.
_LEAST_GYRO_STD_RAD_S, _LEAST_OFFSET_STD_M_S2 = 0.0009, 0.01
_WORST_RESIDUAL_M_S2 = 0.1
_SATURATED = int(SampleFlags.ACCEL_SATURATED | SampleFlags.GYRO_SATURATED)
_PIECE_S = 2.0  # of a rest: long compared with the slowest low-pass filter (5 Hz), short compared with warm-up


@dataclass(frozen=True, slots=True)
class FoundImuErrors:
    """Sensor errors and noise. Vectors are by axis; None where the recordings do not show a value."""

    rests: int
    saturated: int  # further rests, left out because a reading is at the end of its range
    attitudes: int
    missing_sides: tuple[str, ...]  # "+x" where no attitude has the x axis upwards
    gyro_bias_rad_s: Floats
    gyro_bias_std_rad_s: float  # each axis: scatter of the rests, and what a calibration leaves
    gyro_noise_rad_s: float
    accel_noise_m_s2: float
    accel_offset_m_s2: Floats | None
    accel_offset_std_m_s2: float | None
    accel_scale: Floats | None
    accel_residual_m_s2: float | None  # rms of ‖(s_A − o) / k‖ − g over the attitudes
    pressure_noise_Pa: float | None

    def as_dict(self) -> dict[str, Any]:
        """The object that `calibrate imu --json` prints; None where the recordings do not show it."""
        values = {name: getattr(self, name) for name in self.__slots__}
        return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}


def calibrate_imu(recordings: Sequence[Recording]) -> FoundImuErrors:
    """The calibration from all rests in the recordings.

    Where the attitudes do not determine offset and scale of the accelerometer, it has the gyro's bias and the noise
    alone. Raises LinkposeError without a rest, and for values that no MPU-6050 has.
    """
    found = [r.measurements[part] for r in recordings for part in find_rests(r.measurements)]
    rests = [rest for rest in found if not (rest.flags & _SATURATED).any()]
    if not rests:
        raise _no_rest(recordings, len(found))
    weights = np.array([len(rest) for rest in rests], dtype=np.float64)
    means = np.array([rest.gyro_rad_s.mean(axis=0) for rest in rests])
    bias = np.average(means, axis=0, weights=weights)
    if np.abs(bias).max() > _LARGEST_BIAS_RAD_S:
        raise LinkposeError(
            f"the gyro reads {np.round(bias, 2)} rad/s at rest, which no MPU-6050 does: does it turn steadily, or is "
            "the range set wrong?"
        )
    gyro_noise = _noise(rests, [rest.gyro_rad_s for rest in rests])
    scatter = np.average(np.square(means - bias).mean(axis=1), weights=weights) + gyro_noise**2 / weights.sum()
    attitudes = _distinct(np.array([rest.accel_m_s2.mean(axis=0) for rest in rests]))
    offset = scale = residual = offset_std = None
    if _determines_all_axes(attitudes):
        offset, scale, residual, offset_std = fit_sphere(attitudes)
    return FoundImuErrors(
        len(rests),
        len(found) - len(rests),
        len(attitudes),
        _missing_sides(attitudes),
        np.asarray(bias),
        float(np.hypot(np.sqrt(scatter), _LEAST_GYRO_STD_RAD_S)),
        gyro_noise,
        _noise(rests, [rest.accel_m_s2 for rest in rests]),
        offset,
        offset_std,
        scale,
        residual,
        _pressure_noise(rests),
    )


def _no_rest(recordings: Sequence[Recording], saturated: int) -> LinkposeError:
    """What lacks: readings within the range, stillness, or time."""
    names = ", ".join(str(r.path) for r in recordings)
    if saturated:
        return LinkposeError(f"{names}: the sensor is saturated at each rest; record with a larger range")
    seen = [s for s in (stillness(r.measurements) for r in recordings) if s is not None]
    if not seen:
        return LinkposeError(f"there is no rest of a second or more in {names}: record the sensor lying still")
    best = max(seen, key=lambda s: s.longest_s)
    if best.longest_s > 0:
        return LinkposeError(
            f"{names}: the longest rest lasts {best.longest_s:.1f} s, too short: leave the sensor on each side for 3 s"
        )
    best = min(seen, key=lambda s: s.accel_std_m_s2)
    return LinkposeError(
        f"{names}: the sensor is never at rest; where it is stillest, the accelerometer varies by "
        f"{best.accel_std_m_s2:.2g} m/s² and the gyro by {best.gyro_std_rad_s:.2g} rad/s (1σ): lay it down, away from "
        "running motors"
    )


def with_calibration(rig: Rig, found: FoundImuErrors) -> Rig:
    """The rig with the calibration; everything else as it was."""
    imu = replace(
        rig.imu,
        gyro_bias_rad_s=to_vector(found.gyro_bias_rad_s),
        gyro_bias_std_rad_s=round(found.gyro_bias_std_rad_s, 6),
        gyro_noise_rad_s=found.gyro_noise_rad_s,
        accel_noise_m_s2=found.accel_noise_m_s2,
    )
    if found.accel_offset_m_s2 is not None and found.accel_scale is not None:
        imu = replace(
            imu,
            accel_offset_m_s2=to_vector(found.accel_offset_m_s2),
            accel_offset_std_m_s2=round(found.accel_offset_std_m_s2 or _LEAST_OFFSET_STD_M_S2, 5),
            accel_scale=to_vector(found.accel_scale),
        )
    baro = rig.baro if found.pressure_noise_Pa is None else replace(rig.baro, pressure_noise_Pa=found.pressure_noise_Pa)
    return replace(rig, imu=imu, baro=baro)


def fit_sphere(forces: Floats) -> tuple[Floats, Floats, float, float]:
    """Offset and scale (3,) that put the mean forces (N, 3) of N attitudes on the sphere of radius g.

    The third value is the rms residual, the fourth σ of the offset, each axis (m/s²). Raises LinkposeError where the
    attitudes do not determine all axes, or the result is impossible.
    """
    offset, scale = np.zeros(3), np.full(3, np.linalg.norm(forces, axis=1).mean() / STANDARD_GRAVITY)
    for _ in range(20):
        length, jacobian = _sphere(forces, offset, scale)
        if np.linalg.cond(jacobian) > _MOST_CONDITION:
            raise LinkposeError(
                "the attitudes do not determine all axes: lay the sensor on each of its six sides, and record them"
            )
        change = np.linalg.lstsq(jacobian, STANDARD_GRAVITY - length, rcond=None)[0]
        offset, scale = offset + change[:3], scale + change[3:]
        if np.abs(change).max() < 1e-12:
            break
    residual = float(np.sqrt(np.mean((np.linalg.norm((forces - offset) / scale, axis=1) - STANDARD_GRAVITY) ** 2)))
    if np.abs(offset).max() > LARGEST_OFFSET_M_S2 or np.abs(scale - 1).max() > LARGEST_SCALE:
        raise LinkposeError(
            f"the rests give an offset of {np.round(offset, 2)} m/s² and a scale of {np.round(scale, 3)}, which no "
            "MPU-6050 has: did it move slowly, or is the range set wrong?"
        )
    if residual > _WORST_RESIDUAL_M_S2:
        raise LinkposeError(
            f"the rests do not fit one sphere (residual {residual:.2f} m/s² rms): keep the sensor still at each"
        )
    freedom = max(len(forces) - 6, 1)
    variances = np.diag(np.linalg.inv(jacobian.T @ jacobian))[:3] * residual**2 * len(forces) / freedom
    return offset, scale, residual, float(np.sqrt(variances.mean() + _LEAST_OFFSET_STD_M_S2**2))


def _sphere(forces: Floats, offset: Floats, scale: Floats) -> tuple[Floats, Floats]:
    """Lengths (N,) of the calibrated forces, and their derivatives (N, 6) by offset and scale."""
    true = (forces - offset) / scale
    length = np.linalg.norm(true, axis=1)
    along = true / length[:, None]
    return length, np.hstack([-along / scale, -along * true / scale])


def _determines_all_axes(forces: Floats) -> bool:
    enough = len(forces) >= FEWEST_ATTITUDES
    return enough and bool(np.linalg.cond(_sphere(forces, np.zeros(3), np.ones(3))[1]) <= _MOST_CONDITION)


def _missing_sides(forces: Floats) -> tuple[str, ...]:
    """Sides, in the sensor's axes, that point up in none of the attitudes (M, 3)."""
    up = forces / np.linalg.norm(forces, axis=1, keepdims=True)
    return tuple(
        f"{'+-'[k]}{'xyz'[axis]}"
        for axis in range(3)
        for k, sign in enumerate((1.0, -1.0))
        if not (sign * up[:, axis] > _FACING).any()
    )


def _distinct(forces: Floats) -> Floats:
    """One mean force for each attitude (M, 3)."""
    groups: list[list[Floats]] = []
    for force in forces:
        for group in groups:
            if force @ group[0] > _APART_COSINE * np.linalg.norm(force) * np.linalg.norm(group[0]):
                group.append(force)
                break
        else:
            groups.append([force])
    return np.array([np.mean(group, axis=0) for group in groups])


def _noise(rests: Sequence[Measurements], readings: Sequence[Floats]) -> float:
    """Standard deviation of one sample about a line through each piece of a rest, which removes a slow drift.

    Differences of neighbours would be too small, because the sensor's low-pass filter correlates them.
    """
    squares, freedom = 0.0, 0
    for rest, values in zip(rests, readings, strict=True):
        span = float(rest.time_s[-1] - rest.time_s[0])
        for piece in np.array_split(np.arange(len(rest)), max(1, round(span / _PIECE_S))):
            at, apart = rest.time_s[piece], values[piece]
            at, apart = at - at.mean(), apart - apart.mean(axis=0)
            left = apart - np.outer(at, at @ apart / (at @ at))
            squares += float((left**2).sum())
            freedom += 3 * (len(piece) - 2)
    return max(float(np.sqrt(squares / freedom)), 1e-6)


def _pressure_noise(rests: Sequence[Measurements]) -> float | None:
    steps = [np.diff(rest.pressure_Pa[rest.baro_fresh]) for rest in rests]
    together = np.concatenate(steps)
    together = together[np.isfinite(together)]
    return max(float(np.sqrt(np.mean(together**2) / 2)), 0.1) if len(together) >= 20 else None
