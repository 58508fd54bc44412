"""`linkpose localize` on public recordings of real robots, beside the figures that tuned filters of others reached.

    python tests/bench/real_localization.py [--data FOLDER] [--quick] [--json]

FOLDER (../shared/data beside the checkout) holds plaza, mrclam, uwb_labyrinth, uwb_tag, auv_lbl, laser_maps and wean. A
recording that is not there is named and left out. Each recording is run with the default options, smoothed, and with
options from the sensors' data sheets. Beside them run filterpy's extended Kalman filter, Monte-Carlo localization
(laser), and the batch optimum of GTSAM, which takes some minutes and is left out with --quick.
"""

from __future__ import annotations

import gzip
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from _localization_peers import filterpy_path, gtsam_path, problem_of
from _report import is_there, print_row, recordings_parser

from linkpose.localization.carmen import Reading, flaser_angles, format_reading
from linkpose.localization.events import Event
from linkpose.localization.localizer import estimate_track
from linkpose.localization.logs import read_log
from linkpose.localization.measuring import default_constants
from linkpose.localization.noise import RangeNoise
from linkpose.localization.settings import Settings
from linkpose.localization.tables import read_beacons, read_truth, score
from linkpose.localization.tuning import TUNABLE, tune
from linkpose.localization.vehicle import kinds_of

PLAZA_RMS_M = {"Plaza1": 0.40, "Plaza2": 0.59}  # what a tuned EKF of others reached
MRCLAM_RMS_M, LABYRINTH_RMS_M = 0.17, 0.15
TAG_RMS_M, AUV_RMS_M = 0.090, 5.3  # a constant-velocity EKF with a bias; GTSAM's batch optimum
FILES = 5  # log, --beacons, file, --truth, file: what is no option of the filter
MRCLAM_ROBOTS = range(1, 6)
WEAN_ENDS_M = {"robotdata1": (39.90, 41.43)}  # where a particle filter of others ended


@dataclass(frozen=True)
class Case:
    """A recording as inputs of `linkpose localize`."""

    name: str
    arguments: list[str]
    limit_m: float | None


def write_csv(path: Path, header: str, rows: Iterable[tuple[object, ...]]) -> Path:
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n", encoding="utf-8")
    return path


def write_log(path: Path, rows: list[tuple[object, ...]]) -> Path:
    return write_csv(path, "time_s,kind,a,b,c", sorted(rows, key=lambda row: float(str(row[0]))))


def plaza(folder: Path, out: Path) -> list[Case]:
    """A lawn mower with range radios that read 6.6 % long, and 97 s without any. The first true pose starts the log."""
    from scipy.io import loadmat

    cases = []
    for name, limit in PLAZA_RMS_M.items():
        if not (folder / f"{name}_.mat").exists():
            continue
        data = loadmat(folder / f"{name}_.mat")
        truth, odometry, ranges = data["GT"], data["DR"], data["TD"]
        truth[:, 3] += math.pi if name == "Plaza2" else 0.0  # its headings are turned about
        zero = truth[0, 0]
        # An increment is stamped when it ends; as a speed it holds from the stamp before.
        starts = np.concatenate(([zero], odometry[:-1, 0]))
        rows: list[tuple[object, ...]] = [(0.0, "pose", *truth[0, 1:4])]
        for start, (end, way, turn) in zip(starts, odometry, strict=True):
            rows.append((start - zero, "odometry", way / (end - start), turn / (end - start), ""))
        rows += [(t - zero, "range", int(beacon), r, "") for t, _, beacon, r in ranges]
        log = write_log(out / f"{name}.csv", rows)
        beacons = write_csv(out / f"{name}_beacons.csv", "id,x_m,y_m", ((int(i), x, y) for i, x, y in data["TL"]))
        path = ((t - zero, x, y, h) for t, x, y, h in truth)
        reference = write_csv(out / f"{name}_truth.csv", "time_s,x_m,y_m,heading_rad", path)
        options = ["--estimate", "scale", "--range-std", "0.5", "--turn-std", "0.05"]
        cases.append(Case(name, [str(log), "--beacons", str(beacons), "--truth", str(reference), *options], limit))
    return cases


