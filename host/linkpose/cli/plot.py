"""`linkpose plot`: pictures of recordings, estimates and references."""

from __future__ import annotations

from pathlib import Path

import click

from linkpose.cli import options


@click.command("plot")
@click.argument("files", type=options.FILE, nargs=-1, required=True)
@click.option("-o", "--output", type=options.FILE, metavar="FILE.png", help="Picture; default: the first file's name.")
def command(files: tuple[Path, ...], output: Path | None) -> None:
    """Draw recordings, estimates and references over time, those of one quantity in one panel."""
    from linkpose import plotting
    from linkpose.recording.table import read_table

    output = output or files[0].with_suffix(".png")
    plotting.save(plotting.plot_tables([read_table(path) for path in files]), output)
    click.echo(output)
