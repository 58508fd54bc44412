"""linkpose estimate"""

from __future__ import annotations

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from linkpose.cli import options
from linkpose.cli.board_settings import board_settings
from linkpose.cli.findings import report_findings, report_running
from linkpose.cli.page import PageOptions
from linkpose.cli.sink import Sink
from linkpose.errors import LinkposeError, NoUsableData
from linkpose.presentation import counted
from linkpose.sensors.rig import Joint

if TYPE_CHECKING:
    from linkpose.cli.live import Console
    from linkpose.estimation import Estimator


@dataclass(frozen=True, slots=True)
class Request:
    """The options of the command, live or not."""

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
    Without -o, the estimates go to the standard output. On a terminal, a live view or a table of their lowest and
    highest values takes their place.

    Keys of the live view: m marks an instant (the closing line lists it under "marks"), f shows the next filter, q ends
    the run as Ctrl-C does.
    """
    from linkpose.cli.estimate_live import estimate_live
    from linkpose.cli.live import Console, refuse_same_file
    from linkpose.outputs import STDOUT, check_outputs

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
    check_outputs([path for path in (output, record, raw) if path is not None], force)
    joint = options.joint_from(joint, j2s_std)
    request = Request(
        output, filter_names, rig_file, joint, smooth, json_lines, force, plain, targets, page, chain_joint, mag
    )
    console = Console(quiet, verbose, json_lines or output == STDOUT)
    if recording is not None:
        _replay(recording, request, console)
    else:
        estimate_live(port, duration, record, raw, board, request, console)


def _replay(path: Path, request: Request, console: Console) -> None:
    """Estimates over a recording, block by block."""
    from linkpose.cli.screen import final_table
    from linkpose.estimation import Estimator, with_chain_joint
    from linkpose.extremes import Extremes
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
    report_running(estimator, request.joint, console)
    if request.smooth:
        _smooth(estimator)
    if request.mag:
        estimator.hold_heading()
    console.compile([f.name for f in estimator.filters])
    head: dict[str, Any] = {"recording": str(path), "filters": [f.name for f in estimator.filters]}
    head |= {"smooth": request.smooth, "mag": request.mag, "rig": rig.as_dict()}
    rows = 0
    with Sink(estimator, request, head) as sink:
        extremes = None if sink.gives_rows else Extremes(estimator.columns)
        blocks = iter([recording.load()]) if request.smooth else recording.blocks()
        for estimates in ahead(map(estimator.process, blocks)):
            sink.write(estimates)
            if extremes is not None:
                extremes.add(estimates)
            rows += len(estimates)
            share = rows / recording.survey.rows
            console.progress(lambda share=share: f"estimating {path} {share:.0%}")  # type: ignore[misc]
        sink.close({"rows": rows, **estimator.outcome})
    if extremes is not None:
        console.clear()
        for line in final_table(extremes.summary(), shutil.get_terminal_size().columns):
            click.echo(line)
    report_findings(estimator, console)
    if sink.path or not sink.gives_rows:
        console.report(f"{counted(rows, 'row')} of {', '.join(head['filters'])}{options.written(sink.path)}")
    if sink.path:
        options.show_next(console.is_quiet, *options.plot_command(sink.path))
    elif not sink.gives_rows:
        options.show_next(console.is_quiet, *sys.argv[1:], "-o", options.new_file("estimate.csv"))


def _smooth(estimator: Estimator) -> None:
    try:
        estimator.smooth()
    except LinkposeError as reason:
        raise click.UsageError(f"--smooth: {reason}") from None
