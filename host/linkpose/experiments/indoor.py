"""The comparisons and figures of chapter 3.1 of [Thesis] on simulated drives through a floor of the same size.

Our copy of the thesis ends before its results: host/docs/thesis.md lists what is lost.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from linkpose.experiments.paths import ComparedPath, path_of
from linkpose.experiments.variants import ClaimVerdict, Progress, Variant, verdict
from linkpose.localization.carmen import as_log
from linkpose.localization.events import Log, Scan
from linkpose.localization.grid import GridMap
from linkpose.localization.kalman import FilterName
from linkpose.localization.linalg import Floats
from linkpose.localization.localizer import estimate_track
from linkpose.localization.noise import RangeNoise
from linkpose.localization.options import NoiseModel
from linkpose.localization.settings import Settings
from linkpose.localization.tables import score
from linkpose.localization.ukf import Transform
from linkpose.simulation.indoor import IndoorErrors, IndoorRun, office_map, simulate_indoor

FILTERS: tuple[FilterName, ...] = ("ekf", "ukf")
NOISES: tuple[NoiseModel, ...] = ("fixed", "adaptive", "affine")
GATE = 0.997
CORRELATION = 0.3  # off-diagonal elements of R and of Q, over the diagonal's
DURATION_S: float | None = None  # of a drive; None is a whole round, about 200 s
UNMAPPED = (0.0, 0.02)  # share of beams that end at an obstacle that the map lacks


def compare(seeds: int, progress: Progress = iter) -> list[Variant]:
    """All variants, each scored on seeds 0 … seeds − 1."""
    compared, grid = list(variants()), office_map()
    for seed, unmapped in progress(list(itertools.product(range(seeds), UNMAPPED))):
        errors = IndoorErrors(outlier_fraction=unmapped)
        run = simulate_indoor(seed, errors, DURATION_S, grid)
        log = as_log(run.readings)
        for variant in compared:
            if variant.others["unmapped"] == unmapped:
                settings = _settings(variant, log, errors, run)
                track = estimate_track(log, variant.filter, settings, grid)
                variant.scores.append(score(track.time_s, track.position_m, track.heading_rad, run.truth))
    return compared


def variants() -> Iterator[Variant]:
    """EKF and UKF with three noise models, diagonal and off-diagonal R and Q, with and without gate and obstacles."""
    for unmapped, gate in itertools.product(UNMAPPED, (GATE, None)):
        for name, noise, rho in itertools.product(FILTERS, NOISES, (0.0, CORRELATION)):
            yield Variant(name, noise, rho, gate, _others(0.0, "unscented", unmapped))
        for name in FILTERS:
            yield Variant(name, "adaptive", CORRELATION, gate, _others(CORRELATION, "unscented", unmapped))
        yield Variant("ukf", "affine", 0.0, gate, _others(0.0, "scaled", unmapped))


def _others(motion_correlation: float, transform: str, unmapped: float) -> dict[str, object]:
    return {"motion_correlation": motion_correlation, "transform": transform, "unmapped": unmapped}


def _settings(variant: Variant, log: Log, errors: IndoorErrors, run: IndoorRun) -> Settings:
    """The filter starts at the true pose and uses the simulated sensors' true errors.

    A fixed or adaptive R has the mean variance of the log's beams, so that all noise models have the same R on average.
    """
    std_m, growth, (x, y, heading) = errors.range_m, errors.range_growth, run.pose[0].tolist()
    model = next(noise for noise in NOISES if noise == variant.noise)
    ranges = np.concatenate([event.ranges_m for event in log if isinstance(event, Scan)])
    mean = math.sqrt(std_m**2 + growth**2 * float(np.nanmean(ranges**2)))
    return Settings(
        ranges=RangeNoise(model, std_m if model == "affine" else mean, growth=growth, correlation=variant.correlation),
        speed_std_m_s=0.05,
        turn_std_rad_s=0.05,
        motion_correlation=float(str(variant.others["motion_correlation"])),
        gate=variant.gate,
        transform=Transform(0.1, 2.0) if variant.others["transform"] == "scaled" else Transform(),
        start=(x, y, heading),
        start_std=(0.2, 0.05),
    )


def claims(compared: Sequence[Variant]) -> list[ClaimVerdict]:
    """The thesis's claims by table, and comparisons that it does not make."""
    found = []
    for name in FILTERS:
        fixed, adaptive, correlated, both = (
            _find(compared, name, "fixed", 0.0),
            _find(compared, name, "adaptive", 0.0),
            _find(compared, name, "adaptive", CORRELATION),
            _find(compared, name, "adaptive", CORRELATION, motion=CORRELATION),
        )
        found.append(verdict(f"{name}, adaptive R is better than fixed R", fixed, adaptive, "3.2"))
        found.append(verdict(f"{name}, off-diagonal R is better than diagonal R", adaptive, correlated, "3.3"))
        found.append(verdict(f"{name}, off-diagonal Q is better than diagonal Q", correlated, both, "3.3"))
    for what, rho in (("adaptive R", 0.0), ("adaptive, off-diagonal R and Q", CORRELATION)):
        ekf, ukf = (_find(compared, name, "adaptive", rho, motion=rho) for name in FILTERS)
        found.append(verdict(f"the UKF is better than the EKF ({what})", ekf, ukf, "3.4"))
    found.sort(key=lambda one: one.table)
    return [*found, *_further_claims(compared)]


