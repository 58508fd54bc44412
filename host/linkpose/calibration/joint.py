"""J2S from a recording of the link in motion, with no other reference.

The tilt has length 1, so whatever it is, ‖s_A − ([ω̇×] + [ω×][ω×]) d‖ = g at every sample: three unknowns in as many
equations as there are samples. Gauss-Newton from d = 0, on samples smoothed without a lag, with Huber's weights. That
tells which axes the motion excites. The joint-inertial filter, which knows the sensors' errors, then refines it.

Source: T. Seel, J. Raisch, T. Schauer, "IMU-based joint angle measurement for gait analysis", Sensors 14(4), 2014, who
compare two sensors where here gravity's length is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.recording.reader import Recording
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Imu, Joint, Rig

_HALF_WINDOW_S = 0.05  # of the parabola that smooths and differentiates
_LONGEST_STEPS = 1.5  # a longer step than so many usual ones splits the recording
_HUBER_M_S2 = 0.3
_WORST_STD_M = 0.03  # of an axis that the motion does not tell
_FEWEST_SAMPLES = 500
_CORRELATED = 20.0  # neighbouring samples that say the same, by the smoothing and by what the model leaves out
_REFINE_FROM_STD_M = 0.05
_REFINE_PASSES = 2
_FARTHEST_M = 5.0
_SCALE_DOUBT = 0.002  # of the sensors' scale, which stretches the lever and shows in no residual


@dataclass(frozen=True, slots=True)
class JointCalibration:
    """What was found. The residual of a calibrated sensor on a good joint is 0.1 m/s² or less."""

    j2s_m: Floats  # (3,)
    std_m: Floats  # (3,)
    residual_m_s2: float  # rms of ‖s_A − K d‖ − g
    samples: int


def with_calibration(rig: Rig, found: JointCalibration) -> Rig:
    """The rig with J2S as it was found; the rest of it as it was."""
    x, y, z = (round(float(value), 5) for value in found.j2s_m)
    return replace(rig, joint=Joint((x, y, z), round(float(found.std_m.max()), 5)))


def calibrate_joint(recordings: Sequence[Recording], rig: Rig) -> JointCalibration:
    """J2S from all recordings together. Raises LinkposeError, naming the axis, for a motion that does not tell it."""
    force, k = (np.concatenate(part) for part in zip(*(_equations(r, rig.imu) for r in recordings), strict=True))
    if len(force) < _FEWEST_SAMPLES:
        raise LinkposeError(
            f"only {len(force)} samples show motion; swing the link for half a minute or more, in all directions"
        )
    d, covariance, residual = _gauss_newton(force, k)
    _refuse_weak_axes(covariance)
    d, std = _refine([r.measurements for r in recordings], rig, d)
    if not np.linalg.norm(d) < _FARTHEST_M:
        raise LinkposeError(f"the fit gives a J2S of {np.round(d, 2)} m: is the link on a joint that is fixed?")
    return JointCalibration(d, std, residual, len(force))


def _equations(recording: Recording, imu: Imu) -> tuple[Floats, Floats]:
    """Smoothed forces (N, 3), m/s², and K = [ω̇×] + [ω×][ω×] (N, 3, 3), 1/s², of all unbroken stretches."""
    block = recording.measurements
    force = (block.accel_m_s2 - np.array(imu.accel_offset_m_s2)) / np.array(imu.accel_scale)
    rate = block.gyro_rad_s - np.array(imu.gyro_bias_rad_s)
    usable = np.isfinite(force).all(axis=1) & np.isfinite(rate).all(axis=1)
    time_s, force, rate = block.time_s[usable], force[usable], rate[usable]
    steps = np.diff(time_s)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    breaks = np.flatnonzero((steps > _LONGEST_STEPS * usual) | (steps <= 0)) + 1
    parts = []
    half = max(2, round(_HALF_WINDOW_S / usual)) if usual else 2
    for rows in np.split(np.arange(len(time_s)), breaks):
        if len(rows) > 4 * half:
            parts.append((_smooth(force[rows], half), _smooth(rate[rows], half), _slope(rate[rows], half) / usual))
    if not parts:
        raise LinkposeError(f"{recording.path} has no unbroken stretch of samples; record again")
    force, rate, derivative = (np.concatenate(part) for part in zip(*parts, strict=True))
    moving = np.linalg.norm(rate, axis=1) > 0.2
    w, wd = rate[moving], derivative[moving]
    inward = w[:, :, None] * w[:, None, :] - (w**2).sum(axis=1)[:, None, None] * np.eye(3)
    return force[moving], _cross_matrix(wd) + inward


def _smooth(values: Floats, half: int) -> Floats:
    """Value at the middle of the parabola fitted to 2·half + 1 neighbours: Savitzky and Golay."""
    i = np.arange(-half, half + 1)
    n, s2, s4 = len(i), (i**2).sum(), (i.astype(float) ** 4).sum()
    weight = (s4 - s2 * i**2) / (n * s4 - s2**2)
    return np.column_stack([np.convolve(axis, weight, "valid") for axis in values.T])


def _slope(values: Floats, half: int) -> Floats:
    """Slope, per sample, at the middle of the same parabola."""
    i = np.arange(-half, half + 1)
    weight = i[::-1] / (i**2).sum()
    return np.column_stack([np.convolve(axis, weight, "valid") for axis in values.T])


def _cross_matrix(v: Floats) -> Floats:
    zero = np.zeros(len(v))
    x, y, z = v.T
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _gauss_newton(force: Floats, k: Floats) -> tuple[Floats, Floats, float]:
    """d, its covariance, and the rms residual."""
    d = np.zeros(3)
    for _ in range(50):
        gravity = force - k @ d
        length = np.linalg.norm(gravity, axis=1)
        residual = length - STANDARD_GRAVITY
        jacobian = -np.einsum("ni,nij->nj", gravity / length[:, None], k)
        weight = np.minimum(1.0, _HUBER_M_S2 / np.maximum(np.abs(residual), 1e-12))
        normal = jacobian.T @ (weight[:, None] * jacobian)
        if np.linalg.cond(normal) > 1e12:
            break  # told apart from a good fit by its covariance
        change = -np.linalg.solve(normal, jacobian.T @ (weight * residual))
        d = d + change
        if np.abs(change).max() < 1e-9:
            break
    variance = float(np.average(residual**2, weights=weight)) * _CORRELATED
    values, vectors = np.linalg.eigh(normal)
    covariance = (vectors * (variance / np.maximum(values, 1e-12))) @ vectors.T
    return d, np.asarray(covariance), float(np.sqrt(np.mean(residual**2)))


def _refuse_weak_axes(covariance: Floats) -> None:
    values, vectors = np.linalg.eigh(covariance)
    if np.sqrt(values[-1]) > _WORST_STD_M:
        axis = int(np.argmax(np.abs(vectors[:, -1])))
        others = " and ".join(name for i, name in enumerate("xyz") if i != axis)
        raise LinkposeError(
            f"the motion does not tell J2S along the sensor's {'xyz'[axis]} axis (to {np.sqrt(values[-1]):.2f} m "
            f"only): turn the link about its {others} axes too, and faster"
        )


def _refine(blocks: Sequence[Measurements], rig: Rig, d: Floats) -> tuple[Floats, Floats]:
    """J2S and standard deviations (3,) by the joint-inertial filter, each pass from what the last one found."""
    from linkpose.filters.joint_inertial import JointInertialFilter, JointInertialParameters

    parameters = JointInertialParameters(lever_misfit=0.0)
    for _ in range(_REFINE_PASSES):
        total, weighted = np.zeros((3, 3)), np.zeros(3)
        for block in blocks:
            start = Joint((float(d[0]), float(d[1]), float(d[2])), _REFINE_FROM_STD_M)
            f = JointInertialFilter(Rig(joint=start, imu=rig.imu), parameters)
            f.process(block)
            mean, covariance = f.j2s_m
            information = np.linalg.inv(covariance)
            total, weighted = total + information, weighted + information @ mean
        d = np.asarray(np.linalg.solve(total, weighted), dtype=np.float64)
    variance = np.diag(np.linalg.inv(total)) + _SCALE_DOUBT**2 * (d @ d)
    return d, np.sqrt(variance)
