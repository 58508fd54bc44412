"""Magnetometer: hard iron, soft iron and the rotation into the inertial sensor's axes, from the sensor turned about.

The earth's field has one strength, so the readings s of a sensor that is turned into many attitudes lie on an ellipsoid

    ‖W (s − h)‖ = F,        W symmetric, det W = 1

with the hard iron h and the soft iron W⁻¹. An algebraic fit starts, and Gauss-Newton with Huber's weights refines it.
The field does not turn with the sensor: with the rotation R into the inertial sensor's axes, and θ the rotation by the
gyro between two readings u, u′ = W (s − h),

    R (u′ − u) + θ × R (u + u′) / 2 = 0

which is linear in the nine elements of R. Its least eigenvector, made orthogonal, is R. The gyro's bias is estimated
along with it.

Sources: Q. Li, J. G. Griffiths, "Least squares ellipsoid specific fitting", Proc. Geometric Modeling and Processing,
2004; the alignment by the rotation rate after [Kok2016], equation (8b).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.recording.reader import Recording
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Imu, Mag, Rig, Vector

# Earth's field at the surface: 22 to 67 µT (IGRF-13); a calibrated sensor is accurate to some per cent.
LEAST_FIELD_UT, MOST_FIELD_UT = 25.0, 65.0
# Share of the sphere's cells that must hold a reading. At 0.3 the fit extrapolates over two thirds of all attitudes;
# at 0.6 every attitude has a neighbour within 35°.
LEAST_COVERAGE, GOOD_COVERAGE = 0.3, 0.6
_CELLS = 60  # of the sphere, 26° wide
LARGE_RESIDUAL = 0.04  # share of the field; a calibrated QMC5883L leaves 1 %
_LARGEST_STD_UT = 2.0  # of the hard iron
# Ratio of the ellipsoid's longest to its shortest axis. Soft iron of a circuit board makes it 1.5 at most; noise on
# directions in one plane makes it 10 and more. Doubled, two planes a few degrees apart pass.
_MOST_STRETCH = 3.0
_FEWEST = 100  # readings
# A reading is left out if its magnitude differs from the median by more than this many median absolute deviations
# and by more than twice the strongest field of the earth, by which hard iron alone can change it. Doubled, spikes of a
# field of 300 µT stay, and the algebraic fit fails.
_OUTLIER_DEVIATIONS = 10.0
_OUTLIER_UT = 2 * MOST_FIELD_UT
# Median distance of the readings from their middle. A third of all attitudes makes it 15 µT at 25 µT, noise at rest
# 0.3 µT. Doubled, weak fields are refused; halved, a swing by a few degrees passes.
_LEAST_SPREAD_UT = 5.0
_PASSES, _HUBER_SIGMAS = 30, 2.5
_STEP_S = 0.1  # between two readings that the rotation joins: at 1 rad/s the field turns by 0.1 rad, 3 µT
_LONGEST_STEP_S = 0.3
_ALIGNMENT_PASSES = 6
_UNDETERMINED = "the attitudes of the recording do not determine the hard iron"
_LARGEST_ALIGNMENT_STD_RAD = math.radians(3.0)
_SLOW_M_S2 = 0.5  # ‖force‖ differs from g by less: the force is vertical


@dataclass(frozen=True, slots=True)
class MagCalibration:
    """The ellipsoid, its rotation into the inertial sensor's axes, and what the recording was worth."""

    hard_iron_uT: Floats  # (3,)
    hard_iron_std_uT: Floats  # (3,)
    soft_iron: Floats  # (3, 3) W
    rotation: Floats | None  # (3, 3) R; None where the motion does not determine it
    rotation_std_deg: float | None
    field_uT: float
    residual_uT: float  # rms of ‖W (s − h)‖ − F
    coverage: float  # share of the sphere
    readings: int
    outliers: int  # readings left out, their magnitude far from the median
    dip_deg: float | None  # below the horizon; None without a rotation

    @property
    def is_plausible(self) -> bool:
        """Whether the field is as strong as the earth's."""
        return LEAST_FIELD_UT <= self.field_uT <= MOST_FIELD_UT

    @property
    def is_clean(self) -> bool:
        """Whether the readings fit one ellipsoid."""
        return self.residual_uT <= LARGE_RESIDUAL * self.field_uT

    def as_dict(self) -> dict[str, Any]:
        """The object that `calibrate mag --json` prints."""
        return {
            "hard_iron_uT": self.hard_iron_uT.tolist(),
            "hard_iron_std_uT": self.hard_iron_std_uT.tolist(),
            "soft_iron": self.soft_iron.tolist(),
            "rotation": None if self.rotation is None else self.rotation.tolist(),
            "rotation_std_deg": self.rotation_std_deg,
            "field_uT": self.field_uT,
            "residual_uT": self.residual_uT,
            "coverage": self.coverage,
            "readings": self.readings,
            "outliers": self.outliers,
            "dip_deg": self.dip_deg,
            "is_plausible": self.is_plausible,
            "is_clean": self.is_clean,
        }


