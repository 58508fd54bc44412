"""`linkpose convert`: estimates and recordings in the formats of other programs."""

from __future__ import annotations

from pathlib import Path

import click

from linkpose.cli import options


@click.command("convert")
@click.argument("source", type=options.FILE, metavar="IN")
@click.option(
    "-o",
    "--output",
    type=options.FILE,
    required=True,
    metavar="OUT.ext",
    help="Write this file; its ending selects the format: .sto, .mot, .trc, .c3d, .tum, .mcap or .parquet.",
)
@click.option(
    "--filter",
    "wanted",
    metavar="NAME",
    shell_complete=options.complete_filter,
    help="Convert the estimates of this filter only.",
)
@click.option(
    "--label",
    default="sensor_imu",
    show_default=True,
    metavar="NAME",
    help="Name of the sensor in .sto, .trc and .c3d; OpenSense expects BODY_imu.",
)
@options.force
@options.quiet
def command(source: Path, output: Path, wanted: str | None, label: str, force: bool, quiet: bool) -> None:
    """Convert the estimate or recording IN into a format of OpenSim, motion capture, robotics or pandas.

    .sto holds orientations for OpenSense, .mot all columns for OpenSim, .trc and .c3d three markers on the sensor,
    .tum a trajectory for evo, .mcap poses and values for Foxglove, .parquet all columns and the metadata.
    linkpose reads .parquet wherever it reads .csv.
    """
    from linkpose.cli.live import Console
    from linkpose.convert import ENDINGS, convert

    if output.suffix.lower() not in ENDINGS:
        raise click.UsageError(f"{output} has none of the endings {', '.join(ENDINGS)}")
    if any(not 33 <= ord(character) < 127 or character in ",;" for character in label) or not label:
        raise click.UsageError(f"--label {label!r} must consist of letters, digits and _")
    console = Console(quiet, verbose=False)
    remarks = convert(
        source, output, wanted, label, force, lambda share: console.progress(lambda: f"converting {share:.0%}")
    )
    console.clear()
    for remark in remarks:
        console.report(remark)
    click.echo(output)
