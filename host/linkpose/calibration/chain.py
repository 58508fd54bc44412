"""Mounting of two sensors on two links (r_1, r_2, the axis of a hinge) from a recording of the links in motion.

r_k is the vector from the centre of the joint between the links to sensor k, in the sensor's axes. Seen from either
sensor, the specific force at the joint's centre is the same vector:

    γ_1(t) = R γ_2(t),    γ_k = ∫ w C_k f_k dt + ∫ ẇ C_k (ω_k × r_k) dt

with the weights w and the integrated rotations C_k of `joint_constraint`, and the rotation R from sensor 2's axes into
sensor 1's at the start of a piece of the recording. Each piece has its own R, which is eliminated, so a drift of the
heading between the two sensors has no effect. Least squares estimates r_1 and r_2 together with the errors of both
sensors, with Huber's weights; residuals are correlated, and the covariance is widened as in `joint`.

A hinge keeps its axis in the same direction in both links. The axes j_1 and j_2 that do so best, over all pieces, and
the angle that they leave (the play) show the kind of the joint.

Sources: the constraint is (5) of M. Kok, K. Eckhoff, I. Weygers, T. Seel, "Observability of the relative motion from
inertial data in kinematic chains", Control Engineering Practice 125, 2022, in the weak form of `joint_constraint`;
T. Seel, J. Raisch, T. Schauer, "IMU-based joint angle measurement for gait analysis", Sensors 14(4), 2014, 3.3, for the
point on a hinge's axis; F. Olsson et al., "Robust plug-and-play joint axis estimation using inertial sensors", Sensors
20(12), 2020, for what motion an axis needs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from linkpose.calibration.hinge import AXIS_STEP_S, HingeMotion, Rotations, best_hinge
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
    attitudes,
    cross_matrices,
    equations,
    paired_stretches,
    pieces,
)
from linkpose.calibration.normal_equations import Sums, correlation, huber, in_blocks
from linkpose.calibration.rests import find_rests
from linkpose.errors import LinkposeError
from linkpose.recording.reader import Recording
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Rig, Vector, to_vector

Kind = Literal["ball", "hinge"]

_SHORT_PIECES_S, _PIECE_S = (1.0, 1.0, 3.0, 3.0), 8.0  # as in `joint`: short ones before the gyro biases are known
_MOST_PASSES, _SETTLED_M = 10, 1e-4
_MOST_PIECES = 75  # 10 minutes of a longer recording
_FREE_PASSES = 2  # before the residuals are small enough to measure their correlation
_HUBER_SIGMAS = 3.0
# Prior standard deviations: r_k of people and robots (m); data sheet of [MPU-6050]: ±20 °/s, ±50 mg, 3 %, 2 %.
LEVER_STD_M = 0.5
_PRIOR_STD = {J2S: LEVER_STD_M, GYRO_BIAS: 0.35, ACCEL_BIAS: 0.3, ACCEL_MATRIX: 0.017, GYRO_MATRIX: 0.017}
# Slow, by scale and cross-axis errors: as in the filter `chain`. An axis of a slow robot arm that depends on the
# relative heading is wrong by 20° to 29° at σ of 26° to 35°. Doubled, this σ is 36° to 40°; σ of axes that the gyros
# give stays.
_ACCEL_ERROR_M_S2 = 0.1
# A gyro bias from rests: its drift until the motion, and the largest rate that is not a slow turn (rad/s).
_REST_STD_RAD_S, _MOST_REST_RAD_S = 0.003, 0.1
_ACCEL_SCALES = np.concatenate([first + ACCEL_MATRIX + np.arange(0, 9, 4) for first in (0, UNKNOWNS)])
_LEVERS = [*range(J2S, GYRO_BIAS), *range(UNKNOWNS + J2S, UNKNOWNS + GYRO_BIAS)]
_TURN_STD_RAD = 1.0  # of a piece's rotation about a direction that its forces do not show
_UNKNOWN_HEADING_RAD = float(np.pi / np.sqrt(3.0))  # σ of a heading that is uniform all around
_MOVING_RAD_S, _LEAST_MOTION_S = 0.2, 5.0
# Residuals: real chains leave 0.01 to 0.1 m/s², a shaft with a vibrating motor 0.6; two unrelated sensors leave more
# than 3. Doubled, sensors on links that slide against each other are accepted.
LARGE_RESIDUAL_M_S2, _NO_JOINT_M_S2 = 0.5, 3.0
# Share of the residual that may follow the motion and shift r_k. On diodem_chain, whose residuals are 0.01 to 0.07
# m/s², results from four starting times differ by as much as 0.2 predicts. Doubled, σ of a clear direction doubles.
_COHERENT_SHARE = 0.2
_STILL_RAD_S = 0.05  # rms rate below which a sensor does not turn: its noise, and the trembling of a hand
# Difference from a rig's r1 and r2 that a sensor taken off and put on again has (m); 99.9 % of χ² with 6 degrees.
_SAME_M, _CHI2_6 = 0.02, 22.5
WEAK_M = 0.03  # σ of r_k along a direction from which on it counts as not observable

# Kind of the joint, by the rms rotation about the best axis and the rms angle that this axis leaves (its play).
LEAST_TURN_DEG = 5.0  # smaller motion shows nothing
_HINGE_RATIO = 0.15  # of play to rotation: the hinges of diodem_chain have up to 0.08, with soft parts
_BALL_RATIO = 0.3  # from which on it is no play of a hinge
_DRIFT_SIGMAS = 2.0  # of the play that wrong gyro biases cause: less play does not show a ball joint
WEAK_AXIS_DEG = 15.0  # σ of an axis from which on it counts as not observable
_TURNS_ITSELF = 0.3  # share of the other sensor's rate from which on a sensor's own rate gives its axis


@dataclass(frozen=True, slots=True)
class ChainCalibration:
    """Mounting of both sensors, and the kind of the joint between them."""

    joint: Kind | None  # None: the motion does not show it
    motion: HingeMotion  # of a hinge that explains it best
    levers_m: Floats  # (2, 3) r_1 and r_2
    covariance_m2: Floats  # (6, 6) of both
    residual_m_s2: float  # rms, by axis, of the force at the joint's centre that the two sensors do not agree on
    samples: int  # in motion
    turning_rad_s: tuple[float, float]  # rms rate of either sensor while one of them moves

    @property
    def std_m(self) -> Floats:
        """(2, 3) σ of each component of r_1 and r_2."""
        return np.asarray(np.sqrt(np.diag(self.covariance_m2)).reshape(2, 3))

    @property
    def axes(self) -> Floats | None:
        """(2, 3) the axis of a hinge in either sensor's axes; None where there is none, or none observable."""
        shown = self.joint == "hinge" and self.motion.std_deg.max() < WEAK_AXIS_DEG
        return self.motion.axes if shown else None

    def as_dict(self) -> dict[str, Any]:
        """The object that `calibrate chain --json` prints."""
        found: dict[str, Any] = {"joint": self.joint}
        found |= {"turn_deg": self.motion.turn_deg, "play_deg": self.motion.play_deg}
        for k in range(2):
            found |= {
                f"r{k + 1}_m": self.levers_m[k].tolist(),
                f"r{k + 1}_std_m": self.std_m[k].tolist(),
                f"r{k + 1}_observable": (self.std_m[k] <= WEAK_M).tolist(),
            }
        for k in range(2 * (self.joint == "hinge")):
            found[f"axis{k + 1}"] = self.axes[k].tolist() if self.axes is not None else None
            found[f"axis{k + 1}_std_deg"] = float(self.motion.std_deg[k])
        return found | {"residual_m_s2": self.residual_m_s2, "samples": self.samples}


