"""Measurements in, estimates out: the filters run side by side, live and over a recording."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from linkpose import filters, quantities
from linkpose.errors import CannotRun, FilterCannotRun, InvalidValue, LinkposeError, NoFilterRuns, NoMagnetometer
from linkpose.exclusions import ExcludedMice
from linkpose.mice_findings import mice_findings
from linkpose.recording.csvfile import CsvFile
from linkpose.recording.fixedpoint import format_rows
from linkpose.recording.reader import Recording, RecordingFile, load_recording
from linkpose.recording.units import suspicions
from linkpose.sensors.conversion import TIME_DECIMALS, BoardSettings
from linkpose.sensors.devices import Sensors, found
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.rig import CHAIN_JOINTS, LONGEST_LINK_M, UNKNOWN_JOINT, Joint, Rig, as_rig, to_vector

if TYPE_CHECKING:
    import pandas

    from linkpose.board import Board
    from linkpose.filters.magnetic_heading import FieldRecord


def sensors_of(measurements: Measurements) -> Sensors:
    """Those that ever gave a value in these measurements."""
    imu = Sensors.MPU6050 if np.isfinite(measurements.gyro_rad_s).any() else Sensors(0)
    imu |= Sensors.IMU2 if measurements.has_imu2 else Sensors(0)
    imu |= Sensors.MAG if measurements.mag_fresh.any() else Sensors(0)
    return imu | (Sensors.BMP180 if measurements.baro_fresh.any() else Sensors(0))


def mice_of(measurements: Measurements) -> int:
    """Mouse ports up to the last that ever gave a count."""
    counted = np.isfinite(measurements.mice_counts).any(axis=(0, 2))
    return int(np.flatnonzero(counted).max(initial=-1)) + 1


class FoundJ2s(NamedTuple):
    """J2S (the vector from the joint centre to the sensor) as a filter has estimated it, in the sensor's axes."""

    mean_m: Floats  # (3,)
    std_m: Floats  # (3,) of each axis
    worst_std_m: float  # in the direction that is known least
    worst_axis: str  # x, y or z, the axis nearest to this direction

    @staticmethod
    def of(mean_m: Floats, covariance_m2: Floats) -> FoundJ2s:
        values, vectors = np.linalg.eigh(covariance_m2)
        axis = "xyz"[int(np.argmax(np.abs(vectors[:, -1])))]
        return FoundJ2s(mean_m, np.sqrt(np.diag(covariance_m2)), float(np.sqrt(values[-1])), axis)


# Samples: a filter takes about 1 ms for them, ten times as long as a thread needs to start. Doubling it changes nothing
# that can be measured.
_LONG_BLOCK = 1000
# A scale of the mice is reported if it differs from 1 by more than this many standard deviations, and by more than the
# gyro's scale error.
_SCALE_Z, _SCALE_LEAST = 3.0, 0.01


