"""`linkpose plot`: pictures of recordings, estimates and references."""

from __future__ import annotations

from pathlib import Path

import click

from linkpose.cli import options


@click.command("plot")
@click.argument("files", type=options.FILE, nargs=-1, required=True)
@click.option(
    "-o", "--output", type=options.FILE, metavar="FILE.png", help="PNG, SVG or PDF; default: the first file's name."
)
@click.option("--filter", "wanted", multiple=True, metavar="NAME", help="Draw this filter only; may be repeated.")
@options.up
@options.force
@click.option("-q", "--quiet", is_flag=True, help="Print no remarks.")
def command(
    files: tuple[Path, ...], output: Path | None, wanted: tuple[str, ...], up: str, force: bool, quiet: bool
) -> None:
    """Draw recordings, estimates and references.

    An estimate together with its reference (a truth or a motion-capture export) shows the errors with ±2σ. Filters that
    measure height by air pressure are drawn only when --filter names them.
    """
    from linkpose import plotting
    from linkpose.evaluation.motive import read_any

    output = output or files[0].with_suffix(".png")
    plotting.check_output(output, force)
    tables = [read_any(path, up) for path in files]
    figure, remarks = plotting.plot_tables(tables, [name.replace("_", "-") for name in wanted])
    plotting.save(figure, output, force)
    for remark in [remark for table in tables for remark in table.remarks] + remarks:
        if not quiet:
            click.echo(remark, err=True)
    click.echo(output)
