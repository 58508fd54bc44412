"""J2S from a recording of the link in motion, with no other reference.

The joint's constraint is asked of the readings themselves (`joint_constraint`), and J2S is found by least squares
together with how the sensors err: biases, scales, alignment. A calibration leaves 0.2 % of scale, which would stretch
J2S by as much; but gravity, whose length is known, turns in the sensor's axes by the angles that the gyro tells, and so
shows the scales. By how much scale and alignment may err is asked of the recording as well: each group's variance is
that of its members as they are found (empirical Bayes), within what the data sheet allows.

Gauss-Newton, with Huber's weights. Gravity's direction γ is each piece's own, and is eliminated: over some seconds
neither the gyro's noise nor its wandering bias turns it by much. The first passes take short pieces, over which a gyro
bias of 20 °/s leaves γ nearly in its place.

What the residuals have in common from one to the next (a joint with play, a sensor that lags) makes them worth less
than their number. That is measured on the gradients of blocks of a second, and the variance is widened by it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

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
    pieces,
    stretches,
)
from linkpose.errors import LinkposeError
from linkpose.recording.reader import Recording
from linkpose.sensors.measurements import Floats
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Imu, Joint, Rig, to_vector

_NO_JOINT_M_S2 = 1.0
LARGE_RESIDUAL_M_S2 = 0.2  # what a joint that moves by centimetres leaves; one with a little play leaves 0.03
_MOVING_RAD_S, _LEAST_MOTION_S = 0.2, 5.0
_WORST_STD_M, _WORST_SHARE = 0.03, 0.05  # of an axis that the motion does not tell: metres, share of ‖d‖
_FARTHEST_M = 5.0
_SHORT_PIECES_S, _PIECE_S = (1.0, 1.0, 3.0, 3.0), 8.0
_MOST_PASSES, _SETTLED_M = 20, 1e-5
_HUBER_SIGMAS = 3.0
_BLOCK_S = 1.0
_GRAVITY_STD_M_S2 = 0.003  # of ‖γ‖ from piece to piece
_LOCAL_GRAVITY = 0.0005  # share by which g differs from the standard's between 38° and 52° of latitude

# Data sheet: zero-rate output ±20 °/s, zero-g output ±50 mg.
_GYRO_BIAS_STD_RAD_S, _ACCEL_BIAS_STD_M_S2 = 0.35, 0.3
# Scale and alignment: who errs alike, and the largest standard deviation (data sheet: ±3 %, ±2 %). What both sensors'
# axes are turned by together shows nowhere: J2S is then in the axes halfway between the two sensors'.
_DIAGONAL = np.arange(0, 9, 4)
_OFF_DIAGONAL = np.setdiff1d(np.arange(9), _DIAGONAL)
_GROUPS = (
    (ACCEL_MATRIX + _DIAGONAL, 0.03),
    (GYRO_MATRIX + _DIAGONAL, 0.03),
    (np.concatenate([ACCEL_MATRIX + _OFF_DIAGONAL, GYRO_MATRIX + _OFF_DIAGONAL]), 0.02),
)
_ACCEL_SCALES = _GROUPS[0][0]
_FREE_PASSES = 2  # before the residuals tell anything of themselves
_AS_CALIBRATED = (0.01, 0.15, 0.01)  # gyro bias (rad/s), accelerometer offset (m/s²) and scale: off by no more
_FIRST_STD = 0.01
_USUAL_STD, _USUAL_WEIGHT = 0.003, 2.0  # of a calibrated sensor, worth so many members


SENSOR_ERRORS = ("gyro_bias_rad_s", "accel_offset_m_s2", "accel_scale")  # of the rig's [imu], which the fit estimates


@dataclass(frozen=True, slots=True)
class JointCalibration:
    """What was found. The residual of a good joint is 0.03 m/s² or less.

    `imu` is the rig's with the sensor's bias, offset and scale as the same fit has them.
    """

    j2s_m: Floats  # (3,)
    std_m: Floats  # (3,)
    residual_m_s2: float  # rms, by axis, of the smoothed specific force that is not explained
    samples: int  # in motion
    imu: Imu

    def as_dict(self) -> dict[str, Any]:
        """The object that `calibrate joint --json` prints: J2S, and the sensor errors that the same fit estimated."""
        fit = {"j2s_m": self.j2s_m.tolist(), "std_m": self.std_m.tolist(), "residual_m_s2": self.residual_m_s2}
        return fit | {"samples": self.samples} | {name: getattr(self.imu, name) for name in SENSOR_ERRORS}


class _Sums(NamedTuple):
    """Normal equations at some unknowns, gravity's directions eliminated, in blocks."""

    normals: Floats  # (B, UNKNOWNS, UNKNOWNS)
    gradients: Floats  # (B, UNKNOWNS), downhill
    residual: Floats  # (M, 3) m/s²
    equations: float  # how many, less what the robust weights take


