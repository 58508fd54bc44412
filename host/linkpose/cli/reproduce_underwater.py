"""`linkpose reproduce underwater`: the checks and comparisons of the thesis's chapter 3.2 on simulated dives."""

from __future__ import annotations

import json
from pathlib import Path

import click

from linkpose.cli import options
from linkpose.cli.patience import while_compiling

<<<<<<< HEAD
if TYPE_CHECKING:
    from linkpose.cli.comparison import Variant
    from linkpose.localization.kalman import FilterName
    from linkpose.localization.settings import Settings
    from linkpose.localization.track import Track
    from linkpose.simulation.underwater import UnderwaterErrors, UnderwaterRun

FILTERS: tuple[FilterName, ...] = ("ekf", "ukf")
GATE = 0.997
DURATION_S = 60.0
OUTLIERS = 30
TIMINGS = ("asynchronous", "synchronous")


@dataclass(slots=True)
class Detection:
    """Outliers over all seeds of a variant: injected and found, and good ranges that were refused."""

    injected: int = 0
    found: int = 0
    good: int = 0
    refused: int = 0

    def add(self, run: UnderwaterRun, track: Track) -> None:
        ranges = sum(len(values) for values in run.ranges_m.values())
        found = len(track.rejected_ranges & run.outliers)
        self.injected += len(run.outliers)
        self.found += found
        self.good += ranges - len(run.outliers)
        self.refused += len(track.rejected_ranges) - found

    def as_row(self) -> dict[str, object]:
        return {
            "detection_rate": self.found / self.injected if self.injected else None,
            "false_alarm_rate": self.refused / self.good,
        }


@dataclass(frozen=True, slots=True)
class Case:
    """A simulated sea, and the variants that dive in it."""

    timing: str
    correlated: bool
    outliers: int
    variants: list[Variant] = field(default_factory=list)
    detections: list[Detection] = field(default_factory=list)

    def errors(self) -> UnderwaterErrors:
        from dataclasses import replace

        from linkpose.simulation.underwater import UnderwaterErrors

        errors = UnderwaterErrors(outliers=self.outliers)
        return errors if self.correlated else replace(errors, correlation_m=0.0)

=======
>>>>>>> main

@click.command("underwater")
@options.seeds("dives")
@options.plot("Draw the errors of all variants.")
@options.force
@options.as_json
def command(seeds: int, plot_path: Path | None, force: bool, json_lines: bool) -> None:
    """Check the simulator of Tables 2.2 to 2.9, and compare the EKF with the UKF on its measurements.

    Synchronous and asynchronous sensors, with and without a common error of the ranges, outliers and gate. The
    thesis's own values and result tables are not public.
    """
    from linkpose import plotting
    from linkpose.cli.rendering import as_table, progress
    from linkpose.experiments import underwater
    from linkpose.localization.localizer import warm_up

    plotting.check_output(plot_path, force)
    with while_compiling():
        warm_up(underwater.FILTERS)
    checks = underwater.check_simulator(seeds)
    cases = underwater.compare(seeds, progress("dives"))
    rows = [row for case in cases for row in case.rows()]
    if json_lines:
        click.echo("\n".join(json.dumps(row) for row in [*checks, *rows]))
    else:
        click.echo(f"{as_table(checks)}\n\n{as_table(rows)}")
        click.echo("\n".join(["", "What the thesis expects:", *underwater.claims(cases)]))
    if plot_path:
<<<<<<< HEAD
        plot(plot_path, "Underwater localisation", variants, [_label(variant) for variant in variants])


def _case(timing: str, correlated: bool, outliers: int) -> Case:
    """Off-diagonal R is for ranges of one instant; asynchronous ranges have no neighbour to correlate with."""
    from linkpose.cli.comparison import Variant

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
    from linkpose.localization.localizer import localize
    from linkpose.localization.tables import score
    from linkpose.simulation.underwater import BEACONS, simulate_underwater

    errors = case.errors()
    run = simulate_underwater(seed, errors, DURATION_S, case.timing == "synchronous")
    for variant, detection in zip(case.variants, case.detections, strict=True):
        track = localize(run.log, variant.filter, _settings(errors, variant), None, BEACONS)
        variant.scores.append(score(track.time_s, track.position_m, track.heading_rad, run.motion.truth))
        detection.add(run, track)


def _settings(errors: UnderwaterErrors, variant: Variant) -> Settings:
    """The filter knows the sensors' errors, the common one as part of each range's variance."""
    from linkpose.localization.noise import RangeNoise
    from linkpose.localization.settings import Settings

    return Settings(
        ranges=RangeNoise("fixed", math.hypot(errors.range_m, errors.correlation_m), correlation=variant.correlation),
        depth_std_m=errors.depth_m,
        attitude_std_rad=errors.attitude_rad,
        velocity_std_m_s=math.hypot(errors.velocity_m_s, errors.motion_velocity_m_s),
        gate=variant.gate,
    )


def _checks(seeds: int) -> Iterator[dict[str, object]]:
    """The simulator's own figures, mean over the seeds."""
    from linkpose.simulation.underwater import UnderwaterErrors, self_check, simulate_underwater

    runs = [
        self_check(simulate_underwater(seed, UnderwaterErrors(outliers=OUTLIERS), DURATION_S)) for seed in range(seeds)
    ]
    for rows in zip(*runs, strict=True):
        yield {"check": rows[0].check, "asked": rows[0].asked, "measured": sum(row.measured for row in rows) / seeds}


def _verdicts(cases: list[Case]) -> Iterator[str]:
    from linkpose.cli.comparison import verdict

    def find(
        timing: str, correlated: bool, outliers: int, name: str, gate: float | None = GATE, rho: bool = False
    ) -> Variant:
        case = next(c for c in cases if (c.timing, c.correlated, c.outliers) == (timing, correlated, outliers))
        return next(v for v in case.variants if (v.filter, v.gate, v.correlation > 0) == (name, gate, rho))

    late, at_once = TIMINGS
    yield verdict(
        "the UKF is better than the EKF", find(late, True, OUTLIERS, "ekf"), find(late, True, OUTLIERS, "ukf")
    )
    yield verdict(
        "with outliers, the gate is better than none",
        find(late, True, OUTLIERS, "ukf", None),
        find(late, True, OUTLIERS, "ukf"),
    )
    yield verdict(
        "without outliers, the gate is better than none", find(late, True, 0, "ukf", None), find(late, True, 0, "ukf")
    )
    yield verdict(
        "ranges without a common error are better than with", find(late, True, 0, "ukf"), find(late, False, 0, "ukf")
    )
    yield verdict(
        "with a common error, off-diagonal R is better than diagonal R",
        find(at_once, True, 0, "ukf"),
        find(at_once, True, 0, "ukf", rho=True),
    )
    yield verdict(
        "asynchronous sensors are better than synchronous ones",
        find(at_once, True, 0, "ukf"),
        find(late, True, 0, "ukf"),
    )


def _label(variant: Variant) -> str:
    words = [variant.filter, str(variant.others["timing"]), f"ρ {variant.correlation:g}"]
    words += [
        "gate" if variant.gate else "no gate",
        f"common {variant.others['correlation_std_m']} m",
        f"{variant.others['outliers']} outliers",
    ]
    return ", ".join(words)
=======
        variants = [variant for case in cases for variant in case.variants]
        labels = [underwater.label(variant) for variant in variants]
        plotting.save(plotting.variants("Underwater localisation", variants, labels), plot_path, force)
>>>>>>> main
