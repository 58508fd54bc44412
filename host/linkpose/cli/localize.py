"""`linkpose localize`: where the robot was, from its log and a map or beacons."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click

from linkpose.cli import options
from linkpose.cli.live import Console, ending_well
from linkpose.cli.page import PageOptions
from linkpose.errors import InvalidValue
from linkpose.localization.options import (
    ESTIMATED_NOISES,
    MAY_BE_NEGATIVE,
    MAY_BE_ZERO,
    LocalizationOptions,
    check_constants,
    check_start_std,
)
from linkpose.presentation import counted

if TYPE_CHECKING:
    from linkpose.localization.localizer import Method
    from linkpose.localization.tables import PathScore
    from linkpose.localization.track import Track

DEFAULTS = LocalizationOptions()


def _number(
    flag: str, name: str, text: str, kind: click.ParamType[Any] | None = None
) -> Callable[[options.Function], options.Function]:
    """The option of the number `name` of LocalizationOptions, with its default; `kind` if its bounds are others."""
    if kind is None:
        least = None if name in MAY_BE_NEGATIVE else 0
        kind = options.FiniteRange(min=least, min_open=least == 0 and name not in MAY_BE_ZERO)
    default = getattr(DEFAULTS, name)
    if default is None and (assumed := ESTIMATED_NOISES[name][1]) is not None:
        text += f" Else {assumed:g}."
    return click.option(flag, name, type=kind, default=default, show_default=default is not None, help=text)


class Numbers(click.ParamType):  # type: ignore[type-arg]  # generic only in newer releases of click
    """Finite numbers separated by commas, one for each name."""

    def __init__(self, names: str) -> None:
        self.name = names

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        words = str(value).split(",")
        try:
            numbers = tuple(float(word) for word in words)
        except ValueError:
            numbers = ()
        if len(numbers) != len(self.name.split(",")) or not all(abs(number) <= options.LARGEST for number in numbers):
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


def estimated_constants(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> tuple[str, ...] | None:
    """The words of --estimate, each once; None where it is not given, () for `none`."""
    words = list(dict.fromkeys(word.strip() for item in value for word in item.split(",")))
    if words in ([], ["none"]):
        return () if words else None
    _check(check_constants, words)
    return tuple(words)


def start_std(ctx: click.Context, param: click.Parameter, value: str) -> tuple[float, ...]:
    """M,RAD as two numbers above 0."""
    std = Numbers("M,RAD").convert(value, param, ctx)
    _check(check_start_std, std)
    return std


def _check(check: Callable[[Any], None], value: object) -> None:
    """Raises BadParameter for a value for which `check` raises InvalidValue."""
    try:
        check(value)
    except InvalidValue as error:
        raise click.BadParameter(str(error).removeprefix(f"{error.name} ")) from None


def start_pose(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[float, ...] | str | None:
    """X,Y,HEADING as numbers, or `auto`."""
    if value is None or value == "auto":
        return value
    return Numbers("X,Y,HEADING").convert(value, param, ctx)


# The help's sections: title, a sentence on the options, and the first of them.
SECTIONS = (
    ("Map or beacons", "", "map_path"),
    ("Results", "", "output"),
    ("Filter", "", "filters"),
    (
        "Noise",
        "Default: estimated from the log of beacons. Streams, laser scans and logs with few measurements use the value "
        'after "Else".',
        "range_std_m",
    ),
    ("Variants of the thesis", "", "noise"),
)


class Sectioned(click.Command):
    """A command whose help lists the options of the ordinary case first."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        chosen = [parameter for parameter in self.params if isinstance(parameter, click.Option)]
        own = self.get_help_option(ctx)
        if own is not None:
            chosen.insert(next(i for i, option in enumerate(chosen) if option.name == "filters"), own)
        names = [option.name for option in chosen]
        starts = [names.index(first) for _, _, first in SECTIONS]
        for (title, sentence, _), start, end in zip(SECTIONS, starts, [*starts[1:], len(chosen)], strict=True):
            with formatter.section(title):
                if sentence:
                    formatter.write_text(sentence)
                formatter.write_dl([record for option in chosen[start:end] if (record := option.get_help_record(ctx))])


