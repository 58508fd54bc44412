"""`linkpose reproduce indoor`: the comparisons of the thesis's chapter 3.1 on simulated drives."""

from __future__ import annotations

import json
from pathlib import Path

import click

from linkpose.cli import options
from linkpose.cli.live import Console


@click.command("indoor")
@options.seeds("drives")
@options.plot("Draw the errors of all variants.")
@options.force
@options.as_json
@options.quiet
def command(seeds: int, plot_path: Path | None, force: bool, json_lines: bool, quiet: bool) -> None:
    """Compare fixed with range-adaptive R, diagonal with off-diagonal Q and R, and the EKF with the UKF, indoors.

    The thesis's own logs and result tables are not public. The drives are simulated on a floor of the same size.
    """
    from linkpose import plotting
    from linkpose.cli.rendering import as_table, progress
    from linkpose.experiments import indoor

    plotting.check_output(plot_path, force)
    Console(quiet, verbose=False).compile(indoor.FILTERS)
    variants = indoor.compare(seeds, progress("drives", quiet))
    rows = [variant.as_row() for variant in variants]
    if json_lines:
        click.echo("\n".join(json.dumps(row) for row in rows))
    else:
        click.echo(as_table(rows))
        click.echo("\n".join(["", "Claims of the thesis:", *indoor.claims(variants)]))
        click.echo("\n".join(["", "Comparisons that the thesis does not make:", *indoor.further_claims(variants)]))
    if plot_path:
        figure = plotting.variants("Indoor localisation", variants, [indoor.label(variant) for variant in variants])
        plotting.save(figure, plot_path, force)
