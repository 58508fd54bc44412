"""The checks, comparisons and figures of chapter 3.2 of [Thesis] on simulated dives.

The simulator follows the thesis's Tables 2.2 to 2.9. Our copy of the thesis ends before its results:
host/docs/thesis.md lists what is lost.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from linkpose.experiments.paths import ComparedPath, path_of
from linkpose.experiments.variants import ClaimVerdict, Progress, Variant, verdict
from linkpose.localization.kalman import FilterName
from linkpose.localization.linalg import Floats
from linkpose.localization.localizer import estimate_track
from linkpose.localization.noise import RangeNoise
from linkpose.localization.settings import Settings
from linkpose.localization.tables import score
from linkpose.localization.track import Track
from linkpose.simulation.underwater import (
    BEACONS,
    UnderwaterErrors,
    UnderwaterRun,
    motion_data,
    self_check,
    simulate_underwater,
)

FILTERS: tuple[FilterName, ...] = ("ekf", "ukf")
GATE = 0.997
DURATION_S = 60.0
OUTLIERS = 30
TIMINGS = ("asynchronous", "synchronous")


@dataclass(slots=True)
class Detection:
    """Outliers of a variant over all seeds: injected and rejected ones, and good ranges that were rejected."""

    injected: int = 0
    found: int = 0
    good: int = 0
    false_alarms: int = 0

    def add(self, run: UnderwaterRun, track: Track) -> None:
        """Counts one run."""
        ranges = sum(len(values) for values in run.ranges_m.values())
        found = len(track.rejected_sightings & run.outliers)
        self.injected += len(run.outliers)
        self.found += found
        self.good += ranges - len(run.outliers)
        self.false_alarms += len(track.rejected_sightings) - found

    def as_row(self) -> dict[str, object]:
        """The part of the JSON object that reports how well outliers were detected."""
        return {
            "detection_rate": self.found / self.injected if self.injected else None,
            "false_alarm_rate": self.false_alarms / self.good,
        }


@dataclass(frozen=True, slots=True)
class Case:
    """A simulated sea, and the variants that are compared in it."""

    timing: str
    correlated: bool
    outliers: int
    variants: list[Variant] = field(default_factory=list)
    detections: list[Detection] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)  # measurements by sensor, in one dive

    def errors(self) -> UnderwaterErrors:
        """The simulated errors of this sea."""
        errors = UnderwaterErrors(outliers=self.outliers)
        return errors if self.correlated else replace(errors, correlation_m=0.0)

    def as_set(self, number: int) -> dict[str, object]:
        """The row of Table 3.10: which errors this set of measurements has, and how many measurements of each kind."""
        errors = self.errors()
        return {
            "table": "3.10",
            "set": number,
            "timing": self.timing,
            "range_std_m": errors.range_m,
            "correlation_std_m": errors.correlation_m,
            "outliers": errors.outliers,
            **self.counts,
        }

    def rows(self) -> list[dict[str, object]]:
        """The objects of its variants that `reproduce underwater --json` prints."""
        return [v.as_row() | d.as_row() for v, d in zip(self.variants, self.detections, strict=True)]


def compare(seeds: int, progress: Progress = iter) -> list[Case]:
    """All cases, their variants scored on seeds 0 … seeds − 1."""
    cases = [
        _case(timing, correlated, n)
        for timing, correlated, n in itertools.product(TIMINGS, (False, True), (0, OUTLIERS))
    ]
    for case, seed in progress(list(itertools.product(cases, range(seeds)))):
        _dive(case, seed)
    return cases


def _case(timing: str, correlated: bool, outliers: int) -> Case:
    """Off-diagonal R applies to ranges of one instant: asynchronous ranges have no neighbour to correlate with."""
    case = Case(timing, correlated, outliers)
    errors = case.errors()
    shared = errors.correlation_m**2 / (errors.correlation_m**2 + errors.range_m**2)
    rhos = (0.0, round(shared, 3)) if correlated and timing == "synchronous" else (0.0,)
    for name, rho, gate in itertools.product(FILTERS, rhos, (GATE, None)):
        others: dict[str, object] = {"timing": timing, "correlation_std_m": errors.correlation_m, "outliers": outliers}
        case.variants.append(Variant(name, "fixed", rho, gate, others))
        case.detections.append(Detection())
    return case


def _dive(case: Case, seed: int) -> None:
    errors = case.errors()
    run = simulate_underwater(seed, errors, DURATION_S, case.timing == "synchronous")
    case.counts.update(_counts(run))
    for variant, detection in zip(case.variants, case.detections, strict=True):
        track = estimate_track(run.log, variant.filter, _settings(errors, variant), None, BEACONS)
        variant.scores.append(score(track.time_s, track.position_m, track.heading_rad, run.motion.truth))
        detection.add(run, track)


def _counts(run: UnderwaterRun) -> dict[str, int]:
    """Measurements of one dive by kind."""
    ranges = sum(len(values) for values in run.ranges_m.values())
    return {
        "velocities": len(run.velocity_m_s),
        "attitudes": len(run.attitude_rad),
        "depths": len(run.depth_m),
        "ranges": ranges,
    }


def _settings(errors: UnderwaterErrors, variant: Variant) -> Settings:
    """The filter uses the simulated sensors' true errors; the common error is part of each range's variance."""
    return Settings(
        ranges=RangeNoise("fixed", math.hypot(errors.range_m, errors.correlation_m), correlation=variant.correlation),
        depth_std_m=errors.depth_m,
        attitude_std_rad=errors.attitude_rad,
        velocity_std_m_s=math.hypot(errors.velocity_m_s, errors.motion_velocity_m_s),
        gate=variant.gate,
    )


def check_simulator(seeds: int) -> list[dict[str, object]]:
    """The simulator's statistics beside the values set, mean over the seeds, in the order of the tables."""
    runs = [
        self_check(simulate_underwater(seed, UnderwaterErrors(outliers=OUTLIERS), DURATION_S)) for seed in range(seeds)
    ]
    return [
        asdict(rows[0]) | {"measured": sum(row.measured for row in rows) / seeds}
        for rows in sorted(zip(*runs, strict=True), key=lambda rows: rows[0].table)
    ]


