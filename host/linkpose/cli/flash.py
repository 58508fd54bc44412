"""linkpose flash"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options
from linkpose.errors import LinkposeError

if TYPE_CHECKING:
    from collections.abc import Callable

    from linkpose.cli.live import Console
    from linkpose.flashing.image import Image
    from linkpose.flashing.upload import Progress
    from linkpose.wire.messages import Hello


@click.command(name="flash")
@click.option(
    "--port",
    metavar="PORT",
    shell_complete=options.complete_port,
    help="Device, such as /dev/ttyACM0 or COM3. Default: the only connected UNO.",
)
@click.option("--prebuilt", is_flag=True, help="Upload the firmware image of this package without building it.")
@click.option("--hex", "hex_file", type=options.FILE, metavar="FILE.hex", help="Upload this build of the firmware.")
@click.option(
    "--env",
    "environment",
    default="uno",
    show_default=True,
    metavar="NAME",
    help="Environment of platformio.ini to build: uno downloads its toolchain, uno_distro uses the distribution's.",
)
@options.verbosity
def command(
    port: str | None, prebuilt: bool, hex_file: Path | None, environment: str, verbose: bool, quiet: bool
) -> None:
    """Build the firmware with PlatformIO, upload it to the board, and check that it answers.

    If PlatformIO cannot build (it is not installed, or cannot download its toolchain), the firmware image of this
    package is uploaded instead. The upload needs no other program.
    """
    from linkpose.cli.live import Console
    from linkpose.flashing.image import PREBUILT, read_image

    if prebuilt and hex_file is not None:
        raise click.UsageError("choose one of --prebuilt and --hex")
    console = Console(quiet, verbose)
    port = _usable_port(port)
    try:
        ready = PREBUILT if prebuilt else hex_file
        image = read_image(ready) if ready is not None else _build(environment, console)
        _upload(image, port, console)
    finally:
        console.clear()
    hello = _prove(port, image, console)
    click.echo(f"{'port':18} {port}")
    click.echo(f"{'firmware':18} {image.identity.version}")
    click.echo(f"{'source revision':18} {hello.source_revision:08x}")


def _usable_port(named: str | None) -> str:
    """The board's port. An obstacle to opening it is reported before anything is built."""
    from linkpose.device.ports import choose_port, open_port

    port = named or choose_port(simulated_will_do=False)
    if "://" in port:
        raise LinkposeError(f"{port} is not a board that can be flashed. Pass a device such as /dev/ttyACM0 or COM3")
    open_port(port).close()
    return port


def _build(environment: str, console: Console) -> Image:
    """The image that PlatformIO builds, or the prebuilt one when PlatformIO cannot build."""
    from linkpose.flashing.build import CannotBuild, build, project
    from linkpose.flashing.image import PREBUILT, read_image

    console.report("building the firmware with PlatformIO; the first build downloads the toolchain")
    try:
        with project(environment) as firmware:
            return build(firmware, _shows_build(console))
    except CannotBuild as error:
        console.report(f"{error}; uploading the prebuilt firmware instead (--prebuilt does so at once)")
    return read_image(PREBUILT)


def _upload(image: Image, port: str, console: Console) -> None:
    from linkpose.flashing.upload import upload

    def show(progress: Progress) -> None:
        console.progress(lambda: f"{progress.stage.value} {progress.percent} %")

    console.report(f"uploading {image.identity} ({len(image.data)} bytes) to {port}")
    upload(image, port, show)


def _shows_build(console: Console) -> Callable[[str], None]:
    """A receiver of PlatformIO's output: its last line as progress, and every line with -v."""
    pending, last_line = "", "building"

    def show(output: str) -> None:
        nonlocal pending, last_line
        *lines, pending = (pending + output).split("\n")
        for line in filter(str.strip, lines):
            console.detail(line)
            last_line = line.strip()
        console.progress(lambda: last_line[:78])

    return show


def _prove(port: str, image: Image, console: Console) -> Hello:
    """The HELLO of the firmware that was written."""
    from linkpose.device.session import Session

    console.report("the upload is verified; waiting for the firmware")
    with _as_consequence(), Session(port, console.report) as session:
        hello = session.hello
    if hello.source_revision != image.identity.source_revision:
        raise LinkposeError(
            f"The board at {port} reports source revision {hello.source_revision:08x}, but "
            f"{image.identity.source_revision:08x} was written. Check that {port} is the board that was flashed"
        )
    return hello


@contextlib.contextmanager
def _as_consequence() -> Iterator[None]:
    try:
        yield
    except LinkposeError as error:
        raise LinkposeError(f"The firmware was written and verified, but the handshake failed: {error}") from error
