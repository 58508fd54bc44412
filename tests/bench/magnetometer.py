"""Yaw with and without the magnetometer, beside VQF's with (9D) and without (6D), in one run.

    python tests/bench/magnetometer.py [--data FOLDER] [--seeds N] [--only TEXT] [--json]

Simulated link (Test 1, five minutes), calibrated or data-sheet sensors, in an undisturbed field and beside a desk, a
motor and iron. The seeds from FIRST_SEED on chose no constant. Sensors of the data sheet get the magnetometer's
calibration that `calibrate mag` finds from a recording of the same sensors in an undisturbed field, as a user would.
Real: BROAD, whose authors calibrated the magnetometer; strength and dip of the field are those of the first second.

The error is that of the heading of the whole attitude, less that at the start: none of the filters knows north. For a
trial of BROAD, only movement with a reference counts. `never_worse` is whether yaw with the magnetometer has at most
WORSE times the root mean square error without it, or LEAST_DEG more.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import numpy as np
from _report import print_row, recordings_parser
from scipy.io import loadmat
from vqf import VQF

import linkpose as lp
from linkpose.calibration.mag import calibrate_mag, with_calibration
from linkpose.rotations import of_vectors, product, wrapped
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.rig import Mag, Rig
from linkpose.simulation.link import LinkRun

FIRST_SEED, SECONDS = 100, 300.0
DISTURBANCES = (None, "desk", "motor", "iron")
WORSE, LEAST_DEG = 1.1, 0.2
# Over which the first heading is averaged (s): the link rests for 2 s, and the first second gives the gyro biases.
_START_S = (1.0, 2.0)


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
    sources = [simulated(options.seeds), broad(options.data / "broad")]
    rows = []
    for case in itertools.chain(*sources):
        if options.only in case.name:
            rows.append(row_of(case))
            print_row(rows[-1], options.json)
    kinds = dict.fromkeys(str(row["case"]).rsplit(" ", 1)[0] for row in rows)
    for kind in kinds:
        mine = [row for row in rows if str(row["case"]).startswith(kind)]
        means = {
            name: float(np.sqrt(np.mean([cast(float, row[name]) ** 2 for row in mine])))
            for name in ("own_deg", "mag_deg", "vqf_6d_deg", "vqf_9d_deg")
        }
        worse = sum(not row["never_worse"] for row in mine)
        print_row({"case": f"all {kind}", **means, "runs": len(mine), "worse": worse}, options.json)


if __name__ == "__main__":
    main()