class Estimator:
    """Runs filters over consecutive blocks of measurements."""

    def __init__(self, names: Sequence[str], rig: Rig, sensors: Sensors, mice: int = 0) -> None:
        """The filters of these names, or all that can run when there is none; `mice` is how many ports have one.

        Raises UnknownFilter, FilterCannotRun when a named filter cannot run, NoFilterRuns when none can. `left_out`
        maps each filter that cannot run to the reason.
        """
        self._rig, self._sensors = rig, sensors
        self.left_out: dict[str, CannotRun] = {}
        self.filters: list[filters.Filter] = []
        for name in dict.fromkeys(name.replace("_", "-") for name in names or filters.NAMES):
            try:
                self.filters.append(filters.create(name, rig, sensors, mice))
            except CannotRun as reason:
                if names:
                    raise FilterCannotRun(name, reason) from None
                self.left_out[name] = reason
        if not self.filters:
            raise NoFilterRuns(self.left_out)
        self._set_columns()

    @staticmethod
    def for_board(names: Sequence[str], board: Board, chain_joint: str | None = None) -> Estimator:
        """An estimator for a connected board's stream; `chain_joint` as for `with_chain_joint`.

        Raises as the constructor does.
        """
        settings = BoardSettings.of(board.hello)
        rig = with_chain_joint(board.rig.with_delay(settings.imu_delay_s), chain_joint)
        return Estimator(names, rig, found(board.hello), settings.mouse_ports)

    @staticmethod
    def for_recording(names: Sequence[str], rig: Rig, recording: RecordingFile) -> Estimator:
        """An estimator for the sensors and mice that gave values in a recording. Raises as the constructor does."""
        survey = recording.survey
        sensors = Sensors.MPU6050 if survey.has_gyro else Sensors(0)
        sensors |= Sensors.IMU2 if survey.has_gyro2 else Sensors(0)
        sensors |= Sensors.MAG if survey.has_mag else Sensors(0)
        return Estimator(names, rig, sensors | (Sensors.BMP180 if survey.has_pressure else Sensors(0)), survey.mice)

    @staticmethod
    def for_measurements(names: Sequence[str], rig: Rig, measurements: Measurements) -> Estimator:
        """An estimator for the sensors and mice that gave values. Raises as the constructor does."""
        return Estimator(names, rig, sensors_of(measurements), mice_of(measurements))

    def _set_columns(self) -> None:
        self.columns = ["time_s", *(column for f in self.filters for column in f.columns)]
        self._decimals = np.array([_decimals(name) for name in self.columns], dtype=np.int64)
        self._excluded = ExcludedMice(self.columns)

    @property
    def rig(self) -> Rig:
        """The rig in force."""
        return self._rig

    def smooth(self) -> None:
        """Replaces each filter that has a smoother by it. `process` then requires a whole recording.

        Raises LinkposeError where none of the filters has one.
        """
        smoothable = [name for name, able in filters.REGISTRY.items() if able.smoother]
        names = [f.name for f in self.filters]
        if not set(smoothable) & set(names):
            reasons = "".join(f"; {self.left_out[name]}" for name in smoothable if name in self.left_out)
            raise LinkposeError(f"no filter that can be smoothed ({', '.join(smoothable)}) runs{reasons}")
        self.filters = [filters.create_smoother(f.name, self._rig) if f.name in smoothable else f for f in self.filters]

    def hold_heading(self, port: str | None = None) -> None:
        """Corrects the yaw of all filters with the magnetometer. Call it after `smooth` and before `process`.

        `port` is the port of the board; None for a recording.
        Raises NoMagnetometer, UncalibratedMagnetometer, and CannotRun where no filter estimates a yaw.
        """
        from linkpose.filters.magnetic_heading import MagneticHeading, has_yaw

        if not self._sensors & Sensors.MAG:
            raise NoMagnetometer(port)
        if not any(map(has_yaw, self.filters)):
            raise CannotRun("none of the filters that run estimates a yaw since the start")
        self.filters = [MagneticHeading(f, self._rig.mag) if has_yaw(f) else f for f in self.filters]
        self._set_columns()

    @property
    def magnetic_field(self) -> FieldRecord | None:
        """The magnetic field as recorded by the first filter that uses it; None if no filter does."""
        from linkpose.filters.magnetic_heading import MagneticHeading

        return next((f.found for f in self.filters if isinstance(f, MagneticHeading)), None)

    def warm_up(self) -> None:
        """Compiles all that `process` and `text` need, or loads it compiled: no sample waits for a compiler."""
        filters.warm_up(f.name for f in self.filters)
        self.text(np.zeros((1, len(self.columns))))

    def process(self, block: Measurements) -> Floats:
        """The estimates (N, columns) at the next N samples. The filters run in parallel over a long block."""
        workers = 1 if len(block) < _LONG_BLOCK else min(os.cpu_count() or 1, len(self.filters))
        if workers < 2:
            parts = [f.process(block) for f in self.filters]
        else:
            with ThreadPoolExecutor(workers) as pool:
                parts = list(pool.map(lambda f: f.process(block), self.filters))
        estimates = side_by_side(block.time_s, parts)
        self.count_excluded(block, estimates)
        return estimates

    def count_excluded(self, block: Measurements, estimates: Floats) -> None:
        """Counts the mice that the filters exclude in the estimates (N, columns) of a block of N samples."""
        self._excluded.count(block, estimates)

    @property
    def excluded(self) -> ExcludedMice:
        """The mice that were excluded so far, by the columns that show it, or else by the first filter that does it."""
        if not self._excluded.columns:
            for f in self.filters:
                if isinstance(f, filters.ExcludesMice):
                    return f.excluded_mice
        return self._excluded

    @property
    def found_j2s(self) -> FoundJ2s | None:
        """J2S as estimated so far; None where it was known, or where no filter estimates it."""
        if self._rig.joint.known_j2s_m is not None:
            return None
        for f in self.filters:
            f = getattr(f, "inner", f)
            if isinstance(f, filters.FindsJ2s):
                return FoundJ2s.of(*f.j2s_m)
        return None

    @property
    def remarks(self) -> list[str]:
        """What the filters found wrong with the measurements so far."""
        return [remark for f in self.filters if isinstance(f, filters.HasRemarks) for remark in f.remarks]

    @property
    def mice_scale(self) -> tuple[float, float] | None:
        """Counts per metre of the mice relative to the rig file, and its standard deviation, where they differ.

        None where no filter compares the mice with the gyro, or where the difference is not significant.
        """
        for f in self.filters:
            if isinstance(f, filters.FindsMiceScale):
                factor, std = f.scale_change
                if abs(factor - 1.0) > max(_SCALE_Z * std, _SCALE_LEAST):
                    return factor, std
        return None

    @property
    def gyro_jumps(self) -> filters.GyroJumps | None:
        """Jumps of the gyro's bias that the mice have shown; None where no filter compares them, or without a jump."""
        for f in self.filters:
            if isinstance(f, filters.FindsGyroJumps) and f.gyro_jumps.times:
                return f.gyro_jumps
        return None

    @property
    def moved_mice(self) -> tuple[filters.MovedMouse, ...]:
        """Mice that the first filter that estimates their places shows elsewhere than the rig file states."""
        for f in self.filters:
            if isinstance(f, filters.FindsMovedMice):
                return f.moved_mice
        return ()

    @property
    def mouse_causes(self) -> dict[int, str]:
        """Why mice were excluded (1 for the first; 0: all together), by the first filter that can state it."""
        causes: dict[int, str] = {}
        for f in self.filters:
            if isinstance(f, filters.ExplainsMice):
                causes = f.mouse_causes | causes
        return causes

    @property
    def mice_remarks(self) -> list[str]:
        """Faults that mice share, by the filter that finds most."""
        return max((f.mice_remarks for f in self.filters if isinstance(f, filters.RemarksOnMice)), key=len, default=[])

    @property
    def outcome(self) -> dict[str, Any]:
        """Entries of a file's closing line: rejected samples, and what the filters found of J2S, mice and field."""
        outcome: dict[str, Any] = {"rejected": {f.name: f.rejected for f in self.filters}}
        if found := self.found_j2s:
            outcome["j2s_m"], outcome["j2s_std_m"] = ([round(v, 6) for v in vector.tolist()] for vector in found[:2])
        if self.excluded.samples:
            outcome["excluded_mice"] = self.excluded.samples
            outcome["excluded_mice_since_s"] = {name: round(at, 3) for name, at in self.excluded.first_s.items()}
        if jumps := self.gyro_jumps:
            last = {"last_rad_s": round(jumps.last_rad_s, 5), "found_s": round(jumps.last_time_s, 3)}
            outcome["gyro_jumps"] = {"count": jumps.times} | last
        if self.mice_scale:
            outcome["mice_scale"], outcome["mice_scale_std"] = (round(value, 5) for value in self.mice_scale)
        if self.magnetic_field:
            outcome["mag"] = self.magnetic_field.as_dict()
        return outcome

    def text(self, estimates: Floats) -> bytes:
        """Estimates as lines of CSV."""
        return format_rows(estimates, self._decimals)

    def objects(self, estimates: Floats) -> list[dict[str, float | None]]:
        """Estimates as objects with the CSV's keys and digits; a missing value is None."""
        places = self._decimals.tolist()
        return [
            {
                name: round(value, digits) if value == value else None
                for name, value, digits in zip(self.columns, row, places, strict=True)
            }
            for row in estimates.tolist()
        ]


