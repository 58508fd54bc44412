"""The comparisons of chapter 3.1 of [Thesis] on simulated drives through a floor of the same size.

The thesis's own logs and result tables are not public.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np

from linkpose.experiments.variants import Progress, Variant, verdict
from linkpose.localization.carmen import as_log
from linkpose.localization.events import Log, Scan
from linkpose.localization.kalman import FilterName
from linkpose.localization.localizer import localize
from linkpose.localization.noise import NoiseModel, RangeNoise
from linkpose.localization.settings import Settings
from linkpose.localization.tables import score
from linkpose.localization.ukf import Transform
from linkpose.simulation.indoor import IndoorErrors, office_map, simulate_indoor

FILTERS: tuple[FilterName, ...] = ("ekf", "ukf")
NOISES: tuple[NoiseModel, ...] = ("fixed", "adaptive", "affine")
GATE = 0.997
CORRELATION = 0.3  # off-diagonal elements of R and of Q, over the diagonal's
UNMAPPED = (0.0, 0.02)  # share of beams that end at an obstacle that the map lacks


def compare(seeds: int, progress: Progress = iter) -> list[Variant]:
    """All variants, each scored on seeds 0 … seeds − 1."""
    compared, grid = list(variants()), office_map()
    for seed, unmapped in progress(list(itertools.product(range(seeds), UNMAPPED))):
        errors = IndoorErrors(outlier_fraction=unmapped)
        run = simulate_indoor(seed, errors, None, grid)
        log = as_log(run.readings)
        start = (float(run.pose[0, 0]), float(run.pose[0, 1]), float(run.pose[0, 2]))
        for variant in compared:
            if variant.others["unmapped"] == unmapped:
                settings = _settings(variant, log, errors.range_m, errors.range_growth, start)
                track = localize(log, variant.filter, settings, grid)
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


def _settings(variant: Variant, log: Log, std_m: float, growth: float, start: tuple[float, float, float]) -> Settings:
    """The filter uses the simulated sensors' true errors.

    A fixed or adaptive R has the mean variance of the log's beams, so that all noise models have the same R on average.
    """
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
        start=start,
        start_std=(0.2, 0.05),
    )


def claims(compared: Sequence[Variant]) -> list[str]:
    """The thesis's claims, each with its result on these runs."""
    found = []
    for name in FILTERS:
        fixed, adaptive, correlated, both = (
            _find(compared, name, "fixed", 0.0),
            _find(compared, name, "adaptive", 0.0),
            _find(compared, name, "adaptive", CORRELATION),
            _find(compared, name, "adaptive", CORRELATION, motion=CORRELATION),
        )
        found.append(verdict(f"{name}, adaptive R is better than fixed R", fixed, adaptive))
        found.append(verdict(f"{name}, off-diagonal R is better than diagonal R", adaptive, correlated))
        found.append(verdict(f"{name}, off-diagonal Q is better than diagonal Q", correlated, both))
    ekf, ukf = (_find(compared, name, "adaptive", 0.0) for name in FILTERS)
    return [*found, verdict("the UKF is better than the EKF (adaptive R)", ekf, ukf)]


def further_claims(compared: Sequence[Variant]) -> list[str]:
    """Comparisons that the thesis does not make."""
    adaptive, affine = (_find(compared, "ukf", noise, 0.0) for noise in ("adaptive", "affine"))
    return [
        verdict("ukf, affine R is better than adaptive R", adaptive, affine),
        verdict(
            "ukf, the scaled transform is better than the plain one",
            affine,
            _find(compared, "ukf", "affine", 0.0, transform="scaled"),
        ),
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


def label(variant: Variant) -> str:
    """The variant in one line of a plot."""
    words = [variant.filter, variant.noise, f"ρ {variant.correlation:g}", f"Q {variant.others['motion_correlation']}"]
    words += [str(variant.others["transform"]), "gate" if variant.gate else "no gate"]
    return ", ".join([*words, f"unmapped {variant.others['unmapped']}"])