class _Piece(NamedTuple):
    """A piece of the recording as both sensors measured it."""

    first: Stretch
    second: Stretch


class _Turned(NamedTuple):
    """The equations of a piece at some unknowns, its rotation R eliminated."""

    rotation: Floats  # (3, 3) R
    residual: Floats  # (M, 3) γ_1 − R γ_2
    jacobian: Floats  # (M, 3, 2 UNKNOWNS)
    information: Floats  # (3, 3) of the error of R, 1/rad², with independent residuals
    apart_s: float


def with_calibration(rig: Rig, found: ChainCalibration) -> Rig:
    """The rig with the mounting; a kind that the motion does not show, and everything else, stay as they were."""
    kind = found.joint or rig.chain.joint
    (r1, r2), (std1, std2) = found.levers_m, map(_std_of, found.std_m)
    chain = replace(rig.chain, joint=kind, r1_m=to_vector(r1, 5), r1_std_m=std1, r2_m=to_vector(r2, 5), r2_std_m=std2)
    chain = replace(chain, axis1=None, axis2=None)
    if kind == "hinge" and found.axes is not None:
        (axis1, axis2), (std1_deg, std2_deg) = found.axes, np.round(found.motion.std_deg, 3).tolist()
        chain = replace(chain, axis1=to_vector(axis1, 5), axis1_std_deg=std1_deg)
        chain = replace(chain, axis2=to_vector(axis2, 5), axis2_std_deg=std2_deg)
    return replace(rig, chain=chain)


