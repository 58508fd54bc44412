"""Single keys that the user presses while a live view is shown."""

from __future__ import annotations

import math
import os
import select
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from linkpose.sensors.measurements import Measurements


class Marker:
    """Marks the newest sample's instant each time it is called, or the first sample's if there is none yet."""

    def __init__(self, mark: Callable[[float], object]) -> None:
        """`mark` is called with the time (s) of each mark."""
        self._mark = mark
        self._time_s = math.nan
        self._is_due = False

    def advance(self, block: Measurements) -> None:
        """Takes the samples that arrived, which may be none."""
        if len(block):
            self._time_s = float(block.time_s[-1])
            if self._is_due:
                self()

    def __call__(self) -> None:
        self._is_due = not math.isfinite(self._time_s)
        if not self._is_due:
            self._mark(self._time_s)


class Keys:
    """Reads keys without waiting for Enter, where stdin is a terminal that this process has in the foreground.

    A context manager: leaving it restores the terminal. Anywhere else there are no keys, and nothing is changed.
    """

    def __init__(self, is_wanted: bool) -> None:
        self._settings: list[Any] | None = None
        self._is_open = is_wanted and sys.stdin is not None and sys.stdin.isatty()

    @property
    def are_read(self) -> bool:
        """Whether a key that is pressed arrives here."""
        return self._is_open

    def pressed(self) -> str:
        """The characters since the last call, empty where there are none. Never waits."""
        return self._read() if self._is_open else ""

    def follow(self, actions: Mapping[str, Callable[[], object]]) -> None:
        """Runs the action of each key pressed since the last call.

        Raises KeyboardInterrupt for q, which ends a run as Ctrl-C does.
        """
        for key in self.pressed().lower():
            if key == "q":
                raise KeyboardInterrupt
            actions.get(key, lambda: None)()

    if sys.platform == "win32":

        def __enter__(self) -> Keys:
            return self

        def __exit__(self, *_: object) -> None:
            self._is_open = False

        def _read(self) -> str:
            import msvcrt

            text = ""
            while msvcrt.kbhit():
                text += msvcrt.getwch()
            return text

    else:

        def __enter__(self) -> Keys:
            import termios
            import tty

            if self._is_open and self._is_foreground():
                self._settings = termios.tcgetattr(sys.stdin.fileno())
                tty.setcbreak(sys.stdin.fileno(), termios.TCSANOW)  # Ctrl-C still interrupts
            else:
                self._is_open = False
            return self

        def __exit__(self, *_: object) -> None:
            import termios

            self._is_open = False
            if self._settings is not None and self._is_foreground():
                termios.tcsetattr(sys.stdin.fileno(), termios.TCSANOW, self._settings)
            self._settings = None

        @staticmethod
        def _is_foreground() -> bool:
            """Whether this process may use the terminal: one in the background would be stopped."""
            try:
                return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
            except OSError:  # not this process's controlling terminal, or it has gone
                return False

        def _read(self) -> str:
            stdin = sys.stdin.fileno()
            text = b""
            try:
                while self._is_foreground() and select.select([stdin], [], [], 0)[0]:
                    read = os.read(stdin, 64)
                    if not read:
                        raise OSError
                    text += read
            except OSError:  # the terminal was closed
                self._is_open = False
            return text.decode(errors="replace")
