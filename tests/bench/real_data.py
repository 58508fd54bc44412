"""Tilt from public recordings of real sensors, beside VQF's in the same run.

    python tests/bench/real_data.py [--data FOLDER] [--json]

FOLDER (../shared/data beside the checkout) holds repoimu_pendulum, mpu6050_encoder, broad, openaxes_robot and
diodem_chain, each as its authors published it; a missing one is named and skipped. Nothing is calibrated beforehand.
The error is the root mean square angle between the tilts.

Sensor and reference do not share a clock: the sensor's filter and the logger delay the readings. The delay is the lag
of the gyro behind the reference's rate, one for all trials of a kind. Every filter gets the same correction: ours
through the rig, VQF's estimate is extrapolated by the last rate less VQF's own bias. The score at each filter's own
best lag stands beside the score at that fixed delay. The peer of --smooth is offline VQF.

The pendulums' reference limits their scores. Its quaternion is that of a body whose x and y axes point the other way
(177° about z); the rotation is fitted to the rates. It departs from the gyro by 5 to 8 °/s over 0.1 s: its
time offset varies, and parts look interpolated. `slow` scores average the error over `SLOW_S`, which removes the
departures that no filter follows; `fast_deg` is their size, a scale error of the gyro included. `within_2sigma` is the
share of the second half's errors of roll and pitch within 2σ, with `slow` that of the averaged errors. The upward
direction is fitted to the accelerometer, whose own bias a filter that estimates it gets as an error.

`chosen_on` marks the trials on which constants of the filters were chosen; all others are held out. The last lines give
for each set and filter the geometric mean of the ratios to VQF, over all and over held-out trials, and the worst.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from _report import print_row, print_rows, recordings_parser
from scipy.io import loadmat
from vqf import VQF, offlineVQF

from linkpose import filters
from linkpose.filters.smoother import JointInertialSmoother
from linkpose.filters.tilt_inertial import ERRORS
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Imu, Joint, Rig

PENDULUM_J2S = Joint((-0.15, 0.0, 0.0), 0.03)  # by a ruler
PENDULUM_DELAY_S, BROAD_DELAY_S, ENCODER_DELAY_S, ROBOT_DELAY_S = 0.0057, 0.0038, 0.011, 0.0
OMC_LATE_S = 0.0165  # the camera's stamps of diodem_chain, half a frame
# Constants of the filters are chosen on these only. Add a trial before you look at its score to choose anything.
CHOSEN_ON = {"broad 01", "broad 15", "broad 24", "pendulum 02a_Trial1", "robot circle-100_radius", "diodem segment 2"}
MOST_LAG_S = 0.06
SLOW_S = 2.0  # longer than a swing of the pendulums (1.5 s)
_RATE_S = 0.1  # over which the rates of a jittering reference are compared with the gyro's


class Case(NamedTuple):
    """A recording with the truth of its tilt."""

    data: str
    name: str
    time_s: Floats
    accel_m_s2: Floats
    gyro_rad_s: Floats
    errors_deg: Callable[[Floats], Floats]  # of tilts (N, 3): one per sample of the reference, NaN where unknown
    joint: Joint | None
    delay_s: float
    truth: Floats | None = None  # tilts (N, 3) at the samples, NaN where unknown

    def error_deg(self, tilt: Floats) -> float:
        """Root mean square error of tilts (N, 3)."""
        return float(np.sqrt(np.nanmean(np.square(self.errors_deg(tilt)))))

    def split_deg(self, tilt: Floats) -> tuple[float, float]:
        """Root mean square of the error's mean over `SLOW_S`, and of the rest, where the truth is a tilt."""
        if self.truth is None:
            raise ValueError("the truth of this recording is no tilt")
        error = tilt - self.truth
        slow = running_mean(error, self.time_s)
        mean, rest = (float(np.degrees(np.sqrt(np.nanmean((e**2).sum(axis=1))))) for e in (slow, error - slow))
        return mean, rest

    def best_deg(self, tilt: Floats) -> float:
        """The error at the estimate's own best lag."""
        step = (self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1)
        most, at = round(MOST_LAG_S / step), np.arange(len(tilt))
        stride = max(1, most // 12)
        lags = range(-most, most + 1, stride)
        return min(self.error_deg(tilt[np.clip(at + lag, 0, len(tilt) - 1)]) for lag in lags)


def running_mean(values: Floats, time_s: Floats) -> Floats:
    """Mean of values (N, k) over `SLOW_S` about each sample; over less at the ends."""
    n, half = len(time_s), round(0.5 * SLOW_S * (len(time_s) - 1) / (time_s[-1] - time_s[0]))
    total = np.cumsum(np.vstack([np.zeros((1, values.shape[1])), values]), axis=0)
    begin, end = np.maximum(np.arange(n) - half, 0), np.minimum(np.arange(n) + half + 1, n)
    return np.asarray((total[end] - total[begin]) / (end - begin)[:, None])


def pendulum(folder: Path) -> Iterator[Case]:
    """A link on a fixed pivot, Vicon; the mounting of the reference and its upward direction are fitted."""
    for path in sorted(folder.glob("Pendulum_*_Segment_1.csv")):
        lines = path.read_text(encoding="utf-8").splitlines()[2:]
        rows = np.array([[float(c.replace(",", ".")) for c in line.split(";") if c] for line in lines if line.strip()])
        time_s = np.linspace(0, rows[-1, 0] - rows[0, 0], len(rows))
        accel, gyro = np.ascontiguousarray(rows[:, 5:8]), np.ascontiguousarray(rows[:, 8:11])
        rotation = _mounted(matrices(rows[:, 1:5]), gyro, time_s, round(_RATE_S / time_s[1]))
        up = np.median(np.einsum("nij,nj->ni", rotation, accel), axis=0)
        tilt = np.einsum("nji,j->ni", rotation, up / np.linalg.norm(up))
        name = "pendulum " + path.stem[13:23]
        yield Case("repoimu_pendulum", name, time_s, accel, gyro, _against(tilt), PENDULUM_J2S, PENDULUM_DELAY_S, tilt)


def broad(folder: Path) -> Iterator[Case]:
    """Free motion, optical reference; errors where it moves."""
    for path in sorted(folder.glob("*.mat")):
        data = loadmat(path)
        accel, gyro = (np.ascontiguousarray(data[name], dtype=np.float64) for name in ("imu_acc", "imu_gyr"))
        tilt = matrices(data["opt_quat"])[:, 2, :]
        tilt[~data["movement"].ravel().astype(bool)] = np.nan
        time_s = np.arange(len(accel)) / float(data["sampling_rate"].item())
        yield Case("broad", "broad " + path.stem[:2], time_s, accel, gyro, _against(tilt), None, BROAD_DELAY_S, tilt)


class Pair(NamedTuple):
    """Readings of two sensors at the same times: accel (N, 2, 3) m/s², gyro (N, 2, 3) rad/s."""

    time_s: Floats
    accel_m_s2: Floats
    gyro_rad_s: Floats


def read_encoder(path: Path) -> tuple[Pair, Floats]:
    """Both MPU-6050, the fixed one first, and the shaft's angle (N,) rad; rows with impossible readings are dropped."""
    data = {key: np.ravel(value).astype(np.float64) for key, value in loadmat(path).items() if key[:2] != "__"}
    gyro, accel = (
        np.stack([np.column_stack([data[f"all_{kind}_{k}_{axis}"] for axis in "xyz"]) for k in (1, 2)], axis=1)
        for kind in ("gyro", "accel")
    )
    time_s = data["all_time"]
    in_range = (np.abs(gyro).max(axis=(1, 2)) < 2000) & (np.abs(accel).max(axis=(1, 2)) < 16)
    use = np.concatenate([[True], np.diff(time_s) > 0]) & in_range
    pair = Pair(time_s[use] - time_s[use][0], STANDARD_GRAVITY * accel[use], np.radians(gyro[use]))
    return pair, np.radians(data["all_encoder"][use])


def encoder(folder: Path) -> Iterator[Case]:
    """An MPU-6050 on a motor's shaft, with an encoder: the angle about the shaft, less its mean error."""
    for path in sorted(folder.glob("raw_[rp]*.mat")):  # yaw is no tilt
        across = 0 if "pitch" in path.stem else 1  # the shaft lies along y in the trials of pitch, else along x
        pair, angle = read_encoder(path)

        def errors_deg(tilt: Floats, angle: Floats = angle, across: int = across) -> Floats:
            measured = np.arctan2(tilt[:, across], tilt[:, 2])
            both = [np.angle(np.exp(1j * (sign * measured - angle))) for sign in (1, -1)]
            both = [np.angle(np.exp(1j * (e - np.angle(np.nanmean(np.exp(1j * e)))))) for e in both]
            return np.degrees(min(both, key=lambda e: float(np.nanmean(np.square(e)))))

        force, rate = (np.ascontiguousarray(values[:, 1]) for values in pair[1:])
        name = "encoder " + path.stem[4:]
        yield Case("mpu6050_encoder", name, pair.time_s, force, rate, errors_deg, None, ENCODER_DELAY_S)


def read_robot(path: Path) -> tuple[Floats, Floats, Floats, Floats]:
    """Of a `_imu.csv` beside its `_truth.csv`: time (N,) s, accel and gyro (N, 3), the link's rotation (N, 3, 3)."""
    read = np.loadtxt(path, delimiter=",", skiprows=1)
    truth = np.loadtxt(path.with_name(path.name.replace("_imu", "_truth")), delimiter=",", skiprows=1)
    n = min(len(read), len(truth))
    accel, gyro = np.ascontiguousarray(read[:n, 1:4]), np.ascontiguousarray(read[:n, 4:7])
    return (truth[:n, 0] - truth[0, 0]) * 1e-6, accel, gyro, matrices(truth[:n, 1:5])


def robot(folder: Path) -> Iterator[Case]:
    """A robot arm, encoder truth; the sensor's mounting on its link, and the upward direction, are fitted."""
    for path in sorted(folder.glob("*_imu.csv")):
        time_s, accel, gyro, link = read_robot(path)
        rotation = _mounted(link, gyro, time_s)
        up = np.median(np.einsum("nij,nj->ni", rotation, accel), axis=0)
        tilt = np.einsum("nji,j->ni", rotation, up / np.linalg.norm(up))
        yield Case(
            "openaxes_robot", "robot " + path.stem[:-4], time_s, accel, gyro, _against(tilt), None, ROBOT_DELAY_S, tilt
        )


def diodem(folder: Path) -> Iterator[Case]:
    """A chain of five links, optical reference at 30 Hz; mounting and upward direction are fitted."""
    if not folder.joinpath("trial1_imu_rigid.csv").is_file():
        return
    read, omc = (
        np.genfromtxt(folder / f"trial1_{name}.csv", delimiter=",", skip_header=2, names=True)
        for name in ("imu_rigid", "omc")
    )
    time_s, at_s = np.arange(len(read)) / 40.0, np.arange(len(omc)) / 30.0 - OMC_LATE_S
    for k in range(1, 6):
        accel, gyro = (np.column_stack([read[f"seg{k}_{kind}_{a}"] for a in "xyz"]) for kind in ("acc", "gyr"))
        quaternion = np.column_stack([omc[f"seg{k}_quat_{a}"] for a in "wxyz"])
        use = np.isfinite(quaternion).all(axis=1) & (at_s > 0)
        rotation = _mounted(matrices(quaternion[use]), _at(at_s[use], time_s, gyro), at_s[use])
        up = np.median(np.einsum("nij,nj->ni", rotation, _at(at_s[use], time_s, accel)), axis=0)
        errors = _against(np.einsum("nji,j->ni", rotation, up / np.linalg.norm(up)))

        def errors_deg(tilt: Floats, errors: Callable[[Floats], Floats] = errors, at_s: Floats = at_s[use]) -> Floats:
            found = _at(at_s, time_s, tilt)
            return errors(found / np.linalg.norm(found, axis=1, keepdims=True))

        yield Case("diodem_chain", f"diodem segment {k}", time_s, accel, gyro, errors_deg, None, 0.0)


def _at(at_s: Floats, time_s: Floats, values: Floats) -> Floats:
    """Values (N, 3) at other times, linearly between samples."""
    return np.column_stack([np.interp(at_s, time_s, column) for column in values.T])


def _mounted(rotation: Floats, gyro: Floats, time_s: Floats, stride: int = 1) -> Floats:
    """Rotations (N, 3, 3) from the sensor, for those from the link or to it: the mounting that fits the rates best.

    Rates are compared over `stride` samples.
    """
    steps = 0.5 * (gyro[1:] + gyro[:-1]) * np.diff(time_s)[:, None]  # between two samples, as the differences are
    total = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    span = (time_s[stride:] - time_s[:-stride])[:, None]
    gyro, fits = (total[stride:] - total[:-stride]) / span, []
    for turned in (rotation, rotation.transpose(0, 2, 1)):
        step = np.einsum("nji,njk->nik", turned[:-stride], turned[stride:])
        angle = np.column_stack(
            [step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]]
        )
        rate = 0.5 * angle / span
        u, _, v = np.linalg.svd(rate.T @ gyro)
        mount = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
        fits.append((float(np.square(rate @ mount - gyro).sum()), turned @ mount))
    return min(fits, key=lambda fit: fit[0])[1]


