"""linkpose record"""

from __future__ import annotations

import datetime
from pathlib import Path

import click

from linkpose.cli import options
from linkpose.cli.board_settings import board_settings


@click.command(name="record")
@click.argument("out", type=options.FILE, required=False)
@options.port
@options.duration
@click.option("--raw", type=options.FILE, metavar="OUT.bin", help="Also keep every byte as it came.")
@click.option("--rig", "rig_file", type=options.FILE, help="Rig file to store with the recording.")
@board_settings
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
    force: bool,
    plain: bool,
    json_lines: bool,
    verbose: bool,
    quiet: bool,
) -> None:
    """Record the sensors into OUT, a CSV file. Without OUT the file is named by date and time. Ctrl-C ends it well."""
    from linkpose.board import Board
    from linkpose.cli import live
    from linkpose.sensors.measurements import Measurements

    path = out or Path(f"linkpose-{datetime.datetime.now():%Y%m%d-%H%M%S}.csv")
    live.refuse_same_file(path, raw)
    console = live.Console(quiet, verbose)
    with Board(port, settings=board, rig=rig_file, raw=raw, force=force, notify=console.say) as connected:
        connected.record(path, force=force, plain=plain)
        console.detail(f"firmware {connected.hello}")
        console.say(f"recording to {path}" + ("" if duration else ", Ctrl-C ends"))

        def handle(_: Measurements) -> None:
            console.progress(lambda: live.health_line(connected.health))

        live.run_board(connected, duration, handle)
        live.show_summary(console, connected.health, json_lines, f": {path}")
        connected.check_usable()
