"""`linkpose localize`: where the robot was, from its log and a map or beacons."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click

from linkpose.cli import options
from linkpose.cli.live import Console, ending_well
from linkpose.cli.page import PageOptions
from linkpose.errors import LinkposeError
from linkpose.presentation import counted

if TYPE_CHECKING:
    from linkpose.localization.events import Log
    from linkpose.localization.localizer import Method
    from linkpose.localization.settings import Settings
    from linkpose.localization.tables import Beacons, PathScore
    from linkpose.localization.track import Track
    from linkpose.recording.table import Table

# The noises that are estimated from the log where the user does not state them: option -> its name in `tuning`, and the
# value for streams, laser scans, and logs of fewer than 100 measurements.
NOISES = {
    "range_std": ("range", 0.1), "range_growth": ("growth", 0.02), "bearing_std": ("bearing", 0.05),
    "speed_std": ("speed", 0.1), "turn_std": ("turn", 0.1), "velocity_std": ("velocity", 0.1),
    "acceleration_std": ("acceleration", 1.0),
}  # fmt: skip
FROM_LOG = "Default: estimated from the log; in a stream, or with few measurements,"
POSITIVE = options.FiniteRange(min=0, min_open=True)


def _default(noise: str) -> str:
    """The last sentence of the help text of an option for one of NOISES."""
    return f"{FROM_LOG} {NOISES[noise][1]:g}."


class Numbers(click.ParamType):  # type: ignore[type-arg]  # generic only in newer releases of click
    """So many finite numbers, separated by commas."""

    def __init__(self, names: str) -> None:
        self.name = names

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        import math

        words = str(value).split(",")
        try:
            numbers = tuple(float(word) for word in words)
        except ValueError:
            numbers = ()
        if len(numbers) != len(self.name.split(",")) or not all(math.isfinite(number) for number in numbers):
            self.fail(f"{value!r} is not {self.name}, numbers separated by commas", param, ctx)
        return numbers


def gate_probability(ctx: click.Context, param: click.Parameter, value: str) -> float | None:
    """A probability within 0 to 1, or None for `off`."""
    if value == "off":
        return None
    try:
        probability = float(value)
    except ValueError:
        probability = 0.0
    if not 0.0 < probability < 1.0:
        raise click.BadParameter(f"{value!r} is neither `off` nor a probability between 0 and 1, such as 0.997")
    return probability


def estimated_constants(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> tuple[str, ...]:
    """The words of --estimate, each once."""
    from linkpose.localization.settings import ESTIMATED

    words = [word.strip() for item in value for word in item.split(",")]
    if words == ["none"]:
        return ("none",)
    for word in words:
        if word not in ESTIMATED:
            raise click.BadParameter(f"{word!r} is none of {', '.join(ESTIMATED)}")
        if f"{word}:each" in words:
            raise click.BadParameter(f"{word} and {word}:each exclude each other; name one")
    return tuple(dict.fromkeys(words))


def start_pose(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[float, ...] | str | None:
    """X,Y,HEADING as numbers, or `auto`."""
    if value is None or value == "auto":
        return value
    return Numbers("X,Y,HEADING").convert(value, param, ctx)


@click.command("localize")
@click.argument("log", type=options.FILE)
@click.option(
    "--map",
    "map_path",
    type=options.FILE,
    metavar="MAP.yaml",
    help="Grid map of map_server, for a log with laser scans.",
)
@click.option(
    "--beacons",
    "beacons_path",
    type=options.FILE,
    metavar="BEACONS.csv",
    help="Places of beacons or landmarks: id,x_m,y_m[,z_m].",
)
@click.option(
    "--odometry",
    "odometry_path",
    type=options.FILE,
    metavar="MICE.csv",
    help="Take the odometry from this estimate of the mice filter, on the log's clock.",
)
@click.option(
    "--filter",
    "filters",
    type=click.Choice(["scan-match", "ekf", "ukf", "mcl"]),
    multiple=True,
    help="May be repeated. Default: scan-match for a log with laser scans, ekf for others.",
)
@click.option(
    "--noise",
    type=click.Choice(["fixed", "adaptive", "affine"]),
    default="affine",
    show_default=True,
    help="How the variance of a range follows from it: σ², η (r/r̄) σ², or σ² + (k r)².",
)
@click.option(
    "--correlation",
    type=options.FiniteRange(),
    default=0.0,
    show_default=True,
    help="Between ranges taken at one instant.",
)
@click.option(
    "--gate",
    callback=gate_probability,
    default="0.997",
    show_default=True,
    metavar="P|off",
    help="Reject measurements whose squared Mahalanobis distance exceeds the χ² quantile for this probability.",
)
@click.option("--range-std", type=POSITIVE, help=f"σ of a range (m). {_default('range_std')}")
@click.option(
    "--range-growth",
    type=options.FiniteRange(min=0),
    help=f"Growth k of the range's standard deviation with --noise affine (m/m). {_default('range_growth')}",
)
@click.option("--eta", type=POSITIVE, default=1.0, show_default=True, help="η of --noise adaptive.")
@click.option("--bearing-std", type=POSITIVE, help=f"σ of a bearing (rad). {_default('bearing_std')}")
@click.option("--depth-std", type=POSITIVE, default=0.05, show_default=True, help="σ of a depth (m).")
@click.option("--attitude-std", type=POSITIVE, default=0.01, show_default=True, help="σ of a yaw reading (rad).")
@click.option("--speed-std", type=POSITIVE, help=f"σ of one odometry sample's speed (m/s). {_default('speed_std')}")
@click.option("--turn-std", type=POSITIVE, help=f"σ of one odometry sample's turn rate (rad/s). {_default('turn_std')}")
@click.option(
    "--velocity-std", type=POSITIVE, help=f"σ of one velocity sample on each axis (m/s). {_default('velocity_std')}"
)
@click.option(
    "--acceleration-std",
    type=POSITIVE,
    help=f"σ of the acceleration on each axis of a log without odometry (m/s²). {_default('acceleration_std')}",
)
@click.option(
    "--error-time",
    type=options.FiniteRange(min=0),
    help="Time for which the error of a range or bearing of one beacon persists (s): sightings in quicker succession "
    "count less. Default: estimated for landmarks and in streams; with few measurements 0, and 0.5 for landmarks.",
)
@click.option(
    "--drift-std",
    type=options.FiniteRange(min=0),
    help="σ of the part of a range's error that drifts (m), for each beacon by itself; estimated beside the pose. "
    f"{FROM_LOG} 0.",
)
@click.option(
    "--drift-time",
    type=POSITIVE,
    default=10.0,
    show_default=True,
    help="Time for which this part persists (s); estimated with it.",
)
@click.option(
    "--motion-correlation",
    type=options.FiniteRange(),
    default=0.0,
    show_default=True,
    help="Between the errors of speed and turn rate.",
)
@click.option(
    "--estimate",
    multiple=True,
    callback=estimated_constants,
    metavar="scale|bias[:each]|none",
    help="Estimate the scale error or the bias of the ranges, too, for all beacons or for each. "
    "May be repeated or separated by commas. Default: scale,bias for ranges to three beacons and more, except under "
    "water.",
)
@click.option(
    "--start",
    callback=start_pose,
    metavar="X,Y,HEADING|auto",
    help="Pose at the log's start (m, m, rad), or `auto`: search the whole map. "
    "Default: the log's own pose, else auto.",
)
@click.option(
    "--start-std", type=Numbers("M,RAD"), default="0.5,0.1", show_default=True, help="Standard deviation of the start."
)
@click.option(
    "--transform",
    type=click.Choice(["unscented", "scaled"]),
    default="unscented",
    show_default=True,
    help="Sigma points √(n + κ) σ out, as the thesis has them, or α times that: better in a map with many edges.",
)
@click.option(
    "--alpha",
    type=options.FiniteRange(0, 1, min_open=True),
    default=0.1,
    show_default=True,
    help="α of --transform scaled.",
)
@click.option(
    "--beta", type=options.FiniteRange(min=0), default=2.0, show_default=True, help="β of --transform scaled."
)
@click.option("--kappa", type=options.FiniteRange(min=0), default=0.0, show_default=True, help="κ of either transform.")
@click.option("--smooth", is_flag=True, help="Smooth the path afterwards with all measurements.")
@click.option("--particles", type=click.IntRange(10, 1000000), default=2000, show_default=True, help="Of --filter mcl.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of --filter mcl.")
@click.option("-o", "--output", type=options.FILE, metavar="OUT.csv", help="Write the estimated path.")
@click.option(
    "--plot",
    "picture",
    type=options.FILE,
    metavar="PICTURE",
    help="Draw the paths with 2σ ellipses, map, beacons and truth (.png, .pdf, .svg), or play them (.html).",
)
@click.option(
    "--truth", "truth_path", type=options.FILE, metavar="T.csv", help="True path: time_s,x_m,y_m[,z_m][,heading_rad]."
)
@options.page
@options.force
@options.as_json
@options.quiet
def command(
    log: Path,
    map_path: Path | None,
    beacons_path: Path | None,
    odometry_path: Path | None,
    filters: tuple[str, ...],
    output: Path | None,
    picture: Path | None,
    truth_path: Path | None,
    has_page: bool,
    view_host: str,
    view_port: int | None,
    force: bool,
    json_lines: bool,
    quiet: bool,
    **settings: Any,
) -> None:
    """Estimate a robot's path from a LOG of odometry and measurements, and a map or beacons.

    LOG is a CARMEN log (ODOM, FLASER, ROBOTLASER1) or a CSV with one measurement a row: time_s,kind,a,b,c, where kind
    is odometry, range, bearing_range, depth, velocity, attitude or pose. With `-`, rows of the CSV are read from
    standard input, and poses are written to standard output as they come. With --view, the path is then played in the
    browser until Ctrl-C.
    """
    page = PageOptions(has_page, view_host, view_port)
    page.check()
    if map_path is None and beacons_path is None:
        raise click.UsageError("nothing to localise against; add --map MAP.yaml or --beacons BEACONS.csv")
    from linkpose import precompile
    from linkpose.localization.localizer import check, localize, most_at_once
    from linkpose.localization.logs import read_log
    from linkpose.localization.maps import load_map
    from linkpose.localization.plausibility import check_units
    from linkpose.localization.surroundings import Surroundings
    from linkpose.localization.tables import read_beacons, read_truth, score_track

    console = Console(quiet, verbose=False)
    if str(log) == "-":
        given: dict[str, object] = {"--map": map_path, "--odometry": odometry_path, "--plot": picture}
        given |= {"--truth": truth_path, "--json": json_lines or None, "--view": has_page or None}
        _refuse_in_stream(given | {"-o": None if str(output) == "-" else output})
        _stream(settings, filters, read_beacons(beacons_path) if beacons_path else {}, console)
        return
    grid = load_map(map_path) if map_path else None
    beacons = read_beacons(beacons_path) if beacons_path else {}
    truth = read_truth(truth_path) if truth_path else None
    if picture is not None:
        from linkpose.page.animation import FORMATS
        from linkpose.plotting import check_output

        check_output(picture, force, FORMATS)
    read = read_log(log)
    for remark in read.remarks:
        console.report(remark)
    events = read.events
    if odometry_path is not None:
        from linkpose.localization.odometry import with_mice_odometry

        events = with_mice_odometry(events, odometry_path)
    has_scans = any(event.kind == "scan" for event in events)
    default: Method = "scan-match" if has_scans else "ekf"
    names = cast("list[Method]", list(dict.fromkeys(filters))) or [default]
    settings["estimate"] = _estimated(settings["estimate"], events, console)
    free = _free_noises(settings)
    chosen = {name: _settings(settings, name, read.start) for name in names}
    if not read.is_carmen:  # its units are defined, and poses a millisecond apart give any turn rate
        check_units(events, beacons, str(log))
    for method in names:
        check(events, method, chosen[method], grid, beacons, str(log))
    if chosen[names[0]].ranges.correlation and most_at_once(events) == 1:
        console.report("no two ranges of this log are of one instant: --correlation changes nothing")
    if _has_no_odometry(events):
        console.report(
            "the log has no odometry: a constant-velocity model is used (--acceleration-std), "
            "at the mean height of the beacons"
        )
    console.compile([*names, precompile.NOISES] if beacons and not has_scans else names)
    if beacons and not has_scans:
        chosen = _tuned(events, chosen, beacons, free, console)
    tracks: dict[str, Track] = {
        method: localize(events, method, chosen[method], grid, beacons, str(log)) for method in names
    }
    for name, track in tracks.items():
        _require_measurements(log, name, track)
    options.refuse_mixed_output(output, json_lines)
    if output is not None:
        from linkpose.localization.output import write_tracks

        write_tracks(output, tracks, log, force)
    if picture is not None:
        from linkpose.page.animation import save_picture

        around = Surroundings(grid, beacons, tracks[names[0]].rejected_xy_m)
        save_picture(picture, _tables(tracks, log, truth_path), [], around, force)
    for name, track in tracks.items():
        result = score_track(track, truth) if truth else None
        text = json.dumps(_summary(name, track, result)) if json_lines else _sentence(name, track, result)
        click.echo(text, err=str(output) == "-")
    if has_page:
        page.play(_tables(tracks, log, truth_path), [], Surroundings(grid, beacons), console)


def _tables(tracks: dict[str, Track], log: Path, truth: Path | None) -> list[Table]:
    """The paths and the truth as `plot` reads them from their files."""
    from linkpose.evaluation.references import read_for_picture
    from linkpose.localization.output import table_of

    return [table_of(tracks, log), *([read_for_picture(truth, "z")] if truth is not None else [])]


def _refuse_in_stream(given: dict[str, object]) -> None:
    """Raises UsageError for options that a stream does not use."""
    if unused := [option for option, value in given.items() if value is not None]:
        raise click.UsageError(f"a stream from standard input does not use {', '.join(unused)}; leave it out")


def _stream(settings: dict[str, Any], filters: tuple[str, ...], beacons: Beacons, console: Console) -> None:
    """Reads rows from standard input and writes a row of CSV for each, until the input ends or the user interrupts."""
    import sys

    from linkpose import precompile
    from linkpose.localization.output import header_line, row_line
    from linkpose.localization.stream import Stream

    name = filters[0] if filters else "ekf"
    if len(filters) > 1 or name not in ("ekf", "ukf") or not beacons or settings["smooth"]:
        raise click.UsageError("standard input takes --beacons, one --filter ekf or ukf, and no --smooth")
    words = settings["estimate"]
    settings["estimate"] = () if words == ("none",) else words
    free = _free_noises(settings)
    method = cast("Method", name)
    console.compile([name, precompile.NOISES])
    stream = Stream(method, _settings(settings, method, None), beacons, free, not words, console.report)
    if isinstance(sys.stdin, io.TextIOWrapper):
        sys.stdin.reconfigure(encoding="utf-8-sig", errors="replace")
    last = None
    with contextlib.suppress(KeyboardInterrupt), ending_well():
        for row in stream.rows(sys.stdin):
            if last is None:
                click.echo(header_line(name, stream.states))
            click.echo(row_line(row))
            sys.stdout.flush()
            last = row
    for remark in stream.remarks():
        console.report(remark)
    if stream.run is not None and last is not None:
        track = stream.run.track([last])
        _require_measurements(Path("standard input"), name, track)
        console.report(_sentence(name, track, None))


def _estimated(words: tuple[str, ...], events: Log, console: Console) -> tuple[str, ...]:
    """The constants to estimate: as given, or those that the ranges determine."""
    from linkpose.localization.events import Event
    from linkpose.localization.measuring import default_constants
    from linkpose.localization.vehicle import kinds_of

    if words:
        return () if words == ("none",) else words
    beacons = {event.beacon for event in events if isinstance(event, Event) and event.kind == "range"}
    found = default_constants(kinds_of(events), len(beacons))
    if found:
        console.report("scale error and bias of the ranges are estimated, too (--estimate none: not)")
    return found


def _free_noises(given: dict[str, Any]) -> tuple[str, ...]:
    """The noises that the user did not state, which get their values for logs that do not determine them."""
    free = [name for option, (name, _) in NOISES.items() if given[option] is None]
    for option, (_, value) in NOISES.items():
        given[option] = value if given[option] is None else given[option]
    if given["noise"] != "affine" and "growth" in free:
        free.remove("growth")
    free += [name for option, name in (("error_time", "error_time"), ("drift_std", "drift")) if given[option] is None]
    given["drift_std"] = given["drift_std"] or 0.0
    return (*free, "yaw")


def _tuned(
    events: Log, chosen: dict[Method, Settings], beacons: Beacons, free: tuple[str, ...], console: Console
) -> dict[Method, Settings]:
    """The settings of all filters with the free noises estimated from the log, and a line that reports them."""
    from linkpose.localization.tuning import described, tune

    first = next(iter(chosen.values()))
    tuned = tune(events, first, beacons, free)
    if tuned is first:
        return chosen
    console.report(f"noises estimated from the log: {described(tuned, events)}")
    return dict.fromkeys(chosen, tuned)


def _has_no_odometry(events: Log) -> bool:
    from linkpose.localization.kalman import CONSTANT_VELOCITY
    from linkpose.localization.vehicle import kinds_of, vehicle_of

    return vehicle_of(kinds_of(events)) is CONSTANT_VELOCITY


def _require_measurements(log: Path, name: str, track: Track) -> None:
    """Raises LinkposeError where no measurement was applied: the path would be dead reckoning."""
    if track.applied == 0:
        raise LinkposeError(
            f"{log}: {name} applied none of {counted(track.rejected, 'measurement')}, so there is no estimate; "
            "check the units (m, s, rad), --start, and the places of the beacons or the map"
        )


def _settings(given: dict[str, Any], name: Method, own_start: tuple[float, float, float] | None) -> Settings:
    from linkpose.localization.noise import RangeNoise
    from linkpose.localization.settings import Settings
    from linkpose.localization.ukf import Transform

    scaled = given["transform"] == "scaled"
    if min(given["start_std"]) <= 0:
        raise click.BadParameter(
            "both must be above 0; a start without uncertainty could not be corrected", param_hint="--start-std"
        )
    # Odometry's own frame is the map's in a simulation only: scan-match checks the whole map instead.
    start = given["start"] if name == "scan-match" else given["start"] or own_start
    if start == "auto":
        start = None
    return Settings(
        ranges=RangeNoise(
            given["noise"], given["range_std"], given["eta"], given["range_growth"], given["correlation"]
        ),
        bearing_std_rad=given["bearing_std"],
        depth_std_m=given["depth_std"],
        attitude_std_rad=given["attitude_std"],
        speed_std_m_s=given["speed_std"],
        turn_std_rad_s=given["turn_std"],
        motion_correlation=given["motion_correlation"],
        velocity_std_m_s=given["velocity_std"],
        gate=given["gate"],
        transform=Transform(given["alpha"], given["beta"], given["kappa"])
        if scaled
        else Transform(kappa=given["kappa"]),
        estimate=tuple(dict.fromkeys(given["estimate"])),
        start=start,
        start_std=given["start_std"],
        acceleration_std_m_s2=given["acceleration_std"],
        error_time_s=given["error_time"],
        drift_std_m=given["drift_std"],
        drift_time_s=given["drift_time"],
        smooth=given["smooth"],
        particles=given["particles"],
        seed=given["seed"],
    )


def _summary(name: str, track: Track, result: PathScore | None) -> dict[str, object]:
    row: dict[str, object] = {
        "filter": name,
        "updates": track.applied,
        "rejected": track.rejected,
        "widened": track.widened,
        "relocated": track.relocated,
        "known_share": float(track.known.mean()),
        "consistency": [
            {"sensor": v.sensor, "count": v.count, "mean_nis": v.mean_nis, "noise_factor": v.noise_factor,
             "verdict": v.sentence()}
            for v in track.consistency.verdicts() + track.consistency.verdicts(each=True)
        ],
    }  # fmt: skip
    if result is not None:
        row |= {"position_rmse_m": result.position_rmse_m, "position_max_m": result.position_max_m}
        row |= {"rows_compared": result.rows, "rows_possible": result.possible, "within_2_sigma": result.within_2_sigma}
        if result.heading_rmse_rad is not None:
            row["heading_rmse_rad"] = result.heading_rmse_rad
    return row


def _sentence(name: str, track: Track, result: PathScore | None) -> str:
    text = f"{name}: {counted(track.applied, 'measurement')} applied, {track.rejected} rejected"
    known = track.known
    if not known.all():
        first = f" (first at {track.time_s[known][0]:.6g} s)" if known.any() else ""
        text += f"\n  the pose is known in {100 * known.mean():.0f} % of the rows{first}"
    if known[-1]:
        last = ", ".join(
            f"{state} {value:.3f} ± {std:.3f}"
            for state, value, std in zip(track.names, track.state[-1], track.std[-1], strict=True)
        )
        text += f"\n  at the end {last}"
    if track.widened:
        often = counted(track.widened, "time")
        text += f"\n  {often} most measurements were rejected, so the pose was made uncertain again"
    if track.relocated:
        text += f"\n  {counted(track.relocated, 'time')} the pose was lost and found anew"
    for verdict in track.consistency.verdicts():
        text += f"\n  {verdict.sentence()} (mean NIS {verdict.mean_nis:.2f}, 1 is consistent)"
    if result is not None:
        text += (
            f"\n  position error {result.position_rmse_m:.3f} m rms, {result.position_max_m:.3f} m at most, "
            f"from {result.rows} of {result.possible} rows"
        )
        if result.heading_rmse_rad is not None:
            text += f"; heading {result.heading_rmse_rad:.4f} rad rms"
        if result.within_2_sigma is not None:
            text += f"; {100 * result.within_2_sigma:.0f} % of the errors within 2σ"
    return text