class EstimateWriter(CsvFile):
    """An estimate CSV under way. Raises LinkposeError as `CsvFile` does."""

    def __init__(
        self, path: Path, head: dict[str, Any], columns: Sequence[str], force: bool, plain: bool = False
    ) -> None:
        super().__init__(path, "estimate", head, columns, force, plain)


class FilterEstimates:
    """The columns of one filter as attributes: `height_m`, `height_std_m`, …, each (N,) float64."""

    def __init__(self, columns: dict[str, Floats]) -> None:
        self._columns = columns

    @property
    def columns(self) -> tuple[str, ...]:
        """Their names, without the filter's."""
        return tuple(self._columns)

    def __getattr__(self, name: str) -> Floats:
        try:
            return self.__dict__["_columns"][name]  # type: ignore[no-any-return]
        except KeyError:
            raise AttributeError(f"no {name}; there are {', '.join(self.columns)}") from None

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self._columns]


@dataclass(frozen=True)
class Estimates:
    """What `estimate` returns: a table of N rows, one per sample.

    `estimates["joint_inertial_height_m"]` and `estimates.joint_inertial.height_m` are the same column, (N,) float64.
    NaN means that the value is not known. Each quantity has its standard deviation beside it (`height_std_m`).

    Attributes:
        columns: names of the columns: time_s, then <filter>_<quantity>_<unit>.
        values: (N, len(columns)), all columns.
        filters: names of the filters that ran, the most accurate one first.
        rejected: number of samples that each filter could not use.
        left_out: for each filter that did not run, the error that explains why.
        excluded_mice: for "mouse1", ..., the number of valid samples that a filter excluded.
        found_j2s: the estimated J2S (m) and its standard deviation; None if J2S was known.
        magnetic_field: what was found of the magnetic field; None without `mag`.
        rig: sensor placement and calibration in force.
        remarks: faults of the measurements, one sentence each.
    """

    columns: tuple[str, ...]
    values: Floats
    filters: tuple[str, ...]
    rejected: dict[str, int]
    left_out: dict[str, CannotRun]
    excluded_mice: dict[str, int]
    found_j2s: FoundJ2s | None
    magnetic_field: FieldRecord | None
    rig: Rig
    remarks: tuple[str, ...] = ()

    @property
    def time_s(self) -> Floats:
        """(N,) time of each row, s."""
        return self["time_s"]

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, column: str) -> Floats:
        try:
            return self.values[:, self.columns.index(column)]
        except ValueError:
            raise KeyError(f"no column {column}; there are {', '.join(self.columns)}") from None

    def __getattr__(self, name: str) -> FilterEstimates:
        columns = self.__dict__.get("columns", ())
        found = {c: at for at, c in enumerate(columns) if (split := quantities.split(c)) and split.prefix == name}
        if not found:
            raise AttributeError(f"no filter {name}; there are {', '.join(self.__dict__.get('filters', ()))}")
        return FilterEstimates({c.removeprefix(f"{name}_"): self.values[:, at] for c, at in found.items()})

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def to_pandas(self) -> pandas.DataFrame:
        """A pandas.DataFrame with the same columns. Raises ImportError if pandas is not installed."""
        import pandas

        return pandas.DataFrame(self.values, columns=list(self.columns))

    def save(self, path: str | PathLike[str], *, force: bool = False) -> None:
        """Writes an estimate CSV, as `linkpose estimate -o` does. Raises FileExists (unless `force`), CannotWrite."""
        head = {"filters": list(self.filters), "rig": self.rig.as_dict()}
        decimals = np.array([_decimals(name) for name in self.columns], dtype=np.int64)
        with EstimateWriter(Path(path), head, self.columns, force) as writer:
            writer.write(format_rows(self.values, decimals))
            writer.close({"rows": len(self), "rejected": self.rejected})


