"""`linkpose simulate chain`."""

from __future__ import annotations

from pathlib import Path

import click

from linkpose.cli import options
from linkpose.sensors.rig import CHAIN_JOINTS, FIRST_JOINTS, Rig


@click.command("chain")
@options.simulated_outputs("Recording to write (CSV).")
@click.option(
    "--joint", type=click.Choice(CHAIN_JOINTS), default="hinge", show_default=True, help="Joint between the two links."
)
@click.option(
    "--first-joint",
    type=click.Choice(FIRST_JOINTS),
    default="fixed",
    show_default=True,
    help="Joint from which link 1 hangs. A free one is carried to and fro, like a hip, and gives no heights.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Motion, errors and noise.")
@click.option("--duration", type=options.SecondsType(), default=60.0, show_default=True, help="Length in seconds.")
@click.option("--rate", type=click.IntRange(50, 500), default=100, show_default=True, help="Samples per second.")
@options.sensor_errors_or_rig
@click.option(
    "--rig", "rig_file", type=options.FILE, metavar="RIG.toml", help="Also write a rig file with the true mounting."
)
@options.force
@options.quiet
def command(
    output: Path,
    truth: Path,
    joint: str,
    first_joint: str,
    seed: int,
    duration: float,
    rate: int,
    errors: str | Rig,
    rig_file: Path | None,
    force: bool,
    quiet: bool,
) -> None:
    """Simulate a recording of two links with a sensor on each, and its truth.

    The first link hangs from a joint, like a thigh from the hip. The recording states the kind of the joint
    between the links, not how the sensors are mounted; --rig writes the mounting into a rig file.
    """
    from linkpose.outputs import check_outputs
    from linkpose.simulation.chain import ChainRun
    from linkpose.simulation.export import check_length, write_chain

    check_outputs((output, truth, *([rig_file] if rig_file else [])), force)
    check_length(duration, rate)
    level, noise_of = ("calibrated", errors) if isinstance(errors, Rig) else (errors, None)
    run = ChainRun(joint, seed, duration, rate, level, noise_of=noise_of, first_joint=first_joint)
    write_chain(run, output, truth, rig_file, force)
    with_rig = ("--rig", rig_file) if rig_file else ()
    options.show_next(quiet, *options.estimate_command(output, "--filter", "chain", *with_rig))
