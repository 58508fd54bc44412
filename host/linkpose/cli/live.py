"""What `record` and `estimate --live` have in common on the terminal: progress, messages, and the end of a run."""

from __future__ import annotations

import contextlib
import json
import shutil
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, TypeVar

import click

from linkpose.cli.rendering import wrapped
from linkpose.cli.streams import unfiltered
from linkpose.errors import NamedTwice, printable
from linkpose.presentation import counted, is_stale, state_text

if TYPE_CHECKING:
    from linkpose.board import Board
    from linkpose.device.session import Health
    from linkpose.sensors.measurements import Measurements

Block = TypeVar("Block")

PROGRESS_INTERVAL_S = 0.2
MOST_REPORTED = 10  # lines that a view prints again after it has cleared a terminal that was resized


def progress_width() -> int:
    """The most characters of a progress line; a carriage return would not undo a wrapped one."""
    return shutil.get_terminal_size().columns - 1


class Console:
    """Lines for the user on stderr, and a progress line there when it is a terminal."""

    def __init__(self, quiet: bool, verbose: bool, prints_rows: bool = False) -> None:
        """`prints_rows`: rows go to stdout. On the same terminal, a progress line or a view would overwrite them."""
        self.is_quiet, self._verbose = quiet, verbose
        self.shows_progress = sys.stderr.isatty() and not quiet and not (prints_rows and sys.stdout.isatty())
        self.reported: deque[str] = deque(maxlen=MOST_REPORTED)  # the latest lines
        self._width = 0
        self._shown_at = 0.0
        self._print: Callable[[str], object] = lambda text: click.echo(wrapped(text, sys.stderr), err=True)
        context = click.get_current_context(silent=True)
        if context is not None:  # the end of the command and its error start on a line of their own
            context.call_on_close(self.clear)

    def report(self, text: str) -> None:
        """Prints a line."""
        self.clear()
        if not self.is_quiet:
            self.reported.append(printable(text))
            self._print(self.reported[-1])

    @contextlib.contextmanager
    def through(self, print_line: Callable[[str], None]) -> Iterator[None]:
        """Within this context, lines are printed by a live view, which keeps them above itself."""
        self._print, before = print_line, self._print
        try:
            yield
        finally:
            self._print = before

    def detail(self, text: str) -> None:
        if self._verbose:
            self.report(text)

    def progress(self, make_text: Callable[[], str]) -> None:
        """Shows a line that replaces the one before, a few times a second."""
        now = time.perf_counter()
        if self.shows_progress and now - self._shown_at >= PROGRESS_INTERVAL_S:
            self._shown_at = now
            text = printable(make_text())[: progress_width()]
            stream = unfiltered(sys.stderr)
            stream.write("\r" + text.ljust(self._width))
            stream.flush()
            self._width = len(text)

    def compile(self, names: Sequence[str]) -> None:
        """Compiles filters that are not compiled yet. Shows the progress; without a terminal, its first line only."""
        from linkpose.precompile import prepare

        if self.shows_progress:
            prepare(names, lambda text: self.progress(lambda: text))
        else:
            first = iter([self.report])
            prepare(names, lambda text: next(first, str)(text))
        self.clear()

    def clear(self) -> None:
        """Removes the progress line from the screen."""
        if self._width:
            stream = unfiltered(sys.stderr)
            stream.write("\r" + " " * self._width + "\r")
            stream.flush()  # before anything that stdout shows on the same terminal
            self._width = 0


def run(stream: Generator[Block, None, None], handle: Callable[[Block], object]) -> str:
    """Passes the blocks of a stream to `handle` until the stream or the user ends it.

    The stream must yield several times a second: a signal takes effect between two blocks, a second one at once.
    Returns which of the two it was: "duration" or "interrupted".
    """
    with _signals_between_blocks() as raise_if_signalled, contextlib.closing(stream):
        try:
            for block in stream:
                handle(block)
                raise_if_signalled()
        except KeyboardInterrupt:
            return "interrupted"
    return "duration"


def run_board(board: Board, duration_s: float | None, handle: Callable[[Measurements], object]) -> str:
    """Passes the board's blocks to `handle`, empty ones too, and ends the recording as the user ended the run."""
    ended = run(board.stream(duration_s, yield_idle=True), handle)
    board.finish(ended)
    return ended