def estimate(
    source: Recording | Measurements | str | PathLike[str],
    filters: str | Sequence[str] | None = None,
    *,
    j2s_m: Sequence[float] | Literal["auto"] | None = None,
    j2s_std_m: float | None = None,
    joint: Literal["ball", "hinge"] | None = None,
    rig: Rig | str | PathLike[str] | None = None,
    smooth: bool = False,
    mag: bool = False,
) -> Estimates:
    """Runs filters over a recording or over measurements, and returns their estimates.

    Args:
        source: what `load` returned, `Measurements`, or the path of a recording.
        filters: a name such as "joint-inertial", or several; None: all that the sensors and the rig support.
        j2s_m: J2S, the vector from the joint centre to the sensor in the sensor's axes (m); "auto" estimates it from
            the motion. None: the rig's.
        j2s_std_m: standard deviation of `j2s_m`, each axis (m). Default: 0.1 mm.
        joint: the joint between the two links of a chain, "ball" or "hinge". Default: the rig's.
        rig: sensor placement and calibration, or the path of a rig.toml. Default: the recording's; for `Measurements`,
            an empty rig.
        smooth: use a smoother, which also uses later measurements, for each filter that has one.
        mag: correct the yaw with the magnetometer. The rig must contain the magnetometer's calibration.

    Warns:
        UserWarning where values contradict their unit (g in place of m/s², milliseconds), where the recording is
        faulty, where the measurements do not fit what a filter assumes, and where mice or gyro failed; the sentences
        are in `remarks`, too.

    Raises:
        UnknownFilter, FilterCannotRun (a named filter), NoFilterRuns, InvalidValue, FileError; for `mag`:
        NoMagnetometer, UncalibratedMagnetometer, CannotRun (no filter estimates a yaw).
    """
    measurements, own, delay_s, remarks = _input(source)
    in_force = as_rig(rig, own).with_delay(delay_s)
    first_joint = _joint(j2s_m, j2s_std_m)
    if first_joint is not None:
        in_force = replace(in_force, joint=first_joint)
    in_force = with_chain_joint(in_force, joint)
    estimator = Estimator.for_measurements(
        [filters] if isinstance(filters, str) else filters or (), in_force, measurements
    )
    if smooth:
        estimator.smooth()
    if mag:
        estimator.hold_heading()
    values = estimator.process(measurements)
    remarks = list(dict.fromkeys([*remarks, *mice_findings(estimator), *estimator.remarks]))
    for remark in remarks:
        warnings.warn(remark, stacklevel=2)
    return Estimates(
        tuple(estimator.columns),
        values,
        tuple(f.name for f in estimator.filters),
        {f.name: f.rejected for f in estimator.filters},
        estimator.left_out,
        estimator.excluded.samples,
        estimator.found_j2s,
        estimator.magnetic_field,
        in_force,
        tuple(remarks),
    )


