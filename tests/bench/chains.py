"""Relative orientation of two links from public recordings, beside VQF's and qmt's in the same run.

    python tests/bench/chains.py [--data FOLDER] [--only TEXT] [--json]

FOLDER (../shared/data beside the checkout) holds diodem_chain, openaxes_robot and mpu6050_encoder, each as its authors
published it; a missing one is named and skipped. Our filter is causal and is given the kind of the joint alone;
`chain --smooth` uses the whole recording.

Peers: two VQF without and with a magnetometer (`vqf_6d`, `vqf_9d`), and for hinges qmt's heading correction of the
former, with windows that end at the estimate (`qmt_causal`) or lie around it (`qmt_batch`); both use axes that qmt
finds from the whole recording. qmt's correction of ball joints needs the ranges of the joint's angles: not known here.

The error is the root mean square angle between the relative rotations after a constant alignment on either side,
without the first 5 s. The reference is read
at the sensor's time less one delay for each set (the lag of the gyros behind its rate), for all filters alike.
`within_2sigma` is the share of these errors below twice the reported standard deviation, `unknown` the share of samples
without an estimate.

`chosen_on` marks the pairs on which constants of the filter were chosen; other starts were held out.
"""

from __future__ import annotations

import contextlib
import io
import math
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import qmt
from _report import print_rows, recordings_parser
from real_data import ENCODER_DELAY_S, OMC_LATE_S, Pair, matrices, read_encoder, read_robot
from vqf import VQF

import linkpose as lp
from linkpose import filters
from linkpose.sensors.measurements import Floats

SKIPPED_S = 5.0
DIODEM_JOINTS = {(1, 2): "ball", (2, 3): "hinge", (3, 4): "hinge", (4, 5): "hinge"}
LATER_STARTS_S = (0.0, 10.0, 20.0, 30.0)
CHOSEN_STARTS_S = (0.0, 20.0)
LONGEST_CHOSEN_S = 400.0  # of mpu6050_encoder
MOST_ALIGNED = 2000  # samples, evenly spaced, that the alignment is fitted to
Rotations = Floats  # (N, 3, 3), from sensor 2's axes into sensor 1's


class Case(NamedTuple):
    """Two sensors and the true rotation of link 2 relative to link 1."""

    data: str
    name: str
    pair: Pair
    mag: Floats | None  # (N, 2, 3), any unit
    truth: Rotations
    joint: str
    chosen_on: bool
    known: Floats  # (N,) whether the reference exists


def diodem(folder: Path) -> Iterator[Case]:
    """Five segments, optical reference, from several starts."""
    for path in sorted(folder.glob("*_imu_rigid.csv")):
        read = np.genfromtxt(path, delimiter=",", skip_header=2, names=True)
        seen = np.genfromtxt(Path(str(path).replace("_imu_rigid", "_omc")), delimiter=",", skip_header=2, names=True)
        time_s = np.arange(len(read)) / _first_line_rate(path)
        seen_s = np.arange(len(seen)) / _first_line_rate(Path(str(path).replace("_imu_rigid", "_omc")))
        for (a, b), joint in DIODEM_JOINTS.items():
            accel, gyro, mag = (
                np.stack([np.column_stack([read[f"seg{k}_{kind}_{c}"] for c in "xyz"]) for k in (a, b)], axis=1)
                for kind in ("acc", "gyr", "mag")
            )
            first, second = (np.column_stack([seen[f"seg{k}_quat_{c}"] for c in "wxyz"]) for k in (a, b))
            truth, known = _interpolated(seen_s, qmt.qmult(qmt.qinv(first), second), time_s + OMC_LATE_S)
            for start_s in LATER_STARTS_S:
                pair = _from(Pair(time_s, accel, gyro), start_s)
                cut = slice(len(time_s) - len(pair.time_s), None)
                name = f"diodem {path.stem[:6]} {a}-{b} from {start_s:.0f} s"
                chosen = path.stem.startswith("trial1") and start_s in CHOSEN_STARTS_S
                yield Case("diodem_chain", name, pair, mag[cut], truth[cut], joint, chosen, known[cut])


def _first_line_rate(path: Path) -> float:
    with path.open(encoding="utf-8") as file:
        return float(file.readline().rsplit(":", 1)[1])


def _interpolated(seen_s: Floats, quaternion: Floats, time_s: Floats) -> tuple[Rotations, Floats]:
    """Rotations at other times, and whether both neighbours are present; linear between quaternions 33 ms apart."""
    sound = np.isfinite(quaternion).all(axis=1)
    kept = qmt.quatUnwrap(quaternion[sound])
    mixed = np.column_stack([np.interp(time_s, seen_s[sound], kept[:, i]) for i in range(4)])
    known = np.interp(time_s, seen_s, sound.astype(float), left=0.0, right=0.0) > 0.99
    return matrices(mixed), known


