"""J2S (the vector from the joint centre to the sensor) from a recording of the link in motion, without a reference.

The readings must satisfy the joint's constraint (`joint_constraint`). Least squares estimates J2S together with the
sensor errors: biases, scales, alignment. A calibration leaves 0.2 % of scale error, which alone would stretch J2S by
0.2 %. Gravity makes the scales observable, because its length is known and it turns in the sensor's axes by the angles
that the gyro measures. The prior variance of each group of scales and alignments is the mean square of the estimated
members (empirical Bayes), bounded by the data sheet.

The method is Gauss-Newton with Huber's weights. Each piece of the recording has its own direction of gravity γ, which
is eliminated: within seconds neither the gyro's noise nor a drift of its bias turns γ by much. The first passes use
short pieces, over which a gyro bias of 20 °/s hardly turns γ.

Residuals are correlated (play in the joint, delay of a sensor), so they contain less information than their number
suggests. The variance of the gradients of one-second blocks measures this, and the covariance is widened accordingly.
An error that follows the swing coherently (a support that moves along) does not average out at all; it is added to the
covariance as a share of the residual.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from linkpose.calibration.imu import LARGEST_OFFSET_M_S2, LARGEST_SCALE
from linkpose.calibration.joint_constraint import (
    ACCEL_BIAS,
    ACCEL_MATRIX,
    GYRO_BIAS,
    GYRO_MATRIX,
    J2S,
    LONGEST_STEP_S,
    UNKNOWNS,
    Equations,
    Stretch,
    equations,
    noise_of,
    pieces,
    stretches,
)
from linkpose.calibration.normal_equations import Sums, correlation, huber, in_blocks
from linkpose.errors import LinkposeError
from linkpose.recording.reader import Recording
from linkpose.sensors.measurements import Floats
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import UNKNOWN_JOINT, Imu, Joint, Rig, to_vector

_NO_JOINT_M_S2 = 1.0
LARGE_RESIDUAL_M_S2 = 0.2  # of a joint that moves by centimetres; one with a little play leaves 0.03
_MOVING_RAD_S, _LEAST_MOTION_S = 0.2, 5.0
# σ of J2S along a direction from which on it counts as not observable: a share of ‖d‖, within bounds in metres.
_WEAK_SHARE, _LEAST_WEAK_M, _MOST_WEAK_M = 0.05, 0.005, 0.03
# Share of the residual that may follow the swing and shift J2S. Three trials of a real pendulum with residuals of 0.07
# to 0.19 m/s² disagree by 0.05 m (rms) along the axis that 0.1 gives a σ of 0.02 to 0.05 m. Doubled, the σ of an axis
# that the motion hardly excites doubles.
_COHERENT_SHARE = 0.1
_CLEAR_OF_NOISE = 2.0  # mean square of regressors, in units of that by noise, that is no motion
_UNKNOWN_M = UNKNOWN_JOINT.largest_std_m  # σ along a direction without any motion: that of an unknown J2S
_LEAST_EXCESS = 0.5  # share of the residual that counts even where the sensors' noise explains all of it
_FARTHEST_M = 5.0
_SHORT_PIECES_S, _PIECE_S = (1.0, 1.0, 3.0, 3.0), 8.0
_MOST_PASSES, _SETTLED_M = 20, 1e-5
_HUBER_SIGMAS = 3.0
_GRAVITY_STD_M_S2 = 0.003  # of ‖γ‖ from piece to piece
_LOCAL_GRAVITY = 0.0005  # share by which g differs from the standard's between 38° and 52° of latitude

# Data sheet: zero-rate output ±20 °/s, zero-g output ±50 mg.
_GYRO_BIAS_STD_RAD_S, _ACCEL_BIAS_STD_M_S2 = 0.35, 0.3
# Scale and alignment: groups with a common variance, and its largest standard deviation (data sheet: ±3 %, ±2 %). A
# common rotation of both sensors' axes is not observable: J2S is in the axes halfway between the two sensors'.
_DIAGONAL = np.arange(0, 9, 4)
_OFF_DIAGONAL = np.setdiff1d(np.arange(9), _DIAGONAL)
_GROUPS = (
    (ACCEL_MATRIX + _DIAGONAL, 0.03),
    (GYRO_MATRIX + _DIAGONAL, 0.03),
    (np.concatenate([ACCEL_MATRIX + _OFF_DIAGONAL, GYRO_MATRIX + _OFF_DIAGONAL]), 0.02),
)
_ACCEL_SCALES = _GROUPS[0][0]
_FEWEST_BLOCKS = 4  # into which the recording is cut to measure how far residuals are correlated
_FREE_PASSES = 2  # before the residuals are small enough to measure their correlation
# Largest changes of a calibrated sensor's gyro bias (rad/s), accelerometer offset (m/s²) and scale.
_AS_CALIBRATED = (0.01, 0.15, 0.01)
_FIRST_STD = 0.01
# Of a calibrated sensor, weighted as this many members. With a weight of 2, 93 % of the J2S of 40 simulated sensors
# within the data sheet lay within 2σ, with 1 it is 95 %.
_USUAL_STD, _USUAL_WEIGHT = 0.003, 1.0


SENSOR_ERRORS = (
    "gyro_bias_rad_s",
    "accel_offset_m_s2",
    "accel_scale",
)  # keys of the rig's [imu] that the fit estimates


@dataclass(frozen=True, slots=True)
class JointCalibration:
    """J2S and its covariance. The residual of a good joint is 0.03 m/s² or less.

    `imu` is the rig's with the sensor's bias, offset and scale as the same fit estimates them.
    """

    j2s_m: Floats  # (3,)
    covariance_m2: Floats  # (3, 3)
    residual_m_s2: float  # rms, by axis, of the smoothed specific force that is not explained
    samples: int  # in motion
    imu: Imu

    @property
    def std_m(self) -> Floats:
        """(3,) σ of each axis."""
        return np.sqrt(np.diag(self.covariance_m2))

    @property
    def worst_std_m(self) -> float:
        """σ along the direction that is known least."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance_m2)[-1]))

    @property
    def worst_direction(self) -> Floats:
        """(3,) the direction that is known least, a unit vector in the sensor's axes: the axis of a hinge."""
        return np.asarray(np.linalg.eigh(self.covariance_m2)[1][:, -1])

    @property
    def weak_axis(self) -> int | None:
        """0, 1 or 2: the axis nearest to a direction along which J2S is not observable; None if all are."""
        is_weak = self.worst_std_m > weak_std_m(float(np.linalg.norm(self.j2s_m)))
        return int(np.argmax(np.abs(self.worst_direction))) if is_weak else None

    def as_dict(self) -> dict[str, Any]:
        """The object that `calibrate joint --json` prints: J2S, and the sensor errors that the same fit estimated."""
        limit = weak_std_m(float(np.linalg.norm(self.j2s_m)))
        return {
            "j2s_m": self.j2s_m.tolist(),
            "std_m": self.std_m.tolist(),
            "observable": (self.std_m <= limit).tolist(),
            "worst_std_m": self.worst_std_m,
            "worst_direction": self.worst_direction.tolist(),
            "residual_m_s2": self.residual_m_s2,
            "samples": self.samples,
        } | {name: getattr(self.imu, name) for name in SENSOR_ERRORS}