def _input(
    source: Recording | Measurements | str | PathLike[str],
) -> tuple[Measurements, Rig | None, float | None, list[str]]:
    """Measurements, their own rig and delay (s), and remarks on them. Raises InvalidValue, and FileError for a path."""
    recording = load_recording(source) if isinstance(source, str | PathLike) else source
    if isinstance(recording, Recording):
        return recording.measurements, recording.rig, recording.imu_delay_s, [*recording.remarks]
    if not isinstance(recording, Measurements):
        raise InvalidValue(
            "source",
            f"is of the type {type(source).__name__}; it must be a path, a Recording or Measurements: "
            "Measurements.from_imu(time_s, accel_m_s2, gyro_rad_s) makes them from arrays",
        )
    if not len(recording):
        raise InvalidValue("source", "holds no sample")
    return recording, None, None, [found.sentence for found in suspicions(recording)]


def with_chain_joint(rig: Rig, joint: str | None) -> Rig:
    """The rig with another joint between the links of its chain; None keeps it. Raises InvalidValue."""
    if joint is None:
        return rig
    if joint not in CHAIN_JOINTS:
        raise InvalidValue("joint", f'is {joint!r}; it must be "ball" or "hinge"')
    return replace(rig, chain=replace(rig.chain, joint=joint))


def _joint(j2s_m: Sequence[float] | Literal["auto"] | None, j2s_std_m: float | None) -> Joint | None:
    """The joint that the arguments of `estimate` describe. Raises InvalidValue."""
    if j2s_m is None or isinstance(j2s_m, str):
        if j2s_std_m is not None:
            raise InvalidValue("j2s_std_m", "describes a J2S that is given: give j2s_m too")
        if j2s_m not in (None, "auto"):
            raise InvalidValue("j2s_m", f'is {j2s_m!r}; it must be three numbers (m) or "auto"')
        return None if j2s_m is None else UNKNOWN_JOINT
    try:
        vector = np.asarray(j2s_m, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InvalidValue("j2s_m", f"is {j2s_m!r}; it must be three finite numbers (m)")
    if np.linalg.norm(vector) > LONGEST_LINK_M:
        raise InvalidValue("j2s_m", f"is {j2s_m!r}, longer than {LONGEST_LINK_M:.0f} m; it must be in metres")
    if j2s_std_m is not None and not 0 < j2s_std_m < np.inf:
        raise InvalidValue("j2s_std_m", f"is {j2s_std_m!r}; it must be above 0 (m)")
    joint = Joint(to_vector(vector)) if j2s_std_m is None else Joint(to_vector(vector), j2s_std_m)
    if joint.is_too_short:
        raise InvalidValue("j2s_m", f'is {j2s_m!r}, the joint\'s centre; if J2S is unknown, give "auto"')
    return joint


def side_by_side(time_s: Floats, parts: Sequence[Floats]) -> Floats:
    """Times (N,) and the columns (N, K) of each filter as one table."""
    return np.concatenate([time_s[:, None], *parts], axis=1)


def _decimals(column: str) -> int:
    return TIME_DECIMALS if column == "time_s" else quantities.decimals(column)