SETS = {
    "repoimu_pendulum": pendulum,
    "mpu6050_encoder": encoder,
    "broad": broad,
    "openaxes_robot": robot,
    "diodem_chain": diodem,
}


def matrices(quaternion: Floats) -> Floats:
    w, x, y, z = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
        2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, axis=1).reshape(-1, 3, 3)


def _against(truth: Floats) -> Callable[[Floats], Floats]:
    def errors_deg(tilt: Floats) -> Floats:
        return np.asarray(np.degrees(np.arccos(np.clip((tilt * truth).sum(axis=1), -1, 1))))

    return errors_deg


def block_of(case: Case) -> Measurements:
    """The recording as measurements of an inertial sensor alone."""
    n = len(case.time_s)
    nothing = np.full(n, np.nan)
    return Measurements(
        case.time_s, case.accel_m_s2, case.gyro_rad_s, nothing, nothing, nothing, np.zeros(n, bool),
        np.empty((n, 0, 2)), np.ones(n, np.uint16),
    )  # fmt: skip


def imu_of(name: str, delay_s: float) -> Imu:
    """For `tilt-inertial`, the sensor is declared calibrated, as it is; σ would include the errors of one as sold."""
    return Imu(delay_s=delay_s, accel_offset_std_m_s2=ERRORS.accel_bias_m_s2 if name == "tilt-inertial" else None)