def calibrate_mag(recordings: Sequence[Recording], rig: Rig) -> MagCalibration:
    """The magnetometer's calibration from all recordings together.

    Raises LinkposeError where there is no magnetometer, or where its attitudes do not determine the ellipsoid.
    """
    names = ", ".join(str(r.path) for r in recordings)
    measured = [r.measurements for r in recordings if r.measurements.has_mag]
    if not measured:
        raise LinkposeError(f"{names}: there is no magnetometer; check its wiring, and record again")
    blocks, outliers = _without_outliers(measured)
    readings = [block.mag_uT[_usable(block)] for block in blocks]
    together = np.concatenate(readings)
    if len(together) < _FEWEST:
        raise LinkposeError(f"{names}: {len(together)} magnetometer readings are too few; record half a minute or more")
    if _spread(together) < _LEAST_SPREAD_UT:
        raise _too_little("the readings hardly change")
    try:
        hard_iron, soft_iron, field, std, residual = _fit_ellipsoid(together)
    except np.linalg.LinAlgError:  # the fit diverges
        raise _too_little(_UNDETERMINED) from None
    if not (np.linalg.cond(soft_iron) <= _MOST_STRETCH and std.max() <= _LARGEST_STD_UT):
        raise _too_little(_UNDETERMINED)
    coverage = _coverage((together - hard_iron) @ soft_iron)
    if coverage < LEAST_COVERAGE:
        raise _too_little(f"the recording covers {100 * coverage:.0f} % of all attitudes")
    rotation, rotation_std = _alignment(blocks, rig.imu, hard_iron, soft_iron)
    dip = None if rotation is None else _dip_deg(blocks, rig.imu, rotation, hard_iron, soft_iron)
    return MagCalibration(
        hard_iron,
        std,
        soft_iron,
        rotation,
        None if rotation is None else math.degrees(rotation_std),
        field,
        residual,
        coverage,
        len(together),
        outliers,
        dip,
    )


def with_calibration(rig: Rig, found: MagCalibration) -> Rig:
    """The rig with the magnetometer's calibration; everything else as it was."""
    matrix = found.soft_iron if found.rotation is None else found.rotation @ found.soft_iron
    x, y, z = (_vector(row) for row in matrix)
    dip = None if found.dip_deg is None else round(found.dip_deg, 2)
    mag = Mag(_vector(found.hard_iron_uT), x, y, z, round(found.field_uT, 3), round(found.residual_uT, 3), dip)
    return replace(rig, mag=mag)


def _too_little(finding: str) -> LinkposeError:
    return LinkposeError(
        f"{finding}, too little to calibrate the magnetometer: turn the sensor by hand through all attitudes, each "
        "axis up, down and sideways, for a minute, away from iron"
    )


def _spread(readings: Floats) -> float:
    """Median distance of readings (N, 3) from their middle, µT."""
    return float(np.median(np.linalg.norm(readings - np.median(readings, axis=0), axis=1)))


def _usable(block: Measurements) -> Any:
    """(N,) Rows with a new reading."""
    return block.mag_fresh & np.isfinite(block.mag_uT).all(axis=1)


def _without_outliers(blocks: Sequence[Measurements]) -> tuple[list[Measurements], int]:
    """The measurements without the readings whose magnitude is far from the median, and how many these are."""
    usable = [_usable(block) for block in blocks]
    magnitudes = [np.linalg.norm(block.mag_uT, axis=1) for block in blocks]
    together = np.concatenate([values[rows] for values, rows in zip(magnitudes, usable, strict=True)])
    if not len(together):
        return list(blocks), 0
    middle = float(np.median(together))
    limit = max(_OUTLIER_DEVIATIONS * float(np.median(np.abs(together - middle))), _OUTLIER_UT)
    kept = [rows & (np.abs(values - middle) <= limit) for values, rows in zip(magnitudes, usable, strict=True)]
    cleaned = [replace(block, mag_fresh=rows) for block, rows in zip(blocks, kept, strict=True)]
    return cleaned, len(together) - sum(int(rows.sum()) for rows in kept)


