"""The command line. Each command is one module of this package, imported only when it is typed."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Mapping
from typing import Any

import click

from linkpose import __version__
from linkpose.cli.streams import safe_streams
from linkpose.errors import LinkposeError, printable

# Command -> what it does.
COMMANDS = {
    "ports": "List the serial ports and say which is the board.",
    "flash": "Build the firmware, upload it to the board, and prove it.",
    "info": "Show the board's versions, sensors, settings and link health.",
    "record": "Record the sensors into a CSV file.",
    "estimate": "Run the filters, live or over a recording.",
    "calibrate": "Complete a rig file from recordings made for it.",
    "evaluate": "Compare estimates with a reference.",
    "simulate": "Make a recording and its truth from a simulated rig.",
    "reproduce": "Measure the papers' tables and figures anew.",
    "plot": "Draw recordings, estimates and references.",
    "localize": "Find where a robot was, in a map or among beacons.",
}


class LazyGroup(click.Group):
    """A group that knows its commands by name and imports a command only to run it or to show its help."""

    def __init__(self, *args: Any, table: Mapping[str, str], modules: str, **more: Any) -> None:
        """`table` is command -> what it does; `modules` begins the name of the module that holds it, as `command`."""
        super().__init__(*args, **more)
        self._table, self._modules = table, modules

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self._table)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self._table:
            return None
        command: click.Command = importlib.import_module(self._modules + cmd_name).command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(self._table.items()))


@click.group(
    cls=LazyGroup,
    table=COMMANDS,
    modules="linkpose.cli.",
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
)
@click.version_option(__version__, prog_name="linkpose")
def group() -> None:
    """Measure how a joint-connected link or a small robot moves, with an Arduino UNO for a motion-capture room."""


def main() -> None:
    """Entry point. Every failure a user can cause ends here as one sentence and a status."""
    with safe_streams():
        status = _run()
    sys.exit(status)


def _run() -> int:
    """Run the command; its exit status."""
    try:
        status = group.main(prog_name="linkpose", standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.Abort:
        return 130
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except LinkposeError as error:
        from linkpose.cli.cures import sentence

        click.echo(f"linkpose: {printable(sentence(error))}", err=True)
        return 1
    except Exception as error:
        if os.environ.get("LINKPOSE_DEBUG"):
            raise
        what = f"{type(error).__name__}: {error}"
        click.echo(
            f"linkpose: unexpected {printable(what)}; please report it with what LINKPOSE_DEBUG=1 shows", err=True
        )
        return 1
    return status if isinstance(status, int) else 0