def estimate_of(name: str, case: Case) -> dict[str, Floats]:
    """A filter's estimates (N,) by column, without the filter's name."""
    rig = Rig(joint=case.joint or Joint(), imu=imu_of(name, case.delay_s))
    made = JointInertialSmoother(rig) if name == "--smooth" else filters.create(name, rig)
    prefix = made.name.replace("-", "_") + "_"
    names = (column.removeprefix(prefix) for column in made.columns)
    return dict(zip(names, made.process(block_of(case)).T, strict=True))


def within_2sigma(case: Case, found: dict[str, Floats]) -> dict[str, float]:
    """Share of the second half's errors of roll and pitch within 2σ, as they are and averaged over `SLOW_S`."""
    if case.truth is None or "roll_std_deg" not in found:
        return {}
    x, y, z = case.truth.T
    true, shares = {"roll": np.arctan2(y, z), "pitch": np.arctan2(-x, np.hypot(y, z))}, {}
    half = slice(len(x) // 2, None)
    for name, angle in true.items():
        error = (found[f"{name}_deg"] - np.degrees(angle) + 180.0) % 360.0 - 180.0
        slow, std = running_mean(error[:, None], case.time_s)[:, 0], found[f"{name}_std_deg"]
        shares[f"{name}_within_2sigma"] = float((np.abs(error) < 2 * std)[half].mean())
        shares[f"slow_{name}_within_2sigma"] = float((np.abs(slow) < 2 * std)[half].mean())
    return shares


def tilt_from(roll_deg: Floats, pitch_deg: Floats) -> Floats:
    """Tilts (N, 3) from roll and pitch (N,)."""
    roll, pitch = np.radians(roll_deg), np.radians(pitch_deg)
    return np.column_stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])


