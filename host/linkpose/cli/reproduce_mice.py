"""`linkpose reproduce mice`: Figures 2 and 3 of the redundant-mice paper, measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options
from linkpose.cli.patience import while_compiling

if TYPE_CHECKING:
    from linkpose.evaluation.mice import PaperRun, Redundancy

PLOTTED_S = 4.0


@click.command("mice")
@click.option("--seeds", type=click.IntRange(min=1), default=5, show_default=True, help="How many simulated drives.")
@click.option("--plot", "plot_path", type=options.FILE, metavar="FILE.png", help="Draw Figures 2 and 3.")
@options.as_json
def command(seeds: int, plot_path: Path | None, json_lines: bool) -> None:
    """Compare two and three optical mice with one: the robot drives at (1, 1) cm/s, mice err within ± 0.25 cm/s."""
    from linkpose import filters
    from linkpose.evaluation.mice import paper_run, redundancy

    with while_compiling():
        filters.warm_up(["mice"])
    rows = [row for mice in (2, 3) for row in redundancy(mice, seeds)]
    if json_lines:
        for row in rows:
            click.echo(json.dumps(_object(row)))
    else:
        _show(rows, seeds)
    if plot_path:
        _plot(plot_path, paper_run(3, 0))


def _object(row: Redundancy) -> dict[str, str | int | float]:
    return {
        "quantity": row.quantity,
        "mice": row.mice,
        "single_std": row.single_std,
        "fused_std": row.fused_std,
        "ratio": row.ratio,
        "theory_ratio": row.theory_ratio,
    }


def _show(rows: list[Redundancy], seeds: int) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("", "mice", title=f"Noise of the estimated velocity against one mouse's, {seeds} seeds")
    for name in ("one mouse σ", "together σ", "ratio", "theory"):
        table.add_column(name, justify="right")
    for row in rows:
        unit = "rad/s" if row.quantity == "wz" else "m/s"
        values = (f"{row.single_std:.5f} {unit}", f"{row.fused_std:.5f} {unit}", f"{row.ratio:.3f}")
        table.add_row(row.quantity, str(row.mice), *values, f"{row.theory_ratio:.3f}")
    Console().print(table)
    best = [1 - row.ratio for row in rows if row.mice == 3]
    click.echo(
        f"Three mice take {100 * sum(best) / len(best):.0f} % of the error away; the paper reads about 30 % from its "
        "Figures 2 and 3, where least squares promises 1 − 1/√3 = 42 %."
    )


def _plot(path: Path, run: PaperRun) -> None:
    from linkpose import plotting

    figure = plotting.new_figure(11.0, 7.0)
    axes = figure.subplots(3, 2, sharex=True, sharey="row")
    labels = ("v_x (cm/s)", "v_y (cm/s)", "ω (rad/s)")
    for j, (label, scale) in enumerate(zip(labels, (100.0, 100.0, 1.0), strict=True)):
        apart = run.single[..., j] - (run.single[..., j].mean(axis=0) - run.truth[j] if j == 2 else 0.0)
        for mouse in range(run.single.shape[1]):
            axes[j, 0].plot(run.time_s, scale * apart[:, mouse], linewidth=0.6, label=f"mouse {mouse + 1}")
        axes[j, 1].plot(run.time_s, scale * run.fused[:, j], linewidth=0.6, color="black")
        axes[j, 0].set_ylabel(label)
    axes[0, 0].legend(loc="upper right", ncols=3)
    axes[0, 0].set_title("What the mice say (Figure 2)")
    axes[0, 1].set_title("The robot's velocity by least squares (Figure 3)")
    for axis in axes[-1]:
        axis.set_xlabel("time (s)")
        axis.set_xlim(0, PLOTTED_S)
    plotting.save(figure, path)
