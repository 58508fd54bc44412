"""`linkpose localize`: where the robot was, from its log and a map or beacons."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click

from linkpose import __version__
from linkpose.cli import options
from linkpose.cli.patience import while_compiling

if TYPE_CHECKING:
    from linkpose.localization.kalman import FilterName
    from linkpose.localization.localizer import Settings, Track
    from linkpose.localization.tables import Score

RANGE_STD_M = 0.1
POSITIVE = options.FiniteRange(min=0, min_open=True)


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
    type=click.Choice(["ekf", "ukf"]),
    multiple=True,
    default=["ukf"],
    show_default=True,
    help="May be repeated.",
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
    help="Refuse a measurement that so many of the good ones come nearer than, by χ² of d².",
)
@click.option("--range-std", type=POSITIVE, default=RANGE_STD_M, show_default=True, help="σ of a range (m).")
@click.option(
    "--range-growth",
    type=options.FiniteRange(min=0),
    default=0.02,
    show_default=True,
    help="k of --noise affine (m/m).",
)
@click.option("--eta", type=POSITIVE, default=1.0, show_default=True, help="η of --noise adaptive.")
@click.option("--bearing-std", type=POSITIVE, default=0.05, show_default=True, help="σ of a bearing (rad).")
@click.option("--depth-std", type=POSITIVE, default=0.05, show_default=True, help="σ of a depth (m).")
@click.option("--attitude-std", type=POSITIVE, default=0.01, show_default=True, help="σ of a yaw reading (rad).")
@click.option(
    "--speed-std", type=POSITIVE, default=0.1, show_default=True, help="σ of one odometry sample's speed (m/s)."
)
@click.option(
    "--turn-std", type=POSITIVE, default=0.1, show_default=True, help="σ of one odometry sample's turn rate (rad/s)."
)
@click.option(
    "--velocity-std", type=POSITIVE, default=0.1, show_default=True, help="σ of one velocity sample on each axis (m/s)."
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
    type=click.Choice(["scale", "bias"]),
    multiple=True,
    help="Estimate the range sensor's scale error or bias, too. May be repeated.",
)
@click.option(
    "--start", type=Numbers("X,Y,HEADING"), help="Pose at the log's start (m, m, rad); by default the log's own."
)
@click.option(
    "--start-std", type=Numbers("M,RAD"), default="0.5,0.1", show_default=True, help="How far the start may be off."
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
@click.option("-o", "--output", type=options.FILE, metavar="OUT.csv", help="Write the estimated path.")
@click.option(
    "--truth", "truth_path", type=options.FILE, metavar="T.csv", help="True path: time_s,x_m,y_m[,z_m][,heading_rad]."
)
@options.force
@options.as_json
def command(
    log: Path,
    map_path: Path | None,
    beacons_path: Path | None,
    odometry_path: Path | None,
    filters: tuple[str, ...],
    output: Path | None,
    truth_path: Path | None,
    force: bool,
    json_lines: bool,
    **settings: Any,
) -> None:
    """Estimate a robot's path from a LOG with an extended or an unscented Kalman filter.

    LOG is a CARMEN log (ODOM, FLASER, ROBOTLASER1) or a CSV with one measurement a row: time_s,kind,a,b,c, where kind
    is odometry, range, bearing_range, depth, velocity, attitude or pose.
    """
    if map_path is None and beacons_path is None:
        raise click.UsageError("nothing to localise against; add --map MAP.yaml or --beacons BEACONS.csv")
    from linkpose.localization.carmen import is_carmen, read_carmen
    from linkpose.localization.events import read_events
    from linkpose.localization.grid import load_map
    from linkpose.localization.localizer import localize, most_at_once, warm_up
    from linkpose.localization.tables import read_beacons, read_truth, score

    grid = load_map(map_path) if map_path else None
    beacons = read_beacons(beacons_path) if beacons_path else None
    truth = read_truth(truth_path) if truth_path else None
    events, own_start = read_carmen(log) if is_carmen(log) else (read_events(log), None)
    if odometry_path is not None:
        from linkpose.localization.odometry import with_mice_odometry

        events = with_mice_odometry(events, odometry_path)
    chosen = _settings(settings, own_start)
    if chosen.ranges.correlation and most_at_once(events) == 1:
        click.echo("no two ranges of this log are of one instant: --correlation changes nothing", err=True)
    names = cast("list[FilterName]", list(dict.fromkeys(filters)))
    with while_compiling():
        warm_up(names)
    tracks: dict[str, Track] = {name: localize(events, name, chosen, grid, beacons, str(log)) for name in names}
    if output is not None:
        write_tracks(output, tracks, log, force)
    for name, track in tracks.items():
        result = score(track.time_s, track.position_m, track.heading_rad, truth) if truth else None
        click.echo(json.dumps(_summary(name, track, result)) if json_lines else _sentence(name, track, result))


def _settings(given: dict[str, Any], own_start: tuple[float, float, float] | None) -> Settings:
    from linkpose.localization.kalman import Transform
    from linkpose.localization.localizer import Settings
    from linkpose.localization.noise import RangeNoise

    scaled = given["transform"] == "scaled"
    if min(given["start_std"]) <= 0:
        raise click.BadParameter(
            "both must be above 0: without any doubt of the start, nothing could correct it", param_hint="--start-std"
        )
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
        start=given["start"] or own_start,
        start_std=given["start_std"],
    )


def _summary(name: str, track: Track, result: Score | None) -> dict[str, object]:
    row: dict[str, object] = {
        "filter": name,
        "updates": track.applied,
        "rejected": track.rejected,
        "widened": track.widened,
    }
    if result is not None:
        row |= {"position_rmse_m": result.position_rmse_m, "position_max_m": result.position_max_m}
        if result.heading_rmse_rad is not None:
            row["heading_rmse_rad"] = result.heading_rmse_rad
    return row


def _sentence(name: str, track: Track, result: Score | None) -> str:
    last = ", ".join(
        f"{state} {value:.3f} ± {std:.3f}"
        for state, value, std in zip(track.names, track.state[-1], track.std[-1], strict=True)
    )
    text = f"{name}: {track.applied} measurements applied, {track.rejected} rejected by the gate\n  at the end {last}"
    if track.widened:
        text += f"\n  lost {track.widened} times: most was refused, so the pose was opened again"
    if result is not None:
        text += f"\n  position error {result.position_rmse_m:.3f} m rms, {result.position_max_m:.3f} m at most"
        if result.heading_rmse_rad is not None:
            text += f"; heading {result.heading_rmse_rad:.4f} rad rms"
    return text


def write_tracks(path: Path, tracks: dict[str, Track], log: Path, force: bool) -> None:
    """The estimate CSV: `time_s`, then for each filter its states and their standard deviations."""
    import numpy as np

    from linkpose.recording.csvfile import CsvFile

    first = next(iter(tracks.values()))
    columns, parts = ["time_s"], [first.time_s[:, np.newaxis]]
    for name, track in tracks.items():
        columns += [f"{name}_{state}" for state in track.names] + [
            f"{name}_{_std_name(state)}" for state in track.names
        ]
        parts += [track.state, track.std]
    table = np.hstack(parts)
    line = ",".join(["%.6f"] + ["%.9g"] * (len(columns) - 1)) + "\n"
    with CsvFile(
        path, "estimate", {"software": __version__, "log": log.name, "filters": list(tracks)}, columns, force
    ) as file:
        file.write("".join(line % tuple(row) for row in table.tolist()))
        file.close({"rows": len(table), **{f"{name}_rejected": track.rejected for name, track in tracks.items()}})


def _std_name(state: str) -> str:
    """The unit stays last: x_m -> x_std_m."""
    for unit in ("rad_s", "rad", "m"):
        if state.endswith(f"_{unit}"):
            quantity = state.removesuffix(f"_{unit}")
            return f"{quantity}_std_{unit}"
    return f"{state}_std"
