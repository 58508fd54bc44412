"""The link paper's Tables 1 and 2, measured on simulated runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from linkpose import filters
from linkpose.sensors.measurements import Floats
from linkpose.simulation.link import LinkRun

METHODS = ("joint", "tilt", "imu-baro", "baro", "joint-inertial")

# Table 1, RMSE of the vertical position (cm), and Table 2, RMSE of roll and pitch (°), by Test.
PAPER_HEIGHT_CM = {
    "joint": (0.58, 1.86, 2.56),
    "tilt": (0.93, 2.80, 10.21),
    "imu-baro": (17.34, 31.05, 24.35),
    "baro": (31.65, 49.86, 49.54),
}
PAPER_ROLL_PITCH_DEG = {
    "joint": ((0.53, 0.49), (1.20, 1.30), (1.72, 1.76)),
    "tilt": ((0.71, 0.55), (1.80, 1.79), (5.73, 5.83)),
}


@dataclass(frozen=True, slots=True)
class Entry:
    """One filter on one Test, over the seeds; root mean square errors, one a seed."""

    test: int
    filter: str
    height_rmse_cm: Floats  # (seeds,)
    roll_rmse_deg: Floats | None  # (seeds,), None of a filter without attitude
    pitch_rmse_deg: Floats | None
    mean_accel_m_s2: float  # mean ‖a‖ over the runs

    @property
    def paper_height_rmse_cm(self) -> float | None:
        """Table 1's figure; None of a filter that the paper does not have."""
        row = PAPER_HEIGHT_CM.get(self.filter)
        return row[self.test - 1] if row else None

    def as_dict(self) -> dict[str, str | int | float | None]:
        """The object that `reproduce link --json` prints."""
        attitude = {}
        if self.roll_rmse_deg is not None and self.pitch_rmse_deg is not None:
            attitude = {
                "roll_rmse_deg_mean": float(self.roll_rmse_deg.mean()),
                "pitch_rmse_deg_mean": float(self.pitch_rmse_deg.mean()),
            }
        return {
            "test": self.test,
            "filter": self.filter,
            "seeds": len(self.height_rmse_cm),
            "height_rmse_cm_mean": float(self.height_rmse_cm.mean()),
            "height_rmse_cm_max": float(self.height_rmse_cm.max()),
            **attitude,
            "mean_accel_m_s2": self.mean_accel_m_s2,
            "paper_height_rmse_cm": self.paper_height_rmse_cm,
        }


def reproduce(test: int, seeds: int, errors: str) -> list[Entry]:
    """All methods on one Test over seeds 0 … seeds − 1, with the sensors' errors of this level."""
    found: dict[str, list[Floats]] = {name: [] for name in METHODS}
    accel = []
    for seed in range(seeds):
        run = LinkRun(test, seed, errors=errors)
        block, truth = run.measurements(), run.truth()
        accel.append(np.linalg.norm(truth.accel_m_s2, axis=1).mean())
        reference = np.column_stack([truth.height_m, truth.roll_deg, truth.pitch_deg])
        for name in METHODS:
            f = filters.create(name, run.rig)
            estimate = f.process(block)
            found[name].append(_rms(estimate, f.columns, reference))
    mean_accel = float(np.mean(accel))
    return [_entry(test, name, np.array(rows), mean_accel) for name, rows in found.items()]


def _rms(estimate: Floats, columns: tuple[str, ...], reference: Floats) -> Floats:
    """Height (cm), roll and pitch (°), NaN where the filter has none."""
    rms = np.full(3, np.nan)
    for i, (ending, scale) in enumerate((("_height_m", 100.0), ("_roll_deg", 1.0), ("_pitch_deg", 1.0))):
        for j, column in enumerate(columns):
            if column.endswith(ending):
                rms[i] = scale * np.sqrt(np.nanmean((estimate[:, j] - reference[:, i]) ** 2))
    return rms


def _entry(test: int, name: str, rows: Floats, mean_accel: float) -> Entry:
    has_attitude = bool(np.isfinite(rows[:, 1]).all())
    roll, pitch = (rows[:, 1], rows[:, 2]) if has_attitude else (None, None)
    return Entry(test, name, rows[:, 0], roll, pitch, mean_accel)


@dataclass(frozen=True, slots=True)
class Traces:
    """Heights over one run, for Figure 2."""

    time_s: Floats
    truth_m: Floats
    height_m: dict[str, Floats]


def traces(test: int, seed: int, errors: str) -> Traces:
    """The heights of all methods on one run."""
    run = LinkRun(test, seed, errors=errors)
    block = run.measurements()
    heights = {name: filters.create(name, run.rig).process(block)[:, 0] for name in METHODS}
    return Traces(block.time_s, run.truth().height_m, heights)