def with_calibration(rig: Rig, found: JointCalibration, with_imu: bool) -> Rig:
    """The rig with J2S, and on request the sensor's errors, as they were found; the rest of it as it was."""
    joint = Joint(to_vector(found.j2s_m, 5), round(float(found.std_m.max()), 5))
    return replace(rig, joint=joint, imu=found.imu if with_imu else rig.imu)


def is_calibrated(imu: Imu, found: JointCalibration) -> bool:
    """Whether what was found of the sensor's errors is next to what was known of them."""
    before, after = (
        np.array([i.gyro_bias_rad_s, i.accel_offset_m_s2, i.accel_scale], dtype=np.float64) for i in (imu, found.imu)
    )
    return bool((np.abs(after - before).max(axis=1) <= _AS_CALIBRATED).all())


def calibrate_joint(recordings: Sequence[Recording], rig: Rig) -> JointCalibration:
    """J2S from all recordings together. Raises LinkposeError, naming the axis, for a motion that does not tell it."""
    parts = [stretch for r in recordings for stretch in stretches(r.measurements, rig.imu)]
    if not any(True for part in parts for _ in pieces(part, _PIECE_S)):
        names = ", ".join(str(r.path) for r in recordings)
        raise LinkposeError(f"{names}: nowhere is a second with {1 / LONGEST_STEP_S:.0f} samples or more; record again")
    unknowns, covariance, residual = _fit(parts)
    samples = _samples_in_motion(parts, unknowns[GYRO_BIAS:ACCEL_BIAS])
    d, covariance = unknowns[J2S:GYRO_BIAS], covariance[J2S:GYRO_BIAS, J2S:GYRO_BIAS]
    covariance = covariance + _LOCAL_GRAVITY**2 * np.outer(d, d)
    _refuse_weak_axes(d, covariance, residual)
    found = JointCalibration(d, np.sqrt(np.diag(covariance)), residual, samples, _with_errors(rig.imu, unknowns))
    _refuse_impossible(found)
    return found


def _with_errors(imu: Imu, unknowns: Floats) -> Imu:
    """The sensor's calibration with what the readings that it gave still err by."""
    scale = np.array(imu.accel_scale)
    return replace(
        imu,
        gyro_bias_rad_s=to_vector(np.array(imu.gyro_bias_rad_s) + unknowns[GYRO_BIAS:ACCEL_BIAS]),
        accel_offset_m_s2=to_vector(np.array(imu.accel_offset_m_s2) + scale * unknowns[ACCEL_BIAS:ACCEL_MATRIX]),
        accel_scale=to_vector(scale / (1 - unknowns[_ACCEL_SCALES])),
    )


def _samples_in_motion(parts: Iterable[Stretch], gyro_bias: Floats) -> int:
    """How many; raises LinkposeError where they are too few."""
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


def _refuse_weak_axes(d: Floats, covariance: Floats, residual: float) -> None:
    values, vectors = np.linalg.eigh(covariance)
    std, length = float(np.sqrt(values[-1])), float(np.linalg.norm(d))
    if std <= min(_WORST_STD_M, _WORST_SHARE * length):
        return
    if residual > LARGE_RESIDUAL_M_S2:
        raise _no_joint(residual)
    axis = int(np.argmax(np.abs(vectors[:, -1])))
    others = " and ".join(name for i, name in enumerate("xyz") if i != axis)
    raise LinkposeError(
        f"the motion does not tell J2S along the sensor's {'xyz'[axis]} axis (to {std:.3f} m only, of a J2S of "
        f"{length:.2f} m): turn the link about its {others} axes too, and faster"
    )