def _further_claims(compared: Sequence[Variant]) -> list[ClaimVerdict]:
    adaptive, affine = (_find(compared, "ukf", noise, 0.0) for noise in ("adaptive", "affine"))
    scaled = _find(compared, "ukf", "affine", 0.0, transform="scaled")
    return [
        verdict("ukf, affine R is better than adaptive R", adaptive, affine),
        verdict("ukf, the scaled transform is better than the plain one", affine, scaled),
        verdict("ukf, the gate is better than none", _find(compared, "ukf", "adaptive", 0.0, None), adaptive),
    ]


def _find(
    compared: Sequence[Variant],
    name: str,
    noise: str,
    rho: float,
    gate: float | None = GATE,
    motion: float = 0.0,
    transform: str = "unscented",
) -> Variant:
    wanted = (name, noise, rho, gate, _others(motion, transform, UNMAPPED[-1]))
    return next(v for v in compared if (v.filter, v.noise, v.correlation, v.gate, v.others) == wanted)


def label(variant: Variant) -> tuple[str, str]:
    """For a plot: what the drives and the gate are like, and the settings that are compared under these conditions."""
    of_q, transform, unmapped = (variant.others[name] for name in ("motion_correlation", "transform", "unmapped"))
    conditions = ["gate" if variant.gate else "no gate"]
    conditions += [f"{unmapped:.0%} of the beams unmapped".replace("%", " %")] * bool(unmapped)
    words = [f"{variant.noise} R", *[f"{transform} transform"] * (transform != "unscented")]
    words += [f"ρ of R = {variant.correlation:g}"] * bool(variant.correlation)
    return ", ".join(conditions), ", ".join([*words, *[f"ρ of Q = {of_q}"] * bool(of_q)])


@dataclass(frozen=True, slots=True)
class DrawnDrive:
    """One simulated drive on its map, and the estimated paths by the number of their figure."""

    grid: GridMap
    truth_m: Floats  # (N, 2)
    odometry_m: Floats  # (N, 2) dead reckoning from the true start
    paths: dict[str, ComparedPath]


# Figure -> filter, R, and the correlation in R and Q. Figures 3.5 and 3.6 show the thesis's method as a whole.
FIGURES: dict[str, tuple[FilterName, NoiseModel, float]] = {
    "3.2": ("ukf", "fixed", 0.0),
    "3.3": ("ukf", "adaptive", 0.0),
    "3.5": ("ekf", "adaptive", CORRELATION),
    "3.6": ("ukf", "adaptive", CORRELATION),
}


def drive(seed: int) -> DrawnDrive:
    """The runs behind Figures 3.1 to 3.6: one drive with obstacles that the map lacks."""
    grid, errors = office_map(), IndoorErrors(outlier_fraction=UNMAPPED[-1])
    run = simulate_indoor(seed, errors, DURATION_S, grid)
    log, paths = as_log(run.readings), {}
    for figure, (name, noise, rho) in FIGURES.items():
        variant = Variant(name, noise, rho, GATE, _others(rho, "unscented", UNMAPPED[-1]))
        track = estimate_track(log, name, _settings(variant, log, errors, run), grid)
        words = f"{name.upper()}, {noise} R" + (f", R and Q off-diagonal (ρ = {rho:g})" if rho else "")
        paths[figure] = path_of(name, words, track, run.truth, np.unwrap(run.pose[:, 2]))
    odometry = np.array([reading.odometry[:2] for reading in run.readings])
    return DrawnDrive(grid, run.pose[:, :2], odometry, paths)