def mrclam(folder: Path, out: Path) -> list[Case]:
    """A small robot that sees barcodes on posts. Barcodes of other robots are left out."""
    cases = []
    for data in sorted(folder.glob("MRCLAM_Dataset*")):
        barcodes = {int(code): int(subject) for subject, code in np.loadtxt(data / "Barcodes.dat")}
        landmarks = np.loadtxt(data / "Landmark_Groundtruth.dat")
        known = set(landmarks[:, 0].astype(int))
        beacons = write_csv(
            out / f"{data.name}_beacons.csv", "id,x_m,y_m", ((int(i), x, y) for i, x, y, _, _ in landmarks)
        )
        for robot in MRCLAM_ROBOTS:
            if not (data / f"Robot{robot}_Odometry.dat").exists():
                continue
            truth, odometry, seen = (
                np.loadtxt(data / f"Robot{robot}_{part}.dat") for part in ("Groundtruth", "Odometry", "Measurement")
            )
            zero = max(truth[0, 0], odometry[0, 0])
            start = truth[np.searchsorted(truth[:, 0], zero), 1:4]
            rows: list[tuple[object, ...]] = [(0.0, "pose", *start)]
            rows += [(t - zero, "odometry", v, w, "") for t, v, w in odometry if t >= zero]
            rows += [
                (t - zero, "bearing_range", barcodes[int(code)], r, b)
                for t, code, r, b in seen
                if t >= zero and barcodes.get(int(code)) in known
            ]
            name = f"{data.name.lower()}_robot{robot}"
            log = write_log(out / f"{name}.csv", rows)
            reference = write_csv(
                out / f"{name}_truth.csv", "time_s,x_m,y_m,heading_rad", ((t - zero, x, y, h) for t, x, y, h in truth)
            )
            options = ["--range-std", "0.2", "--bearing-std", "0.05"]
            cases.append(
                Case(name, [str(log), "--beacons", str(beacons), "--truth", str(reference), *options], MRCLAM_RMS_M)
            )
    return cases


def uwb_labyrinth(folder: Path, out: Path) -> list[Case]:
    """A robot with an ultra-wideband radio. Its wheel columns are swapped, and its 'distance between wheels' is half of
    it.
    """
    rows: list[tuple[object, ...]] = []
    beacons: dict[int, tuple[float, float]] = {}
    for line in (folder / "Indoor_UWB_Input.txt").read_text().splitlines():
        kind, *words = line.split()
        values = [float(word) for word in words]
        if kind == "range2":
            beacons[int(values[5])] = (values[3], values[4])
            rows.append((values[0], "range", int(values[5]), values[1], ""))
        elif kind == "odom2diff":
            left, right, half_track = values[1], values[2], values[4]
            rows.append((values[0], "odometry", (left + right) / 2, (right - left) / (2 * half_track), ""))
    truth = np.array(
        [
            [float(word) for word in line.split()[1:4]]
            for line in (folder / "Indoor_UWB_GT.txt").read_text().splitlines()
        ]
    )
    rows.append((truth[0, 0], "pose", *truth[0, 1:3], 2.985))
    log = write_log(out / "uwb.csv", rows)
    places = write_csv(out / "uwb_beacons.csv", "id,x_m,y_m", ((i, *place) for i, place in beacons.items()))
    reference = write_csv(out / "uwb_truth.csv", "time_s,x_m,y_m", (tuple(row) for row in truth))
    options = ["--estimate", "bias", "--range-std", "0.1", "--start-std", "0.1,0.05"]
    return [
        Case(
            "uwb_labyrinth", [str(log), "--beacons", str(places), "--truth", str(reference), *options], LABYRINTH_RMS_M
        )
    ]


