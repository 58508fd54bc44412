"""`linkpose evaluate`: errors of the filters against a reference."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options

if TYPE_CHECKING:
    from linkpose.evaluation.scores import Evaluation
    from linkpose.evaluation.scoring import Score


@click.command("evaluate")
@click.argument("estimate", type=options.FILE)
@click.argument("reference", type=options.FILE)
@click.option("--from", "from_s", type=options.FiniteRange(), metavar="S", help="Score from this time_s on (s).")
@click.option("--to", "to_s", type=options.FiniteRange(), metavar="S", help="Score up to this time_s (s).")
@options.up
@options.plot("Draw errors with ±2σ, their distribution and the table.")
@options.force
@options.as_json
@options.quiet
def command(
    estimate: Path,
    reference: Path,
    from_s: float | None,
    to_s: float | None,
    up: str | None,
    plot_path: Path | None,
    force: bool,
    json_lines: bool,
    quiet: bool,
) -> None:
    """Compare each filter in ESTIMATE with REFERENCE.

    Prints root mean square, mean, worst and 95 % error of each quantity. Where the estimate has a standard deviation σ,
    it also prints NEES (the mean of (error/σ)², 1 where σ is right) and the share of errors within ±2σ. Rows without an
    estimate yet are left out.

    The two files are aligned in time by cross-correlation where that fits clearly better than their stamps. The
    reference is a truth of `linkpose simulate`, any table with such columns, or a motion-capture take (C3D, TRC, CSV of
    OptiTrack Motive) of three markers: the first at the sensor, the second along its x axis, the third on the side of
    its y axis.
    """
    from linkpose import plotting
    from linkpose.cli.live import Console
    from linkpose.evaluation.longfiles import evaluate_files

    if from_s is not None and to_s is not None and from_s >= to_s:
        raise click.UsageError(f"--from {from_s:g} is not before --to {to_s:g}")
    plotting.check_output(plot_path, force)
    console = Console(quiet, verbose=False)
    found = evaluate_files(
        estimate, reference, up, from_s, to_s, lambda share: console.progress(lambda: f"comparing {share:.0%}")
    )
    console.clear()
    for remark in found.remarks:
        console.report(remark)
    if json_lines:
        for score in found.scores:
            click.echo(json.dumps(score.as_dict()))
    else:
        _show(found, quiet)
    if plot_path:
        plotting.save(plotting.evaluation(found, estimate.name, reference.name), plot_path, force)
        if not quiet:
            click.echo(f"picture: {plot_path}", err=True)


def _show(found: Evaluation, quiet: bool) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from linkpose.cli.rendering import show_table, wrapped
    from linkpose.presentation import same_digits
    from linkpose.quantities import unit_text, words

    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column("filter", no_wrap=True)
    table.add_column("error of", no_wrap=True)
    for name in ("RMSE", "mean", "worst", "95 %", "NEES", "in ±2σ"):
        table.add_column(name, justify="right", no_wrap=True)
    for score in found.scores:
        title = score.filter
        for name, value in score.statistics().items():
            of = score.errors[name]
            unit = unit_text(of.unit)
            figures = same_digits(value.rmse, value.mean, value.worst, value.p95)
            sigma = ["", ""]
            if value.nees is not None and value.within_2sigma is not None:
                sigma = [f"{value.nees:.3g}", f"{100 * value.within_2sigma:.0f} %"]
            table.add_row(title, f"{words(name)} ({unit})", *figures, *sigma)
            title = ""
    show_table(table)
    if quiet:
        return
    for score in found.scores:
        for line in _sentences(score):
            click.echo(wrapped(line, sys.stdout))
    if found.scores[0].time_offset_s:
        click.echo(
            wrapped(
                f"The clocks differ: {found.scores[0].time_offset_s:+.4f} s were added to the estimate's to get the "
                "reference's.",
                sys.stdout,
            )
        )


def _sentences(score: Score) -> list[str]:
    """How many rows were used, and whether σ is right, for each quantity that has one."""
    from linkpose.quantities import ROTATION, words

    rows = f"{score.filter}: {score.rows} of {score.known_rows} rows compared"
    if score.empty_rows:
        rows += f", {score.empty_rows} without an estimate left out"
    if score.yaw_drift_deg_per_min is not None:
        rows += f"; the yaw drifts by {score.yaw_drift_deg_per_min:.2g} °/min"
    verdicts = {name: value.verdict(of_three=name == ROTATION.name) for name, value in score.statistics().items()}
    return [f"{rows}.", *(f"  {words(name)}: {verdict}" for name, verdict in verdicts.items() if verdict)]