def remarks(found: ChainCalibration, stated: Kind | None, before: Rig) -> list[str]:
    """What contradicts the calibration, a sentence each. `stated` is the kind that the user gave, `before` the rig that
    was in force.
    """
    of = []
    shown = _kind(found.motion)
    if stated is not None and shown not in (stated, None):
        words = {"hinge": "a hinge", "ball": "a ball joint"}
        of.append(
            f"The motion is that of {words[shown or stated]}, not of {words[stated]}: the links turn by "
            f"{found.motion.turn_deg:.1f}° rms about the best axis and by {found.motion.play_deg:.1f}° about others. "
            "Leave out --joint, or move only the joint between the two sensors."
        )
    still = [k + 1 for k, rate in enumerate(found.turning_rad_s) if rate < _STILL_RAD_S]
    of += [f"Sensor {k} does not turn, so r{k} is not observable: move both links." for k in still]
    if _are_swapped(found, before):
        of.append(
            "The sensors look swapped: r1 found here is r2 of the rig file, and r2 is r1. Sensor 1 (0x68) belongs on "
            "link 1."
        )
    return of


def _are_swapped(found: ChainCalibration, before: Rig) -> bool:
    """Whether the vectors agree with those that the rig has stated, but in the other order."""
    r1, r2 = before.chain.r1_m, before.chain.r2_m
    if r1 is None or r2 is None:
        return False
    variance = found.covariance_m2 + _SAME_M**2 * np.eye(6)
    straight, swapped = (
        float(off @ np.linalg.solve(variance, off))
        for off in (found.levers_m.ravel() - np.concatenate(order) for order in ((r1, r2), (r2, r1)))
    )
    return swapped < _CHI2_6 < straight


def _std_of(std_m: Floats) -> float | Vector:
    """As a rig file states it: one for all axes, or one for each where r_k is not observable along all."""
    std_m = np.maximum(np.round(std_m, 5), 1e-5)
    return float(std_m.max()) if std_m.max() <= WEAK_M else to_vector(std_m)


def calibrate_chain(recordings: Sequence[Recording], rig: Rig, joint: Kind | None = None) -> ChainCalibration:
    """Mounting and kind of the joint from all recordings together; `joint` states the kind where it is known.

    What the motion does not show has a large σ. Raises LinkposeError where there is no second sensor, where nothing
    moves, or where the readings fit no joint.
    """
    names = ", ".join(str(r.path) for r in recordings)
    if not all(r.measurements.has_imu2 for r in recordings):
        raise LinkposeError(f"{names}: a chain needs a second inertial sensor, and a recording has none")
    parts = [pair for r in recordings for pair in paired_stretches(r.measurements, rig.imu)]
    chosen = _pieces(parts, _PIECE_S)
    if not chosen:
        raise LinkposeError(f"{names}: nowhere is a second with {1 / LONGEST_STEP_S:.0f} samples or more; record again")
    known = _prior(parts)
    fit = _fit(chosen, known)
    samples, turning = _in_motion(parts, fit.unknowns)
    if fit.residual_m_s2 > _NO_JOINT_M_S2:
        raise LinkposeError(
            f"the readings fit no joint between the two sensors ({fit.residual_m_s2:.1f} m/s² rms are left over): fix "
            "each sensor firmly on its own link, on either side of one joint"
        )
    motion = _with_common_errors(_relative_motion(chosen, fit), fit, turning)
    motion = _with_unknown_heading(motion, chosen, fit, turning)
    motion = motion._replace(drift_deg=_drift_deg(chosen, fit, known))
    kind = joint or _kind(motion)
    levers = fit.unknowns[_LEVERS].reshape(2, 3)
    covariance = fit.covariance[np.ix_(_LEVERS, _LEVERS)] + _coherent_errors(chosen, fit)
    if kind == "hinge" and motion.std_deg.max() < WEAK_AXIS_DEG:
        levers, covariance = _nearest_on_axis(levers, covariance, motion)
    return ChainCalibration(kind, motion, levers, covariance, fit.residual_m_s2, samples, turning)