def weak_std_m(length_m: float) -> float:
    """σ (m) from which on a direction of a J2S of this length counts as not observable."""
    return min(max(_WEAK_SHARE * length_m, _LEAST_WEAK_M), _MOST_WEAK_M)


def with_calibration(rig: Rig, found: JointCalibration, with_imu: bool) -> Rig:
    """The rig with J2S, and on request the sensor's errors; everything else as it was.

    The standard deviation is the largest of the axes, or one for each axis if J2S is not observable along all.
    """
    std_m = np.maximum(np.round(found.std_m, 5), 1e-5)
    joint = Joint(to_vector(found.j2s_m, 5), float(std_m.max()) if found.weak_axis is None else to_vector(std_m))
    return replace(rig, joint=joint, imu=found.imu if with_imu else rig.imu)


def is_calibrated(imu: Imu, found: JointCalibration) -> bool:
    """Whether the sensor errors that the fit estimates agree with the rig's calibration."""
    before, after = (
        np.array([i.gyro_bias_rad_s, i.accel_offset_m_s2, i.accel_scale], dtype=np.float64) for i in (imu, found.imu)
    )
    return bool((np.abs(after - before).max(axis=1) <= _AS_CALIBRATED).all())


def calibrate_joint(recordings: Sequence[Recording], rig: Rig) -> JointCalibration:
    """J2S from all recordings together.

    A direction that the motion does not excite has a large σ. Raises LinkposeError where more than one direction is
    not observable, where nothing moves, or where the readings fit no joint.
    """
    parts = [stretch for r in recordings for stretch in stretches(r.measurements, rig.imu)]
    if not any(True for part in parts for _ in pieces(part, _PIECE_S)):
        names = ", ".join(str(r.path) for r in recordings)
        raise LinkposeError(f"{names}: nowhere is a second with {1 / LONGEST_STEP_S:.0f} samples or more; record again")
    unknowns, whole, residual = _fit(parts)
    samples = _samples_in_motion(parts, unknowns[GYRO_BIAS:ACCEL_BIAS])
    d, covariance = unknowns[J2S:GYRO_BIAS], whole[J2S:GYRO_BIAS, J2S:GYRO_BIAS]
    covariance = covariance + _LOCAL_GRAVITY**2 * np.outer(d, d) + _coherent_errors(parts, unknowns, residual, rig.imu)
    found = JointCalibration(d, covariance, residual, samples, _with_errors(rig.imu, unknowns))
    _refuse_unobservable(found)
    _refuse_impossible(found)
    return found


