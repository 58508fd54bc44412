"""`linkpose reproduce indoor`: the comparisons of the thesis's chapter 3.1 on simulated drives."""

from __future__ import annotations

import json
from pathlib import Path

import click

from linkpose.cli import options
from linkpose.cli.patience import while_compiling

<<<<<<< HEAD
if TYPE_CHECKING:
    from linkpose.cli.comparison import Variant
    from linkpose.localization.events import Log
    from linkpose.localization.kalman import FilterName
    from linkpose.localization.settings import Settings

FILTERS: tuple[FilterName, ...] = ("ekf", "ukf")
GATE = 0.997
CORRELATION = 0.3  # off the diagonals of R and of Q
UNMAPPED = (0.0, 0.02)  # share of beams that end at something that the map does not know

=======
>>>>>>> main

@click.command("indoor")
@options.seeds("drives")
@options.plot("Draw the errors of all variants.")
@options.force
@options.as_json
def command(seeds: int, plot_path: Path | None, force: bool, json_lines: bool) -> None:
    """Compare fixed with range-adaptive R, diagonal with off-diagonal Q and R, and the EKF with the UKF, indoors.

    The thesis's own logs and result tables are not public. The drives are simulated on a floor of the same size.
    """
    from linkpose import plotting
    from linkpose.cli.rendering import as_table, progress
    from linkpose.experiments import indoor
    from linkpose.localization.localizer import warm_up

    plotting.check_output(plot_path, force)
    with while_compiling():
        warm_up(indoor.FILTERS)
    variants = indoor.compare(seeds, progress("drives"))
    rows = [variant.as_row() for variant in variants]
    if json_lines:
        click.echo("\n".join(json.dumps(row) for row in rows))
    else:
        click.echo(as_table(rows))
        click.echo("\n".join(["", "Claims of the thesis:", *indoor.claims(variants)]))
        click.echo("\n".join(["", "Comparisons that the thesis does not make:", *indoor.further_claims(variants)]))
    if plot_path:
<<<<<<< HEAD
        plot(plot_path, "Indoor localisation", variants, [_label(variant) for variant in variants])


def _variants() -> Iterator[Variant]:
    """All of EKF or UKF, three noises, diagonal or not, gate or not, with and without obstacles that the map does not
    know.
    """
    from linkpose.cli.comparison import Variant

    for unmapped, gate in itertools.product(UNMAPPED, (GATE, None)):
        for name, noise, rho in itertools.product(FILTERS, ("fixed", "adaptive", "affine"), (0.0, CORRELATION)):
            yield Variant(
                name, noise, rho, gate, {"motion_correlation": 0.0, "transform": "unscented", "unmapped": unmapped}
            )
        for name in FILTERS:
            yield Variant(
                name,
                "adaptive",
                CORRELATION,
                gate,
                {"motion_correlation": CORRELATION, "transform": "unscented", "unmapped": unmapped},
            )
        yield Variant(
            "ukf", "affine", 0.0, gate, {"motion_correlation": 0.0, "transform": "scaled", "unmapped": unmapped}
        )


def _settings(variant: Variant, log: Log, std_m: float, growth: float, start: tuple[float, float, float]) -> Settings:
    """The filter knows the sensors' errors. A fixed or adaptive R has the mean variance of the log's beams: no R is
    given more in all.
    """
    import numpy as np

    from linkpose.localization.events import Scan
    from linkpose.localization.kalman import Transform
    from linkpose.localization.noise import NoiseModel, RangeNoise
    from linkpose.localization.settings import Settings

    model: NoiseModel = "fixed" if variant.noise == "fixed" else "adaptive" if variant.noise == "adaptive" else "affine"
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


def _verdicts(variants: list[Variant]) -> Iterator[str]:
    from linkpose.cli.comparison import verdict

    def find(
        name: str, noise: str, rho: float, gate: float | None = GATE, motion: float = 0.0, transform: str = "unscented"
    ) -> Variant:
        others = {"motion_correlation": motion, "transform": transform, "unmapped": UNMAPPED[-1]}
        wanted = (name, noise, rho, gate, others)
        return next(v for v in variants if (v.filter, v.noise, v.correlation, v.gate, v.others) == wanted)

    for name in FILTERS:
        yield verdict(
            f"{name}, adaptive R is better than fixed R", find(name, "fixed", 0.0), find(name, "adaptive", 0.0)
        )
        yield verdict(
            f"{name}, R off the diagonal is better than diagonal R",
            find(name, "adaptive", 0.0),
            find(name, "adaptive", CORRELATION),
        )
        yield verdict(
            f"{name}, Q off the diagonal is better than diagonal Q",
            find(name, "adaptive", CORRELATION),
            find(name, "adaptive", CORRELATION, motion=CORRELATION),
        )
    yield verdict(
        "the UKF is better than the EKF (adaptive R)", find("ekf", "adaptive", 0.0), find("ukf", "adaptive", 0.0)
    )
    yield "And what the thesis does not claim:"
    yield verdict("ukf, affine R is better than adaptive R", find("ukf", "adaptive", 0.0), find("ukf", "affine", 0.0))
    yield verdict(
        "ukf, the scaled transform is better than the plain one",
        find("ukf", "affine", 0.0),
        find("ukf", "affine", 0.0, transform="scaled"),
    )
    yield verdict("ukf, the gate is better than none", find("ukf", "adaptive", 0.0, None), find("ukf", "adaptive", 0.0))


def _label(variant: Variant) -> str:
    words = [variant.filter, variant.noise, f"ρ {variant.correlation:g}", f"Q {variant.others['motion_correlation']}"]
    words += [
        str(variant.others["transform"]),
        "gate" if variant.gate else "no gate",
        f"unmapped {variant.others['unmapped']}",
    ]
    return ", ".join(words)
=======
        figure = plotting.variants("Indoor localisation", variants, [indoor.label(variant) for variant in variants])
        plotting.save(figure, plot_path, force)
>>>>>>> main
