"""`linkpose simulate indoor`."""

from __future__ import annotations

from pathlib import Path

import click

from linkpose.cli import options


@click.command("indoor")
@options.simulated_outputs("Log to write (CARMEN: ODOM and FLASER lines).")
@click.option("--map", "map_file", type=options.FILE, help="Map to write. Default: OUT's name with .yaml.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Motion, errors and noise.")
@click.option(
    "--duration", type=options.FiniteRange(min=5, max=3600), help="Length in seconds. Default: one round, some 200 s."
)
@click.option(
    "--range-std", type=options.FiniteRange(min=0), default=0.03, show_default=True, help="σ of a beam at range 0 (m)."
)
@click.option(
    "--range-growth", type=options.FiniteRange(min=0), default=0.02, show_default=True, help="Its growth (m/m)."
)
@click.option(
    "--outliers",
    type=options.FiniteRange(0, 1),
    default=0.02,
    show_default=True,
    help="Share of beams that end at an obstacle that the map lacks.",
)
@options.force
@options.quiet
def command(
    output: Path,
    truth: Path,
    map_file: Path | None,
    seed: int,
    duration: float | None,
    range_std: float,
    range_growth: float,
    outliers: float,
    force: bool,
    quiet: bool,
) -> None:
    """Simulate a log of a robot with odometry and a laser scanner on a floor of 100 x 40 m, its map and its truth."""
    from linkpose.outputs import STDOUT, check_outputs
    from linkpose.simulation.export import write_indoor
    from linkpose.simulation.indoor import IndoorErrors, simulate_indoor

    map_file = map_file or (truth if output == STDOUT else output).with_suffix(".yaml")
    check_outputs((output, truth, map_file, map_file.with_suffix(".pgm")), force)
    errors = IndoorErrors(range_m=range_std, range_growth=range_growth, outlier_fraction=outliers)
    run = simulate_indoor(seed, errors, duration)
    write_indoor(run, seed, output, truth, map_file, force)
    options.show_next(quiet, "localize", output, "--map", map_file, "--truth", truth)
