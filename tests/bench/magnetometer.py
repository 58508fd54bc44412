"""The magnetometer's calibration and the yaw that it holds, beside published peers, in one run.

    python tests/bench/magnetometer.py [--data FOLDER] [--seeds N] [--only TEXT] [--json]

Calibration: a sensor with known hard and soft iron that is turned about, in all attitudes or in some, with more noise,
or beside iron for a tenth of the time. `ours` is `calibrate mag`; the peers are the ellipsoid fit of Q. Li, J. G.
Griffiths, "Least squares ellipsoid specific fitting", 2004, and qmt's `calibrateMagnetometerSimple` (hard iron and one
scale an axis). `…_iron_uT` is the error of the hard iron. `…_direction_deg` is the root mean square error of the
field's direction over all attitudes, after the constant rotation that fits best. Both are means over the seeds, without
those that a method refuses (`…_refused`).

Yaw with and without the magnetometer, beside VQF's with (9D) and without (6D):
Simulated link (Test 1, five minutes), calibrated or data-sheet sensors, in an undisturbed field and in each disturbance
of `simulation.mag_disturbances`. The seeds from FIRST_SEED on chose no constant. Sensors of the data sheet get the
magnetometer's calibration that `calibrate mag` finds from a recording of the same sensors in an undisturbed field, as a
user would.
Drifting yaw: ten minutes of a filter whose yaw drifts by 0.01 °/s (1σ), in the same fields (`tests/host/drifting_yaw`).
Real: BROAD, whose authors calibrated the magnetometer; strength and dip of the field are those of the first second.

The error is that of the heading of the whole attitude, less that at the start: none of the filters knows north. For a
trial of BROAD, only movement with a reference counts. `never_worse` is whether yaw with the magnetometer has at most
WORSE times the root mean square error without it, or LEAST_DEG more.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import numpy as np
import qmt
from _report import print_row, recordings_parser
from scipy.io import loadmat
from scipy.linalg import eig
from vqf import VQF

import linkpose as lp
from linkpose.calibration.mag import calibrate_mag, with_calibration
from linkpose.errors import LinkposeError
from linkpose.recording.reader import Recording
from linkpose.rotations import matrices, of_vectors, product, rotation_vectors, wrapped
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.rig import Mag, Rig
from linkpose.simulation import mag_disturbances
from linkpose.simulation.link import LinkRun

sys.path.append(str(Path(__file__).resolve().parents[1] / "host"))
import drifting_yaw

FIRST_SEED, SECONDS = 100, 300.0
DISTURBANCES = (None, *mag_disturbances.KINDS)
WORSE, LEAST_DEG = 1.1, 0.2
# Over which the first heading is averaged (s): the link rests for 2 s, and the first second gives the gyro biases.
_START_S = (1.0, 2.0)


class Turning(NamedTuple):
    """How a sensor is turned for its calibration."""

    reach_rad: float  # amplitude of roll; pitch has half of it
    noise_uT: float = 0.2  # of a QMC5883L
    is_skewed: bool = True  # soft iron with cross-axis terms, as of a circuit board
    beside_iron: float = 0.0  # share of the time


TURNINGS = {
    "all attitudes": Turning(math.pi),
    "scales alone": Turning(math.pi, is_skewed=False),
    "noise 1 µT": Turning(math.pi, noise_uT=1.0),
    "beside iron": Turning(math.pi, beside_iron=0.1),
    "two thirds": Turning(1.9),
    "half": Turning(1.2),
    "a third": Turning(0.8),
}
_FIELD_UT, _IRON_UT = np.array([30.0, 0.0, -42.0]), np.array([20.0, -30.0, 10.0])
_SCALES, _SKEW = np.diag([1.06, 0.97, 0.98]), np.array([[0, 0.03, -0.02], [0.03, 0, 0.04], [-0.02, 0.04, 0]])
_HZ, _TURNING_S = 50, 60.0
Ellipsoid = tuple[Floats, Floats]  # hard iron (3,) and the matrix (3, 3) that corrects soft iron


def turned_about(turning: Turning, seed: int) -> tuple[Measurements, Ellipsoid]:
    """A sensor turned by hand, and the true hard iron and correction."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, _TURNING_S, 1 / _HZ)
    phase = rng.uniform(0, 2 * np.pi, 3)
    reach = turning.reach_rad
    angles = (
        reach * np.sin(0.61 * t + phase[0]), 0.5 * reach * np.sin(0.37 * t + phase[1]), 0.45 * t + np.sin(0.3 * t),
    )  # fmt: skip
    attitude = _attitude(*(np.degrees(angle) for angle in angles))
    step = rotation_vectors(product(attitude[:-1] * [1, -1, -1, -1], attitude[1:])) * _HZ
    rate = np.concatenate([step[:1], 0.5 * (step[1:] + step[:-1]), step[-1:]])
    to_earth = matrices(attitude)
    matrix = _SCALES + _SKEW * turning.is_skewed
    hard_iron = rng.uniform(-25, 25, 3)
    field = _FIELD_UT @ to_earth + np.outer(t > (1 - turning.beside_iron) * _TURNING_S, _IRON_UT)
    mag = field @ np.linalg.inv(matrix).T + hard_iron + turning.noise_uT * rng.standard_normal((len(t), 3))
    accel = np.array([0.0, 0.0, 9.81]) @ to_earth + 0.04 * rng.standard_normal((len(t), 3))
    gyro = rate + 0.002 * rng.standard_normal((len(t), 3))
    return Measurements.from_imu(t, accel, gyro, mag_uT=mag), (hard_iron, matrix)