def robot(folder: Path) -> Iterator[Case]:
    """Two links of a robot arm (radius, carpus), encoder reference, from several starts."""
    for path in sorted(folder.glob("*_radius_imu.csv")):
        read = [read_robot(path), read_robot(path.with_name(path.name.replace("_radius", "_carpus")))]
        n = min(len(each[0]) for each in read)
        accel, gyro = (np.stack([each[i][:n] for each in read], axis=1) for i in (1, 2))
        truth = np.einsum("nji,njk->nik", read[0][3][:n], read[1][3][:n])
        for start_s in LATER_STARTS_S:
            pair = _from(Pair(read[0][0][:n], accel, gyro), start_s)
            name = f"robot {path.stem.removesuffix('_radius_imu')} from {start_s:.0f} s"
            chosen = "circle-100" in name and start_s in CHOSEN_STARTS_S
            known = np.ones(len(pair.time_s), bool)
            yield Case("openaxes_robot", name, pair, None, truth[-len(known) :], "hinge", chosen, known)


def _from(pair: Pair, start_s: float) -> Pair:
    """The readings from a time on, with that time as zero."""
    first = int(np.searchsorted(pair.time_s, start_s))
    return Pair(pair.time_s[first:] - pair.time_s[first], *(values[first:] for values in pair[1:]))


def encoder(folder: Path) -> Iterator[Case]:
    """A fixed MPU-6050 and one on a motor's shaft."""
    for path in sorted(folder.glob("raw_*.mat")):
        pair, angle = read_encoder(path)
        turned = np.interp(pair.time_s - ENCODER_DELAY_S, pair.time_s, angle)
        c, s, zero, one = np.cos(turned), np.sin(turned), np.zeros_like(turned), np.ones_like(turned)
        truth = np.stack([one, zero, zero, zero, c, -s, zero, s, c], axis=1).reshape(-1, 3, 3)
        use = pair.time_s < LONGEST_CHOSEN_S
        for name, cut, chosen in (("start", use, True), ("whole", np.ones(len(use), bool), False)):
            part = Pair(*(values[cut] for values in pair))
            about = f"encoder {path.stem[4:]} {name}"
            yield Case("mpu6050_encoder", about, part, None, truth[cut], "hinge", chosen, np.ones(cut.sum(), bool))


SETS = {"diodem_chain": diodem, "openaxes_robot": robot, "mpu6050_encoder": encoder}


class Found(NamedTuple):
    """Relative rotations (N, 4) wxyz and, for a filter that reports it, their σ (N,) in degrees; time of one sample."""

    quaternion: Floats
    std_deg: Floats | None
    sample_us: float


def ours(case: Case, smooth: bool) -> Found:
    """The chain filter, with nothing known but the kind of the joint."""
    accel, gyro = case.pair.accel_m_s2, case.pair.gyro_rad_s
    measured = lp.Measurements.from_imu(
        case.pair.time_s, accel[:, 0], gyro[:, 0], accel2_m_s2=accel[:, 1], gyro2_rad_s=gyro[:, 1]
    )
    began = time.perf_counter()
    joint = "hinge" if case.joint == "hinge" else "ball"
    estimates = lp.estimate(measured, filters=["chain"], joint=joint, smooth=smooth)
    took = time.perf_counter() - began
    quaternion = np.column_stack([estimates[f"chain_q{axis}"] for axis in "wxyz"])
    return Found(quaternion, estimates["chain_rotation_std_deg"], 1e6 * took / len(accel))


def peers(case: Case) -> Iterator[tuple[str, Found]]:
    """Each peer that the case allows."""
    step = _step(case)
    began = time.perf_counter()
    both = [_vqf(case, k, step) for k in range(2)]
    took = time.perf_counter() - began
    first, second = (each["quat6D"] for each in both)
    yield "vqf_6d", _found(first, second, took)
    if case.mag is not None:
        nine = [each["quat9D"] for each in both]
        yield "vqf_9d", _found(*nine, took)
    if case.joint == "hinge":
        began = time.perf_counter()
        axis1, axis2 = _hinge_axes(case)
        turned = qmt.qmult(first, _onto_z(axis1)), qmt.qmult(second, _onto_z(axis2))
        rates = [
            qmt.rotate(qmt.qinv(_onto_z(axis)), case.pair.gyro_rad_s[:, k]) for k, axis in ((0, axis1), (1, axis2))
        ]
        at = np.arange(len(first)) * step
        axes_took = time.perf_counter() - began
        for name, alignment in (("qmt_causal", "backward"), ("qmt_batch", "center")):
            began = time.perf_counter()
            settings = {"alignment": alignment}
            corrected = qmt.headingCorrection(*rates, *turned, at, np.array([0.0, 0.0, 1.0]), {}, settings)[0]
            yield name, _found(turned[0], corrected, took + axes_took + time.perf_counter() - began)