def _coherent_errors(parts: Sequence[Stretch], unknowns: Floats, residual: float, imu: Imu) -> Floats:
    """Covariance (3, 3) (m²) of J2S by a share of the residual that is proportional to its regressors.

    The rms of the regressors along a direction, s (1/s²), divides an error of r (m/s²) that follows them: r / s. The
    part of r that the sensors' noise explains does not follow them. The part of s that the gyro's noise explains is no
    motion: along a direction without any other, J2S is unknown.
    """
    squares, count, by_force, by_rate = np.zeros((3, 3)), 0, 0.0, 0.0
    for piece in (piece for part in parts for piece in pieces(part, _PIECE_S)):
        jacobian = equations(piece, unknowns).jacobian[:, :, J2S:GYRO_BIAS]
        centred = jacobian - jacobian.mean(axis=0)
        squares += np.einsum("nip,niq->pq", centred, centred)
        force, rate = noise_of(piece, imu)
        by_force, by_rate, count = (
            by_force + len(jacobian) * force,
            by_rate + len(jacobian) * rate,
            count + len(jacobian),
        )
    d = unknowns[J2S:GYRO_BIAS]
    excess = max(residual**2 - (by_force + by_rate * float(d @ d)) / count, (_LEAST_EXCESS * residual) ** 2)
    coherent = _COHERENT_SHARE**2 * excess
    values, vectors = np.linalg.eigh(squares / (3 * count))
    clear = np.maximum(values - _CLEAR_OF_NOISE * by_rate / count, coherent / _UNKNOWN_M**2)
    return np.asarray(vectors @ np.diag(coherent / clear) @ vectors.T)


def _with_errors(imu: Imu, unknowns: Floats) -> Imu:
    """The rig's calibration, corrected by the errors that the fit estimates of the calibrated readings."""
    scale = np.array(imu.accel_scale)
    return replace(
        imu,
        gyro_bias_rad_s=to_vector(np.array(imu.gyro_bias_rad_s) + unknowns[GYRO_BIAS:ACCEL_BIAS]),
        accel_offset_m_s2=to_vector(np.array(imu.accel_offset_m_s2) + scale * unknowns[ACCEL_BIAS:ACCEL_MATRIX]),
        accel_scale=to_vector(scale / (1 - unknowns[_ACCEL_SCALES])),
    )


def _samples_in_motion(parts: Iterable[Stretch], gyro_bias: Floats) -> int:
    """Number of samples in motion. Raises LinkposeError where they are too few."""
    samples, seconds = 0, 0.0
    for part in parts:
        moving = np.linalg.norm(part.rate - gyro_bias, axis=1) > _MOVING_RAD_S
        samples += int(moving.sum())
        seconds += float(np.diff(part.time_s)[moving[1:]].sum())
    if seconds < _LEAST_MOTION_S:
        raise LinkposeError(
            f"only {seconds:.1f} s show motion; swing the link for half a minute or more, in all directions"
        )
    return samples


def _refuse_unobservable(found: JointCalibration) -> None:
    """A rotation about one axis leaves J2S unknown along this axis alone; two unknown directions are no result."""
    std = float(np.sqrt(np.linalg.eigvalsh(found.covariance_m2)[1]))
    if std <= _MOST_WEAK_M:
        return
    if found.residual_m_s2 > LARGE_RESIDUAL_M_S2:
        raise _no_joint(found.residual_m_s2)
    raise LinkposeError(
        f"the motion is too slow or too short to find J2S: two of its three directions are known to {std:.2f} m or "
        "worse; swing the link faster and in all directions"
    )


def _refuse_impossible(found: JointCalibration) -> None:
    if found.residual_m_s2 > _NO_JOINT_M_S2 or np.linalg.norm(found.j2s_m) > _FARTHEST_M:
        raise _no_joint(found.residual_m_s2)
    offset, scale = np.array(found.imu.accel_offset_m_s2), np.array(found.imu.accel_scale)
    if np.abs(offset).max() > LARGEST_OFFSET_M_S2 or np.abs(scale - 1).max() > LARGEST_SCALE:
        raise LinkposeError(
            f"the fit needs an accelerometer with an offset of {np.round(offset, 2)} m/s² and a scale of "
            f"{np.round(scale, 3)}, which no MPU-6050 has: is the joint fixed, the sensor firmly on the link, and the "
            "range right?"
        )