def calibrated(block: Measurements) -> Ellipsoid | None:
    """`calibrate mag`; None where it refuses."""
    try:
        found = calibrate_mag([Recording(Path("turned.csv"), block, None, float(_HZ), {}, [])], Rig())
    except LinkposeError:
        return None
    return found.hard_iron_uT, found.soft_iron


def li_griffiths(block: Measurements) -> Ellipsoid | None:
    """Ellipsoid-specific fit: the generalised eigenvector of the scatter under the constraint 4 J − I² > 0."""
    x, y, z = block.mag_uT.T / 50
    design = np.stack([x * x, y * y, z * z, 2 * y * z, 2 * x * z, 2 * x * y, 2 * x, 2 * y, 2 * z, np.ones(len(x))])
    scatter = design @ design.T
    constraint = np.diag([-1.0, -1.0, -1.0, -4.0, -4.0, -4.0])
    constraint[:3, :3] += 1 - np.eye(3)
    right = np.linalg.solve(scatter[6:, 6:], scatter[6:, :6])
    values, vectors = eig(scatter[:6, :6] - scatter[:6, 6:] @ right, constraint)
    a = np.real(vectors[:, np.argmax(np.real(values))])
    linear = -right @ a
    form = np.array([[a[0], a[5], a[4]], [a[5], a[1], a[3]], [a[4], a[3], a[2]]])
    form, linear = (form, linear) if form[0, 0] > 0 else (-form, -linear)
    values, vectors = np.linalg.eigh(form)
    if values[0] <= 0:
        return None
    return -50 * np.linalg.solve(form, linear[:3]), vectors * np.sqrt(values) @ vectors.T


def of_qmt(block: Measurements) -> Ellipsoid | None:
    """qmt's hard iron and scales; None where it reports a failure."""
    arrays = (np.ascontiguousarray(values) for values in (block.gyro_rad_s, block.accel_m_s2, block.mag_uT))
    gain, bias, is_found = qmt.calibrateMagnetometerSimple(*arrays, Ts=1 / _HZ)
    return (bias / gain, np.diag(gain)) if is_found else None


CALIBRATIONS = {"ours": calibrated, "li_griffiths": li_griffiths, "qmt": of_qmt}


