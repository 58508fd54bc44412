"""linkpose record"""

from __future__ import annotations

import datetime
from pathlib import Path

import click

from linkpose.cli import options
from linkpose.cli.board_settings import apply, board_settings


@click.command(name="record")
@click.argument("out", type=options.FILE, required=False)
@options.port
@options.duration
@click.option("--raw", type=options.FILE, metavar="OUT.bin", help="Also keep every byte as it came.")
@click.option("--rig", "rig_file", type=options.FILE, help="Rig file to store with the recording.")
@board_settings
@options.force
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
    json_lines: bool,
    verbose: bool,
    quiet: bool,
) -> None:
    """Record the sensors into OUT, a CSV file. Without OUT the file is named by date and time. Ctrl-C ends it well."""
    from linkpose.cli import live
    from linkpose.device.ports import choose_port
    from linkpose.device.session import Session
    from linkpose.sensors.measurements import Block

    path = out or Path(f"linkpose-{datetime.datetime.now():%Y%m%d-%H%M%S}.csv")
    live.refuse_same_file(path, raw)
    console = live.Console(quiet, verbose)
    with live.raw_capture(raw, force) as capture, Session(port or choose_port(), console.say, capture) as session:
        apply(board, session)
        rig = options.resolve_rig(rig_file, None, session.rig)
        session.wait_for_mice(len(rig.mouse))
        console.detail(f"firmware {session.hello}")
        with live.Recorder(session, path, rig, force) as recorder:
            console.say(f"recording to {path}" + ("" if duration else ", Ctrl-C ends"))

            def handle(block: Block) -> None:
                recorder.take(block)
                console.progress(lambda: live.health_line(session.health()))

            recorder.close(live.run(session, duration, len(rig.mouse), handle))
        live.show_summary(console, session.health(), json_lines, f": {path}")