def _refuse_impossible(found: JointCalibration) -> None:
    if found.residual_m_s2 > _NO_JOINT_M_S2 or np.linalg.norm(found.j2s_m) > _FARTHEST_M:
        raise _no_joint(found.residual_m_s2)
    offset, scale = np.array(found.imu.accel_offset_m_s2), np.array(found.imu.accel_scale)
    if np.abs(offset).max() > LARGEST_OFFSET_M_S2 or np.abs(scale - 1).max() > LARGEST_SCALE:
        raise LinkposeError(
            f"the fit needs an accelerometer with an offset of {np.round(offset, 2)} m/s² and a scale of "
            f"{np.round(scale, 3)}, which no MPU-6050 has: is the joint fixed, and the range set right?"
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
        worth = 1.0 if first else _correlation(sums, normal + worth * np.diag(prior))
        # The readings' density: a fit that shrinks them would shrink its residuals, and be none the better for it.
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


def _normal_equations(parts: Sequence[Equations], scale: float) -> _Sums:
    """Sums over the pieces, `scale` (m/s²) being the usual residual.

    To let γ be what fits a piece best is to take its means off, and leaves one equation on the length of the mean.
    """
    block_normals, gradients, residuals, number = [], [], [], 0.0
    for gravity, jacobian, apart_s in parts:
        mean, residual, weight = _mean_gravity(gravity, scale)
        residuals.append(residual)
        number += float(weight.sum())
        weight = weight / scale**2
        mean_jacobian = np.tensordot(weight / weight.sum(), jacobian, 1)
        centred = jacobian - mean_jacobian
        blocks = max(1, round(len(gravity) * apart_s / _BLOCK_S))
        for rows in np.array_split(np.arange(len(gravity)), blocks):
            j, w = centred[rows], weight[rows]
            block_normals.append(np.einsum("n,nip,niq->pq", w, j, j))
            gradients.append(-np.einsum("n,nip,ni->p", w, j, residual[rows]))
        length = max(float(np.linalg.norm(mean)), 1e-9)
        row, known = mean / length @ mean_jacobian, 1 / (_GRAVITY_STD_M_S2**2 + 1 / weight.sum())
        block_normals.append(known * np.outer(row, row))
        gradients.append(known * (STANDARD_GRAVITY - length) * row)
    return _Sums(np.array(block_normals), np.array(gradients), np.concatenate(residuals), number)


def _mean_gravity(gravity: Floats, scale: float) -> tuple[Floats, Floats, Floats]:
    """Of a piece: the robust mean (3,) of γ (M, 3), the residuals (M, 3), and their weights (M,), up to 1."""
    mean = np.median(gravity, axis=0)
    for _ in range(5):
        residual = gravity - mean
        away = np.linalg.norm(residual, axis=1)
        weight = np.minimum(1.0, _HUBER_SIGMAS * scale / np.maximum(away, 1e-12))
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
    """Variance of each group's members, as they are found; those that are not told do not count (MacKay's update)."""
    found = []
    for (members, largest), variance in zip(_GROUPS, spread, strict=True):
        told = len(members) - float(np.diag(covariance)[members].sum()) / variance
        squares = float((unknowns[members] ** 2).sum())
        found.append(min((_USUAL_WEIGHT * _USUAL_STD**2 + squares) / (_USUAL_WEIGHT + told), largest**2))
    return np.array(found)


def _correlation(sums: _Sums, information: Floats) -> float:
    """By how much the gradients of blocks vary more than those of independent residuals would; 1 or more.

    Σ sᵀ N⁻¹ s over the blocks' gradients s, over what it is expected to be: a block's own normal matrix, less its part
    in what was fitted.
    """
    inverse = np.linalg.inv(information)
    measured = np.einsum("bp,pq,bq->", sums.gradients, inverse, sums.gradients)
    told = inverse @ sums.normals
    expected = np.einsum("bpp->", told) - np.einsum("bpq,bqp->", told, told)
    return max(1.0, float(measured / expected))
