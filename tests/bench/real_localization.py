"""`linkpose localize` on public recordings of real robots, beside the figures that tuned filters of others reached.

    python tests/bench/real_localization.py [--data FOLDER] [--json]

FOLDER (../shared/data beside the checkout) holds plaza, mrclam, uwb_labyrinth, uwb_tag, auv_lbl, laser_maps and wean. A
recording that is not there is named and left out. Each recording is run with the default options and with those of a
user who knows the sensors.
"""

from __future__ import annotations

import argparse
import gzip
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from _report import RECORDINGS

from linkpose.localization import models
from linkpose.localization.carmen import BEAM_ANGLES_RAD, Reading, flaser_angles, format_reading
from linkpose.localization.grid import GridMap
from linkpose.localization.maps import load_map

PLAZA_RMS_M = {"Plaza1": 0.40, "Plaza2": 0.59}  # what a tuned EKF of others reached
MRCLAM_RMS_M, LABYRINTH_RMS_M = 0.17, 0.15
TAG_RMS_M, AUV_RMS_M = 0.090, 5.3  # a constant-velocity EKF with a bias; GTSAM's batch optimum
FILES = 5  # log, --beacons, file, --truth, file: what is no option of the filter
MRCLAM_ROBOTS = range(1, 6)
WEAN_START_SPREAD = ((0.0, 0.0, 0.0), (0.5, 0.0, 0.1), (-0.5, 0.0, -0.1), (0.0, 0.5, -0.1), (0.0, -0.5, 0.1))
WEAN_CANDIDATES = 30
WEAN_ENDS_M = {"robotdata1": (39.90, 41.43)}  # where a particle filter of others ended
# An old map, people in the hall, and walls of glass: most of a beam's error is the map's.
WEAN_OPTIONS = ["--start-std", "0.5,0.15", "--range-std", "1", "--range-growth", "0.05", "--gate", "0.95"]


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


def wean_starts(grid: GridMap, first: Reading) -> list[tuple[float, float, float]]:
    """The poses of the map from which the first scan looks most like what it was, best first."""
    table = np.zeros((len(BEAM_ANGLES_RAD), 5))
    seen = [int(np.argmin(np.abs(first.angles_rad - angle))) for angle in BEAM_ANGLES_RAD]
    table[:, 0], table[:, 1], table[:, 4] = first.angles_rad[seen], 0.25, 80.0
    rows, columns = np.nonzero(grid.blocked == 0)
    places = np.unique(np.column_stack((columns, rows)) // 4, axis=0) * 0.4 + 0.2
    scored, expected = [], np.empty(len(seen))
    for x, y in places:
        for heading in np.arange(-math.pi, math.pi, math.pi / 18):
            models.predict(models.BEAMS, np.array([x, y, heading]), table, grid.blocked, grid.geometry, expected)
            off = np.minimum(np.abs(expected - first.ranges_m[seen]), 1.0)
            scored.append((float(off.mean()), (float(x), float(y), float(heading))))
    return [pose for _, pose in sorted(scored)[:WEAN_CANDIDATES]]


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
    """No truth: does the filter, from starts half a metre and a tenth of a radian apart, end at one place?"""
    map_path = wean_map(folder, out)
    grid = load_map(map_path)
    for path in sorted(folder.glob("robotdata*.log.gz")):
        log, readings = wean_log(path, out)
        first = next(reading for reading in readings if reading.ranges_m is not None)
        common = [str(log), "--map", str(map_path), *WEAN_OPTIONS]

        def fits(start: tuple[float, float, float], common: list[str] = common) -> float:
            (row,) = run_localize([*common, f"--start={start[0]},{start[1]},{start[2]}", "--filter", "ukf"])
            return row["updates"] / (row["updates"] + row["rejected"])

        best = max(wean_starts(grid, first), key=fits)
        for name in ("ekf", "ukf"):
            ends, accepted = [], []
            for dx, dy, turn in WEAN_START_SPREAD:
                start = f"--start={best[0] + dx},{best[1] + dy},{best[2] + turn}"
                (row,) = run_localize([*common, start, "--filter", name, "-o", str(out / "wean_path.csv"), "--force"])
                accepted.append(row["updates"] / (row["updates"] + row["rejected"]))
                ends.append(last_pose(out / "wean_path.csv", name))
            spread = np.max(np.linalg.norm(np.array(ends)[:, :2] - np.median(ends, axis=0)[:2], axis=1))
            x, y, _ = np.median(ends, axis=0)
            known = WEAN_ENDS_M.get(path.name.split(".")[0])
            yield {
                "bench": f"wean_{path.name.split('.')[0]}",
                "filter": name,
                "starts": len(ends),
                "accepted": float(np.mean(accepted)),
                "end_spread_m": float(spread),
                "end_from_others_m": math.dist((x, y), known) if known else None,
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
    """Two buildings, with the start given and without, beside Monte-Carlo localisation in the same run."""
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


def with_truth(cases: Iterable[Case]) -> Iterable[dict[str, object]]:
    """Each case with the default options, and with the documented ones for both filters."""
    for case in cases:
        for row in run_localize(case.arguments[:FILES]):
            yield {"bench": case.name, "options": "default", **row, "others_position_rmse_m": case.limit_m}
        for row in run_localize([*case.arguments, "--filter", "ekf", "--filter", "ukf"]):
            options = " ".join(case.arguments[FILES:]) or "default"
            yield {"bench": case.name, "options": options, **row, "others_position_rmse_m": case.limit_m}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=RECORDINGS, help="folder of the recordings")
    parser.add_argument("--json", action="store_true", help="one object a line")
    options = parser.parse_args()
    sources: dict[str, Callable[[Path, Path], Iterable[dict[str, object]]]] = {
        "plaza": lambda folder, out: with_truth(plaza(folder, out)),
        "mrclam": lambda folder, out: with_truth(mrclam(folder, out)),
        "uwb_labyrinth": lambda folder, out: with_truth(uwb_labyrinth(folder, out)),
        "uwb_tag": lambda folder, out: with_truth(uwb_tag(folder, out)),
        "auv_lbl": lambda folder, out: with_truth(auv_lbl(folder, out)),
        "laser_maps": laser_maps,
        "wean": wean,
    }
    with tempfile.TemporaryDirectory() as out:
        for name, source in sources.items():
            folder = options.data / name
            if not folder.is_dir():
                print(f"{folder} is not there: left out", file=sys.stderr)
                continue
            for row in source(folder, Path(out)):
                print(
                    json.dumps(row) if options.json else "  ".join(f"{key} {value}" for key, value in row.items()),
                    flush=True,
                )


if __name__ == "__main__":
    main()