def wean_map(folder: Path, out: Path) -> Path:
    """The map as map_server has it. In the file the first index is x, 1 is free, 0 occupied, -1 unknown."""
    from PIL import Image

    with gzip.open(folder / "wean.dat.gz", "rt") as file:
        rows = [line.split() for line in file if not line.startswith(("robot", "global"))]
    free = np.array([[float(word) for word in row] for row in rows if row]).T
    pixels = np.where(free < 0, 127, np.round(254 * free)).astype(np.uint8)
    Image.fromarray(pixels[::-1]).save(out / "wean.pgm")
    text = "image: wean.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.45\n"
    (out / "wean.yaml").write_text(text)
    return out / "wean.yaml"


def wean_log(path: Path, out: Path) -> tuple[Path, list[Reading]]:
    """Odometry and scans as a CARMEN log, centimetres turned into metres."""
    readings = []
    with gzip.open(path, "rt") as file:
        lines = file.readlines()
    for line in lines:
        kind, *words = line.split()
        values = np.array([float(word) for word in words])
        pose = (values[0] / 100, values[1] / 100, values[2])
        if kind == "O":
            readings.append(Reading(values[-1], pose))
        else:
            laser = (values[3] / 100, values[4] / 100, values[5])
            readings.append(Reading(values[-1], pose, values[6:-1] / 100, flaser_angles(len(values) - 7), laser))
    log = out / f"{path.name.split('.')[0]}.log"
    log.write_text("\n".join(map(format_reading, readings)) + "\n")
    return log, readings


