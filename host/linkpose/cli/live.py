"""What `record` and `estimate --live` have in common on the terminal: progress, messages, and the end of a run."""

from __future__ import annotations

import contextlib
import functools
import json
import signal
import sys
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, TypeVar

import click

from linkpose.errors import LinkposeError, printable

if TYPE_CHECKING:
    from linkpose.board import Board
    from linkpose.device.session import Health
    from linkpose.sensors.measurements import Measurements

Block = TypeVar("Block")

PROGRESS_INTERVAL_S = 0.2


class Console:
    """Lines for the user on stderr, and a progress line there when it is a terminal."""

    def __init__(self, quiet: bool, verbose: bool) -> None:
        self._quiet, self._verbose = quiet, verbose
        self.shows_progress = sys.stderr.isatty() and not quiet
        self._width = 0
        self._shown_at = 0.0
        self._print: Callable[[str], object] = functools.partial(click.echo, err=True)

    def say(self, text: str) -> None:
        """Prints a line."""
        self.clear()
        if not self._quiet:
            self._print(printable(text))

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
            self.say(text)

    def progress(self, make_text: Callable[[], str]) -> None:
        """Shows a line that replaces the one before, a few times a second."""
        now = time.perf_counter()
        if self.shows_progress and now - self._shown_at >= PROGRESS_INTERVAL_S:
            self._shown_at = now
            text = make_text()
            sys.stderr.write("\r" + text.ljust(self._width))
            sys.stderr.flush()
            self._width = len(text)

    def compile(self, names: Sequence[str]) -> None:
        """Compiles filters that are not compiled yet. Shows the progress; without a terminal, its first line only."""
        from linkpose.precompile import prepare

        if self.shows_progress:
            prepare(names, lambda text: self.progress(lambda: text))
        else:
            first = iter([self.say])
            prepare(names, lambda text: next(first, str)(text))
        self.clear()

    def clear(self) -> None:
        """Removes the progress line from the screen."""
        if self._width:
            sys.stderr.write("\r" + " " * self._width + "\r")
            self._width = 0


def run(stream: Generator[Block, None, None], handle: Callable[[Block], object]) -> str:
    """Passes the blocks of a stream to `handle` until the stream or the user ends it.

    Returns which of the two it was: "duration" or "interrupted".
    """
    with ending_well(), contextlib.closing(stream):
        try:
            for block in stream:
                handle(block)
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
    """Within this context, SIGTERM and SIGHUP (the terminal was closed) end a run as Ctrl-C does.

    A signal that is ignored, as `nohup` ignores SIGHUP, stays so.
    """

    def interrupt(*_: int | FrameType | None) -> None:
        raise KeyboardInterrupt

    names = ("SIGTERM", "SIGHUP")  # Windows has no SIGHUP
    signals = [getattr(signal, name) for name in names if hasattr(signal, name)]
    before = {each: signal.signal(each, interrupt) for each in signals if signal.getsignal(each) != signal.SIG_IGN}
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def show_summary(console: Console, health: Health, json_lines: bool, where: str) -> None:
    """The summary on stderr, and as the last line of stdout with --json."""
    from linkpose.device.session import summary

    console.say(f"{health_line(health)}{where}")
    if json_lines:
        click.echo(json.dumps(summary(health)))


def health_line(health: Health) -> str:
    """How it goes, in a line."""
    text = f"{health.duration_s:.1f} s, {health.samples} samples, {health.rate_hz:.1f} Hz, {health.lost} lost"
    text += f", {health.corrupt.total} corrupt"
    if health.gaps:
        text += f", {len(health.gaps)} gaps"
    faults = [f"{name} {of['state']}" for name, of in health.sensors.items() if of["state"] not in ("ok", "absent")]
    invalid = sum(sum(of.get("invalid", {}).values()) for of in health.sensors.values())
    saturated = sum(of.get("saturated", 0) for of in health.sensors.values())
    text += f", {invalid} invalid" * bool(invalid) + f", {saturated} saturated" * bool(saturated)
    text += "".join(f", {fault}" for fault in faults)
    if health.status and health.status.frames_dropped:
        text += f", {health.status.frames_dropped} dropped by the board"
    return text


def refuse_same_file(*outputs: Path | None, source: Path | None = None) -> None:
    """Raises LinkposeError when two outputs are one file, or one of them is the file that is read."""
    named = [path.absolute() for path in outputs if path is not None]
    for path in named:
        if named.count(path) > 1:
            raise LinkposeError(f"{path} is named for two outputs; name two files")
        if source is not None and path == source.absolute():
            raise LinkposeError(f"{path} is the recording that is read; name another file for the estimates")
