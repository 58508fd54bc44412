"""linkpose estimate"""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from linkpose.cli import options
from linkpose.cli.board_settings import board_settings
from linkpose.cli.cures import sentence
from linkpose.cli.page import PageOptions, show_newest
from linkpose.errors import LinkposeError, MissingJ2S, NoUsableData
from linkpose.presentation import counted
from linkpose.sensors.rig import Joint

if TYPE_CHECKING:
    from linkpose.board import Board
    from linkpose.cli.keys import Keys
    from linkpose.cli.live import Console
    from linkpose.device.session import Health
    from linkpose.estimation import EstimateWriter, Estimator
    from linkpose.precompile import Precompilation
    from linkpose.sensors.measurements import Floats, Measurements

WORST_STD_M = 0.03  # (m, 1σ in the worst direction) from which on the heights are rough: 2 % of a link of 1.65 m


@dataclass(frozen=True, slots=True)
class Request:
    """What the user asked for, live or not."""

    output: Path | None
    filter_names: tuple[str, ...]
    rig_file: Path | None
    joint: Joint | None
    smooth: bool
    json_lines: bool
    force: bool
    plain: bool
    targets: tuple[str, ...]
    page: PageOptions
    chain_joint: str | None = None
    mag: bool = False


@click.command(name="estimate")
@click.argument("recording", type=options.FILE, required=False)
@click.option("--live", "is_live", is_flag=True, help="Estimate live, from the board.")
@options.port
@options.duration
@click.option("-o", "--output", type=options.FILE, metavar="OUT.csv", help="Write the estimates here.")
@click.option(
    "--record", type=options.FILE, metavar="REC.csv", help="Also write the live measurements to this recording."
)
@click.option("--raw", type=options.FILE, metavar="OUT.bin", help="Also write every received byte to this file.")
@click.option(
    "--filter",
    "filter_names",
    multiple=True,
    metavar="NAME",
    shell_complete=options.complete_filter,
    help="Run this filter; may be repeated. Default: every filter that the sensors and the rig support.",
)
@click.option(
    "--smooth",
    is_flag=True,
    help="Use the smoothers of joint-inertial and chain, with later samples; recordings only.",
)
@options.rig_and_j2s
@click.option(
    "--joint",
    "chain_joint",
    type=click.Choice(["ball", "hinge"]),
    help="Joint between the two links of a chain. Default: the rig file's, or ball.",
)
@click.option(
    "--mag", is_flag=True, help="Hold the heading with the magnetometer; `calibrate mag` must have calibrated it."
)
@options.page
@board_settings
@options.force
@options.plain
@click.option(
    "--to",
    "targets",
    multiple=True,
    metavar="URL",
    help="Also send live estimates to udp://HOST:PORT (JSON), osc://HOST:PORT, ws://HOST:PORT (Foxglove) or lsl:NAME; "
    "may be repeated.",
)
@options.as_json
@options.verbosity
def command(
    recording: Path | None,
    is_live: bool,
    port: str | None,
    duration: float | None,
    output: Path | None,
    record: Path | None,
    raw: Path | None,
    filter_names: tuple[str, ...],
    smooth: bool,
    rig_file: Path | None,
    joint: Joint | None,
    j2s_std: float | None,
    chain_joint: str | None,
    mag: bool,
    has_page: bool,
    view_host: str,
    view_port: int | None,
    board: dict[str, int],
    force: bool,
    plain: bool,
    targets: tuple[str, ...],
    json_lines: bool,
    verbose: bool,
    quiet: bool,
) -> None:
    """Run the filters, live from the board or over RECORDING (a .csv or a raw .bin).

    Without --filter, every filter that the sensors and the rig support runs; -v lists the others with the reason.
    Without -o, the estimates go to the standard output, unless a live view on the terminal shows them.

    Keys of the live view: m marks an instant (the closing line lists it under "marks"), f shows the next filter, q ends
    the run as Ctrl-C does.
    """
    from linkpose.cli.live import Console, refuse_same_file

    if is_live == (recording is not None):
        both = f"--live estimates from the board: leave out {recording}, or leave out --live"
        raise click.UsageError(both if is_live else "name a RECORDING, or add --live to estimate from the board")
    if recording is not None and (port or duration or record or raw or board or targets):
        raise click.UsageError("--port, --duration, --record, --raw, --to and the board's settings go with --live")
    if smooth and is_live:
        raise click.UsageError(
            "--smooth uses later samples: record first, then type: linkpose estimate RECORDING --smooth"
        )
    if recording is not None and has_page:
        raise click.UsageError(
            "--view goes with --live; estimate with -o OUT.csv, then type: linkpose plot --view OUT.csv"
        )
    page = PageOptions(has_page, view_host, view_port)
    page.check()
    refuse_same_file(output, record, raw, source=recording)
    options.refuse_mixed_output(output, json_lines)
    joint = options.joint_from(joint, j2s_std)
    request = Request(
        output, filter_names, rig_file, joint, smooth, json_lines, force, plain, targets, page, chain_joint, mag
    )
    console = Console(quiet, verbose)
    if recording is not None:
        _replay(recording, request, console)
    else:
        _live(port, duration, record, raw, board, request, console)