def _step(case: Case) -> float:
    """The sampling interval, from a rate in whole hertz as qmt asks."""
    return 1.0 / round((len(case.pair.time_s) - 1) / (case.pair.time_s[-1] - case.pair.time_s[0]))


def _vqf(case: Case, k: int, step: float) -> dict[str, Floats]:
    mag = None if case.mag is None else np.ascontiguousarray(case.mag[:, k])
    gyro, accel = (np.ascontiguousarray(values[:, k]) for values in (case.pair.gyro_rad_s, case.pair.accel_m_s2))
    found: dict[str, Floats] = VQF(step).updateBatch(gyro, accel, mag)
    return found


def _found(first: Floats, second: Floats, took: float) -> Found:
    return Found(qmt.qmult(qmt.qinv(first), second), None, 1e6 * took / len(first))


def _hinge_axes(case: Case) -> tuple[Floats, Floats]:
    """Axis of the hinge in either sensor's axes; qmt leaves the sense between the two open in slow motion."""
    accel, gyro = case.pair.accel_m_s2, case.pair.gyro_rad_s
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():  # it prints each step
        warnings.simplefilter("ignore")
        found = qmt.jointAxisEstHingeOlsson(
            accel[:, 0], accel[:, 1], gyro[:, 0], gyro[:, 1], {"useSampleSelection": True}
        )
    first, second = (np.ravel(axis) for axis in found)
    return first, second


def _onto_z(axis: Floats) -> Floats:
    """Rotation (4,) of Z onto the axis."""
    across = np.cross([0.0, 0.0, 1.0], axis)
    return np.ravel(qmt.quatFromAngleAxis(math.acos(np.clip(axis[2], -1, 1)), across if across.any() else [1.0, 0, 0]))


def errors_deg(found: Rotations, truth: Rotations, use: Floats) -> Floats:
    """Angles (N,) between A found B and truth, for the constant rotations A, B that fit best where `use` is true.

    A and B follow in turn, each as the best rotation for the other (Kabsch), from both of which the fit descends.
    """
    thin = np.flatnonzero(use)[:: max(1, use.sum() // MOST_ALIGNED)]
    mine, true = found[thin], truth[thin]
    best = math.inf, np.eye(3), np.eye(3)
    for start in _starts():
        after = start
        for _ in range(60):
            before = _nearest(np.einsum("nij,njk->ik", true, (mine @ after).transpose(0, 2, 1)))
            after = _nearest(np.einsum("nij,njk->ik", (before @ mine).transpose(0, 2, 1), true))
        cost = float(np.square(before @ mine @ after - true).sum())
        if cost < best[0]:
            best = cost, before, after
    cosine = (np.einsum("nij,nij->n", best[1] @ found @ best[2], truth) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def _starts() -> Iterator[Rotations]:
    """The 24 rotations of a cube: the alternation finds the nearest minimum only."""
    for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1)):
        for angle in (0, 90, 180, 270):
            for other in (0, 180):
                first = qmt.quatFromAngleAxis(math.radians(angle), axis)
                second = qmt.quatFromAngleAxis(math.radians(other), (axis[1], axis[2], axis[0]))
                yield matrices(np.atleast_2d(qmt.qmult(first, second)))[0]


def _nearest(matrix: Floats) -> Floats:
    """The rotation nearest to a matrix."""
    u, _, v = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v)


def scores(case: Case, found: Found) -> dict[str, object]:
    """RMSE, share within 2σ and share of samples without an estimate, from the sixth second on."""
    late = case.known & (case.pair.time_s >= SKIPPED_S)
    use = late & np.isfinite(found.quaternion).all(axis=1)
    out: dict[str, object] = {"rmse_deg": None, "unknown": 1 - use.sum() / late.sum(), "sample_us": found.sample_us}
    if use.any():
        error = errors_deg(matrices(found.quaternion), case.truth, use)[use]
        out["rmse_deg"] = float(np.sqrt(np.mean(error**2)))
        if found.std_deg is not None:
            out["within_2sigma"] = float(np.mean(error < 2 * found.std_deg[use]))
            out["mean_std_deg"] = float(np.mean(found.std_deg[use]))
    return out


def rows(case: Case) -> Iterator[dict[str, object]]:
    """The scores of each filter on a pair of sensors."""
    about = {"set": case.data, "data": case.name, "joint": case.joint, "chosen_on": case.chosen_on}
    yield {**about, "filter": "chain", **scores(case, ours(case, smooth=False))}
    yield {**about, "filter": "chain --smooth", **scores(case, ours(case, smooth=True))}
    for name, found in peers(case):
        yield {**about, "filter": name, **scores(case, found)}


def main() -> None:
    options = recordings_parser(__doc__).parse_args()
    filters.warm_up(["chain"])
    list(print_rows(SETS, rows, options))


if __name__ == "__main__":
    main()
