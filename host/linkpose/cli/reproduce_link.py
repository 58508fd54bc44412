"""`linkpose reproduce link`: Tables 1 and 2 and Figure 2 of the link paper."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options
from linkpose.cli.live import Console

if TYPE_CHECKING:
    from linkpose.experiments.link import Entry


@click.command("link")
@options.seeds("runs of each Test")
@options.sensor_errors
@options.plot("Draw Figure 2.")
@options.force
@options.as_json
@options.quiet
def command(seeds: int, errors: str, plot_path: Path | None, force: bool, json_lines: bool, quiet: bool) -> None:
    """Run Methods A to D and joint-inertial on Tests 1 to 3, and compare with the paper's Tables 1 and 2."""
    from linkpose import plotting
    from linkpose.experiments.link import METHODS, reproduce, traces

    plotting.check_output(plot_path, force)
    Console(quiet, verbose=False).compile(METHODS)
    entries = [entry for test in (1, 2, 3) for entry in reproduce(test, seeds, errors)]
    if json_lines:
        for entry in entries:
            click.echo(json.dumps(entry.as_dict()))
    else:
        _show(entries, seeds, errors)
    if plot_path:
        plotting.save(plotting.paper_figure_2([traces(test, 0, errors) for test in (1, 2, 3)]), plot_path, force)


def _show(entries: list[Entry], seeds: int, errors: str) -> None:
    from rich.table import Table

    from linkpose.cli.rendering import show_table
    from linkpose.experiments.link import PAPER_ROLL_PITCH_DEG, title
    from linkpose.presentation import counted

    heights = Table("test", "method", title=f"Table 1: height RMSE (cm), {counted(seeds, 'seed')}, errors: {errors}")
    for name in ("mean", "spread", "worst", "paper", "mean ‖a‖ (m/s²)"):
        heights.add_column(name, justify="right")
    attitudes = Table("test", "method", title="Table 2: roll and pitch RMSE (°), mean")
    for name in ("roll", "pitch", "paper roll", "paper pitch"):
        attitudes.add_column(name, justify="right")
    places = Table("test", "method", title="Beyond the paper: position (cm) and yaw (°) since the start, RMSE, mean")
    for name in ("position", "yaw", "yaw drift (°/min)"):
        places.add_column(name, justify="right")
    for entry in entries:
        rmse, paper, method = entry.rmse["height"], entry.paper_height_rmse_cm, title(entry.filter)
        figures = (f"{rmse.mean():.3f}", f"{rmse.std():.3f}", f"{rmse.max():.3f}", f"{paper:.2f}" if paper else "")
        heights.add_row(str(entry.test), method, *figures, f"{entry.mean_accel_m_s2:.2f}")
        if "roll" in entry.rmse and "pitch" in entry.rmse:
            printed = PAPER_ROLL_PITCH_DEG.get(entry.filter)
            beside = [f"{value:.2f}" for value in printed[entry.test - 1]] if printed else ["", ""]
            ours = [f"{entry.rmse[name].mean():.3f}" for name in ("roll", "pitch")]
            attitudes.add_row(str(entry.test), method, *ours, *beside)
        if "position" in entry.rmse and entry.yaw_drift_deg_per_min is not None:
            ours = [f"{entry.rmse[name].mean():.3f}" for name in ("position", "yaw")]
            places.add_row(str(entry.test), method, *ours, f"{entry.yaw_drift_deg_per_min.mean():.3f}")
    show_table(heights)
    show_table(attitudes)
    if places.row_count:
        show_table(places)
