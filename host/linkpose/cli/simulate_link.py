"""`linkpose simulate link`."""

from __future__ import annotations

from pathlib import Path

import click

from linkpose.cli import options
from linkpose.sensors.rig import Vector


@click.command("link")
@click.option("-o", "--output", type=options.FILE, required=True, help="Recording to write (CSV).")
@click.option("--truth", type=options.FILE, required=True, help="Truth to write (CSV).")
@click.option("--test", type=click.IntRange(1, 3), default=1, show_default=True, help="Test of the link paper.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Motion, errors and noise.")
@click.option("--duration", type=float, default=65.0, show_default=True, metavar="S", help="Length in seconds.")
@click.option("--rate", type=click.IntRange(50, 500), default=100, show_default=True, help="Samples a second.")
@options.sensor_errors
@click.option(
    "--j2s",
    type=options.VectorType(),
    default="-0.09,-0.04,1.65",
    show_default=True,
    help="Vector from the joint centre to the sensor, in its axes (m).",
)
@options.force
def command(
    output: Path, truth: Path, test: int, seed: int, duration: float, rate: int, errors: str, j2s: Vector, force: bool
) -> None:
    """Make a recording of the link paper's rig, and the truth of it."""
    from linkpose.recording.truth import write_truth
    from linkpose.recording.writer import write_recording
    from linkpose.simulation import board
    from linkpose.simulation.link import LinkRun
    from linkpose.wire.messages import Configure

    run = LinkRun(test, seed, duration, rate, errors, j2s)
    settings: Configure = board.DEFAULTS._replace(sample_rate_hz=rate)
    name = f"sim://link?test={test}&seed={seed}&errors={errors}"
    exact = run.truth()
    columns = {
        "time_s": exact.time_s,
        "height_m": exact.height_m,
        "roll_deg": exact.roll_deg,
        "pitch_deg": exact.pitch_deg,
    }
    write_truth(truth, columns, {"device": name, "j2s_m": j2s}, force)
    write_recording(output, board.hello(settings), run.samples(), name, run.rig, force)