def _replay(path: Path, request: Request, console: Console) -> None:
    """Estimates over a recording, block by block."""
    from linkpose.estimation import Estimator, with_chain_joint
    from linkpose.recording.ahead import ahead
    from linkpose.recording.reader import RecordingFile

    recording = RecordingFile(path, lambda share: console.progress(lambda: f"reading {path} {share:.0%}"))
    rig = options.resolve_rig(request.rig_file, request.joint, recording.rig).with_delay(recording.imu_delay_s)
    for remark in [*recording.remarks, *recording.contradictions(rig)]:
        console.report(remark)
    if recording.unusable and not request.filter_names:
        raise NoUsableData(f"{path}: {recording.unusable}")
    rig = with_chain_joint(rig, request.chain_joint)
    estimator = Estimator.for_recording(request.filter_names, rig, recording)
    _check(estimator, request, console)
    if request.smooth:
        _smooth(estimator)
    if request.mag:
        estimator.hold_heading()
    console.compile([f.name for f in estimator.filters])
    head: dict[str, Any] = {"recording": str(path), "filters": [f.name for f in estimator.filters]}
    head |= {"smooth": request.smooth, "mag": request.mag, "rig": rig.as_dict()}
    rows = 0
    with _Sink(estimator, request, head) as sink:
        blocks = iter([recording.load()]) if request.smooth else recording.blocks()
        for estimates in ahead(map(estimator.process, blocks)):
            sink.write(estimates)
            rows += len(estimates)
            share = rows / recording.survey.rows
            console.progress(lambda share=share: f"estimating {path} {share:.0%}")  # type: ignore[misc]
        sink.close({"rows": rows, **_outcome(estimator)})
    _report_j2s(estimator, console)
    _report_mice(estimator, console)
    _report_field(estimator, console)
    if request.output:
        console.report(f"{counted(rows, 'row')} of {', '.join(head['filters'])}{options.written(request.output)}")
        options.show_next(console.is_quiet, f"plot {request.output}")


def _smooth(estimator: Estimator) -> None:
    try:
        estimator.smooth()
    except LinkposeError as reason:
        raise click.UsageError(f"--smooth: {reason}") from None


