"""A command on a pseudo terminal, whose screen is emulated (pyte)."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import pyte

HOST = Path(__file__).parents[2] / "host"
PATIENCE_S = 240.0  # a bound on a loaded machine, never a wait


class Terminal:
    """linkpose in the foreground of a terminal; its stdout may be redirected. A context manager."""

    def __init__(
        self, *command: object, stdout: BinaryIO | None = None, columns: int = 80, rows: int = 24, kind: str = "xterm"
    ) -> None:
        self._screen = pyte.HistoryScreen(columns, rows, history=1000)
        self._stream = pyte.ByteStream(self._screen)
        self.received = b""  # as it came
        self._leader, follower = pty.openpty()
        self._set_size(columns, rows)
        # pytest's workers set COLUMNS and LINES, which would hide the terminal's own size.
        inherited = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
        environment = {**inherited, "PYTHONPATH": str(HOST), "TERM": kind}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "linkpose", *map(str, command)],
            stdin=follower,
            stdout=stdout or follower,
            stderr=follower,
            env=environment,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )
        self._follower = follower  # kept open, so that what was written last can still be read

    def _set_size(self, columns: int, rows: int) -> None:
        fcntl.ioctl(self._leader, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))

    @property
    def text(self) -> str:
        """What the screen shows."""
        return "\n".join(line.rstrip() for line in self._screen.display)

    @property
    def reads_lines(self) -> bool:
        """Whether the terminal is as shells leave it: it echoes and passes on whole lines."""
        flags = termios.tcgetattr(self._leader)[3]
        return bool(flags & termios.ECHO and flags & termios.ICANON)

    def until(self, condition: Callable[[str], object]) -> str:
        """Reads until the screen's text fulfils the condition."""
        end = time.monotonic() + PATIENCE_S
        while not condition(self.text):
            assert time.monotonic() < end, self.text
            if select.select([self._leader], [], [], 0.1)[0]:
                self._read()
            elif self.process.poll() is not None:
                assert condition(self.text), self.text
        return self.text

    def _read(self) -> None:
        data = os.read(self._leader, 65536)
        self.received += data
        self._stream.feed(data)

    def press(self, keys: str) -> None:
        """Types these keys."""
        os.write(self._leader, keys.encode())

    def resize(self, columns: int, rows: int) -> None:
        """Changes the size as a window manager does."""
        self._screen.resize(rows, columns)
        self._set_size(columns, rows)

    def wait(self) -> int:
        """Reads to the end of the command; its status."""
        while self.process.poll() is None or select.select([self._leader], [], [], 0)[0]:
            if select.select([self._leader], [], [], 0.1)[0]:
                self._read()
        return self.process.returncode

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        os.close(self._leader)
        os.close(self._follower)
