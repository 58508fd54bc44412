"""`linkpose reproduce mice`: Figures 2 and 3 of the redundant-mice paper."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options
from linkpose.cli.live import Console
from linkpose.presentation import counted

if TYPE_CHECKING:
    from linkpose.experiments.mice import Redundancy


@click.command("mice")
@options.seeds("drives")
@options.plot("Draw Figures 2 and 3.")
@options.force
@options.as_json
@options.quiet
def command(seeds: int, plot_path: Path | None, force: bool, json_lines: bool, quiet: bool) -> None:
    """Compare two and three optical mice with one.

    The robot drives at (1, 1) cm/s, and each mouse's velocity has an error within ±0.25 cm/s, as in the paper.
    """
    from linkpose import plotting
    from linkpose.experiments.mice import paper_run, redundancy

    plotting.check_output(plot_path, force)
    Console(quiet, verbose=False).compile(["mice"])
    rows = [row for mice in (2, 3) for row in redundancy(mice, seeds)]
    if json_lines:
        for row in rows:
            click.echo(json.dumps(asdict(row) | {"ratio": row.ratio}))
    else:
        _show(rows, seeds)
    if plot_path:
        plotting.save(plotting.redundant_mice(paper_run(3, 0)), plot_path, force)


def _show(rows: list[Redundancy], seeds: int) -> None:
    from rich.table import Table

    from linkpose.cli.rendering import show_table, show_text

    table = Table(
        "", "mice", title=f"Noise of the estimated velocity compared with one mouse, {counted(seeds, 'seed')}"
    )
    for name in ("one mouse σ", "together σ", "ratio", "theory"):
        table.add_column(name, justify="right")
    for row in rows:
        unit = "rad/s" if row.quantity == "wz" else "m/s"
        values = (f"{row.single_std:.5f} {unit}", f"{row.fused_std:.5f} {unit}", f"{row.ratio:.3f}")
        table.add_row(row.quantity, str(row.mice), *values, f"{row.theory_ratio:.3f}")
    show_table(table)
    best = [1 - row.ratio for row in rows if row.mice == 3]
    show_text(
        f"Three mice reduce the error by {100 * sum(best) / len(best):.0f} %. The paper reads about 30 % from its "
        "Figures 2 and 3; least squares predicts 1 − 1/√3 = 42 %."
    )