def vqf_tilt(case: Case, offline: bool) -> Floats:
    """VQF's tilts (N, 3), turned on by the last rate less its bias for as long as the readings are late."""
    step = (case.time_s[-1] - case.time_s[0]) / (len(case.time_s) - 1)
    if offline:
        found = offlineVQF(case.gyro_rad_s, case.accel_m_s2, None, step)
    else:
        found = VQF(step).updateBatch(case.gyro_rad_s, case.accel_m_s2)
    tilt = matrices(found["quat6D"])[:, 2, :]
    turned = tilt - np.cross(case.delay_s * (case.gyro_rad_s - found["bias"]), tilt)
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


def rows(case: Case) -> Iterator[dict[str, object]]:
    """The scores of each filter on a recording."""
    peers = {offline: vqf_tilt(case, offline) for offline in ((False, True) if case.joint else (False,))}
    for used in (*(("joint-inertial", "--smooth", "joint") if case.joint else ()), "tilt", "tilt-inertial"):
        found = estimate_of(used, case)
        tilt, peer = tilt_from(found["roll_deg"], found["pitch_deg"]), peers[used == "--smooth"]
        scores = {"ours_deg": case.error_deg(tilt), "vqf_deg": case.error_deg(peer)}
        scores |= {"ours_best_lag_deg": case.best_deg(tilt), "vqf_best_lag_deg": case.best_deg(peer)}
        ratios = {"ratio": scores["ours_deg"] / scores["vqf_deg"]}
        ratios["ratio_best_lag"] = scores["ours_best_lag_deg"] / scores["vqf_best_lag_deg"]
        if case.joint:
            (scores["ours_slow_deg"], scores["fast_deg"]), (scores["vqf_slow_deg"], _) = map(
                case.split_deg, (tilt, peer)
            )
            ratios["ratio_slow"] = scores["ours_slow_deg"] / scores["vqf_slow_deg"]
            scores |= within_2sigma(case, found)
        about = {"set": case.data, "data": case.name, "filter": used, "chosen_on": case.name in CHOSEN_ON}
        yield {**about, **scores, **ratios}


def summary(found: list[dict[str, object]]) -> Iterator[dict[str, object]]:
    """Geometric means and the worst ratio of each set and filter."""
    for key in dict.fromkeys((row["set"], row["filter"]) for row in found):
        mine = [row for row in found if (row["set"], row["filter"]) == key]
        out: dict[str, object] = {"set": key[0], "filter": key[1], "trials": len(mine)}
        for name in (name for name in ("ratio", "ratio_best_lag", "ratio_slow") if name in mine[0]):
            values = np.array([float(str(row[name])) for row in mine])
            held_out = values[[not row["chosen_on"] for row in mine]]
            out[name] = float(np.exp(np.log(values).mean()))
            out[f"{name}_held_out"] = float(np.exp(np.log(held_out).mean())) if len(held_out) else None
            out[f"{name}_worst"] = float(values.max())
        yield out


def main() -> None:
    options = recordings_parser(__doc__).parse_args()
    for row in summary(list(print_rows(SETS, rows, options))):
        print_row(row, options.json)


if __name__ == "__main__":
    main()
