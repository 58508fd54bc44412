"""`linkpose reproduce indoor`: the comparisons and figures of the thesis's chapter 3.1 on simulated drives."""

from __future__ import annotations

from pathlib import Path

import click

from linkpose.cli import options
from linkpose.cli.live import Console

VARIANTS = "variants-indoor"  # the picture with the errors of all variants


@click.command("indoor")
@options.seeds("drives", default=6)
@options.thesis_figures("chapter 3.1")
@options.force
@options.as_json
@options.quiet
def command(seeds: int, plot_path: Path | None, force: bool, json_lines: bool, quiet: bool) -> None:
    """Compare fixed with range-adaptive R, diagonal with off-diagonal Q and R, and the EKF with the UKF, indoors.

    The drives are simulated on a floor of the size of the thesis's. Each claim is judged by a two-sided sign test over
    the drives (p < 0.05). With --plot, Figures 3.1 to 3.6 show the drive of seed 0.
    """
    from linkpose import plotting
    from linkpose.cli import rendering
    from linkpose.experiments import indoor

    files = rendering.files_of_figures(plot_path, VARIANTS, plotting.INDOOR_FIGURES, force)
    Console(quiet, verbose=False).compile(indoor.FILTERS)
    variants = indoor.compare(seeds, rendering.progress("drives", quiet))
    tables = [[variant.as_row() for variant in variants]]
    rendering.show_experiment(tables, indoor.claims(variants), seeds, json_lines)
    if files:
        labels = [indoor.label(variant) for variant in variants]
        figures = plotting.indoor_figures(indoor.drive(0))
        figures[VARIANTS] = plotting.variants("Indoor localization", variants, labels)
        rendering.save_figures(figures, files, force, quiet)
