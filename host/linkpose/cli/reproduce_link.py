"""`linkpose reproduce link`: Tables 1 and 2 and Figure 2 of the link paper, measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options
from linkpose.cli.patience import while_compiling

if TYPE_CHECKING:
    from linkpose.evaluation.link import Entry, Traces

_LETTERS = {"joint": "A", "tilt": "B", "imu-baro": "C", "baro": "D", "joint-inertial": ""}
_SHOWN_S = (30.0, 35.0)  # the five seconds of Figure 2 (a) and (b)


@click.command("link")
@click.option("--seeds", type=click.IntRange(min=1), default=5, show_default=True, help="How many runs of each Test.")
@options.sensor_errors
@click.option("--plot", "plot_path", type=options.FILE, metavar="FILE.png", help="Draw Figure 2.")
@options.as_json
def command(seeds: int, errors: str, plot_path: Path | None, json_lines: bool) -> None:
    """Measure Methods A to D, and joint-inertial, on Tests 1 to 3, beside the paper's Tables 1 and 2."""
    from linkpose import filters
    from linkpose.evaluation.link import METHODS, reproduce, traces

    with while_compiling():
        filters.warm_up(METHODS)
    entries = [entry for test in (1, 2, 3) for entry in reproduce(test, seeds, errors)]
    if json_lines:
        for entry in entries:
            click.echo(json.dumps(entry.as_dict()))
    else:
        _show(entries, seeds, errors)
    if plot_path:
        _plot(plot_path, [traces(test, 0, errors) for test in (1, 2, 3)])


def _show(entries: list[Entry], seeds: int, errors: str) -> None:
    from rich.console import Console
    from rich.table import Table

    from linkpose.evaluation.link import PAPER_ROLL_PITCH_DEG

    heights = Table("test", "method", title=f"Table 1: height RMSE (cm), {seeds} seeds, errors: {errors}")
    for name in ("mean", "spread", "worst", "paper", "mean ‖a‖ (m/s²)"):
        heights.add_column(name, justify="right")
    attitudes = Table("test", "method", title="Table 2: roll and pitch RMSE (°), mean")
    for name in ("roll", "pitch", "paper roll", "paper pitch"):
        attitudes.add_column(name, justify="right")
    for entry in entries:
        rmse, paper = entry.height_rmse_cm, entry.paper_height_rmse_cm
        method = f"{entry.filter} {_LETTERS[entry.filter]}".strip()
        figures = (f"{rmse.mean():.3f}", f"{rmse.std():.3f}", f"{rmse.max():.3f}", f"{paper:.2f}" if paper else "")
        heights.add_row(str(entry.test), method, *figures, f"{entry.mean_accel_m_s2:.2f}")
        if entry.roll_rmse_deg is not None and entry.pitch_rmse_deg is not None:
            printed = PAPER_ROLL_PITCH_DEG.get(entry.filter)
            beside = [f"{value:.2f}" for value in printed[entry.test - 1]] if printed else ["", ""]
            ours = [f"{entry.roll_rmse_deg.mean():.3f}", f"{entry.pitch_rmse_deg.mean():.3f}"]
            attitudes.add_row(str(entry.test), method, *ours, *beside)
    console = Console()
    console.print(heights)
    console.print(attitudes)


def _plot(path: Path, runs: list[Traces]) -> None:
    from linkpose import plotting

    figure = plotting.new_figure(10, 9)
    for test, (axes, run) in enumerate(zip(figure.subplots(3, 1), runs, strict=True), 1):
        for name in ("baro", "imu-baro", "tilt", "joint", "joint-inertial"):
            axes.plot(run.time_s, 100 * run.height_m[name], linewidth=0.8, label=f"{name} {_LETTERS[name]}".strip())
        axes.plot(run.time_s, 100 * run.truth_m, "k--", linewidth=0.8, label="truth")
        axes.set_title(f"Test {test}")
        axes.set_ylabel("height (cm)")
        if test < 3:
            axes.set_xlim(*_SHOWN_S)
    figure.axes[0].legend(loc="upper right", ncols=3, fontsize=8)
    figure.axes[-1].set_xlabel("time (s)")
    plotting.save(figure, path)
