"""`linkpose simulate link`."""

from __future__ import annotations

from pathlib import Path

import click

from linkpose.cli import options
from linkpose.sensors.rig import Rig, Vector


@click.command("link")
@options.simulated_outputs("Recording to write (CSV).")
@click.option("--test", type=click.IntRange(1, 3), default=1, show_default=True, help="Test of the link paper.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Motion, errors and noise.")
@click.option("--duration", type=options.SecondsType(), default=65.0, show_default=True, help="Length in seconds.")
@click.option("--rate", type=click.IntRange(50, 500), default=100, show_default=True, help="Samples per second.")
@options.sensor_errors_or_rig
@click.option(
    "--j2s",
    type=options.VectorType(),
    default="-0.09,-0.04,1.65",
    show_default=True,
    help="J2S: vector from the joint centre to the sensor, in its axes (m).",
)
@click.option("--rests", is_flag=True, help="Lay the sensor on its six sides in turn, as `calibrate imu` needs it.")
@click.option(
    "--still", is_flag=True, help="Keep the link at rest, as `calibrate noise` needs it: with --duration 1800 or more."
)
@click.option("--imu2", is_flag=True, help="Add a second inertial sensor, half-way between the joint and the first.")
@click.option("--mag", is_flag=True, help="Add a magnetometer.")
@click.option(
    "--mag-disturbance",
    type=click.Choice(["desk", "desks", "motor", "iron", "building", "floor", "lift", "car"]),
    help="Disturb the magnetometer, which is added: a steel desk that arrives, several desks, a motor on the link, "
    "iron that is carried past, a building, a steel floor, a lift or a car.",
)
@options.force
@options.quiet
def command(
    output: Path,
    truth: Path,
    test: int,
    seed: int,
    duration: float,
    rate: int,
    errors: str | Rig,
    j2s: Vector,
    rests: bool,
    still: bool,
    imu2: bool,
    mag: bool,
    mag_disturbance: str | None,
    force: bool,
    quiet: bool,
) -> None:
    """Simulate a recording of the link paper's rig, and its truth."""
    from linkpose.outputs import check_outputs
    from linkpose.simulation.export import check_length, write_link
    from linkpose.simulation.link import LinkRun

    if rests and still:
        raise click.UsageError("--rests lays the sensor on its sides, --still keeps it at rest: leave out one of them")
    check_outputs((output, truth), force)
    check_length(duration, rate)
    level, noise_of = ("calibrated", errors) if isinstance(errors, Rig) else (errors, None)
    has_mag = mag or mag_disturbance is not None
    motion = "sides" if rests else "rest" if still else "swing"
    run = LinkRun(
        test, seed, duration, rate, level, j2s, motion=motion, imu2=imu2, mag=has_mag, mag_disturbance=mag_disturbance,
        noise_of=noise_of,
    )  # fmt: skip
    write_link(run, output, truth, force)
    held = ("--mag",) if has_mag and level != "datasheet" else ()  # a data sheet's specimen has no calibration
    if motion == "swing":
        options.show_next(quiet, *options.estimate_command(output, *held))
    else:
        options.show_next(quiet, "calibrate", "imu" if rests else "noise", output, "--rig", "rig.toml")