def _no_joint(residual: float) -> LinkposeError:
    return LinkposeError(
        f"the readings fit no joint that stays in its place ({residual:.1f} m/s² rms are left over): fix the joint, "
        "and the sensor firmly on the link"
    )


def _fit(parts: Sequence[Stretch]) -> tuple[Floats, Floats, float]:
    """The unknowns (UNKNOWNS,), their covariance, and the residual's rms (m/s²)."""
    unknowns, spread, worth, scale = np.zeros(UNKNOWNS), np.full(len(_GROUPS), _FIRST_STD**2), 1.0, 1.0
    for number, longest_s in enumerate((*_SHORT_PIECES_S, *[_PIECE_S] * _MOST_PASSES)):
        sums = _normal_equations([equations(p, unknowns) for part in parts for p in pieces(part, longest_s)], scale)
        normal, prior = sums.normals.sum(axis=0), _prior(spread)
        first = number < _FREE_PASSES
        worth = 1.0 if first else correlation(sums, normal + worth * np.diag(prior), _FEWEST_BLOCKS)
        # The readings' density: without it, a fit could reduce its residuals by shrinking the readings.
        volume = np.zeros(UNKNOWNS)
        volume[_ACCEL_SCALES] = sums.equations / (1 - unknowns[_ACCEL_SCALES])
        curvature = volume**2 / max(sums.equations, 1.0)
        covariance: Floats = np.linalg.inv((normal + np.diag(curvature)) / worth + np.diag(prior))
        change = covariance @ ((sums.gradients.sum(axis=0) - volume) / worth - prior * unknowns)
        unknowns = unknowns + change
        scale = max(1.4826 * float(np.median(np.abs(sums.residual))), 1e-4)
        spread = spread if first else _spreads(unknowns, covariance, spread)
        if number > len(_SHORT_PIECES_S) and np.abs(change[J2S:GYRO_BIAS]).max() < _SETTLED_M:
            break
    return unknowns, covariance, float(np.sqrt(np.mean(sums.residual**2)))


def _normal_equations(parts: Sequence[Equations], scale: float) -> Sums:
    """Sums over the pieces, `scale` (m/s²) being the usual residual.

    Eliminating γ removes the means of a piece, and leaves one equation for the length of the mean.
    """
    block_normals, gradients, residuals, number = [], [], [], 0.0
    for gravity, jacobian, apart_s in parts:
        mean, residual, weight = _mean_gravity(gravity, scale)
        residuals.append(residual)
        number += float(weight.sum())
        weight = weight / scale**2
        mean_jacobian = np.tensordot(weight / weight.sum(), jacobian, 1)
        centred = jacobian - mean_jacobian
        for normal, gradient in in_blocks(centred, weight, residual, len(gravity) * apart_s):
            block_normals.append(normal)
            gradients.append(gradient)
        length = max(float(np.linalg.norm(mean)), 1e-9)
        row, known = mean / length @ mean_jacobian, 1 / (_GRAVITY_STD_M_S2**2 + 1 / weight.sum())
        block_normals.append(known * np.outer(row, row))
        gradients.append(known * (STANDARD_GRAVITY - length) * row)
    return Sums(np.array(block_normals), np.array(gradients), np.concatenate(residuals), number)


def _mean_gravity(gravity: Floats, scale: float) -> tuple[Floats, Floats, Floats]:
    """The robust mean (3,) of γ (M, 3) in a piece, the residuals (M, 3), and their weights (M,), up to 1."""
    mean = np.median(gravity, axis=0)
    for _ in range(5):
        weight = huber(gravity - mean, _HUBER_SIGMAS * scale)
        mean = weight @ gravity / weight.sum()
    return mean, gravity - mean, weight


def _prior(spread: Floats) -> Floats:
    """(UNKNOWNS,) Inverse variances about zero."""
    prior = np.full(UNKNOWNS, 1 / _FARTHEST_M**2)
    prior[GYRO_BIAS:ACCEL_BIAS] = 1 / _GYRO_BIAS_STD_RAD_S**2
    prior[ACCEL_BIAS:ACCEL_MATRIX] = 1 / _ACCEL_BIAS_STD_M_S2**2
    for (members, _), variance in zip(_GROUPS, spread, strict=True):
        prior[members] = 1 / variance
    return prior


def _spreads(unknowns: Floats, covariance: Floats, spread: Floats) -> Floats:
    """Variance of each group's members as estimated; members without information do not count (MacKay's update)."""
    found = []
    for (members, largest), variance in zip(_GROUPS, spread, strict=True):
        informed = len(members) - float(np.diag(covariance)[members].sum()) / variance
        squares = float((unknowns[members] ** 2).sum())
        found.append(min((_USUAL_WEIGHT * _USUAL_STD**2 + squares) / (_USUAL_WEIGHT + informed), largest**2))
    return np.array(found)