# ---- least squares ----


class _Fit(NamedTuple):
    """What the forces at the joint's centre give."""

    unknowns: Floats  # (2 UNKNOWNS,) of both sensors
    covariance: Floats  # of these
    residual_m_s2: float  # rms
    scale_m_s2: float  # a robust measure of it
    worth: float  # equations that count as one independent equation


def _pieces(parts: Iterable[tuple[Stretch, Stretch]], longest_s: float) -> list[_Piece]:
    """Pieces of this length; of a long recording some, evenly spread."""
    found = [
        _Piece(one, two)
        for first, second in parts
        for one, two in zip(pieces(first, longest_s), pieces(second, longest_s), strict=True)
    ]
    if len(found) <= _MOST_PIECES:
        return found
    return [found[at] for at in np.linspace(0, len(found) - 1, _MOST_PIECES).astype(int)]


def _fit(chosen: Sequence[_Piece], known: _Prior) -> _Fit:
    """Least squares over the pieces; the first passes divide them further."""
    unknowns, worth, scale, prior = known.mean, 1.0, 1.0, np.diag(known.information)
    for number, longest_s in enumerate((*_SHORT_PIECES_S, *[_PIECE_S] * _MOST_PASSES)):
        divided = chosen if longest_s == _PIECE_S else _pieces(chosen, longest_s)
        sums = _normal_equations([_turned(p, unknowns, scale) for p in divided], scale)
        normal = sums.normals.sum(axis=0)
        worth = 1.0 if number < _FREE_PASSES else correlation(sums, normal + worth * prior)
        # The readings' density, shared by both sensors: without it, a fit could reduce its residuals by shrinking both.
        volume = np.zeros(2 * UNKNOWNS)
        volume[_ACCEL_SCALES] = 0.5 * sums.equations / (1 - unknowns[_ACCEL_SCALES])
        curvature = 2 * volume**2 / max(sums.equations, 1.0)
        covariance: Floats = np.linalg.inv((normal + np.diag(curvature)) / worth + prior)
        change = covariance @ ((sums.gradients.sum(axis=0) - volume) / worth - prior @ (unknowns - known.mean))
        unknowns = unknowns + change
        scale = max(1.4826 * float(np.median(np.abs(sums.residual))), 1e-4)
        if number > len(_SHORT_PIECES_S) and np.abs(change[_LEVERS]).max() < _SETTLED_M:
            break
    return _Fit(unknowns, covariance, float(np.sqrt(np.mean(sums.residual**2))), scale, worth)


class _Prior(NamedTuple):
    """What is known of the unknowns of both sensors (2 UNKNOWNS,) before the fit."""

    mean: Floats
    information: Floats  # inverse variances


def _prior(parts: Iterable[tuple[Stretch, Stretch]]) -> _Prior:
    """The data sheet's, and a gyro bias where its sensor rests, or hardly turns throughout.

    The latter is a sensor on a stand that a motor shakes. Without its mean rate, a bias of some °/s about the vertical
    passes for a motion of the links where no force shows the heading.
    """
    mean, information = np.zeros(2 * UNKNOWNS), np.empty(UNKNOWNS)
    for first, std in _PRIOR_STD.items():
        information[first:] = 1 / std**2
    information = np.tile(information, 2)
    for k, stretches_of in enumerate(zip(*parts, strict=True)):
        rates = [s.rate[rest] for s in stretches_of for rest in find_rests(Measurements.from_imu(*s))]
        rates = [rate for rate in rates if np.linalg.norm(rate.mean(axis=0)) < _MOST_REST_RAD_S]
        std = _REST_STD_RAD_S
        if not rates:
            rates, std = [s.rate for s in stretches_of], _std_of_mean_rate(stretches_of)
        if std < _PRIOR_STD[GYRO_BIAS]:
            at = slice(k * UNKNOWNS + GYRO_BIAS, k * UNKNOWNS + ACCEL_BIAS)
            mean[at], information[at] = np.concatenate(rates).mean(axis=0), 1 / std**2
    return _Prior(mean, information)


