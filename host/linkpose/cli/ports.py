"""linkpose ports"""

from __future__ import annotations

import dataclasses
import json

import click

from linkpose.cli import options


@click.command(name="ports")
@options.as_json
def command(json_lines: bool) -> None:
    """List the serial ports and mark the board's."""
    from linkpose.device.ports import devices_without_port, find_ports
    from linkpose.errors import printable

    ports = find_ports()
    for port in ports:
        if json_lines:
            click.echo(json.dumps(dataclasses.asdict(port)))
            continue
        ids = f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None and port.pid is not None else "-"
        remarks = ["UNO" if port.likelihood > 0 else "maybe UNO"] * port.is_uno + ["busy"] * bool(port.busy)
        line = f"{port.port:20} {ids:10} {', '.join(remarks):10} {port.description}"
        click.echo(printable(line.rstrip()))
    for device in devices_without_port():
        click.echo(device.cure, err=True)
    if not ports:
        click.echo("no serial port is connected; plug the board in, or try --port sim://link", err=True)
