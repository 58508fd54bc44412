"""Whether σ is right: Tests 1 to 3 of the link paper, simulated, twenty seeds, pooled.

    python tests/bench/sigma.py [--seeds N] [--first-seed N] [--json]

For calibrated sensors and for sensors within the data sheet, with a known and with an unknown J2S (the vector from the
joint centre to the sensor), the share of errors within 2σ of each quantity over all runs, the worst run, the runs below
85 %, NEES and root mean square error. `joint-inertial` has no calibration of the sensors. Yaw, x and y are relative to
the first sample.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from _report import bench_parser, print_row

from linkpose.filters.joint_inertial import JointInertialFilter
from linkpose.sensors.measurements import Floats
from linkpose.sensors.rig import UNKNOWN_JOINT, Rig
from linkpose.simulation.link import PAPER_J2S_M, TESTS, LinkRun, LinkTruth

RIGS = {"known": Rig().with_j2s(PAPER_J2S_M), "unknown": Rig(joint=UNKNOWN_JOINT)}
QUANTITIES = ("height_m", "roll_deg", "pitch_deg", "yaw_deg", "x_m", "y_m")


class Run(NamedTuple):
    """One quantity of one run."""

    share: float  # of errors within 2σ
    nees: float
    rmse: float


def truth_since_start(truth: LinkTruth, yaw_deg: float) -> dict[str, Floats]:
    """The truth with x and y turned, and yaw shifted, to a first yaw of `yaw_deg`."""
    turn = np.radians(yaw_deg - truth.yaw_deg[0])
    return {
        "height_m": truth.height_m,
        "roll_deg": truth.roll_deg,
        "pitch_deg": truth.pitch_deg,
        "yaw_deg": truth.yaw_deg + np.degrees(turn),
        "x_m": np.cos(turn) * truth.x_m - np.sin(turn) * truth.y_m,
        "y_m": np.sin(turn) * truth.x_m + np.cos(turn) * truth.y_m,
    }


def runs_of(test: int, seed: int, errors: str, j2s: str) -> dict[str, Run]:
    """Quantity -> its figures, over the samples with an estimate. `j2s`: key of RIGS."""
    run = LinkRun(test, seed, errors=errors)
    f = JointInertialFilter(RIGS[j2s])
    values = f.process(run.measurements())
    table = dict(zip((name.removeprefix("joint_inertial_") for name in f.columns), values.T, strict=True))
    true = truth_since_start(run.truth(), float(table["yaw_deg"][0]))
    found = {}
    for column in QUANTITIES:
        name, unit = column.rsplit("_", 1)
        error, std = table[column] - true[column], np.maximum(table[f"{name}_std_{unit}"], 1e-9)
        if unit == "deg":
            error = (error + 180.0) % 360.0 - 180.0
        estimated = np.isfinite(error)
        error, std = error[estimated], std[estimated]
        found[column] = Run(
            float(np.mean(np.abs(error) < 2 * std)), float(np.mean((error / std) ** 2)),
            float(np.sqrt(np.mean(error**2))),
        )  # fmt: skip
    return found


def main() -> None:
    parser = bench_parser(__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    for errors, j2s in itertools.product(("calibrated", "datasheet"), RIGS):
        runs = [runs_of(test, seed, errors, j2s) for test, seed in itertools.product(TESTS, seeds)]
        for column in QUANTITIES:
            share, nees, rmse = np.array([run[column] for run in runs]).T
            row = {
                "bench": f"sigma {errors}, {j2s} J2S: {column}",
                "within_2sigma": round(float(share.mean()), 4),
                "worst_run": round(float(share.min()), 4),
                "runs_below_85": int((share < 0.85).sum()),
                "runs": len(runs),
                "nees": round(float(nees.mean()), 3),
                "rmse": round(float(rmse.mean()), 5),
            }
            print_row(row, options.json)


if __name__ == "__main__":
    main()
