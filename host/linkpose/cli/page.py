"""The page of `estimate --live`, `record`, `plot` and `localize` with `--view`."""

from __future__ import annotations

import contextlib
import ipaddress
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from linkpose.board import Board
    from linkpose.cli.live import Console
    from linkpose.device.session import Health
    from linkpose.estimation import Estimator
    from linkpose.live_estimation import LiveRows
    from linkpose.localization.surroundings import Surroundings
    from linkpose.page import Page
    from linkpose.page.history import Replay
    from linkpose.precompile import Precompilation
    from linkpose.recording.table import Table
    from linkpose.sensors.measurements import Measurements
    from linkpose.sensors.rig import Rig


@dataclass(frozen=True, slots=True)
class PageOptions:
    """The values of --view, --view-host and --view-port."""

    is_wanted: bool
    host: str
    port: int | None

    def check(self) -> None:
        """Raises UsageError for an address or a port without --view."""
        if not self.is_wanted and (self.port is not None or self.host != "127.0.0.1"):
            raise click.UsageError("--view-host and --view-port go with --view")

    @contextlib.contextmanager
    def open(
        self,
        columns: Sequence[str],
        rig: Rig,
        title: str,
        report: Callable[[str], None],
        *,
        on_mark: Callable[[float], None] | None = None,
        replay: Replay | None = None,
        surroundings: Surroundings | None = None,
    ) -> Iterator[Page | None]:
        """The page if it is wanted; `report` prints its address, and a warning where it is open to the network."""
        if not self.is_wanted:
            yield None
            return
        from linkpose.page import Page

        with Page(
            columns, rig, title, host=self.host, port=self.port, on_mark=on_mark, replay=replay,
            surroundings=surroundings,
        ) as page:  # fmt: skip
            if not is_loopback(self.host):
                report("warning: everybody who reaches this address over the network can see the page and press stop")
            report(f"page: {page.url}")
            yield page

    def play(
        self, tables: Sequence[Table], wanted: Sequence[str], surroundings: Surroundings, console: Console
    ) -> None:
        """Plays the first estimate, with the reference if there is one, until Ctrl-C.

        `wanted` names filters; without any, all are shown.
        """
        from linkpose.cli.live import ending_well
        from linkpose.page.history import Replay
        from linkpose.page.tables import rig_of, rows_of

        columns, values = rows_of(tables, wanted)
        title = "  ".join(table.path.name for table in tables)
        opened = self.open(
            columns,
            rig_of(tables),
            title,
            lambda text: click.echo(text, err=True),
            replay=Replay(values),
            surroundings=surroundings,
        )
        with ending_well(), opened as page:
            console.report("Ctrl-C ends")
            with contextlib.suppress(KeyboardInterrupt):
                while page is not None:
                    page.stopped.wait(0.5)  # Windows delivers Ctrl-C between two waits only
                    page.raise_if_stopped()

    @contextlib.contextmanager
    def follow(
        self, board: Board, console: Console, on_mark: Callable[[float], None]
    ) -> Iterator[Callable[[Measurements], None]]:
        """A function that takes the board's blocks, runs all filters that can run, and shows the estimates on the page.

        Without --view it does nothing. It raises KeyboardInterrupt once the user has pressed "stop".
        """
        if not self.is_wanted:
            yield lambda _: None
            return
        from linkpose.estimation import Estimator
        from linkpose.live_estimation import LiveEstimator
        from linkpose.precompile import Precompilation

        estimator = Estimator.for_board((), board)
        with (
            Precompilation([f.name for f in estimator.filters]) as compiling,
            self.open(estimator.columns, estimator.rig, board.port, console.report, on_mark=on_mark) as page,
        ):
            following = LiveEstimator(estimator, compiling.is_ready)

            def show(block: Measurements) -> None:
                show_newest(page, following.process(block), lambda: board.health, estimator, compiling)

            yield show


def show_newest(
    page: Page | None,
    rows: LiveRows,
    health: Callable[[], Health],
    estimator: Estimator,
    compiling: Precompilation,
) -> None:
    """Shows the newest row of a live run, or all rows again. Raises KeyboardInterrupt once "stop" was pressed."""
    if page is None:
        return
    from linkpose.page.status import PageStatus  # 0.06 s, by which the first sample without a page would be late

    if len(rows.caught_up):
        page.restart(rows.caught_up)
    page.show(rows.newest, lambda: PageStatus(health(), estimator.found_j2s, compiling.progress))
    page.raise_if_stopped()


def is_loopback(host: str) -> bool:
    """Whether only programs on this machine reach this address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
