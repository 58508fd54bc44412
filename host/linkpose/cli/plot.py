"""`linkpose plot`: pictures of recordings, estimates and references."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options
from linkpose.cli.page import PageOptions

if TYPE_CHECKING:
    from linkpose.cli.live import Console


@click.command("plot")
@click.argument("files", type=options.FILE, nargs=-1, required=True)
@click.option(
    "-o",
    "--output",
    type=options.FILE,
    metavar="FILE.png",
    help="PNG, SVG, PDF, or HTML that plays an estimate in 3-D; default: the first file's name, as PNG.",
)
@click.option(
    "--filter",
    "wanted",
    multiple=True,
    metavar="NAME",
    shell_complete=options.complete_filter,
    help="Draw this filter only; may be repeated.",
)
@click.option("--map", "map_file", type=options.FILE, metavar="MAP.yaml", help="Draw this map under a robot's path.")
@click.option("--beacons", type=options.FILE, metavar="BEACONS.csv", help="Draw these beacons with a robot's path.")
@options.up
@options.page
@options.force
@options.quiet
def command(
    files: tuple[Path, ...],
    output: Path | None,
    wanted: tuple[str, ...],
    map_file: Path | None,
    beacons: Path | None,
    up: str | None,
    has_page: bool,
    view_host: str,
    view_port: int | None,
    force: bool,
    quiet: bool,
) -> None:
    """Draw recordings, estimates and references.

    An estimate together with its reference (a truth or a motion-capture export) shows the errors with ±2σ. Filters that
    measure height by air pressure are drawn only when --filter names them. With --view, an estimate is played in the
    browser until Ctrl-C, and no picture is written.
    """
    from linkpose.cli.live import Console
    from linkpose.evaluation.references import read_any, read_for_picture
    from linkpose.localization.surroundings import Surroundings
    from linkpose.outputs import STDOUT

    page = PageOptions(has_page, view_host, view_port)
    page.check()
    console = Console(quiet, verbose=False)
    names = [name.replace("_", "-") for name in wanted]
    if has_page:
        if output:
            raise click.UsageError("--view shows a page; leave out --output")
        tables = [read_any(path, up) for path in files]
        page.play(tables, names, Surroundings.read(map_file, beacons), console)
        return
    from linkpose import plotting
    from linkpose.page.animation import FORMATS, save_picture

    output = output or files[0].with_suffix(".png")
    plotting.check_output(output, force, FORMATS)
    tables = []
    for path in files:
        tables.append(read_for_picture(path, up, _show_progress(console, path)))
        console.clear()
    remarks = save_picture(output, tables, names, Surroundings.read(map_file, beacons), force)
    for remark in [remark for table in tables for remark in table.remarks] + remarks:
        console.report(remark)
    if output != STDOUT:
        click.echo(output)


def _show_progress(console: Console, path: Path) -> Callable[[float], None]:
    return lambda share: console.progress(lambda: f"reading {path} {share:.0%}")
