"""`linkpose plot`: pictures of recordings, estimates and references."""

from __future__ import annotations

from pathlib import Path

import click

from linkpose.cli import options


@click.command("plot")
@click.argument("files", type=options.FILE, nargs=-1, required=True)
@click.option("-o", "--output", type=options.FILE, metavar="FILE.png", help="Picture; default: the first file's name.")
@options.up
def command(files: tuple[Path, ...], output: Path | None, up: str) -> None:
    """Draw recordings, estimates and references over time, those of one quantity in one panel."""
    from linkpose import plotting
    from linkpose.evaluation.motive import read_any

    output = output or files[0].with_suffix(".png")
    tables = [read_any(path, up) for path in files]
    for table in tables:
        for remark in table.remarks:
            click.echo(remark, err=True)
    plotting.save(plotting.plot_tables(tables), output)
    click.echo(output)