def run_localize(arguments: list[str]) -> list[dict[str, float]]:
    command = [sys.executable, "-m", "linkpose", "localize", *arguments, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: {done.stderr.strip()}")
    return [json.loads(line) for line in done.stdout.splitlines()]


def last_pose(path: Path, name: str) -> np.ndarray:
    """x, y, heading of the last row of an estimate."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    row = dict(zip(lines[0].split(","), lines[-1].split(","), strict=True))
    return np.array([float(row[f"{name}_{state}"]) for state in ("x_m", "y_m", "heading_rad")])


def wean(folder: Path, out: Path) -> Iterable[dict[str, object]]:
    """No truth: where the default filter ends, without a start, and how far from the end that particle
    filters of others found.
    """
    map_path = wean_map(folder, out)
    for path in sorted(folder.glob("robotdata*.log.gz")):
        log, _ = wean_log(path, out)
        common = [str(log), "--map", str(map_path), "-o", str(out / "wean_path.csv"), "--force"]
        (row,) = run_localize(common)
        end = last_pose(out / "wean_path.csv", "scan_match")
        known = WEAN_ENDS_M.get(path.name.split(".")[0])
        yield {
            "bench": f"wean_{path.name.split('.')[0]}",
            "options": "default",
            "filter": "scan-match",
            "known_share": row["known_share"],
            "relocated": row["relocated"],
            "end_m": end[:2].tolist(),
            "end_from_others_m": math.dist(end[:2], known) if known else None,
        }


def uwb_tag(folder: Path, out: Path) -> list[Case]:
    """A tag without odometry among eight anchors, in linkpose's own form."""
    files = [str(folder / "ranges.csv"), "--beacons", str(folder / "beacons.csv"), "--truth", str(folder / "truth.csv")]
    return [Case("uwb_tag", files, TAG_RMS_M)]


def auv_lbl(folder: Path, out: Path) -> list[Case]:
    """An underwater vehicle with acoustic ranges every 6 s, in linkpose's own form."""
    names = (folder / f"goats14{part}.csv" for part in ("", "_b", "_t"))
    log, beacons, truth = map(str, names)
    return [Case("goats14", [log, "--beacons", beacons, "--truth", truth, "--range-std", "3"], AUV_RMS_M)]


def laser_maps(folder: Path, out: Path) -> Iterable[dict[str, object]]:
    """Two buildings, with the start given and without, beside Monte-Carlo localization in the same run."""
    for name in ("intel", "freiburg-101"):
        truth = folder / f"{name}.truth.csv"
        start, x, y, heading = np.loadtxt(truth, delimiter=",", skiprows=1, max_rows=1)
        lines = (folder / f"{name}.log").read_text().splitlines()
        log = out / f"{name}.log"
        log.write_text("\n".join(line for line in lines if float(line.split()[-1]) >= start - 1e-6) + "\n")
        common = [str(log), "--map", str(folder / f"{name}.yaml"), "--truth", str(truth)]
        given = f"--start={x},{y},{heading}"
        for options in ([], [given], [given, "--filter", "mcl"]):
            (row,) = run_localize([*common, *options])
            yield {"bench": name, "options": " ".join(options) or "default", **row}


def with_truth(cases: Iterable[Case], batch: bool) -> Iterable[dict[str, object]]:
    """Each case with the default options, smoothed, with the documented options for both filters, and the peers."""
    for case in cases:
        others = {"others_position_rmse_m": case.limit_m}
        for options in ((), ("--smooth",), ("--filter", "ukf")):
            for row in run_localize([*case.arguments[:FILES], *options]):
                yield {"bench": case.name, "options": " ".join(options) or "default", **row, **others}
        for row in run_localize([*case.arguments, "--filter", "ekf", "--filter", "ukf"]):
            yield {"bench": case.name, "options": " ".join(case.arguments[FILES:]) or "default", **row, **others}
        for row in peers(case, batch):
            yield {"bench": case.name, "options": "noises of linkpose's default", **row}


def peers(case: Case, batch: bool) -> Iterable[dict[str, object]]:
    """filterpy's filter and, with `batch`, GTSAM's optimum, with the noises that linkpose estimates from the log."""
    log, beacons = read_log(Path(case.arguments[0])).events, read_beacons(Path(case.arguments[2]))
    truth = read_truth(Path(case.arguments[4]))
    ranged = {event.beacon for event in log if isinstance(event, Event) and event.kind == "range"}
    first = Settings(ranges=RangeNoise("affine"), estimate=default_constants(kinds_of(log), len(ranged)))
    settings = tune(log, first, beacons, TUNABLE)
    problem = problem_of(log, beacons, settings)
    time_s, path = filterpy_path(problem)
    yield {"filter": "filterpy ekf", "position_rmse_m": score(time_s, path, None, truth).position_rmse_m}
    if not batch:
        return
    track = estimate_track(log, "ekf", replace(settings, smooth=True), None, beacons)
    columns = [np.interp(time_s, track.time_s, column) for column in track.position_m[:, :2].T]
    if problem.form == "odometry":
        columns.append(np.interp(time_s, track.time_s, np.unwrap(np.asarray(track.heading_rad))))
    elif problem.form == "none":
        columns += [np.gradient(column, time_s) for column in columns]
    ours = score(time_s, np.column_stack(columns[:2]), None, truth).position_rmse_m
    for with_drift in (False, True) if settings.drift_std_m else (False,):
        time_s, path = gtsam_path(problem, np.column_stack(columns), with_drift)
        optimum = score(time_s, path, None, truth).position_rmse_m
        name = "gtsam batch optimum" + (" with the drift" if with_drift else "")
        yield {"filter": name, "position_rmse_m": optimum, "smoothed_over_optimum": ours / optimum}


def main() -> None:
    parser = recordings_parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="leave out the batch optimum of GTSAM")
    options = parser.parse_args()
    sources: dict[str, Callable[[Path, Path], Iterable[dict[str, object]]]] = {
        "plaza": lambda folder, out: with_truth(plaza(folder, out), not options.quick),
        "mrclam": lambda folder, out: with_truth(mrclam(folder, out), not options.quick),
        "uwb_labyrinth": lambda folder, out: with_truth(uwb_labyrinth(folder, out), not options.quick),
        "uwb_tag": lambda folder, out: with_truth(uwb_tag(folder, out), not options.quick),
        "auv_lbl": lambda folder, out: with_truth(auv_lbl(folder, out), not options.quick),
        "laser_maps": laser_maps,
        "wean": wean,
    }
    with tempfile.TemporaryDirectory() as out:
        for name, source in sources.items():
            folder = options.data / name
            for row in source(folder, Path(out)) if options.only in name and is_there(folder) else ():
                print_row(row, options.json)


if __name__ == "__main__":
    main()
