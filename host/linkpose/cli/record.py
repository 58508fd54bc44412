"""linkpose record"""

from __future__ import annotations

import contextlib
import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options
from linkpose.cli.board_settings import board_settings
from linkpose.cli.page import PageOptions

if TYPE_CHECKING:
    from linkpose.board import Board
    from linkpose.cli.keys import Keys
    from linkpose.cli.live import Console
    from linkpose.sensors.measurements import Measurements


@click.command(name="record")
@click.argument("out", type=options.FILE, required=False)
@options.port
@options.duration
@click.option("--raw", type=options.FILE, metavar="OUT.bin", help="Also write every received byte to this file.")
@click.option("--rig", "rig_file", type=options.FILE, help="Rig file to store with the recording.")
@board_settings
@options.page
@options.force
@options.plain
@options.as_json
@options.verbosity
def command(
    out: Path | None,
    port: str | None,
    duration: float | None,
    raw: Path | None,
    rig_file: Path | None,
    board: dict[str, int],
    has_page: bool,
    view_host: str,
    view_port: int | None,
    force: bool,
    plain: bool,
    json_lines: bool,
    verbose: bool,
    quiet: bool,
) -> None:
    """Record the sensors into OUT, a CSV file. Without OUT the file is named by date and time.

    Ctrl-C or q ends the recording, m marks an instant: the closing line lists it under "marks". --view also runs the
    filters, and shows their estimates in the browser.
    """
    from linkpose.board import Board
    from linkpose.cli import live
    from linkpose.cli.keys import Keys
    from linkpose.outputs import STDOUT

    page = PageOptions(has_page, view_host, view_port)
    page.check()
    path = out or Path(f"linkpose-{datetime.datetime.now():%Y%m%d-%H%M%S}.csv")
    live.refuse_same_file(path, raw)
    options.refuse_mixed_output(path, json_lines)
    console = live.Console(quiet, verbose, path == STDOUT)
    with contextlib.ExitStack() as stack:
        connected = stack.enter_context(
            Board(port, settings=board, rig=rig_file, raw=raw, force=force, notify=console.report)
        )
        connected.record(path, force=force, plain=plain)
        console.detail(f"firmware {connected.hello}")
        run = _Run(connected, console)
        show = stack.enter_context(page.follow(connected, console, run.mark))
        keys = stack.enter_context(Keys(console.shows_progress))
        end = "q or Ctrl-C ends, m marks an instant" if keys.are_read else "Ctrl-C ends"
        to = "" if str(path) == "-" else f" to {path}"
        console.report(f"recording{to}" + ("" if duration else f", {end}"))

        def handle(block: Measurements) -> None:
            run.follow(keys, block)
            show(block)

        live.run_board(connected, duration, handle)
        path = connected.recording or path
        live.show_summary(console, connected.health, json_lines, options.written(path))
        options.show_next(quiet, *options.estimate_command(path))
        connected.check_usable()


class _Run:
    """The progress line and the keys of a recording."""

    def __init__(self, board: Board, console: Console) -> None:
        from linkpose.cli.keys import Marker

        self._board, self._console = board, console
        self._marker = Marker(self.mark)

    def follow(self, keys: Keys, block: Measurements) -> None:
        """Shows the progress and carries out the keys. Raises KeyboardInterrupt to end the recording."""
        from linkpose.cli.live import progress_line, progress_width

        self._marker.advance(block)
        self._console.progress(lambda: progress_line(self._board.health, progress_width()))
        keys.follow({"m": self._marker})

    def mark(self, time_s: float) -> None:
        """Notes an instant (s) in the recording."""
        self._board.mark(time_s)
        self._console.report(f"mark at {time_s:.2f} s")
