"""`linkpose simulate mice`."""

from __future__ import annotations

from pathlib import Path

import click

from linkpose.cli import options
from linkpose.sensors.devices import MAX_MICE


@click.command("mice")
@options.simulated_outputs("Recording to write (CSV).")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Path, errors and noise.")
@click.option("--duration", type=options.SecondsType(), default=60.0, show_default=True, help="Length in seconds.")
@click.option("--rate", type=click.IntRange(50, 500), default=100, show_default=True, help="Samples per second.")
@click.option(
    "--mice",
    type=click.IntRange(1, MAX_MICE),
    default=3,
    show_default=True,
    help="Number of mice, on a ring of 17 cm radius.",
)
@click.option("--resolution", type=click.IntRange(1, 40), default=8, show_default=True, help="Counts per mm.")
@click.option(
    "--path",
    type=click.Choice(["drive", "paper", "line", "turn"]),
    default="drive",
    show_default=True,
    help="Manoeuvres up to 1 m/s; the paper's steady (1, 1) cm/s; a straight line; a full turn on the spot.",
)
@click.option(
    "--length",
    type=options.FiniteRange(min=0, min_open=True),
    default=2.0,
    show_default=True,
    metavar="M",
    help="Length of the path `line` (m).",
)
@options.sensor_errors
@click.option(
    "--fault",
    "faults",
    multiple=True,
    metavar="KIND:MOUSE:FROM-TO",
    help="Slip, lift or unplug a mouse for some seconds, for example lift:2:5-8; may be repeated.",
)
@options.force
@options.quiet
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
    quiet: bool,
) -> None:
    """Simulate a recording of a robot with optical mice under it, and its truth."""
    from linkpose.outputs import check_outputs
    from linkpose.simulation.export import check_length, write_mice
    from linkpose.simulation.mice import Fault, MiceRun, ring

    check_outputs((output, truth), force)
    check_length(duration, rate)
    placed = ring(mice, counts_per_m=1000.0 * resolution)
    run = MiceRun(seed, duration, rate, placed, path, errors, faults=tuple(map(Fault.parse, faults)), length_m=length)
    write_mice(run, resolution, output, truth, force)
    options.show_next(quiet, *options.estimate_command(output))
