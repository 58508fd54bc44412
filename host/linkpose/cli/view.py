"""The live view on a terminal. `linkpose.cli.screen` renders what it shows."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

import click
import numpy as np

from linkpose.cli.live import progress_width
from linkpose.cli.rendering import wrapped
from linkpose.cli.screen import Screen
from linkpose.cli.streams import unfiltered
from linkpose.device.session import Health

if TYPE_CHECKING:
    from rich.live import Live

    from linkpose.live_estimation import LiveRows
    from linkpose.sensors.measurements import Floats

REDRAW_INTERVAL_S = 0.1


class View:
    """The live view on stderr. If stderr is not a terminal it shows nothing, and imports nothing to show it with."""

    def __init__(
        self, columns: Sequence[str], is_shown: bool, title: str, keys: str = "", reported: Iterable[str] = ()
    ) -> None:
        """`title` names the port and the settings worth a glance, such as J2S; `keys` is the line about keys.

        `reported` has the latest lines above the view.
        """
        self._reported = reported
        self._screen = Screen(title, columns, keys)
        self._waiting: list[Floats] = []  # rows (N, columns) since the screen was drawn
        self._replaces_all = False  # whether they replace all rows before
        self._live: Live | None = None
        self._size: tuple[int, int] = (0, 0)
        self._drawn_at = -math.inf
        self._is_wanted = is_shown
        if is_shown:
            self._start()

    def _start(self) -> None:
        from rich.console import Console
        from rich.live import Live

        console = Console(file=unfiltered(sys.stderr))
        if console.is_dumb_terminal:
            return
        # Results go to stdout untouched: rich must not redirect it.
        self._live = Live(
            console=console, auto_refresh=False, transient=True, redirect_stdout=False,
            redirect_stderr=False,
        )  # fmt: skip
        self._size = self._live.console.size
        self._live.start()

    @property
    def is_shown(self) -> bool:
        """Whether the view is on the screen. A terminal that cannot move its cursor (TERM=dumb) shows none."""
        return self._live is not None

    def line(self, health: Health) -> str:
        """The faults and the headline in one line, where the view is not on the screen."""
        self._take_waiting()
        return self._screen.line(health, progress_width())

    def report(self, text: str) -> None:
        """Prints a line above the view, or where the view was."""
        if self._live is None:
            click.echo(wrapped(text, sys.stderr), err=True)
        else:
            self._live.console.print(text, markup=False, highlight=False)

    def next_filter(self) -> None:
        """Shows the next filter: the best one, then each of the others."""
        self._screen.next_filter()

    def add(self, rows: LiveRows) -> None:
        """Adds the newest row of estimates, or restarts with all rows so far where a filter has caught up.

        The screen takes all waiting rows at once before it is drawn: a filter that catches up delays no sample.
        """
        if not self._is_wanted:
            return
        if len(rows.caught_up):
            self._waiting, self._replaces_all = [rows.caught_up], True
        elif len(rows.newest):
            self._waiting.append(rows.newest[np.newaxis])

    def _take_waiting(self) -> None:
        if self._replaces_all:
            self._screen.forget()
        if self._waiting:
            self._screen.add(np.concatenate(self._waiting))
        self._waiting, self._replaces_all = [], False

    def redraw(self, health: Callable[[], Health], status: str = "") -> None:
        """Redraws a few times a second, also while no estimates arrive.

        `status` is a line on what is not ready yet, such as filters that are being compiled.
        """
        now = time.perf_counter()
        if self._live is None or now - self._drawn_at < REDRAW_INTERVAL_S:
            return
        self._drawn_at = now
        self._take_waiting()
        if self._live.console.size != self._size:
            self._restart()
        self._live.update(self._screen.render(health(), *self._size, status), refresh=True)

    def _restart(self) -> None:
        """Clears a terminal that was resized: it wrapped lines of the view, and rich would erase too few of them."""
        if self._live is not None:
            self._live.stop()
            self._live.console.clear()
            for line in self._reported:
                self.report(line)
            self._start()

    def close(self) -> None:
        """Removes the view from the screen."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def __enter__(self) -> View:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
