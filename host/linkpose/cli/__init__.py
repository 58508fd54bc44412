"""The command line. Each command is one module of this package, imported only when it is typed."""

from __future__ import annotations

import difflib
import importlib
import io
import os
import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import click

from linkpose import __version__
from linkpose.cli.streams import safe_streams
from linkpose.errors import LinkposeError, printable

# Command -> what it does.
COMMANDS = {
    "ports": "List the serial ports and mark the board's.",
    "flash": "Upload the firmware to the board and verify that it answers.",
    "info": "Show the board's versions, sensors, settings and data health.",
    "record": "Record the sensors into a CSV file.",
    "estimate": "Run the filters, live or over a recording.",
    "calibrate": "Calibrate sensors, J2S and mice from recordings; writes rig.toml.",
    "convert": "Convert estimates and recordings for other programs.",
    "evaluate": "Compare estimates with a reference.",
    "simulate": "Make a recording and its truth from a simulated rig.",
    "reproduce": "Recompute the tables and figures of the three papers.",
    "plot": "Draw recordings, estimates and references.",
    "localize": "Estimate the path of a robot in a map or among beacons.",
}


_VECTORS = ("--j2s", "--start")  # options of three numbers, of which a negative one looks like an option by itself
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)")


class LazyGroup(click.Group):
    """A group that lists its commands by name and imports a command only to run it or to show its help."""

    def __init__(self, *args: Any, table: Mapping[str, str], modules: str, **more: Any) -> None:
        """`table` maps each command to its one-line help; its module is `modules` + command."""
        super().__init__(*args, **more)
        self._table, self._modules = table, modules

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self._table)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self._table:
            return None
        command: click.Command = importlib.import_module(self._modules + cmd_name).command
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """As click does, with the nearest name for one that is not known, and for a vector typed as several words."""
        for option in _VECTORS:
            if vector := _spaced_vector(option, args):
                ctx.fail(f"{option} takes its three numbers without spaces: type {option}={vector}")
        name = args[0] if args else ""
        if name and name not in self._table and not name.startswith("-"):
            near = difflib.get_close_matches(name, self._table, 1)
            hint = f"Did you mean {near[0]}?" if near else f"The commands are {', '.join(self._table)}."
            ctx.fail(f"There is no command {name!r}. {hint}")
        return super().resolve_command(ctx, args)

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
    """Measure how a joint-connected link or a small mobile robot moves, using an Arduino UNO and its sensors."""


def main() -> None:
    """Entry point. Every failure a user can cause ends here as one sentence and a status."""
    if not os.environ.get("LINKPOSE_DEBUG"):
        warnings.simplefilter("ignore", RuntimeWarning)  # of NumPy, on values that a message names or a filter drops
    with safe_streams():
        status = _run()
    sys.exit(status)


def _run() -> int:
    """Run the command; its exit status."""
    try:
        if "_LINKPOSE_COMPLETE" in os.environ:  # a shell asks for completions
            from linkpose.cli import completion

            completion.register()
        status = group.main(prog_name="linkpose", standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.Abort:
        return 130
    except click.ClickException as error:
        error.show(shown := io.StringIO())
        _complain(shown.getvalue().rstrip("\n"))
        return error.exit_code
    except LinkposeError as error:
        from linkpose.cli.cures import WRONG_USAGE, sentence

        _complain(f"linkpose: {printable(sentence(error))}")
        return 2 if isinstance(error, WRONG_USAGE) else 1
    except Exception as error:
        if obstacle := _of_the_system(error):
            _complain(f"linkpose: {printable(obstacle)}")
            return 1
        if os.environ.get("LINKPOSE_DEBUG"):
            raise
        what = f"{type(error).__name__}: {error}"
        _complain(f"linkpose: unexpected {printable(what)}; please report it with what LINKPOSE_DEBUG=1 shows")
        return 1
    return status if isinstance(status, int) else 0


def _complain(text: str) -> None:
    """Prints a failure; a terminal breaks it between words, not within a path."""
    from linkpose.cli.rendering import wrapped

    click.echo(wrapped(text, sys.stderr), err=True)


def _spaced_vector(option: str, words: Sequence[str]) -> str:
    """The vector of an option that was typed as several words, as one; "" if there is none."""
    after = words[words.index(option) + 1 :] if option in words else []
    numbers = [word.rstrip(",") for word in after[:3]]
    return ",".join(numbers) if len(numbers) == 3 and all(map(_NUMBER.fullmatch, numbers)) else ""


def _of_the_system(error: Exception) -> str:
    """What the operating system lacks, for errors that no part of the program explains; empty for others."""
    if isinstance(error, MemoryError):
        return "the memory does not suffice; close other programs, or take a shorter file"
    if not isinstance(error, OSError) or error.strerror is None:
        return ""
    if error.filename is not None:
        return f"cannot use {os.fsdecode(error.filename)}: {error.strerror}"
    return f"the operating system reports: {error.strerror}; check the disk and its connection"
