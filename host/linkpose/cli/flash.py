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
    from linkpose.flashing.upload import Upload
    from linkpose.wire.messages import Hello


@click.command(name="flash")
@click.option("--port", metavar="PORT", help="Device, such as /dev/ttyACM0 or COM3. Default: the only UNO connected.")
@click.option("--prebuilt", is_flag=True, help="Upload the firmware that comes ready built; needs only avrdude.")
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
    """Build the firmware with PlatformIO, upload it to the board, and prove it by the handshake."""
    from linkpose.cli.live import Console
    from linkpose.flashing.image import PREBUILT, read_image

    if prebuilt and hex_file is not None:
        raise click.UsageError("choose one of --prebuilt and --hex")
    console = Console(quiet, verbose)
    port = _usable_port(port)
    try:
        if prebuilt or hex_file is not None:
            image = _upload_ready_built(read_image(hex_file or PREBUILT), port, console)
        else:
            image = _build_and_upload(environment, port, console)
    finally:
        console.clear()
    hello = _prove(port, image, console)
    click.echo(f"{'port':18} {port}")
    click.echo(f"{'firmware':18} {image.identity.version}")
    click.echo(f"{'source revision':18} {hello.source_revision:08x}")


def _usable_port(named: str | None) -> str:
    """The board's port, which can be opened: what stands in the way is said before anything is built."""
    from linkpose.device.ports import choose_port, open_port

    if named is not None and "://" in named:
        raise LinkposeError(f"{named} is no board that can be flashed; name a device such as /dev/ttyACM0 or COM3")
    port = named or choose_port()
    open_port(port).close()
    return port


def _upload_ready_built(image: Image, port: str, console: Console) -> Image:
    from linkpose.flashing.upload import upload_with_avrdude

    _announce(console, image, port)
    upload_with_avrdude(image, port, _shows_upload(console))
    return image


def _announce(console: Console, image: Image, port: str) -> None:
    console.say(f"uploading {image.identity} ({len(image.data)} bytes) to {port}")


def _build_and_upload(environment: str, port: str, console: Console) -> Image:
    from linkpose.flashing.build import build, project
    from linkpose.flashing.upload import upload_with_platformio

    with project(environment) as firmware:
        console.say("building the firmware with PlatformIO; the first time it downloads the toolchain")
        image = build(firmware, _shows_build(console))
        _announce(console, image, port)
        upload_with_platformio(firmware, port, _shows_upload(console))
    return image


def _shows_build(console: Console) -> Callable[[str], None]:
    transcript = _Transcript(console)

    def show(said: str) -> None:
        transcript.add(said)
        console.progress(lambda: transcript.last_line[:78])

    return show


def _shows_upload(console: Console) -> Callable[[Upload], None]:
    transcript = _Transcript(console)

    def show(upload: Upload) -> None:
        transcript.add(upload.said[transcript.length :])
        console.progress(lambda: f"{upload.stage.value} {upload.percent} %")

    return show


class _Transcript:
    """What another program says, shown line by line with -v."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._pending = ""
        self.last_line = "building"
        self.length = 0

    def add(self, said: str) -> None:
        self.length += len(said)
        *lines, self._pending = (self._pending + said).split("\n")
        for line in filter(str.strip, lines):
            self._console.detail(line)
            self.last_line = line.strip()


def _prove(port: str, image: Image, console: Console) -> Hello:
    """The HELLO of the firmware just written."""
    from linkpose.device.session import Session

    console.say("the upload is verified; asking the board who it is")
    with _as_consequence(), Session(port, console.say) as session:
        hello = session.hello
    if hello.source_revision != image.identity.source_revision:
        raise LinkposeError(
            f"the board at {port} answers with source revision {hello.source_revision:08x}, although "
            f"{image.identity.source_revision:08x} was written; check that {port} is the board that was flashed"
        )
    return hello


@contextlib.contextmanager
def _as_consequence() -> Iterator[None]:
    try:
        yield
    except LinkposeError as error:
        raise LinkposeError(f"the firmware was written and verified, but the handshake failed: {error}") from error