@contextlib.contextmanager
def ending_well() -> Iterator[None]:
    """Within this context, SIGTERM and SIGHUP (the terminal was closed) end a run as Ctrl-C does."""

    def interrupt(*_: int | FrameType | None) -> None:
        raise KeyboardInterrupt

    with _handled_by(interrupt, "SIGTERM", "SIGHUP"):
        yield


@contextlib.contextmanager
def _signals_between_blocks() -> Iterator[Callable[[], None]]:
    """A function that raises KeyboardInterrupt once Ctrl-C, SIGTERM or SIGHUP has arrived.

    Raised by the signal itself, it could part a sample's count from its row in the file.
    """
    arrived = False

    def note(*_: int | FrameType | None) -> None:
        nonlocal arrived
        if arrived:
            raise KeyboardInterrupt
        arrived = True

    def raise_if_signalled() -> None:
        if arrived:
            raise KeyboardInterrupt

    with _handled_by(note, "SIGINT", "SIGTERM", "SIGHUP"):
        yield raise_if_signalled


@contextlib.contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], object], *names: str) -> Iterator[None]:
    """These signals call the handler. One that is ignored stays so, as `nohup` ignores SIGHUP; Windows has none."""
    signals = [getattr(signal, name) for name in names if hasattr(signal, name)]
    before = {each: signal.signal(each, handler) for each in signals if signal.getsignal(each) != signal.SIG_IGN}
    try:
        yield
    finally:
        for each, earlier in before.items():
            signal.signal(each, earlier)


def show_summary(console: Console, health: Health, json_lines: bool, where: str) -> None:
    """The summary on stderr, and as the last line of stdout with --json."""
    from linkpose.device.session import summary

    console.report(f"{health_line(health)}{where}")
    if json_lines:
        click.echo(json.dumps(summary(health)))


def health_line(health: Health) -> str:
    """How it goes, in a line."""
    return ", ".join(text for _, text in _health_parts(health))


def progress_line(health: Health, width: int) -> str:
    """How it goes now, in a line of at most `width` characters where losses and faults fit: they are never left out."""
    parts = _health_parts(health)
    if is_stale(health):
        parts.append((_FAULT, f"NO SAMPLES ({health.silent_s:.1f} s)"))
    while len(", ".join(text for _, text in parts)) > width and (least := min(parts))[0] < _FAULT:
        parts.remove(least)
    return ", ".join(text for _, text in parts)


_FAULT = 9  # importance of a part of a line


def _health_parts(health: Health) -> list[tuple[int, str]]:
    """(importance, text) of each part of a line on the health; narrow lines leave out the least important ones."""
    parts = [
        (3, f"{health.duration_s:.1f} s"),
        (0, counted(health.samples, "sample")),
        (1, f"{health.rate_hz:.1f} Hz"),
        (_FAULT, f"{health.lost} lost"),
        (4 if health.corrupt.total else 2, f"{health.corrupt.total} corrupt"),
    ]
    if health.gaps:
        parts.append((8, counted(len(health.gaps), "gap")))
    sensors = health.sensors
    invalid = sum(sum(of.get("invalid", {}).values()) for of in sensors.values())
    saturated = sum(of.get("saturated", 0) for of in sensors.values())
    parts += [(7, f"{invalid} invalid")] * bool(invalid) + [(6, f"{saturated} saturated")] * bool(saturated)
    parts += [
        (_FAULT, f"{name.upper()} {state_text(of)}")
        for name, of in sensors.items()
        if of["state"] not in ("ok", "absent")
    ]
    if health.status and health.status.frames_dropped:
        parts.append((5, f"{health.status.frames_dropped} dropped by the board"))
    return parts


def refuse_same_file(*outputs: Path | None, source: Path | None = None) -> None:
    """Raises NamedTwice when two outputs are one file, UsageError when one of them is the file that is read."""
    named = [path.absolute() for path in outputs if path is not None]
    for path in named:
        if named.count(path) > 1:
            raise NamedTwice(path)
        if source is not None and path == source.absolute():
            raise click.UsageError(f"{path} is the recording that is read; name another file for the estimates")