def _std_of_mean_rate(stretches_of: Sequence[Stretch]) -> float:
    """σ (rad/s) with which the mean rate is the gyro bias: a link turns less than half a turn; inf if it moves."""
    every = np.concatenate([s.rate for s in stretches_of])
    if np.sqrt(np.mean(np.sum((every - every.mean(axis=0)) ** 2, axis=1))) > _STILL_RAD_S:
        return np.inf
    seconds = sum(float(s.time_s[-1] - s.time_s[0]) for s in stretches_of)
    return max(float(np.pi) / max(seconds, 1e-9), _REST_STD_RAD_S)


def _turned(piece: _Piece, unknowns: Floats, scale: float) -> _Turned:
    """The equations γ_1 = R γ_2 of a piece; R is the rotation that fits best, `scale` (m/s²) the usual residual."""
    one, two = equations(piece.first, unknowns[:UNKNOWNS]), equations(piece.second, unknowns[UNKNOWNS:])
    weight = np.ones(len(one.gravity))
    for _ in range(3):
        rotation = _rotation_between(one.gravity, two.gravity, weight)
        residual = one.gravity - two.gravity @ rotation.T
        weight = huber(residual, _HUBER_SIGMAS * scale)
    jacobian = _eliminated(one, two, rotation, weight / scale**2)
    information = _information(one.gravity, two.gravity @ rotation.T, weight / scale**2)
    return _Turned(rotation, residual, jacobian, information, one.apart_s)


def _rotation_between(to: Floats, of: Floats, weight: Floats) -> Floats:
    """R (3, 3) with the least Σ w ‖to − R of‖² (G. Wahba, 1965; the solution by singular values)."""
    left, _, right = np.linalg.svd(np.einsum("m,mi,mj->ij", weight, to, of))
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left) * np.linalg.det(right)]) @ right)


def _eliminated(one: Equations, two: Equations, rotation: Floats, weight: Floats) -> Floats:
    """Jacobian (M, 3, 2 UNKNOWNS) of γ_1 − R γ_2 after R has followed the unknowns, δ = −A⁻¹ Dᵀ W J."""
    turned = two.gravity @ rotation.T
    jacobian = np.concatenate([one.jacobian, -np.einsum("ij,mjp->mip", rotation, two.jacobian)], axis=2)
    by_turn = cross_matrices(turned)  # −(δ × R γ_2) = [R γ_2 ×] δ
    inner = np.einsum("m,mia,mib->ab", weight, by_turn, by_turn) + np.eye(3) / _TURN_STD_RAD**2
    follows = np.linalg.solve(inner, np.einsum("m,mia,mip->ap", weight, by_turn, jacobian))
    return np.asarray(jacobian - by_turn @ follows)


def _information(one: Floats, two: Floats, weight: Floats) -> Floats:
    """Information (3, 3) on the error of R, 1/rad²: the curvature of Σ w ‖γ_1 − R γ_2‖² in it, halved.

    It holds products of both sensors' forces. Errors of one accelerometer, which look like a slow horizontal motion,
    add nothing on average, and what they may add by chance is subtracted.
    """
    products = np.einsum("m,mi,mj->ij", weight, one, two)
    curvature = np.trace(products) * np.eye(3) - 0.5 * (products + products.T)
    values, vectors = np.linalg.eigh(curvature)
    values = np.maximum(values - weight.sum() * _ACCEL_ERROR_M_S2**2, 0.0) + 1 / _TURN_STD_RAD**2
    return np.asarray(vectors @ np.diag(values) @ vectors.T)


def _normal_equations(parts: Sequence[_Turned], scale: float) -> Sums:
    normals, gradients, residuals, number = [], [], [], 0.0
    for part in parts:
        weight = huber(part.residual, _HUBER_SIGMAS * scale) / scale**2
        number += float(weight.sum()) * scale**2
        for normal, gradient in in_blocks(part.jacobian, weight, part.residual, len(weight) * part.apart_s):
            normals.append(normal)
            gradients.append(gradient)
        residuals.append(part.residual)
    return Sums(np.array(normals), np.array(gradients), np.concatenate(residuals), number)