@click.command("localize", cls=Sectioned)
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
    "--start",
    callback=start_pose,
    metavar="X,Y,HEADING|auto",
    help="Pose at the log's start (m, m, rad), or `auto`: search the whole map. "
    "Default: the log's own pose, else auto.",
)
@click.option("-o", "--output", type=options.FILE, metavar="OUT.csv", help="Write the estimated path.")
@click.option(
    "--plot",
    "picture",
    type=options.FILE,
    callback=options.refuse_standard_output,
    metavar="PICTURE",
    help="Draw the paths with 2σ ellipses, map, beacons and truth (.png, .pdf, .svg), or play them (.html).",
)
@click.option(
    "--truth", "truth_path", type=options.FILE, metavar="T.csv", help="True path: time_s,x_m,y_m[,z_m][,heading_rad]."
)
@click.option("--smooth", is_flag=True, help="Smooth the path afterwards with all measurements.")
@options.as_json
@options.page
@options.force
@options.quiet
@click.option(
    "--filter",
    "filters",
    type=click.Choice(["scan-match", "ekf", "ukf", "mcl"]),
    multiple=True,
    help="May be repeated. Default: scan-match for a log with laser scans, ekf for others.",
)
@click.option(
    "--gate",
    callback=gate_probability,
    default="0.997",
    show_default=True,
    metavar="P|off",
    help="Reject measurements whose squared Mahalanobis distance exceeds the χ² quantile for this probability.",
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
    "--start-std",
    callback=start_std,
    metavar="M,RAD",
    default=",".join(map(str, DEFAULTS.start_std)),
    show_default=True,
    help="Standard deviation of the start.",
)
@_number("--particles", "particles", "Of --filter mcl.", click.IntRange(10, 1000000))
@_number("--seed", "seed", "Of --filter mcl.", click.IntRange(min=0))
@_number("--range-std", "range_std_m", "σ of a range (m).")
@_number("--range-growth", "range_growth", "Growth of σ with the range (m/m). scan-match: 0.005.")
@_number("--bearing-std", "bearing_std_rad", "σ of a bearing (rad).")
@_number("--speed-std", "speed_std_m_s", "σ of one odometry sample's speed (m/s).")
@_number("--turn-std", "turn_std_rad_s", "σ of one odometry sample's turn rate (rad/s).")
@_number("--velocity-std", "velocity_std_m_s", "σ of one velocity sample on each axis (m/s).")
@_number(
    "--acceleration-std",
    "acceleration_std_m_s2",
    "σ of the acceleration on each axis of a log without odometry (m/s²).",
)
@_number(
    "--error-time",
    "error_time_s",
    "Time for which the error of a range or bearing of one beacon persists (s): sightings in quicker succession "
    "count less. Else 0, and 0.5 for landmarks.",
)
@_number(
    "--drift-std",
    "drift_std_m",
    "σ of the part of a range's error that drifts (m), for each beacon by itself; estimated beside the pose.",
)
@_number("--drift-time", "drift_time_s", "Time for which this part persists (s); estimated with it.")
@_number("--depth-std", "depth_std_m", "σ of a depth (m); not estimated.")
@_number("--attitude-std", "attitude_std_rad", "σ of a yaw reading (rad); not estimated.")
@click.option(
    "--noise",
    type=click.Choice(["fixed", "adaptive", "affine"]),
    default=DEFAULTS.noise,
    show_default=True,
    help="How the variance of a range follows from it: σ², η (r/mean r) σ², or σ² + (k r)² with the growth k.",
)
@_number("--eta", "eta", "η of --noise adaptive.")
@_number("--correlation", "correlation", "Between ranges taken at one instant.")
@_number(
    "--motion-correlation",
    "motion_correlation",
    "Between the errors of speed and turn rate.",
)
@click.option(
    "--transform",
    type=click.Choice(["unscented", "scaled"]),
    default=DEFAULTS.transform,
    show_default=True,
    help="Sigma points √(n + κ) σ out, as the thesis has them, or α times that: better in a map with many edges.",
)
@_number("--alpha", "alpha", "α of --transform scaled.", options.FiniteRange(0, 1, min_open=True))
@_number("--beta", "beta", "β of --transform scaled.")
@_number("--kappa", "kappa", "κ of either transform.")
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
        raise click.UsageError("nothing to localize against; add --map MAP.yaml or --beacons BEACONS.csv")
    console = Console(quiet, verbose=False)
    methods = cast("tuple[Method, ...]", filters)
    chosen = LocalizationOptions(**settings)
    if str(log) == "-":
        given: dict[str, object] = {"--map": map_path, "--odometry": odometry_path, "--plot": picture}
        given |= {"--truth": truth_path, "--json": json_lines or None, "--view": has_page or None}
        _refuse_in_stream(given | {"-o": None if str(output) == "-" else output})
        _stream(chosen, methods, beacons_path, console)
        return
    from linkpose import precompile
    from linkpose.localization.paths import prepare
    from linkpose.localization.surroundings import Surroundings
    from linkpose.localization.tables import read_truth
    from linkpose.outputs import check_outputs

    truth = read_truth(truth_path) if truth_path else None
    if picture is not None:
        from linkpose.page.animation import FORMATS
        from linkpose.plotting import check_output

        check_output(picture, force, FORMATS)
    options.refuse_mixed_output(output, json_lines)
    check_outputs([output] if output is not None else [], force)
    prepared = prepare(log, map_path, beacons_path, odometry_path, methods, chosen, console.report)
    console.compile([*prepared.settings, precompile.NOISES] if prepared.estimates_noises else list(prepared.settings))
    paths = prepared.run()
    for remark in paths.remarks[len(prepared.remarks) :]:
        console.report(remark)
    if output is not None:
        paths.save(output, force=force)
    tables = [paths.table]
    if truth_path is not None and (picture is not None or has_page):
        from linkpose.evaluation.references import read_for_picture

        tables.append(read_for_picture(truth_path, "z"))
    surroundings = Surroundings(prepared.grid, prepared.beacons, paths.tracks[paths.filters[0]].rejected_xy_m)
    if picture is not None:
        from linkpose.page.animation import save_picture

        save_picture(picture, tables, [], surroundings, force)
    scores = paths.score(truth) if truth else {}
    for name, track in paths.tracks.items():
        result = scores.get(name)
        text = json.dumps(_summary(name, track, result)) if json_lines else _sentence(name, track, result)
        click.echo(text, err=str(output) == "-")
    if has_page:
        page.play(tables, [], surroundings, console)


