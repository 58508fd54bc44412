"""linkpose ports"""

from __future__ import annotations

import dataclasses
import json

import click

from linkpose.cli import options


@click.command(name="ports")
@options.as_json
def command(json_lines: bool) -> None:
    """List the serial ports and say which is the board."""
    from linkpose.device.ports import find_ports

    ports = find_ports()
    if json_lines:
        for port in ports:
            click.echo(json.dumps(dataclasses.asdict(port)))
        return
    for port in ports:
        ids = f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None and port.pid is not None else "-"
        remarks = ["UNO"] * port.is_uno + ["busy"] * bool(port.busy)
        click.echo(f"{port.port:20} {ids:10} {', '.join(remarks):10} {port.description}".rstrip())
    if not ports:
        click.echo("no serial port is connected; plug the board in, or try --port sim://link", err=True)
