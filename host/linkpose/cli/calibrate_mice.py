"""`linkpose calibrate mice`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options
from linkpose.cli.live import Console

if TYPE_CHECKING:
    from linkpose.calibration.mice import MouseCalibration


@click.command("mice")
@click.argument("recordings", type=options.FILE, nargs=-1, required=True)
@click.option("--rig", "rig_file", type=options.FILE, required=True, help="Rig file to complete: it places the mice.")
@click.option(
    "--length",
    type=options.FiniteRange(min=0, min_open=True),
    metavar="M",
    help="Length of the straight line (m). Without it the scale comes from the turn and from where the mice sit.",
)
@options.as_json
@options.quiet
def command(recordings: tuple[Path, ...], rig_file: Path, length: float | None, json_lines: bool, quiet: bool) -> None:
    """Estimate counts per metre and mounting angle of each mouse, and write them into the rig file.

    Measure where each mouse sits (x_m ahead, y_m to the left of the robot's centre) and write it into the rig file.
    Record a straight line of known length, driven ahead, and a full turn on the spot (several turns, or several
    recordings, are better), each with a second of rest before it. The gyro shows which recording is which.
    """
    from linkpose.calibration.mice import calibrate_mice, with_calibration
    from linkpose.sensors.devices import slow_mouse_remarks

    console = Console(quiet, verbose=False)
    loaded, rig = options.recordings_and_rig(recordings, rig_file, console.report)
    found = calibrate_mice(loaded, rig, length)
    with_calibration(rig, found).save(rig_file)
    for mouse in found:
        click.echo(json.dumps(mouse.as_dict()) if json_lines else _line(mouse))
    for remark in slow_mouse_remarks([mouse.counts_per_m for mouse in found], loaded[0].sample_rate_hz):
        console.report(remark)
    options.show_rig_written(rig_file, quiet, *options.estimate_command(recordings[0], "--rig", rig_file))


def _line(mouse: MouseCalibration) -> str:
    return (
        f"mouse {mouse.mouse}: {mouse.counts_per_m:.1f} ± {mouse.counts_per_m_std:.1f} counts/m, "
        f"turned by {mouse.angle_deg:.2f} ± {mouse.angle_std_deg:.2f}°, by the turns at x_m = {mouse.x_m:.4f}, "
        f"y_m = {mouse.y_m:.4f} (± {1e3 * mouse.position_std_m:.1f} mm), residual {mouse.residual_mm:.2f} mm"
    )