def _coherent_errors(chosen: Sequence[_Piece], fit: _Fit) -> Floats:
    """Covariance (6, 6) (m²) of r_1 and r_2 by a share of the residual that is proportional to its regressors."""
    squares, count = np.zeros((6, 6)), 0
    for piece in chosen:
        jacobian = _turned(piece, fit.unknowns, fit.scale_m_s2).jacobian[:, :, _LEVERS]
        squares += np.einsum("nip,niq->pq", jacobian, jacobian)
        count += len(jacobian)
    coherent = (_COHERENT_SHARE * fit.residual_m_s2) ** 2
    values, vectors = np.linalg.eigh(squares / (3 * count))
    return np.asarray(vectors @ np.diag(coherent / np.maximum(values, coherent / LEVER_STD_M**2)) @ vectors.T)


def _drift_deg(chosen: Sequence[_Piece], fit: _Fit, known: _Prior) -> float:
    """σ (degrees rms over a piece) of the drift between both sensors that errors of the accelerometers leave possible.

    Where the joint hardly accelerates, these errors pass for a gyro bias about the vertical, unless a rest gives it.
    """
    squares, count, seconds = np.zeros((2 * UNKNOWNS, 2 * UNKNOWNS)), 0, 0.0
    for piece in chosen:
        jacobian = _turned(piece, fit.unknowns, fit.scale_m_s2).jacobian
        squares += np.einsum("nip,niq->pq", jacobian, jacobian)
        count += len(jacobian)
        seconds += float(piece.first.time_s[-1] - piece.first.time_s[0]) / len(chosen)
    information = squares / (3 * count) / (2 * _ACCEL_ERROR_M_S2**2) + np.diag(known.information)
    of_gyro = (slice(at + GYRO_BIAS, at + ACCEL_BIAS) for at in (0, UNKNOWNS))
    least = min(float(np.linalg.eigvalsh(information[at, at])[0]) for at in of_gyro)
    return float(np.degrees(seconds / np.sqrt(12 * least)))


def _in_motion(parts: Sequence[tuple[Stretch, Stretch]], unknowns: Floats) -> tuple[int, tuple[float, float]]:
    """Number of samples in motion, and the rms rate of either sensor in them (rad/s).

    Raises LinkposeError where they are too few.
    """
    samples, seconds, squares = 0, 0.0, np.zeros(2)
    for first, second in parts:
        rates = (first.rate - unknowns[GYRO_BIAS:ACCEL_BIAS], second.rate - unknowns[UNKNOWNS:][GYRO_BIAS:ACCEL_BIAS])
        moving = np.maximum(*(np.linalg.norm(rate, axis=1) for rate in rates)) > _MOVING_RAD_S
        samples += int(moving.sum())
        squares += [float(np.sum(rate[moving] ** 2)) for rate in rates]
        seconds += float(np.diff(first.time_s)[moving[1:]].sum())
    if seconds < _LEAST_MOTION_S:
        raise LinkposeError(
            f"only {seconds:.1f} s show motion; move both links for half a minute or more, in all directions that the "
            "joint allows"
        )
    one, two = np.sqrt(squares / samples).tolist()
    return samples, (one, two)


# ---- kind of the joint, and its axis ----


def _relative_motion(chosen: Sequence[_Piece], fit: _Fit) -> HingeMotion:
    """The hinge that explains the relative motion best."""
    return best_hinge([_rotations(piece, fit) for piece in chosen])


def _with_common_errors(motion: HingeMotion, fit: _Fit, turning_rad_s: tuple[float, float]) -> HingeMotion:
    """The motion with errors of its axes that all pieces have in common.

    Play that follows the motion turns the axes by as much as itself. Errors of the accelerometers tilt R. They reach
    the axis of a sensor that hardly turns: the other sensor's rate and R give that axis.
    """
    of_bias = (slice(at, at + 3) for at in (ACCEL_BIAS, UNKNOWNS + ACCEL_BIAS))
    tilt_square = sum(float(np.linalg.eigvalsh(fit.covariance[at, at])[-1]) for at in of_bias) / STANDARD_GRAVITY**2
    covariance, relies = motion.covariance.copy(), _reliance(turning_rad_s)
    for k in range(2):
        at, axis = slice(3 * k, 3 * k + 3), motion.axes[k]
        square = np.radians(motion.play_deg) ** 2 + relies[k] * tilt_square
        covariance[at, at] += square * (np.eye(3) - np.outer(axis, axis))
    return motion._replace(covariance=covariance)


