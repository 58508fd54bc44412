"""`linkpose plot`: pictures of recordings, estimates and references."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options
from linkpose.cli.page import PageOptions
from linkpose.errors import printable

if TYPE_CHECKING:
    from linkpose.cli.live import Console
    from linkpose.page.scene import Surroundings
    from linkpose.plotting import Scene
    from linkpose.recording.table import Table

_ANIMATION = ".html"


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
    from linkpose import plotting
    from linkpose.cli.live import Console
    from linkpose.evaluation.references import read_any, read_for_picture
    from linkpose.recording.csvfile import STDOUT

    page = PageOptions(has_page, view_host, view_port)
    page.check()
    if has_page:
        if output:
            raise click.UsageError("--view shows a page; leave out --output")
        tables = [read_any(path, up) for path in files]
        names = [name.replace("_", "-") for name in wanted]
        page.play(tables, names, _surroundings(_scene(map_file, beacons)), Console(quiet, verbose=False))
        return
    output = output or files[0].with_suffix(".png")
    plotting.check_output(output, force, (*plotting.FORMATS, _ANIMATION))
    console = Console(quiet, verbose=False)
    tables = []
    for path in files:
        tables.append(read_for_picture(path, up, _show_progress(console, path)))
        console.clear()
    names = [name.replace("_", "-") for name in wanted]
    scene = _scene(map_file, beacons)
    remarks: list[str] = []
    if output.suffix.lower() == _ANIMATION:
        _save_animation(tables, names, output, scene)
    else:
        figure, remarks = plotting.plot_tables(tables, names, scene)
        plotting.save(figure, output, force)
    for remark in [remark for table in tables for remark in table.remarks] + remarks:
        if not quiet:
            click.echo(printable(remark), err=True)
    if output != STDOUT:
        click.echo(output)


def _save_animation(tables: list[Table], wanted: list[str], output: Path, scene: Scene | None) -> None:
    """Writes the first estimate, with the reference if there is one, as an animation in 3-D."""
    from linkpose.page.animation import save_animation
    from linkpose.page.tables import corners_of, rig_of, rows_of

    columns, values = rows_of(tables, wanted)
    surroundings = replace(_surroundings(scene), places=corners_of(columns, values))
    save_animation(output, columns, values, rig_of(tables), surroundings)


def _surroundings(scene: Scene | None) -> Surroundings:
    from linkpose.page.scene import Surroundings

    return Surroundings(scene.grid, scene.beacons) if scene is not None else Surroundings()


def _show_progress(console: Console, path: Path) -> Callable[[float], None]:
    return lambda share: console.progress(lambda: f"reading {path} {share:.0%}")


def _scene(map_file: Path | None, beacons: Path | None) -> Scene | None:
    """What --map and --beacons put under the path."""
    if map_file is None and beacons is None:
        return None
    from linkpose.localization.maps import load_map
    from linkpose.localization.tables import read_beacons
    from linkpose.plotting import Scene

    grid = load_map(map_file) if map_file else None
    places = read_beacons(beacons) if beacons else {}
    return Scene(grid, {str(name): place for name, place in places.items()})
