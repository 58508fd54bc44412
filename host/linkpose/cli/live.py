"""What `record` and `estimate --live` have in common: progress, a recording, and an end that loses nothing."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, BinaryIO

import click

from linkpose.device.session import Health, Session
from linkpose.errors import LinkposeError, printable
from linkpose.recording.csvfile import create
from linkpose.recording.writer import RecordingWriter, closing, metadata
from linkpose.sensors.conversion import BoardSettings
from linkpose.sensors.measurements import Block, Measurements
from linkpose.sensors.rig import Rig

PROGRESS_INTERVAL_S = 0.2


class Console:
    """Lines for the user on stderr, and a progress line there when it is a terminal."""

    def __init__(self, quiet: bool, verbose: bool) -> None:
        self._quiet, self._verbose = quiet, verbose
        self.shows_progress = sys.stderr.isatty() and not quiet
        self._width = 0
        self._shown_at = 0.0

    def say(self, text: str) -> None:
        self.clear()
        if not self._quiet:
            click.echo(printable(text), err=True)

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

    def clear(self) -> None:
        """Takes the progress line off the screen."""
        if self._width:
            sys.stderr.write("\r" + " " * self._width + "\r")
            self._width = 0


class Recorder:
    """Writes a session's blocks where a recording is asked for."""

    def __init__(self, session: Session, path: Path | None, rig: Rig, force: bool) -> None:
        self._session = session
        self._writer: RecordingWriter | None = None
        if path is not None:
            settings = BoardSettings.of(session.hello)
            clock = {"source": "host", "drift_ppm": session.health().drift_ppm}
            head = metadata(session.hello, settings, session.port, rig, clock)
            self._writer = RecordingWriter(path, head, max(settings.mouse_ports, len(rig.mouse)), force)

    def take(self, block: Block) -> Measurements:
        """Writes the block; its measurements."""
        if self._writer is not None and len(block.seq):
            self._writer.write_block(block)
        return block.measurements

    def close(self, ended: str) -> None:
        """Writes the closing line: "duration", "interrupted" or "failure"."""
        writer, self._writer = self._writer, None
        if writer is not None:
            health = self._session.health()
            status = health.status
            board = {"frames_dropped": status.frames_dropped, "ticks_missed": status.ticks_missed} if status else None
            timeline = self._session.timeline
            with writer:
                writer.close(closing(timeline, health.corrupt, health.drift_ppm, board=board, ended=ended))

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(LinkposeError):  # the failure that brought us here is on its way to the user
            self.close("failure")


def run(session: Session, duration_s: float | None, mouse_ports: int, handle: Callable[[Block], None]) -> str:
    """Hands the stream's blocks to `handle` until the time is over or the user ends it; which of the two it was."""
    with ending_well():
        try:
            for block in session.stream(duration_s, mouse_ports):
                handle(block)
        except KeyboardInterrupt:
            return "interrupted"
    return "duration"


@contextlib.contextmanager
def ending_well() -> Iterator[None]:
    """SIGTERM ends a recording as well as Ctrl-C does."""

    def interrupt(*_: int | FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def raw_capture(path: Path | None, force: bool) -> Iterator[BinaryIO | None]:
    """A file for every byte as it comes, unbuffered, or None where none is asked for."""
    if path is None:
        yield None
        return
    with os.fdopen(create(path, force), "wb", buffering=0) as file:
        yield file


def summary(health: Health) -> dict[str, Any]:
    """The closing summary."""
    return {
        "event": "summary",
        "samples": health.samples,
        "lost": health.lost,
        "corrupt": health.corrupt.total,
        "gaps": len(health.gaps),
        "duration_s": round(health.duration_s, 6),
        "rate_hz": round(health.rate_hz, 3),
    }


def show_summary(console: Console, health: Health, json_lines: bool, where: str) -> None:
    """The summary on stderr, and as the last line of stdout with --json."""
    console.say(f"{health_line(health)}{where}")
    if json_lines:
        click.echo(json.dumps(summary(health)))


def health_line(health: Health) -> str:
    """How it goes, in a line."""
    text = f"{health.duration_s:.1f} s, {health.samples} samples, {health.rate_hz:.1f} Hz, {health.lost} lost"
    text += f", {health.corrupt.total} corrupt"
    if health.gaps:
        text += f", {len(health.gaps)} gaps"
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