def _refuse_in_stream(given: dict[str, object]) -> None:
    """Raises UsageError for options that a stream does not use."""
    if unused := [option for option, value in given.items() if value is not None]:
        raise click.UsageError(f"a stream from standard input does not use {', '.join(unused)}; leave it out")


def _stream(
    chosen: LocalizationOptions, filters: tuple[Method, ...], beacons_path: Path | None, console: Console
) -> None:
    """Reads rows from standard input and writes a row of CSV for each, until the input ends or the user interrupts."""
    import sys

    from linkpose import precompile
    from linkpose.localization.stream import Stream
    from linkpose.localization.tables import read_beacons

    name: Method = filters[0] if filters else "ekf"
    if len(filters) > 1 or name not in ("ekf", "ukf") or beacons_path is None or chosen.smooth:
        raise click.UsageError("standard input takes --beacons, one --filter ekf or ukf, and no --smooth")
    beacons = read_beacons(beacons_path)
    console.compile([name, precompile.NOISES])
    stream = Stream(name, chosen, beacons, console.report)
    if isinstance(sys.stdin, io.TextIOWrapper):
        sys.stdin.reconfigure(encoding="utf-8-sig", errors="replace")
    with contextlib.suppress(KeyboardInterrupt), ending_well():
        for line in stream.csv_lines(sys.stdin or ()):  # None: it was closed, which is as empty as /dev/null
            click.echo(line)
            sys.stdout.flush()
    for remark in stream.remarks():
        console.report(remark)
    track = stream.track()
    if track is not None:
        console.report(_sentence(name, track, None))


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
        text += f"\n  {counted(track.relocated, 'time')} the pose was lost and found again"
    for verdict in track.consistency.verdicts():
        text += f"\n  {verdict.sentence()}" + (f" ({figures})" if (figures := verdict.figures()) else "")
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
