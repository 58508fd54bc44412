"""Whether σ is right: Tests 1 to 3 of the link paper, simulated, twenty seeds, pooled.

    python tests/bench/sigma.py [--seeds N] [--json]

For calibrated sensors and for sensors within the data sheet, the share of errors within 2σ of each quantity over all
runs, the worst run, the runs below 85 %, NEES and root mean square error. `joint-inertial` has J2S, but no calibration
of the sensors. Yaw, x and y are relative to the first sample.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from _report import bench_parser, print_row

from linkpose.filters.joint_inertial import JointInertialFilter
from linkpose.sensors.measurements import Floats
from linkpose.sensors.rig import Rig
from linkpose.simulation.link import PAPER_J2S_M, TESTS, LinkRun, LinkTruth

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


def runs_of(test: int, seed: int, errors: str) -> dict[str, Run]:
    """Quantity -> its figures."""
    run = LinkRun(test, seed, errors=errors)
    f = JointInertialFilter(Rig().with_j2s(PAPER_J2S_M))
    values = f.process(run.measurements())
    table = dict(zip((name.removeprefix("joint_inertial_") for name in f.columns), values.T, strict=True))
    true = truth_since_start(run.truth(), float(table["yaw_deg"][0]))
    found = {}
    for column in QUANTITIES:
        name, unit = column.rsplit("_", 1)
        error, std = table[column] - true[column], np.maximum(table[f"{name}_std_{unit}"], 1e-9)
        if unit == "deg":
            error = (error + 180.0) % 360.0 - 180.0
        found[column] = Run(
            float(np.mean(np.abs(error) < 2 * std)), float(np.mean((error / std) ** 2)),
            float(np.sqrt(np.mean(error**2))),
        )  # fmt: skip
    return found


def main() -> None:
    parser = bench_parser(__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    options = parser.parse_args()
    for errors in ("calibrated", "datasheet"):
        runs = [runs_of(test, seed, errors) for test, seed in itertools.product(TESTS, range(options.seeds))]
        for column in QUANTITIES:
            share, nees, rmse = np.array([run[column] for run in runs]).T
            row = {
                "bench": f"sigma {errors} {column}",
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