def _fit_ellipsoid(readings: Floats) -> tuple[Floats, Floats, float, Floats, float]:
    """h (3,), W (3, 3), F, σ of h (3,), and the rms residual of readings (N, 3), µT."""
    hard_iron, soft_iron = _algebraic(readings)
    field = float(np.median(np.linalg.norm((readings - hard_iron) @ soft_iron, axis=1)))
    pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    for _ in range(_PASSES):
        apart = readings - hard_iron
        turned = apart @ soft_iron
        length = np.linalg.norm(turned, axis=1)
        along = turned / length[:, None]
        columns = [-along @ soft_iron]
        for i, j in pairs:
            column = along[:, i] * apart[:, j] + (along[:, j] * apart[:, i] if i != j else 0.0)
            columns.append(column[:, None])
        # W keeps its determinant: the sum of its relative changes is zero, and F is estimated instead.
        jacobian = np.hstack([*columns, -np.ones((len(readings), 1))])
        residual = length - field
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-6)
        weight = np.sqrt(np.minimum(1.0, _HUBER_SIGMAS * scale / np.maximum(np.abs(residual), 1e-12)))
        trace = np.concatenate([np.zeros(3), [1.0, 1.0, 1.0], np.zeros(4)])[None] * field * math.sqrt(len(readings))
        system = np.vstack([jacobian * weight[:, None], trace])
        right = np.concatenate([-residual * weight, [0.0]])
        change = np.linalg.lstsq(system, right, rcond=None)[0]
        hard_iron = hard_iron + change[:3]
        for (i, j), value in zip(pairs, change[3:9], strict=True):
            soft_iron[i, j] += value
            soft_iron[j, i] = soft_iron[i, j]
        soft_iron = soft_iron / np.cbrt(np.linalg.det(soft_iron))
        field += float(change[9])
        if np.abs(change).max() < 1e-9:
            break
    rms = float(np.sqrt(np.mean(residual**2)))
    covariance = np.linalg.pinv(system.T @ system) * max(scale, rms) ** 2
    variance = np.diag(covariance)[:3]  # rounded below zero where the system is singular
    return hard_iron, soft_iron, field, np.sqrt(np.where(variance >= 0, variance, np.inf)), rms


def _algebraic(readings: Floats) -> tuple[Floats, Floats]:
    """h and W of the quadric that fits best; a sphere where the quadric is no ellipsoid."""
    centre, spread = readings.mean(axis=0), max(float(readings.std()), 1e-9)
    x, y, z = ((readings - centre) / spread).T
    quadric = np.column_stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, x, y, z])
    a, b, c, d, e, f, *linear = np.linalg.lstsq(quadric, np.ones(len(x)), rcond=None)[0]
    form = np.array([[a, d, e], [d, b, f], [e, f, c]])
    values, vectors = np.linalg.eigh(form)
    if values[0] > 1e-3 * values[-1]:
        hard_iron = centre + spread * np.linalg.solve(form, -0.5 * np.array(linear))
        root = vectors * np.sqrt(values) @ vectors.T
        return hard_iron, root / np.cbrt(np.linalg.det(root))
    sphere = np.column_stack([x, y, z, np.ones(len(x))])
    solved = np.linalg.lstsq(sphere, x * x + y * y + z * z, rcond=None)[0]
    return centre + spread * 0.5 * solved[:3], np.eye(3)


def _coverage(turned: Floats) -> float:
    """Share of the cells of a sphere that the directions of vectors (N, 3) reach; the cells are equally large."""
    at = np.arange(_CELLS) + 0.5
    height, around = 1 - 2 * at / _CELLS, math.pi * (1 + math.sqrt(5)) * at  # Fibonacci's lattice
    level = np.sqrt(1 - height**2)
    cells = np.column_stack([level * np.cos(around), level * np.sin(around), height])
    unit = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return len(np.unique(np.argmax(unit @ cells.T, axis=1))) / _CELLS


