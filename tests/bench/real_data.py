"""Tilt from public recordings of real sensors, beside VQF's in the same run.

    python tests/bench/real_data.py [--data FOLDER] [--json]

FOLDER (../shared/data beside the checkout) holds repoimu_pendulum, mpu6050_encoder and broad, each as its authors
published it; one that is not there is named and left out. Nothing is calibrated beforehand. The error is the root mean
square angle between the tilts.

Sensor and reference do not share a clock: the sensors' readings come late by what their filter and the logger take. The
delay is the lag of the gyro behind the reference's rate, one for all trials of a kind, and is the rig's. VQF's estimate
is scored as it comes, and (vqf_undelayed_deg) turned on by the last rate for the same time.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from _report import RECORDINGS
from scipy.io import loadmat
from vqf import VQF

from linkpose import filters
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Imu, Joint, Rig

PENDULUM_J2S = Joint((-0.15, 0.0, 0.0), 0.03)  # by a ruler
PENDULUM_DELAY_S, BROAD_DELAY_S, ENCODER_DELAY_S = 0.0057, 0.0038, 0.011


class Case(NamedTuple):
    """A recording with the truth of its tilt."""

    name: str
    time_s: Floats
    accel_m_s2: Floats
    gyro_rad_s: Floats
    error_deg: Callable[[Floats], float]  # of tilts (N, 3)
    joint: Joint | None
    delay_s: float = 0.0


def pendulum(folder: Path) -> Iterator[Case]:
    """A link on a fixed pivot, Vicon. The reference's upward direction is fitted, as its README asks."""
    for path in sorted(folder.glob("Pendulum_*_Segment_1.csv")):
        lines = path.read_text(encoding="utf-8").splitlines()[2:]
        rows = np.array([[float(c.replace(",", ".")) for c in line.split(";") if c] for line in lines if line.strip()])
        time_s = np.linspace(0, rows[-1, 0] - rows[0, 0], len(rows))
        accel, gyro = np.ascontiguousarray(rows[:, 5:8]), np.ascontiguousarray(rows[:, 8:11])
        rotation = _matrices(rows[:, 1:5])
        up = np.median(np.einsum("nij,nj->ni", rotation, accel), axis=0)
        tilt = np.einsum("nji,j->ni", rotation, up / np.linalg.norm(up))
        error_deg = _against(tilt, np.ones(len(tilt), bool))
        yield Case(path.stem[9:22], time_s, accel, gyro, error_deg, PENDULUM_J2S, PENDULUM_DELAY_S)


def broad(folder: Path) -> Iterator[Case]:
    """Free motion, optical reference; errors where it moves."""
    for path in sorted(folder.glob("*.mat")):
        data = loadmat(path)
        accel, gyro = (np.ascontiguousarray(data[name], dtype=np.float64) for name in ("imu_acc", "imu_gyr"))
        tilt = _matrices(data["opt_quat"])[:, 2, :]
        use = data["movement"].ravel().astype(bool) & np.isfinite(tilt).all(axis=1)
        time_s = np.arange(len(accel)) / float(data["sampling_rate"].item())
        yield Case("broad " + path.stem[:2], time_s, accel, gyro, _against(tilt, use), None, BROAD_DELAY_S)


def encoder(folder: Path) -> Iterator[Case]:
    """An MPU-6050 on a motor's shaft, with an encoder: the angle about the shaft, less its mean error."""
    for path in sorted(folder.glob("raw_*.mat")):
        across = 0 if "pitch" in path.stem else 1  # the shaft lies along y in the trials of pitch, else along x
        data = {key: np.ravel(value).astype(np.float64) for key, value in loadmat(path).items() if key[:2] != "__"}
        gyro = np.column_stack([data[f"all_gyro_2_{axis}"] for axis in "xyz"])
        accel = np.column_stack([data[f"all_accel_2_{axis}"] for axis in "xyz"])
        time_s = data["all_time"]
        use = np.concatenate([[True], np.diff(time_s) > 0]) & (np.abs(gyro).max(1) < 2000) & (np.abs(accel).max(1) < 16)
        angle = np.radians(data["all_encoder"][use])

        def error_deg(tilt: Floats, angle: Floats = angle, across: int = across) -> float:
            measured = np.unwrap(np.arctan2(tilt[:, across], tilt[:, 2]))
            both = [sign * measured - angle for sign in (1, -1)]
            return float(np.degrees(min(np.std(difference) for difference in both)))

        force, rate = STANDARD_GRAVITY * accel[use], np.radians(gyro[use])
        start = time_s[use][0]
        yield Case("encoder " + path.stem[4:], time_s[use] - start, force, rate, error_deg, None, ENCODER_DELAY_S)


def _matrices(quaternion: Floats) -> Floats:
    w, x, y, z = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
        2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, axis=1).reshape(-1, 3, 3)


def _against(truth: Floats, use: Floats) -> Callable[[Floats], float]:
    def error_deg(tilt: Floats) -> float:
        cosine = np.clip((tilt * truth).sum(axis=1)[use], -1, 1)
        return float(np.degrees(np.sqrt(np.mean(np.arccos(cosine) ** 2))))

    return error_deg


def tilt_of(name: str, case: Case) -> Floats:
    """A filter's tilts (N, 3)."""
    n = len(case.time_s)
    nothing = np.full(n, np.nan)
    block = Measurements(
        case.time_s, case.accel_m_s2, case.gyro_rad_s, nothing, nothing, nothing, np.zeros(n, bool),
        np.empty((n, 0, 2)), np.ones(n, np.uint16),
    )  # fmt: skip
    estimate = filters.create(name, Rig(joint=case.joint or Joint(), imu=Imu(delay_s=case.delay_s))).process(block)
    roll, pitch = np.radians(estimate[:, 2]), np.radians(estimate[:, 3])
    return np.column_stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])


def vqf_tilt(case: Case) -> Floats:
    """VQF's tilts (N, 3)."""
    step = (case.time_s[-1] - case.time_s[0]) / (len(case.time_s) - 1)
    return _matrices(VQF(step).updateBatch(case.gyro_rad_s, case.accel_m_s2)["quat6D"])[:, 2, :]


def undelayed(tilt: Floats, case: Case) -> Floats:
    """Tilts (N, 3) turned on by the last rate for as long as the readings are late."""
    turned = tilt - np.cross(case.delay_s * case.gyro_rad_s, tilt)
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=RECORDINGS)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    for name, read in (("repoimu_pendulum", pendulum), ("mpu6050_encoder", encoder), ("broad", broad)):
        if not (options.data / name).is_dir():
            print(f"{options.data / name} is not there: left out", file=sys.stderr)
            continue
        for case in read(options.data / name):
            peer = vqf_tilt(case)
            vqf, late = case.error_deg(peer), case.error_deg(undelayed(peer, case))
            for used in (*(("joint-inertial", "joint") if case.joint else ()), "tilt", "tilt-inertial"):
                ours = case.error_deg(tilt_of(used, case))
                row = {"data": case.name, "filter": used, "ours_deg": ours, "vqf_deg": vqf, "ratio": ours / vqf}
                row |= {"delay_s": case.delay_s, "vqf_undelayed_deg": late}
                text = f"{case.name:18} {used:15} {ours:7.3f}°   vqf {vqf:7.3f}°   ratio {ours / vqf:.2f}"
                print(json.dumps(row) if options.json else f"{text}   vqf undelayed {late:7.3f}°")


if __name__ == "__main__":
    main()
