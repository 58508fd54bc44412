"""`linkpose evaluate`: how far the filters are from a reference."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options

if TYPE_CHECKING:
    from linkpose.evaluation.scores import Score

_HEADINGS = {
    "height_rmse_cm": "height (cm)",
    "roll_rmse_deg": "roll (°)",
    "pitch_rmse_deg": "pitch (°)",
    "velocity_rmse_m_s": "velocity (m/s)",
    "rate_rmse_rad_s": "rate (rad/s)",
    "position_rmse_m": "position (m)",
    "heading_rmse_rad": "heading (rad)",
}


@click.command("evaluate")
@click.argument("estimate", type=options.FILE)
@click.argument("reference", type=options.FILE)
@options.up
@options.as_json
def command(estimate: Path, reference: Path, up: str, json_lines: bool) -> None:
    """Root mean square errors of each filter in ESTIMATE.csv against REFERENCE.csv.

    The two are aligned in time by cross-correlation where that fits clearly better than their stamps. The reference
    is a truth of `linkpose simulate`, any CSV with such columns, or OptiTrack Motive's export of three markers: the
    first at the sensor, the second along its x axis, the third on the side of its y axis.
    """
    from linkpose.evaluation.motive import read_any
    from linkpose.evaluation.scores import evaluate
    from linkpose.recording.table import read_table

    truth = read_any(reference, up)
    found = evaluate(read_table(estimate), truth)
    for remark in (*truth.remarks, *found.remarks):
        click.echo(remark, err=True)
    if json_lines:
        for score in found.scores:
            click.echo(json.dumps(score.as_dict()))
    else:
        _show(found.scores)


def _show(scores: list[Score]) -> None:
    from rich.console import Console
    from rich.table import Table

    columns = [key for key in _HEADINGS if any(key in score.errors for score in scores)]
    table = Table("filter", title="Root mean square errors")
    for key in columns:
        table.add_column(_HEADINGS[key], justify="right")
    table.add_column("rows", justify="right")
    for score in scores:
        errors = [f"{score.errors[key]:.4g}" if key in score.errors else "" for key in columns]
        table.add_row(score.filter, *errors, str(score.rows))
    Console().print(table)
    if scores[0].time_offset_s:
        click.echo(f"The reference's clock is {scores[0].time_offset_s:+.4f} s from the estimate's; aligned.")