def _alignment(
    blocks: Sequence[Measurements], imu: Imu, hard_iron: Floats, soft_iron: Floats
) -> tuple[Floats | None, float]:
    """R and its σ (rad); None where the rotation does not determine it."""
    steps = [_steps(block, imu, hard_iron, soft_iron) for block in blocks]
    change, middle, turn, span = (np.concatenate(values) for values in zip(*steps, strict=True))
    if len(change) < _FEWEST:
        return None, math.inf
    bias, rotation, std = np.zeros(3), np.eye(3), math.inf
    for _ in range(_ALIGNMENT_PASSES):
        rotation, std = _rotation(change, middle, turn - span[:, None] * bias)
        # R Δ + θ × R m = h b × R m, linear in b.
        field = middle @ rotation.T
        left = change @ rotation.T + np.cross(turn, field)
        design = -_cross_matrices(field) * span[:, None, None]
        bias = np.linalg.lstsq(design.reshape(-1, 3), left.reshape(-1), rcond=None)[0]
    return (rotation, std) if std < _LARGEST_ALIGNMENT_STD_RAD else (None, math.inf)


def _rotation(change: Floats, middle: Floats, turn: Floats) -> tuple[Floats, float]:
    """R that minimises Σ ‖R Δ + θ × R m‖², and σ of its angles (rad)."""
    # Row-major elements of R: (R Δ)_i = Σ_j R_ij Δ_j, and θ × (R m) = [θ×] R m.
    design = np.einsum("ik,nj->nikj", np.eye(3), change) + np.einsum("nik,nj->nikj", _cross_matrices(turn), middle)
    design = design.reshape(-1, 9)
    values, vectors = np.linalg.eigh(design.T @ design)
    left, _, right = np.linalg.svd(vectors[:, 0].reshape(3, 3))
    rotation = left @ right
    if np.linalg.det(rotation) < 0:  # −R solves the equation as well
        rotation = -rotation
    variance = max(float(values[0]), 0.0) / len(change) * 3  # of a row, with R of norm √3
    return rotation, math.sqrt(variance / max(float(values[1]) / 3, 1e-30))


def _steps(
    block: Measurements, imu: Imu, hard_iron: Floats, soft_iron: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Pairs of readings a tenth of a second apart: change and mean of u, rotation by the gyro (rad), and time (s)."""
    rate = block.gyro_rad_s - np.array(imu.gyro_bias_rad_s)
    step = np.diff(block.time_s)[:, None]
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * step * (rate[1:] + rate[:-1]), axis=0)])
    rows = np.flatnonzero(_usable(block))
    time_s = block.time_s[rows]
    after = np.searchsorted(time_s, time_s + _STEP_S)
    first = np.flatnonzero(after < len(rows))
    second = after[first]
    span = time_s[second] - time_s[first]
    near = span < _LONGEST_STEP_S
    first, second, span = first[near], second[near], span[near]
    turned = (block.mag_uT[rows] - hard_iron) @ soft_iron
    turn = angle[rows[second]] - angle[rows[first]]
    known = np.isfinite(turn).all(axis=1)
    middle = 0.5 * (turned[second] + turned[first])
    return (turned[second] - turned[first])[known], middle[known], turn[known], span[known]


def _dip_deg(
    blocks: Sequence[Measurements], imu: Imu, rotation: Floats, hard_iron: Floats, soft_iron: Floats
) -> float | None:
    """Angle of the field below the horizon, median over readings with a force of g; None without any."""
    sines = []
    for block in blocks:
        force = (block.accel_m_s2 - np.array(imu.accel_offset_m_s2)) / np.array(imu.accel_scale)
        length = np.linalg.norm(force, axis=1)
        rows = _usable(block) & (np.abs(length - STANDARD_GRAVITY) < _SLOW_M_S2)
        field = (block.mag_uT[rows] - hard_iron) @ (rotation @ soft_iron).T
        along = np.einsum("ni,ni->n", field, force[rows])
        sines.append(-along / (length[rows] * np.linalg.norm(field, axis=1)))
    together = np.concatenate(sines)
    return math.degrees(math.asin(float(np.median(together)))) if len(together) >= _FEWEST else None


def _cross_matrices(v: Floats) -> Floats:
    """[v×] of (N, 3): (N, 3, 3)."""
    zero = np.zeros(len(v))
    x, y, z = v.T
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _vector(values: Floats) -> Vector:
    x, y, z = (float(f"{value:.6g}") for value in values)
    return x, y, z