def _live(
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
            estimator.hold_heading()
        _check(estimator, request, console)
        names = [f.name for f in estimator.filters]
        compiling = stack.enter_context(Precompilation(names))
        if record:
            connected.record(record, force=request.force, plain=request.plain)
        head = {"device": connected.port, "filters": names, "mag": request.mag, "rig": estimator.rig.as_dict()}
        sink = stack.enter_context(_Sink(estimator, request, head))
        keys = stack.enter_context(Keys(console.shows_progress))
        run = stack.enter_context(_LiveRun(connected, estimator, compiling, sink, request, console, keys))

        def handle(block: Measurements) -> None:
            run.process(block)
            run.follow_keys()

        ended = live.run_board(connected, duration, handle)
        run.finish(ended)
        live.show_summary(console, run.health, request.json_lines, options.written(request.output))
        if request.output:
            options.show_next(console.is_quiet, f"plot {request.output}")
        connected.check_usable()


class _LiveRun:
    """Filters, outputs, view, page and keys of one live run. A context manager: leaving it clears the view."""

    def __init__(
        self,
        board: Board,
        estimator: Estimator,
        compiling: Precompilation,
        sink: _Sink,
        request: Request,
        console: Console,
        keys: Keys,
    ) -> None:
        from linkpose.cli.keys import Marker
        from linkpose.cli.view import Extremes, View
        from linkpose.estimation import LiveEstimator

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
        self._view = View(estimator.columns, console.shows_progress, _title(board), legend if keys.are_read else "")
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
        rows, newest = self._following.process(block)
        self._write(rows)
        if len(block):
            self._view.show(newest, lambda: self.health, self._compiling.progress)
        else:
            self._view.redraw(lambda: self.health, self._compiling.progress)
        if not self._view.is_shown:
            self._console.progress(lambda: self._compiling.progress or self._view.line(self.health))
        shown = newest if len(block) else newest[:0]
        show_newest(self._page, shown, lambda: self.health, self._estimator, self._compiling)

    def follow_keys(self) -> None:
        """Does what the keys pressed since the last call ask for. Raises KeyboardInterrupt to end the run."""
        self._keys.follow({"m": self._marker, "f": self._view.next_filter})

    def finish(self, ended: str) -> None:
        """Writes the rows of filters that were compiled late, the closing line and the final table."""
        from linkpose.cli.view import final_table

        self._view.close()
        if self._compiling.waiting:
            self._console.report("The estimates of filters that are still being compiled follow.")
            self._compiling.wait(lambda text: self._console.progress(lambda: text))
        self._write(self._following.finish())
        health = self.health
        closing = {"rows": health.samples, "lost": health.lost, "ended": ended, **_outcome(self._estimator)}
        if self._marks:
            closing["marks"] = [round(time_s, 6) for time_s in sorted(self._marks)]
        self._sink.close(closing)
        for remark in self._sink.dropped:
            self._console.report(remark)
        if self._console.shows_progress:
            for line in final_table(self._extremes.summary(), shutil.get_terminal_size().columns):
                self._console.report(line)
        _report_j2s(self._estimator, self._console)
        _report_mice(self._estimator, self._console)
        _report_field(self._estimator, self._console)

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


def _check(estimator: Estimator, request: Request, console: Console) -> None:
    """Reports which filters run. Raises LinkposeError if J2S is to be estimated and no filter that runs does it."""
    from linkpose import filters
    from linkpose.filters import REGISTRY

    if request.joint is not None and request.joint.known_j2s_m is None and estimator.found_j2s is None:
        name = next(name for name, able in filters.REGISTRY.items() if able.j2s == "guess")
        raise LinkposeError(f"--j2s auto is estimated by {name}, which does not run; add --filter {name}")
    left_out = {name: sentence(reason) for name, reason in estimator.left_out.items()}
    for reason in dict.fromkeys(left_out.values()):
        names = ", ".join(name for name, why in left_out.items() if why == reason)
        console.detail(f"not running: {names}: {reason}")
    missing = [name for name, reason in estimator.left_out.items() if isinstance(reason, MissingJ2S)]
    if missing and any(REGISTRY[f.name].sensors for f in estimator.filters):
        console.report(f"{missing[0]}: {left_out[missing[0]]}")
    others = " (-v: why not others)" if left_out else ""
    console.report(f"Running: {', '.join(f.name for f in estimator.filters)}{others}")


def _outcome(estimator: Estimator) -> dict[str, Any]:
    """Entries of the closing line: rejected samples, and J2S and the scale of the mice where they were estimated."""
    outcome: dict[str, Any] = {"rejected": {f.name: f.rejected for f in estimator.filters}}
    found = estimator.found_j2s
    if found:
        outcome["j2s_m"], outcome["j2s_std_m"] = ([round(v, 6) for v in vector.tolist()] for vector in found[:2])
    if estimator.excluded.samples:
        outcome["excluded_mice"] = estimator.excluded.samples
        outcome["excluded_mice_since_s"] = {name: round(at, 3) for name, at in estimator.excluded.first_s.items()}
    jumps = estimator.gyro_jumps
    if jumps:
        last = {"last_rad_s": round(jumps.last_rad_s, 5), "found_s": round(jumps.last_time_s, 3)}
        outcome["gyro_jumps"] = {"count": jumps.times} | last
    if estimator.mice_scale:
        outcome["mice_scale"], outcome["mice_scale_std"] = (round(value, 5) for value in estimator.mice_scale)
    if estimator.magnetic_field:
        outcome["mag"] = estimator.magnetic_field.as_dict()
    return outcome


def _report_field(estimator: Estimator, console: Console) -> None:
    """How long the magnetometer held the heading, and the largest disturbance."""
    found = estimator.magnetic_field
    if found is None:
        return
    if not found.references:
        console.report(
            "The magnetometer did not hold the heading: the field is not as strong as at its calibration. Move away "
            "from iron, or calibrate it here: linkpose calibrate mag RECORDING --rig rig.toml"
        )
        return
    console.report(
        f"The magnetometer held the heading for {found.used_s:.0f} s; for {found.rejected_s:.0f} s the field was "
        f"disturbed, by {found.largest_disturbance_uT:.1f} µT at most."
        + ("" if found.north_deg is None else f" Magnetic north is at yaw {found.north_deg:.0f}°.")
    )


_SHORTEST_S = 0.2  # of exclusions that are reported: a late packet excludes a mouse for a sample


def _report_excluded(estimator: Estimator, console: Console) -> None:
    """Which mice were left out, since when, and for how long."""
    excluded = estimator.excluded
    long = sorted(name for name, total_s in excluded.total_s.items() if total_s >= _SHORTEST_S)
    for name in long:
        still = "; it is still left out" if name in excluded.now else ""
        console.report(
            f"mouse {name.removeprefix('mouse')} was left out for {excluded.total_s[name]:.1f} s, first at "
            f"{excluded.first_s[name]:.1f} s{still}: it contradicted the other sensors. Check that it is on the floor, "
            "and its place and angle in the rig file"
        )


def _report_mice(estimator: Estimator, console: Console) -> None:
    """Excluded mice, jumps of the gyro, and the common scale of the mice where it differs from the rig file."""
    _report_excluded(estimator, console)
    jumps = estimator.gyro_jumps
    if jumps:
        times = "" if jumps.times == 1 else f" {jumps.times} times, last"
        console.report(
            f"the gyro's bias has jumped{times} by {math.degrees(jumps.last_rad_s):+.1f} °/s, found at "
            f"{jumps.last_time_s:.1f} s: the mice contradicted the gyro, and the heading was corrected by the mice. "
            "Check the mounting and the supply of the sensor"
        )
    if estimator.mice_scale:
        factor, std = estimator.mice_scale
        change = "more" if factor > 1 else "fewer"
        console.report(
            f"the mice count {100 * abs(factor - 1):.1f} ± {100 * std:.1f} % {change} per metre than the rig file "
            "states, compared with the gyro (another floor?): type `linkpose calibrate mice` on this floor"
        )


def _report_j2s(estimator: Estimator, console: Console) -> None:
    """J2S where it was estimated, and the axis along which the motion did not excite it."""
    found = estimator.found_j2s
    if not found:
        return
    axes = (f"{value:.4f} ± {std:.4f}" for value, std in zip(found.mean_m, found.std_m, strict=True))
    console.report(f"J2S {', '.join(axes)} m")
    if found.worst_std_m > WORST_STD_M:
        console.report(
            f"The motion does not determine J2S along the sensor's {found.worst_axis} axis (1σ is "
            f"{found.worst_std_m:.2f} m), so the heights are rough. Swing the link longer, in all directions."
        )


class _Sink:
    """Where estimates go: a file, stdout as CSV, or stdout as JSON; file and JSON go together."""

    def __init__(self, estimator: Estimator, request: Request, head: dict[str, Any]) -> None:
        from linkpose.estimation import EstimateWriter
        from linkpose.recording.csvfile import head as csv_head
        from linkpose.streams import open_output

        self._estimator = estimator
        self._outputs = [open_output(target, estimator.columns) for target in request.targets]
        self._json = request.json_lines
        self._file: EstimateWriter | None = None
        if request.output is not None:
            self._file = EstimateWriter(request.output, head, estimator.columns, request.force, request.plain)
        self._prints = self._file is None and not self._json and not sys.stdout.isatty()
        if self._prints:
            header = ",".join(estimator.columns) + "\n"
            _print(header if request.plain else csv_head("estimate", head, estimator.columns))

    def write(self, estimates: Any, start_s: float = 0.0) -> None:
        """Puts out rows of estimates; `start_s` is the host's time (time.perf_counter, s) of `time_s` 0."""
        if self._file is not None:
            self._file.write(self._estimator.text(estimates))
        if self._prints:
            _print(self._estimator.text(estimates).decode())
        if self._json or self._outputs:
            rows = self._estimator.objects(estimates)
            for output in self._outputs:
                for row in rows:
                    output.send(row, start_s + (row["time_s"] or 0.0))
            if self._json:
                _print("".join(json.dumps(row) + "\n" for row in rows))

    @property
    def dropped(self) -> list[str]:
        """What live outputs did not accept, in sentences."""
        return [
            f"{output.name}: {output.dropped} estimates were not sent" for output in self._outputs if output.dropped
        ]

    def close(self, closing: dict[str, Any]) -> None:
        if self._file is not None:
            self._file.close(closing)

    def __enter__(self) -> _Sink:
        return self

    def __exit__(self, *_: object) -> None:
        for output in self._outputs:
            output.close()
        if self._file is not None:
            self._file.__exit__()


def _print(text: str) -> None:
    """Put results on stdout at once."""
    sys.stdout.write(text)
    sys.stdout.flush()
