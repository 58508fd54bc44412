"""`linkpose reproduce underwater`: checks, comparisons and figures of chapter 3.2 of the thesis, on simulated dives."""

from __future__ import annotations

from pathlib import Path

import click

from linkpose.cli import options
from linkpose.cli.live import Console

VARIANTS = "variants-underwater"  # the picture with the errors of all variants


@click.command("underwater")
@options.seeds("dives", default=6)
@options.thesis_figures("chapter 3.2")
@options.force
@options.as_json
@options.quiet
def command(seeds: int, plot_path: Path | None, force: bool, json_lines: bool, quiet: bool) -> None:
    """Check the simulator of Tables 2.2 to 2.9, and compare the EKF with the UKF on its measurements.

    Prints the noises of Tables 3.5 and 3.6, as set and as computed from the dives, the sets of measurements (Table
    3.10), and the errors of each filter on each set. Each claim is judged by a two-sided sign test over the dives (p <
    0.05). With --plot, Figures 3.7 to 3.10 show the dive of seed 0.
    """
    from linkpose import plotting
    from linkpose.cli import rendering
    from linkpose.experiments import underwater
    from linkpose.simulation.underwater import BEACONS

    files = rendering.files_of_figures(plot_path, VARIANTS, plotting.UNDERWATER_FIGURES, force)
    Console(quiet, verbose=False).compile(underwater.FILTERS)
    checks = underwater.check_simulator(seeds)
    cases = underwater.compare(seeds, rendering.progress("dives", quiet))
    sets = [case.as_set(number) for number, case in enumerate(cases, 1)]
    tables = [checks, sets, [row for case in cases for row in case.rows()]]
    rendering.show_experiment(tables, underwater.claims(cases), seeds, json_lines)
    if files:
        variants = [variant for case in cases for variant in case.variants]
        labels = [underwater.label(variant) for variant in variants]
        figures = plotting.underwater_figures(underwater.dive(0), BEACONS)
        figures[VARIANTS] = plotting.variants("Underwater localization", variants, labels)
        rendering.save_figures(figures, files, force, quiet)