def direction_error_deg(found: Ellipsoid, true: Ellipsoid) -> float:
    """Root mean square over directions all around, after the constant rotation that fits best."""
    unit = np.random.default_rng(0).standard_normal((2000, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    readings = 50 * unit @ np.linalg.inv(true[1]).T + true[0]
    seen = (readings - found[0]) @ found[1].T
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    left, _, right = np.linalg.svd(seen.T @ unit)
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    cosine = np.clip(np.einsum("ni,ni->n", seen @ rotation, unit), -1, 1)
    return float(np.degrees(np.sqrt(np.mean(np.arccos(cosine) ** 2))))


def calibration_row(name: str, seeds: int) -> dict[str, object]:
    """Mean errors of all methods on one way of turning."""
    row: dict[str, object] = {"case": f"calibration {name}", "runs": seeds}
    turned = [turned_about(TURNINGS[name], seed) for seed in range(FIRST_SEED, FIRST_SEED + seeds)]
    for method, calibrate in CALIBRATIONS.items():
        pairs = [(found, true) for block, true in turned if (found := calibrate(block)) is not None]
        row[f"{method}_refused"] = seeds - len(pairs)
        if pairs:
            row[f"{method}_iron_uT"] = float(np.mean([np.linalg.norm(f[0] - true[0]) for f, true in pairs]))
            row[f"{method}_direction_deg"] = float(np.mean([direction_error_deg(f, true) for f, true in pairs]))
    return row


class Case(NamedTuple):
    """A recording with a magnetometer and its true attitude."""

    name: str
    measured: Measurements
    truth: Floats  # (N, 4) quaternions, sensor to earth; NaN where unknown
    rig: Rig
    filter: str


def simulated(seeds: int) -> Iterator[Case]:
    """The link, with what a user's rig file would hold."""
    for errors in ("calibrated", "datasheet"):
        for disturbance in DISTURBANCES:
            for seed in range(FIRST_SEED, FIRST_SEED + seeds):
                run = LinkRun(1, seed, SECONDS, errors=errors, mag=True, mag_disturbance=disturbance)
                truth = run.truth()
                attitude = _attitude(truth.roll_deg, truth.pitch_deg, truth.yaw_deg)
                rig = run.rig if errors == "calibrated" else _calibrated(seed)
                name = f"{errors} {disturbance or 'undisturbed'} {seed}"
                yield Case(name, run.measurements(), attitude, rig, "joint-inertial")


def _calibrated(seed: int) -> Rig:
    """The rig with a calibration: the same specimen of sensors, laid on its six sides."""
    turned = LinkRun(1, seed, 120.0, errors="datasheet", mag=True, motion="sides")
    recording = cast(Any, SimpleNamespace(measurements=turned.measurements(), path=Path("turned.csv")))
    return with_calibration(turned.rig, calibrate_mag([recording], turned.rig))


def drifting_row(kind: str | None, seed: int) -> dict[str, object]:
    """RMSE of the drifting yaw, and with the magnetometer."""
    inner, block, drift = drifting_yaw.run(seed, kind)
    error, std, _, f = drifting_yaw.held(inner, block, drift)
    own, mag = (float(np.sqrt(np.mean(np.square(values)))) for values in (drift, error))
    row = {"case": f"drifting {kind or 'undisturbed'} {seed}", "own_deg": own, "mag_deg": mag}
    row |= {"within_2sigma": float(np.mean(np.abs(error) < 2 * std)), "used_s": f.found.used_s}
    return {**row, "never_worse": bool(mag < max(WORSE * own, own + LEAST_DEG))}


def broad(folder: Path) -> Iterator[Case]:
    """Free motion, optical reference."""
    for path in sorted(folder.glob("*.mat")):
        data = loadmat(path)
        accel, gyro, mag = (
            np.ascontiguousarray(data[f"imu_{name}"], dtype=np.float64) for name in ("acc", "gyr", "mag")
        )
        rate = float(data["sampling_rate"].item())
        moves = data["movement"].ravel().astype(bool)
        truth = np.where(moves[:, None], data["opt_quat"], np.nan)
        first = slice(0, round(rate))
        field, up = mag[first].mean(axis=0), accel[first].mean(axis=0)
        strength = float(np.linalg.norm(field))
        dip = math.degrees(math.asin(float(-field @ up) / strength / float(np.linalg.norm(up))))
        measured = Measurements.from_imu(np.arange(len(accel)) / rate, accel, gyro, mag_uT=mag)
        rig = replace(Rig(), mag=Mag((0.0, 0.0, 0.0), field_uT=strength, residual_uT=0.5, dip_deg=dip))
        yield Case(f"broad {path.stem}", measured, truth, rig, "tilt-inertial")


def _attitude(roll_deg: Floats, pitch_deg: Floats, yaw_deg: Floats) -> Floats:
    """Quaternions (N, 4) of R_z(yaw) R_y(pitch) R_x(roll)."""
    turns = (of_vectors(np.outer(np.radians(a), np.eye(3)[i])) for i, a in enumerate((roll_deg, pitch_deg, yaw_deg)))
    x, y, z = turns
    return product(z, product(y, x))


def heading_error_deg(case: Case, attitude: Floats) -> Floats:
    """(M,) where truth and estimate are known, zero in the mean of the second second."""
    off = product(attitude, case.truth * [1, -1, -1, -1])
    error = wrapped(2 * np.arctan2(off[:, 3], off[:, 0]))
    known = np.isfinite(error)
    error, time_s = error[known], case.measured.time_s[known]
    since = time_s - time_s[0]
    start = np.angle(np.mean(np.exp(1j * error[(since >= _START_S[0]) & (since < _START_S[1])])))
    return np.asarray(np.degrees(wrapped(error - start)[since >= _START_S[0]]))


def row_of(case: Case) -> dict[str, object]:
    """RMSE of yaw of each filter."""
    row: dict[str, object] = {"case": case.name}
    errors: dict[str, float] = {}
    for mag in (False, True):
        found = lp.estimate(case.measured, filters=[case.filter], rig=case.rig, mag=mag)
        prefix = case.filter.replace("-", "_")
        angles = (found[f"{prefix}_{name}_deg"] for name in ("roll", "pitch", "yaw"))
        error = heading_error_deg(case, _attitude(*angles))
        errors["mag" if mag else "own"] = float(np.sqrt(np.mean(error**2)))
        if mag and found.magnetic_field is not None:
            row |= {"used_s": found.magnetic_field.used_s, "rejected_s": found.magnetic_field.rejected_s}
    step = float(case.measured.time_s[-1]) / (len(case.measured) - 1)
    m = case.measured
    accel, gyro = np.ascontiguousarray(m.accel_m_s2), np.ascontiguousarray(m.gyro_rad_s)
    for name, quaternion in (
        ("vqf_6d", VQF(step).updateBatch(gyro, accel)["quat6D"]),
        ("vqf_9d", VQF(step).updateBatch(gyro, accel, _field(case))["quat9D"]),
    ):
        errors[name] = float(np.sqrt(np.mean(heading_error_deg(case, quaternion) ** 2)))
    row |= {f"{name}_deg": value for name, value in errors.items()}
    return {**row, "never_worse": bool(errors["mag"] < max(WORSE * errors["own"], errors["own"] + LEAST_DEG))}


def _field(case: Case) -> Floats:
    """The calibrated field (N, 3)."""
    mag = case.rig.mag
    matrix = np.array([mag.matrix_x, mag.matrix_y, mag.matrix_z])
    return np.ascontiguousarray((case.measured.mag_uT - np.array(mag.hard_iron_uT)) @ matrix.T)


def main() -> None:
    parser = recordings_parser(__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    options = parser.parse_args()
    for name in TURNINGS:
        if options.only in f"calibration {name}":
            print_row(calibration_row(name, options.seeds), options.json)
    sources = [simulated(options.seeds), broad(options.data / "broad")]
    rows = []
    for kind, seed in itertools.product(DISTURBANCES, range(FIRST_SEED, FIRST_SEED + options.seeds)):
        if options.only in f"drifting {kind or 'undisturbed'} {seed}":
            rows.append(drifting_row(kind, seed))
            print_row(rows[-1], options.json)
    for case in itertools.chain(*sources):
        if options.only in case.name:
            rows.append(row_of(case))
            print_row(rows[-1], options.json)
    for mine in _by_kind(rows).values():
        print_row(_summary(mine), options.json)


def _by_kind(rows: list[dict[str, object]]) -> dict[str, list[dict[str, object]]]:
    """The rows of each kind of case: names end with the seed or the trial."""
    kinds: dict[str, list[dict[str, object]]] = {}
    for row in rows:
        kinds.setdefault(str(row["case"]).rsplit(" ", 1)[0], []).append(row)
    return kinds


def _summary(rows: list[dict[str, object]]) -> dict[str, object]:
    """Root mean square over the runs of a kind, and in how many the magnetometer made yaw worse."""
    means = {
        name: float(np.sqrt(np.mean([cast(float, row[name]) ** 2 for row in rows])))
        for name in ("own_deg", "mag_deg", "vqf_6d_deg", "vqf_9d_deg")
        if name in rows[0]
    }
    worse = sum(not row["never_worse"] for row in rows)
    return {"case": f"all {str(rows[0]['case']).rsplit(' ', 1)[0]}", **means, "runs": len(rows), "worse": worse}


if __name__ == "__main__":
    main()
