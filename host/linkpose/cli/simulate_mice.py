"""`linkpose simulate mice`."""

from __future__ import annotations

from pathlib import Path

import click

from linkpose.cli import options


@click.command("mice")
@click.option("-o", "--output", type=options.FILE, required=True, help="Recording to write (CSV).")
@click.option("--truth", type=options.FILE, required=True, help="Truth to write (CSV).")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Path, errors and noise.")
@click.option("--duration", type=options.SecondsType(), default=60.0, show_default=True, help="Length in seconds.")
@click.option("--rate", type=click.IntRange(50, 500), default=100, show_default=True, help="Samples a second.")
@click.option(
    "--mice", type=click.IntRange(1, 4), default=3, show_default=True, help="How many, in a ring of 17 cm radius."
)
@click.option("--resolution", type=click.IntRange(1, 40), default=8, show_default=True, help="Counts per mm.")
@click.option(
    "--path",
    type=click.Choice(["drive", "paper", "line", "turn"]),
    default="drive",
    show_default=True,
    help="Manoeuvres up to 1 m/s; the paper's steady (1, 1) cm/s; a straight line; a full turn on the spot.",
)
@click.option("--length", type=float, default=2.0, show_default=True, metavar="M", help="Of the path `line` (m).")
@options.sensor_errors
@click.option(
    "--fault",
    "faults",
    multiple=True,
    metavar="KIND:MOUSE:FROM-TO",
    help="A slip, lift or unplug of a mouse for a time in seconds, as lift:2:5-8; may be repeated.",
)
@options.force
def command(
    output: Path,
    truth: Path,
    seed: int,
    duration: float,
    rate: int,
    mice: int,
    resolution: int,
    path: str,
    length: float,
    errors: str,
    faults: tuple[str, ...],
    force: bool,
) -> None:
    """Make a recording of a robot with optical mice under it, and the truth of it."""
    from linkpose.recording.truth import write_truth
    from linkpose.recording.writer import write_recording
    from linkpose.simulation import board
    from linkpose.simulation.mice import Fault, MiceRun, ring

    run = MiceRun(
        seed,
        duration,
        rate,
        ring(mice, counts_per_m=1000.0 * resolution),
        path,
        errors,
        faults=tuple(map(Fault.parse, faults)),
        length_m=length,
    )
    settings = board.DEFAULTS._replace(sample_rate_hz=rate, mouse_counts_per_mm=resolution)
    name = f"sim://mice?seed={seed}&mice={mice}&path={path}&errors={errors}"
    write_truth(truth, run.truth().columns(), {"device": name, "rig": run.rig.as_dict()}, force)
    hello = board.hello(settings, sensors=run.hello_sensors, mice=run.hello_mice)
    write_recording(output, hello, run.samples(), name, run.rig, force)
