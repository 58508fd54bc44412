"""Tables 1 and 2 and Figure 2 of [Link], measured on simulated runs of its Tests 1 to 3."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from linkpose import filters
from linkpose.evaluation.errors import Drift, errors_of, scored
from linkpose.quantities import HEIGHT, PITCH, ROLL, YAW, Quantity, X, Y, Z, by_filter
from linkpose.sensors.measurements import Floats
from linkpose.simulation.link import LinkRun, LinkTruth

METHODS = ("joint", "tilt", "imu-baro", "baro", "joint-inertial")
_LETTERS = {"joint": "A", "tilt": "B", "imu-baro": "C", "baro": "D"}

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


def title(name: str) -> str:
    """The filter with the letter of its Method in the paper: joint A."""
    return f"{name} {_LETTERS[name]}" if name in _LETTERS else name


@dataclass(frozen=True, slots=True)
class Entry:
    """One filter on one Test over the seeds; each array holds one figure per seed, (seeds,)."""

    test: int
    filter: str
    rmse: dict[str, Floats]  # height (cm), and where the filter estimates it roll, pitch, yaw (°), position (cm)
    yaw_drift_deg_per_min: Floats | None
    mean_accel_m_s2: float  # mean ‖a‖ over the runs

    @property
    def paper_height_rmse_cm(self) -> float | None:
        """The figure of Table 1; None for a filter that the paper does not have."""
        row = PAPER_HEIGHT_CM.get(self.filter)
        return row[self.test - 1] if row else None

    def as_dict(self) -> dict[str, str | int | float | None]:
        """The object that `reproduce link --json` prints."""
        height = self.rmse["height"]
        keys = {"roll": "deg", "pitch": "deg", "yaw": "deg", "position": "cm"}
        means = {
            f"{name}_rmse_{unit}_mean": float(self.rmse[name].mean())
            for name, unit in keys.items()
            if name in self.rmse
        }
        if self.yaw_drift_deg_per_min is not None:
            means["yaw_drift_deg_per_min_mean"] = float(self.yaw_drift_deg_per_min.mean())
        return {
            "test": self.test,
            "filter": self.filter,
            "seeds": len(height),
            "height_rmse_cm_mean": float(height.mean()),
            "height_rmse_cm_max": float(height.max()),
            **means,
            "mean_accel_m_s2": self.mean_accel_m_s2,
            "paper_height_rmse_cm": self.paper_height_rmse_cm,
        }


def reproduce(test: int, seeds: int, errors: str) -> list[Entry]:
    """All methods on one Test over seeds 0 … seeds − 1, with sensor errors of this level."""
    found: dict[str, list[dict[str, float]]] = {name: [] for name in METHODS}
    accel = []
    for seed in range(seeds):
        run = LinkRun(test, seed, errors=errors)
        block, truth = run.measurements(), run.truth()
        accel.append(np.linalg.norm(truth.accel_m_s2, axis=1).mean())
        for name in METHODS:
            f = filters.create(name, run.rig)
            found[name].append(_figures(f.process(block), f.columns, truth))
    mean_accel = float(np.mean(accel))
    return [_entry(test, name, rows, mean_accel) for name, rows in found.items()]


def _figures(estimate: Floats, columns: Sequence[str], truth: LinkTruth) -> dict[str, float]:
    """RMSE by quantity, and the yaw's drift, of one run."""
    name, known = next(iter(by_filter(columns).items()))
    reference = _reference(truth)
    ours = {q: estimate[:, columns.index(c)] * q.radians for q, c in known.items() if q in reference}
    theirs = {q: reference[q] * q.radians for q in ours}
    errors = errors_of(name, ours, theirs)
    figures = {key: of.statistics().rmse for key, of in scored(truth.time_s, errors, {}, is_planar=False).items()}
    drift = Drift()
    if YAW in errors:
        drift.add(truth.time_s, errors[YAW])
    return figures if drift.deg_per_min is None else figures | {"drift": drift.deg_per_min}


def _reference(truth: LinkTruth) -> dict[Quantity, Floats]:
    known = {HEIGHT: truth.height_m, ROLL: truth.roll_deg, PITCH: truth.pitch_deg, YAW: truth.yaw_deg}
    return known | {X: truth.x_m, Y: truth.y_m, Z: truth.height_m}


def _entry(test: int, name: str, rows: list[dict[str, float]], mean_accel: float) -> Entry:
    by_name = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    drift = by_name.pop("drift", None)
    return Entry(test, name, by_name, drift, mean_accel)


@dataclass(frozen=True, slots=True)
class Traces:
    """Heights over one run, for Figure 2."""

    test: int
    time_s: Floats  # (N,)
    truth_m: Floats  # (N,)
    height_m: dict[str, Floats]  # by filter, (N,)


def traces(test: int, seed: int, errors: str) -> Traces:
    """The heights of all methods on one run."""
    run = LinkRun(test, seed, errors=errors)
    block = run.measurements()
    heights = {name: filters.create(name, run.rig).process(block)[:, 0] for name in METHODS}
    return Traces(test, block.time_s, run.truth().height_m, heights)
