"""How well the planar filters do beside ten lines of gyro and mice, on simulated drives: rms of position and heading.

python tests/bench/mice.py [--json] [--seeds FIRST-LAST]
"""

from __future__ import annotations

import argparse
import json
import math

import numpy as np
from _report import bench_parser

from linkpose import filters
from linkpose.experiments.planar import CASES, PoseError, baseline, pose_error

FILTERS = ("planar-ekf", "planar-ukf")


def main() -> None:
    parser = bench_parser(__doc__)
    parser.add_argument("--seeds", type=_seeds, default="0-4", metavar="FIRST-LAST")
    parser.add_argument("--case", default="", help="only the cases whose names contain this text")
    parser.add_argument("--filter", choices=FILTERS, action="append")
    options = parser.parse_args()
    for name, make in CASES.items():
        if options.case not in name:
            continue
        found: dict[str, list[PoseError]] = {}
        for seed in options.seeds:
            drive = make(seed)
            found.setdefault("baseline", []).append(pose_error(baseline(drive), drive.pose))
            for each in options.filter or FILTERS:
                out = filters.create(each, drive.rig).process(drive.measurements)
                found.setdefault(each, []).append(pose_error(out[:, :3], drive.pose))
        rows = {who: [_mean(errors), max(e.position_m for e in errors)] for who, errors in found.items()}
        if options.json:
            print(json.dumps({"case": name} | {who: _row(*row) for who, row in rows.items()}))
        else:
            texts = [
                f"{who} {e.position_m:.4f} m (worst {worst:.4f}) {math.degrees(e.heading_rad):.2f}°"
                for who, (e, worst) in rows.items()
            ]
            print(f"{name:24}" + "   ".join(texts), flush=True)


def _seeds(text: str) -> range:
    """One seed, or all from FIRST to LAST."""
    first, _, last = text.partition("-")
    try:
        return range(int(first), int(last or first) + 1)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a seed nor FIRST-LAST") from None


def _mean(errors: list[PoseError]) -> PoseError:
    """Root mean square over the seeds."""
    values = np.array([(e.position_m, e.heading_rad) for e in errors])
    position, heading = np.sqrt(np.mean(values**2, axis=0)).tolist()
    return PoseError(position, heading)


def _row(error: PoseError, worst: float) -> dict[str, float]:
    return {"position_m": error.position_m, "heading_rad": error.heading_rad, "worst_position_m": worst}


if __name__ == "__main__":
    main()
