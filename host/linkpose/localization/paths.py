"""Localization from Python: a log and a map or beacons in, paths out. `linkpose localize` is its first client."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, get_args

import numpy as np

from linkpose.errors import InvalidValue
from linkpose.localization.doubts import (
    doubts,
    robot_doubts,
    scan_doubts,
    with_doubtful_clock,
    with_doubtful_robot,
)
from linkpose.localization.events import Event, Log, LogFile, beacon_name, in_order
from linkpose.localization.grid import GridMap
from linkpose.localization.kalman import CONSTANT_VELOCITY
from linkpose.localization.linalg import Floats
from linkpose.localization.localizer import Method, check, estimate_track, most_at_once
from linkpose.localization.logs import read_log
from linkpose.localization.map_check import check_map
from linkpose.localization.maps import load_map
from linkpose.localization.measuring import default_constants
from linkpose.localization.odometry import with_mice_odometry
from linkpose.localization.options import LocalizationOptions
from linkpose.localization.output import table_of, write_table
from linkpose.localization.plausibility import check_units
from linkpose.localization.self_calibration import CORRECTIONS, applicable, corrected, together
from linkpose.localization.settings import Settings
from linkpose.localization.tables import Beacons, PathScore, Truth, read_beacons, read_truth, score_track
from linkpose.localization.track import Track
from linkpose.localization.tuning import described, likelier_start, tune
from linkpose.localization.vehicle import (
    WALK_M_S,
    WALK_RAD_S,
    first_pose,
    kinds_of,
    never_moves,
    places_from_ranges,
    vehicle_of,
)
from linkpose.presentation import counted
from linkpose.recording.table import Table

if TYPE_CHECKING:
    import pandas

PathName = str | PathLike[str]
Places = Mapping[str, Sequence[float]]
IN_MEMORY = Path("the log")  # names a log that was not read from a file


@dataclass(frozen=True)
class Paths:
    """What `localize` returns: the path of each filter, a row for each instant with a measurement.

    `paths["ekf_x_m"]` is a column of the file that `save` writes, (N,) float64; NaN while the pose is not known.
    `paths.ekf` is the filter's `Track`, with `position_m`, `heading_rad`, `std` and `covariance` as arrays.

    Attributes:
        tracks: the `Track` of each filter by its name.
        log: the log's file.
        remarks: what was changed in the log, assumed, and estimated from it; one sentence each.
        settings: the settings of the first filter.
    """

    tracks: dict[str, Track]
    log: Path
    remarks: tuple[str, ...]
    settings: Settings

    @property
    def filters(self) -> tuple[str, ...]:
        """Names of the filters that ran."""
        return tuple(self.tracks)

    @functools.cached_property
    def table(self) -> Table:
        """All columns with the names of the file that `save` writes."""
        return table_of(self.tracks, self.log)

    @property
    def columns(self) -> tuple[str, ...]:
        """time_s, then <filter>_<state>_<unit>, standard deviations, and covariances of x, y and heading."""
        return tuple(self.table.columns)

    @property
    def time_s(self) -> Floats:
        """(N,) time of each row, s."""
        return next(iter(self.tracks.values())).time_s

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, column: str) -> Floats:
        columns = self.table.columns
        if column not in columns:
            raise KeyError(f"no column {column}; there are {', '.join(columns)}")
        return columns[column]

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __getattr__(self, name: str) -> Track:
        if name.startswith("__") or name == "tracks":  # copy and pickle ask before the fields are set
            raise AttributeError(name)
        for filter_name, track in self.tracks.items():
            if filter_name.replace("-", "_") == name:
                return track
        raise AttributeError(f"no filter {name}; there are {', '.join(self.tracks)}")

    def score(self, truth: Truth | PathName) -> dict[str, PathScore]:
        """The errors of each filter's path against a true path or its file (time_s,x_m,y_m[,z_m][,heading_rad]).

        Raises LinkposeError where they do not meet in time.
        """
        path = truth if isinstance(truth, Truth) else read_truth(Path(truth))
        return {name: score_track(track, path) for name, track in self.tracks.items()}

    def to_pandas(self) -> pandas.DataFrame:
        """A pandas.DataFrame with the same columns. Raises ImportError if pandas is not installed."""
        import pandas

        return pandas.DataFrame(self.table.columns)

    def save(self, path: PathName, *, force: bool = False) -> None:
        """Writes an estimate CSV, as `linkpose localize -o` does. Raises FileExists (unless `force`), CannotWrite."""
        write_table(Path(path), self.table, force)


def localize(
    log: Log | PathName,
    *,
    map: GridMap | PathName | None = None,
    beacons: Places | PathName | None = None,
    odometry: PathName | None = None,
    filters: Sequence[Method] = (),
    **options: Any,
) -> Paths:
    """Estimates the path of a robot from a log of odometry and measurements, and a map or beacons.

    Args:
        log: a CARMEN log, a CSV (`time_s,kind,a,b,c`), or a list of `Event` and `Scan` in order of time.
        map: a map_server YAML file or a `GridMap`, for a log with laser scans.
        beacons: a file `id,x_m,y_m[,z_m]`, or id -> x, y[, z] (m).
        odometry: an estimate of the mice on the log's clock; replaces the log's odometry.
        filters: "scan-match", "ekf", "ukf", "mcl". Default: scan-match for a log with laser scans, ekf for others.
        options: the attributes of `LocalizationOptions`, for example `smooth=True` or `start=(1.0, 2.0, 0.0)`.

    Raises:
        MissingMap, MissingBeacons, MissingStart, NeedsScans, NothingToEstimate, NothingApplied, InvalidValue, FileError
        and other kinds of LinkposeError; TypeError for an option that does not exist.
    """
    _check_names(options)
    return prepare(log, map, beacons, odometry, filters, LocalizationOptions(**options)).run()


def _check_names(options: Iterable[str]) -> None:
    """Raises TypeError, as a Python function does, for a name that is no attribute of `LocalizationOptions`."""
    known = [field.name for field in fields(LocalizationOptions)]
    for name in options:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            cure = f"write {near[0]}" if near else f"the options are {', '.join(known)}"
            raise TypeError(f"localize has no option {name}; {cure}")


@dataclass(frozen=True, slots=True)
class PreparedLog:
    """A log with all that its localization needs, read and checked."""

    log: Log
    origin: Path
    grid: GridMap | None
    beacons: Beacons
    settings: dict[Method, Settings]  # of each filter
    free: tuple[str, ...]  # noises to estimate from the log
    remarks: tuple[str, ...]

    @property
    def estimates_noises(self) -> bool:
        """Whether noises are estimated from the log: with beacons, unless the log holds laser scans."""
        return bool(self.beacons) and "scan" not in kinds_of(self.log)

    def run(self) -> Paths:
        """Runs the filters one after the other. Raises NothingApplied where one could not use any measurement."""
        settings, remarks, is_tuned = self.settings, self.remarks, False
        if self.estimates_noises:
            first = next(iter(settings.values()))
            tuned = tune(self.log, first, self.beacons, self.free)
            is_tuned = tuned is not first
            if is_tuned:
                settings = {name: replace(tuned, start=own.start) for name, own in settings.items()}
                remarks += (f"noises estimated from the log: {described(tuned, self.log)}",)
        tracks: dict[str, Track] = {}
        for method, chosen in settings.items():
            track, log, applied = self._calibrated(method, chosen)
            on_map = ""
            if method == "scan-match" and self.grid is not None:
                share = track.applied / max(track.applied + track.rejected, 1)
                on_map = check_map(log, self.grid, share, str(self.origin))
                remarks += (*([on_map] if on_map else []), *robot_doubts(track.robot_errors, applied))
                remarks += tuple(scan_doubts(log, track))
                track = with_doubtful_robot(with_doubtful_clock(log, track))
            track.check_applied(str(self.origin), method, on_map)
            if is_tuned and not tracks:
                remarks += tuple(doubts(self.log, chosen, track, self.free))
            tracks[method] = track
        return Paths(tracks, self.origin, remarks, next(iter(settings.values())))

    def _calibrated(self, method: Method, settings: Settings) -> tuple[Track, Log, Floats]:
        """The track of a filter, from the log without the errors of the robot's constants that it shows; this log, and
        the errors (5,), as in `RobotErrors`.
        """
        log, applied = self.log, np.zeros(5)
        track = estimate_track(log, method, settings, self.grid, self.beacons, str(self.origin))
        for _ in range(CORRECTIONS):
            errors = applicable(log, track.robot_errors)
            if not errors.any():
                break
            log, applied = corrected(log, errors), together(applied, errors)
            track = estimate_track(log, method, settings, self.grid, self.beacons, str(self.origin))
        return track, log, applied


def prepare(
    log: Log | PathName,
    grid: GridMap | PathName | None,
    beacons: Places | PathName | None,
    odometry: PathName | None,
    filters: Sequence[Method],
    options: LocalizationOptions,
    report: Callable[[str], object] = lambda remark: None,
) -> PreparedLog:
    """Reads and checks what `localize` takes. Raises LinkposeError where the parts do not fit each other.

    `report` receives each remark at once: those on the log explain why it may not fit the rest.
    """
    remarks: list[str] = []

    def note(*texts: str) -> None:
        for text in texts:
            remarks.append(text)
            report(text)

    read = _events(log)
    note(*read.remarks)
    grid = load_map(Path(grid)) if isinstance(grid, str | PathLike) else grid
    places = _places(beacons)
    origin = Path(log) if isinstance(log, str | PathLike) else IN_MEMORY
    events = read.events
    if odometry is not None:
        events = with_mice_odometry(events, Path(odometry))
    kinds = kinds_of(events)
    methods = _methods(filters, "scan-match" if "scan" in kinds else "ekf")
    constants = options.estimate
    if constants is None:
        ranged = {event.beacon for event in events if isinstance(event, Event) and event.kind == "range"}
        constants = default_constants(kinds, len(ranged))
        if constants:
            note("scale error and bias of the ranges are estimated, too")
    # Odometry's own frame is the map's in a simulation only: scan-match checks the whole map instead.
    settings = {
        method: options.settings(constants, None if method == "scan-match" else read.start) for method in methods
    }
    if never_moves(events):
        speed, turn = options.speed_std_m_s or WALK_M_S, options.turn_std_rad_s or WALK_RAD_S
        settings = {
            method: replace(chosen, speed_std_m_s=speed, turn_std_rad_s=turn) for method, chosen in settings.items()
        }
        note("the odometry of the log is always at rest: the motion is taken from the scans; give --start")
    if not read.is_carmen:  # its units are defined, and poses a millisecond apart give any turn rate
        check_units(events, places, str(origin))
    if vehicle_of(kinds) is CONSTANT_VELOCITY:
        settings, side = _with_side(events, settings, places, options.free)
        note(*side)
    for method, chosen in settings.items():
        check(events, method, chosen, grid, places, str(origin))
    if options.correlation and most_at_once(events) == 1:
        note("no two ranges of this log are of one instant, so their correlation changes nothing")
    if vehicle_of(kinds) is CONSTANT_VELOCITY:
        note("the log has no odometry: a constant-velocity model is used, at the mean height of the beacons")
    return PreparedLog(events, origin, grid, places, settings, options.free, tuple(remarks))


def _with_side(
    log: Log, settings: dict[Method, Settings], beacons: Beacons, free: tuple[str, ...]
) -> tuple[dict[Method, Settings], list[str]]:
    """The settings with the likelier start where the first ranges to beacons near one line fit two, and a remark."""
    one = next(iter(settings.values()))
    if one.start is not None or first_pose(log) or len(places := places_from_ranges(log, beacons)) < 2:
        return settings, []
    start = likelier_start(log, one, beacons, free, places)
    if start is None:
        return settings, []
    other = next(place for place in places if place != start)
    remark = (
        f"the beacons are near one line: the start ({start[0]:.1f}, {start[1]:.1f}) m fits the log better than its "
        f"mirror image ({other[0]:.1f}, {other[1]:.1f}) m; give --start if this is the wrong side"
    )
    return {method: replace(chosen, start=start) for method, chosen in settings.items()}, [remark]


def _places(beacons: Places | PathName | None) -> Beacons:
    """Beacons as name -> (x, y, z) in m. Raises InvalidValue, and LinkposeError for a file."""
    if beacons is None:
        return {}
    if isinstance(beacons, str | PathLike):
        return read_beacons(Path(beacons))
    found: Beacons = {}
    for name, place in beacons.items():
        values = [float(value) for value in place]
        if len(values) not in (2, 3):
            raise InvalidValue("beacons", f"has {len(values)} coordinates for {name}; give x, y or x, y, z (m)")
        found[beacon_name(str(name))] = (values[0], values[1], values[2] if len(values) == 3 else 0.0)
    return found


def _events(log: Log | PathName) -> LogFile:
    """The log, read from its file or sorted."""
    if isinstance(log, str | PathLike):
        return read_log(Path(log))
    events, moved = in_order(list(log))
    remarks = (f"{counted(moved, 'event')} moved into the order of time",) if moved else ()
    return LogFile(events, None, remarks)


def _methods(names: Sequence[str], default: Method) -> list[Method]:
    """The filters, each once. Raises InvalidValue."""
    for name in names:
        if name not in get_args(Method):
            raise InvalidValue("filters", f"has {name!r}, which is none of {', '.join(get_args(Method))}")
    return list(dict.fromkeys(cast("Sequence[Method]", names))) or [default]
