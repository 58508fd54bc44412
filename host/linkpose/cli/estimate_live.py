"""`linkpose estimate --live`: filters, outputs, view, page and keys of one run."""

from __future__ import annotations

import contextlib
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from linkpose.cli import options
from linkpose.cli.findings import report_findings, report_running
from linkpose.cli.page import show_newest
from linkpose.cli.sink import Sink

if TYPE_CHECKING:
    from linkpose.board import Board
    from linkpose.cli.estimate import Request
    from linkpose.cli.keys import Keys
    from linkpose.cli.live import Console
    from linkpose.device.session import Health
    from linkpose.estimation import Estimator
    from linkpose.precompile import Precompilation
    from linkpose.sensors.measurements import Floats, Measurements


def estimate_live(
    port: str | None,
    duration: float | None,
    record: Path | None,
    raw: Path | None,
    board: dict[str, int],
    request: Request,
    console: Console,
) -> None:
    """Estimates as the board measures."""
    from linkpose.board import Board
    from linkpose.cli import live
    from linkpose.cli.keys import Keys

    with contextlib.ExitStack() as stack:
        connected = stack.enter_context(
            Board(
                port, settings=board, rig=request.rig_file, joint=request.joint, raw=raw, force=request.force,
                notify=console.report,
            )
        )  # fmt: skip
        from linkpose.estimation import Estimator
        from linkpose.precompile import Precompilation

        estimator = Estimator.for_board(request.filter_names, connected, request.chain_joint)
        if request.mag:
            estimator.hold_heading(connected.port)
        report_running(estimator, request.joint, console)
        names = [f.name for f in estimator.filters]
        compiling = stack.enter_context(Precompilation(names))
        compiling.load()
        if record:
            connected.record(record, force=request.force, plain=request.plain)
        head = {"device": connected.port, "filters": names, "mag": request.mag, "rig": estimator.rig.as_dict()}
        sink = stack.enter_context(Sink(estimator, request, head))
        keys = stack.enter_context(Keys(console.shows_progress))
        run = stack.enter_context(_LiveRun(connected, estimator, compiling, sink, request, console, keys))

        def handle(block: Measurements) -> None:
            run.process(block)
            run.follow_keys()

        ended = live.run_board(connected, duration, handle)
        run.finish(ended)
        live.show_summary(console, run.health, request.json_lines, options.written(sink.path))
        if sink.path:
            options.show_next(console.is_quiet, *options.plot_command(sink.path))
        connected.check_usable()


class _LiveRun:
    """Filters, outputs, view, page and keys of one live run. A context manager: leaving it clears the view."""

    def __init__(
        self,
        board: Board,
        estimator: Estimator,
        compiling: Precompilation,
        sink: Sink,
        request: Request,
        console: Console,
        keys: Keys,
    ) -> None:
        from linkpose.cli.keys import Marker
        from linkpose.cli.view import View
        from linkpose.extremes import Extremes
        from linkpose.live_estimation import LiveEstimator

        self._board, self._estimator, self._compiling, self._sink = board, estimator, compiling, sink
        self._console, self._keys = console, keys
        self._marks: list[float] = []
        self._marker = Marker(self._mark)
        self._following = LiveEstimator(estimator, compiling.is_ready)
        self._extremes = Extremes(estimator.columns)
        self._exit = contextlib.ExitStack()
        self._page = self._exit.enter_context(
            request.page.open(estimator.columns, estimator.rig, board.port, console.report, on_mark=self._mark)
        )
        several = len(estimator.filters) > 1
        legend = "m mark   " + "f next filter   " * several + "q stop"
        self._view = View(
            estimator.columns, console.shows_progress, _title(board), legend if keys.are_read else "", console.reported
        )
        self._exit.callback(self._view.close)
        if self._view.is_shown:
            self._exit.enter_context(console.through(self._view.report))

    @property
    def health(self) -> Health:
        """Of the line and the sensors; a mouse that a filter excludes is "left out"."""
        found = self._board.health
        return replace(found, sensors=self._estimator.excluded.added_to(found.sensors))

    def process(self, block: Measurements) -> None:
        """Runs the filters over a block, which may be empty, and shows and writes what they give."""
        self._marker.advance(block)
        rows = self._following.process(block)
        self._write(rows.complete)
        self._view.add(rows)
        self._view.redraw(lambda: self.health, self._compiling.progress)
        if not self._view.is_shown:
            self._console.progress(lambda: self._compiling.progress or self._view.line(self.health))
        show_newest(self._page, rows, lambda: self.health, self._estimator, self._compiling)

    def follow_keys(self) -> None:
        """Carries out the keys pressed since the last call. Raises KeyboardInterrupt to end the run."""
        self._keys.follow({"m": self._marker, "f": self._view.next_filter})

    def finish(self, ended: str) -> None:
        """Writes the rows of filters that were compiled late, the closing line and the final table."""
        from linkpose.cli.screen import final_table

        self._view.close()
        if self._compiling.waiting:
            self._console.report("The estimates of filters that are still being compiled follow.")
            self._compiling.wait(lambda text: self._console.progress(lambda: text))
        self._write(self._following.finish())
        health = self.health
        closing = {"rows": health.samples, "lost": health.lost, "ended": ended, **self._estimator.outcome}
        if self._marks:
            closing["marks"] = [round(time_s, 6) for time_s in sorted(self._marks)]
        self._sink.close(closing)
        for remark in self._sink.dropped:
            self._console.report(remark)
        if self._console.shows_progress:
            for line in final_table(self._extremes.summary(), shutil.get_terminal_size().columns):
                self._console.report(line)
        report_findings(self._estimator, self._console)

    def _mark(self, time_s: float) -> None:
        self._marks.append(time_s)
        self._board.mark(time_s)
        self._console.report(f"mark at {time_s:.2f} s")

    def _write(self, rows: Floats) -> None:
        if len(rows):
            self._sink.write(rows, self._board.started_s)
            self._extremes.add(rows)

    def __enter__(self) -> _LiveRun:
        return self

    def __exit__(self, *_: object) -> None:
        self._exit.close()


def _title(board: Board) -> str:
    """The port, and the length of J2S where it is known."""
    j2s = board.rig.joint.known_j2s_m
    return board.port + ("" if j2s is None else f"  J2S {math.hypot(*j2s):.3f} m")
