"""`linkpose reproduce underwater`: the checks and comparisons of the thesis's chapter 3.2 on simulated dives."""

from __future__ import annotations

import json
from pathlib import Path

import click

from linkpose.cli import options
from linkpose.cli.live import Console


@click.command("underwater")
@options.seeds("dives")
@options.plot("Draw the errors of all variants.")
@options.force
@options.as_json
@options.quiet
def command(seeds: int, plot_path: Path | None, force: bool, json_lines: bool, quiet: bool) -> None:
    """Check the simulator of Tables 2.2 to 2.9, and compare the EKF with the UKF on its measurements.

    Synchronous and asynchronous sensors, with and without a common error of the ranges, outliers and gate. The
    thesis's own values and result tables are not public.
    """
    from linkpose import plotting
    from linkpose.cli.rendering import as_table, progress
    from linkpose.experiments import underwater

    plotting.check_output(plot_path, force)
    Console(quiet, verbose=False).compile(underwater.FILTERS)
    checks = underwater.check_simulator(seeds)
    cases = underwater.compare(seeds, progress("dives", quiet))
    rows = [row for case in cases for row in case.rows()]
    if json_lines:
        click.echo("\n".join(json.dumps(row) for row in [*checks, *rows]))
    else:
        click.echo(f"{as_table(checks)}\n\n{as_table(rows)}")
        click.echo("\n".join(["", "What the thesis expects:", *underwater.claims(cases)]))
    if plot_path:
        variants = [variant for case in cases for variant in case.variants]
        labels = [underwater.label(variant) for variant in variants]
        plotting.save(plotting.variants("Underwater localisation", variants, labels), plot_path, force)