def _reliance(turning_rad_s: tuple[float, float]) -> tuple[float, float]:
    """How far the axis in either sensor's axes comes from the other sensor's rate: 1 where a sensor does not turn."""
    one, two = turning_rad_s
    first, second = (max(1 - (a / (_TURNS_ITSELF * b + 1e-12)) ** 2, 0.0) for a, b in ((one, two), (two, one)))
    return first, second


def _with_unknown_heading(
    motion: HingeMotion, chosen: Sequence[_Piece], fit: _Fit, turning_rad_s: tuple[float, float]
) -> HingeMotion:
    """The motion with the error that an unknown relative heading causes.

    The axis of a sensor that does not turn is that of the other one, taken over by R. Where no forces show the heading
    of R either, it may have any direction about the vertical, as far as it is not vertical itself. That is the same for
    all pieces, so their number does not reduce it.
    """
    shown = max(
        float(np.linalg.eigvalsh(_turned(piece, fit.unknowns, fit.scale_m_s2).information)[0]) for piece in chosen
    )
    covariance, relies = motion.covariance.copy(), _reliance(turning_rad_s)
    for k in range(2):
        force = np.concatenate([piece[k].force for piece in chosen]).mean(axis=0)
        moved = np.cross(force / np.linalg.norm(force), motion.axes[k])
        square = relies[k] * _UNKNOWN_HEADING_RAD**2 / (shown * _TURN_STD_RAD**2)
        at = slice(3 * k, 3 * k + 3)
        covariance[at, at] += square * np.outer(moved, moved)
    return motion._replace(covariance=covariance)


def _rotations(piece: _Piece, fit: _Fit) -> Rotations:
    turned = _turned(piece, fit.unknowns, fit.scale_m_s2)
    of = fit.unknowns[:UNKNOWNS], fit.unknowns[UNKNOWNS:]
    rates = np.stack([_rate(piece.first, of[0]), _rate(piece.second, of[1])])
    one, two = (attitudes(piece.first.time_s, rate) for rate in rates)
    every = slice(None, None, max(1, round(AXIS_STEP_S / float(np.median(np.diff(piece.first.time_s))))))
    square_m_s2 = (_COHERENT_SHARE * fit.residual_m_s2) ** 2 + 2 * _ACCEL_ERROR_M_S2**2  # errors of two accelerometers
    coherent = len(turned.residual) * square_m_s2 / fit.scale_m_s2**2
    information, common = turned.information / (fit.worth + coherent), coherent / (fit.worth + coherent)
    return Rotations(one[every], turned.rotation @ two[every], rates[:, every], information, common)


def _rate(stretch: Stretch, unknowns: Floats) -> Floats:
    corrected = np.eye(3) - unknowns[GYRO_MATRIX:].reshape(3, 3)
    return np.asarray((stretch.rate - unknowns[GYRO_BIAS:ACCEL_BIAS]) @ corrected.T)


def _kind(motion: HingeMotion) -> Kind | None:
    if np.hypot(motion.turn_deg, motion.play_deg) < LEAST_TURN_DEG:
        return None
    ratio = motion.play_deg / max(motion.turn_deg, 1e-9)
    if ratio < _HINGE_RATIO:
        return "hinge"
    return "ball" if ratio > _BALL_RATIO and motion.play_deg > _DRIFT_SIGMAS * motion.drift_deg else None


def _nearest_on_axis(levers: Floats, covariance: Floats, motion: HingeMotion) -> tuple[Floats, Floats]:
    """r_1 and r_2 from the point of a hinge's axis that lies nearest to both sensors, as [Seel2014] (3.3) chooses it.

    Every point of the axis stays in its place relative to both links, so the motion cannot show which one is meant.
    An error of the axes shifts the point across the axis, by as much as it lies away from the one found at first.
    """
    along = np.concatenate(list(motion.axes)) / np.sqrt(2.0)
    across = np.eye(6) - np.outer(along, along)
    by_axes = 0.5 * float(along @ levers.ravel()) ** 2 * motion.covariance
    return (across @ levers.ravel()).reshape(2, 3), across @ (covariance + by_axes) @ across.T