def claims(cases: Sequence[Case]) -> list[ClaimVerdict]:
    """What the thesis expects, by the table that would show it."""
    late, at_once = TIMINGS
    ukf = _find(cases, late, True, OUTLIERS, "ukf")
    clean, synchronous = (_find(cases, timing, True, 0, "ukf") for timing in TIMINGS)
    correlated = _find(cases, at_once, True, 0, "ukf", rho=True)
    return [
        verdict(
            "ranges without a common error are better than with one", clean, _find(cases, late, False, 0, "ukf"), "3.8"
        ),
        verdict("with a common error, off-diagonal R is better than diagonal R", synchronous, correlated, "3.8"),
        verdict("asynchronous sensors are better than synchronous ones", synchronous, clean, "3.8"),
        verdict(
            "with outliers, the gate is better than none", _find(cases, late, True, OUTLIERS, "ukf", None), ukf, "3.9"
        ),
        verdict(
            "without outliers, the gate is better than none", _find(cases, late, True, 0, "ukf", None), clean, "3.9"
        ),
        verdict("the UKF is better than the EKF", _find(cases, late, True, OUTLIERS, "ekf"), ukf, "3.11"),
    ]


def _find(
    cases: Sequence[Case],
    timing: str,
    correlated: bool,
    outliers: int,
    name: str,
    gate: float | None = GATE,
    rho: bool = False,
) -> Variant:
    case = next(c for c in cases if (c.timing, c.correlated, c.outliers) == (timing, correlated, outliers))
    return next(v for v in case.variants if (v.filter, v.gate, v.correlation > 0) == (name, gate, rho))


def label(variant: Variant) -> tuple[str, str]:
    """For a plot: what the measurements are like, and the settings that are compared under these conditions."""
    common_m, outliers = variant.others["correlation_std_m"], variant.others["outliers"]
    conditions = [str(variant.others["timing"])]
    conditions += [f"common error {common_m} m"] * bool(common_m)
    conditions += [f"{outliers} outliers"] * bool(outliers)
    words = ["gate" if variant.gate else "no gate"]
    return ", ".join(conditions), ", ".join(
        [*words, *[f"ρ of R = {variant.correlation:g}"] * bool(variant.correlation)]
    )


@dataclass(frozen=True, slots=True)
class Dive:
    """One simulated dive: the commanded and the true path (N, 3) m at `time_s` (N,), the estimates of Figure 3.8 from
    sets of measurements, and those of Figures 3.9 and 3.10 by number.
    """

    time_s: Floats
    command_m: Floats
    truth_m: Floats
    sets: list[ComparedPath]
    paths: dict[str, ComparedPath]


# Figure 3.8: what the ranges carry beside Gaussian noise.
SETS = (
    ("Gaussian noise alone", False, 0),
    ("common error", True, 0),
    ("common error, outliers", True, OUTLIERS),
)


def dive(seed: int) -> Dive:
    """The runs behind Figures 3.7 to 3.10: asynchronous sensors, and in Figures 3.9 and 3.10 all errors at once."""
    still = UnderwaterErrors(motion_velocity_m_s=0.0, motion_rate_rad_s=0.0)
    command = motion_data(np.random.default_rng(seed), still, DURATION_S)
    sets = [_estimated(seed, "ukf", words, correlated, n) for words, correlated, n in SETS]
    ekf = _estimated(seed, "ekf", "EKF", True, OUTLIERS)
    motion = simulate_underwater(seed, UnderwaterErrors(), DURATION_S).motion
    paths = {"3.9": ekf, "3.10": replace(sets[-1], label="UKF")}
    return Dive(motion.time_s, command.pose[:, :3], motion.pose[:, :3], sets, paths)


def _estimated(seed: int, name: FilterName, words: str, correlated: bool, outliers: int) -> ComparedPath:
    errors = Case(TIMINGS[0], correlated, outliers).errors()
    run = simulate_underwater(seed, errors, DURATION_S)
    track = estimate_track(run.log, name, _settings(errors, Variant(name, "fixed", 0.0, GATE)), None, BEACONS)
    return path_of(name, words, track, run.motion.truth, np.unwrap(run.motion.pose[:, 5]))
