"""rig.toml: sensor placement and calibration. Calibration writes it; the filters read it."""

from __future__ import annotations

import contextlib
import difflib
import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from os import PathLike
from pathlib import Path
from typing import Any

from linkpose.errors import CannotWrite, FileFormatError, InvalidValue
from linkpose.inputs import read_bytes
from linkpose.outputs import replace_file
from linkpose.sensors.devices import MAX_MICE

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

# Endings of keys whose values must be above 0.
_POSITIVE = (
    "_noise_rad_s", "_noise_m_s2", "_noise_Pa", "_std_m", "_std_rad_s", "_std_m_s2", "counts_per_m", "field_uT",
    "residual_uT",
)  # fmt: skip
_LARGEST = 1e9  # of any number in a rig file, in the unit of its key: larger ones overflow in the filters' squares

CHAIN_JOINTS = ("ball", "hinge")
FIRST_JOINTS = ("fixed", "free")  # from which the first link hangs
_MOST_PARTS = 64  # of a dotted key, and dots between two separators; linkpose's keys have two parts
_UNIT = 0.01  # by which the length of a quaternion may differ from 1: numbers typed with two digits
_SHORTEST_AXIS = 1e-6  # whose direction a vector still gives

# A J2S with a larger standard deviation (m, each axis) is only an initial value; filters that require a known
# J2S do not run.
_GUESS_M = 0.1
LONGEST_LINK_M = 10.0  # of a J2S that a user gives: a longer one is in centimetres or millimetres
SHORTEST_LINK_M = 0.001  # of a known J2S: nobody measures a shorter one; it was left at 0


@dataclass(frozen=True, slots=True)
class Joint:
    """The joint of the link. J2S is the vector from the joint centre to the sensor."""

    j2s_m: Vector | None = None  # J2S in the sensor's frame (m); None if unknown
    j2s_std_m: float | Vector = 0.0001  # its standard deviation (m), one for all axes or one for each

    def __post_init__(self) -> None:
        """Numbers become floats: the filters are compiled for them, and would be compiled again for integers."""
        if self.j2s_m is not None:
            x, y, z = self.j2s_m
            object.__setattr__(self, "j2s_m", (float(x), float(y), float(z)))

    @property
    def known_j2s_m(self) -> Vector | None:
        """J2S; None if it is unknown or only an initial value."""
        return self.j2s_m if self.largest_std_m <= _GUESS_M else None

    @property
    def largest_std_m(self) -> float:
        """Standard deviation along the axis that is known least (m)."""
        return max(self.std_of_axes_m)

    @property
    def is_too_short(self) -> bool:
        """Whether J2S is said to be known, and places the sensor in the joint's centre."""
        return self.known_j2s_m is not None and math.hypot(*self.known_j2s_m) < SHORTEST_LINK_M

    @property
    def std_of_axes_m(self) -> Vector:
        """Standard deviation along each axis (m)."""
        std = self.j2s_std_m
        x, y, z = std if isinstance(std, tuple) else (std, std, std)
        return float(x), float(y), float(z)


# An unknown J2S, at most some metres long. Filters with the capability "guess" estimate it.
UNKNOWN_JOINT = Joint((0.0, 0.0, 0.0), 1.0)


@dataclass(frozen=True, slots=True)
class Imu:
    """Calibration of the MPU-6050: acceleration = (measured - offset) / scale, rate = measured - bias.

    The noises are the standard deviations of one sample at rest. The defaults are typical figures of [MPU-6050].
    Without standard deviations of bias and offset, the filters assume that the sensor may be uncalibrated.
    """

    gyro_bias_rad_s: Vector = (0.0, 0.0, 0.0)
    gyro_bias_std_rad_s: float | None = None  # 1σ of the bias that remains, each axis
    accel_offset_m_s2: Vector = (0.0, 0.0, 0.0)
    accel_offset_std_m_s2: float | None = None  # 1σ of the offset that remains, each axis
    accel_scale: Vector = (1.0, 1.0, 1.0)
    gyro_noise_rad_s: float = math.radians(0.05)
    accel_noise_m_s2: float = 0.04
    delay_s: float | None = None  # delay of the readings by the low-pass filter; None: follows from the DLPF setting

    @property
    def known_delay_s(self) -> float:
        """The delay (s); 0 if it is unknown."""
        return self.delay_s or 0.0


@dataclass(frozen=True, slots=True)
class Chain:
    """Two links with a sensor on each, and the joint between them.

    r1 and r2 are the vectors from the joint centre to each sensor, axis1 and axis2 the axis of a hinge, each in the
    sensor's own axes. The angle of a hinge grows as link 2 turns about axis2 by the right-hand rule.
    """

    joint: str = "ball"  # or "hinge"
    r1_m: Vector | None = None  # None: unknown; the chain filter estimates it
    r1_std_m: float | Vector = 0.005  # standard deviation (m), one for all axes or one for each; measured with a ruler
    r2_m: Vector | None = None
    r2_std_m: float | Vector = 0.005
    axis1: Vector | None = None  # of any length; None: unknown
    axis1_std_deg: float = 3.0  # standard deviation about each axis across it
    axis2: Vector | None = None
    axis2_std_deg: float = 3.0
    # Angles of a ball joint. None: the length is vertical at the first sample, flexion is about an axis of sensor 1,
    # and the joint is neutral at the first sample.
    long_axis: Vector | None = None  # of link 1 in sensor 1's axes, away from link 2; of any length
    flexion_axis: Vector | None = None  # in sensor 1's axes
    neutral: Quaternion | None = None  # rotation from sensor 2's axes into sensor 1's: w, x, y, z


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of the inertial sensor as `calibrate noise` measures it, by axis; None if it is unknown.

    Coefficients of [IEEE-952]: density of the white noise N, bias instability B, rate (or acceleration) random walk K,
    and the change of the bias with the temperature of the chip. B is the least Allan deviation / 0.664.
    """

    gyro_density_rad_s_sqrtHz: Vector | None = None
    gyro_instability_rad_s: Vector | None = None
    gyro_walk_rad_s_sqrts: Vector | None = None
    gyro_drift_rad_s_degC: Vector | None = None
    accel_density_m_s2_sqrtHz: Vector | None = None
    accel_instability_m_s2: Vector | None = None
    accel_walk_m_s2_sqrts: Vector | None = None
    accel_drift_m_s2_degC: Vector | None = None


@dataclass(frozen=True, slots=True)
class Mag:
    """Calibration of the magnetometer: field in the inertial sensor's axes = matrix (measured − hard iron).

    `matrix` holds the rows of the soft-iron correction and of the rotation into the inertial sensor's axes.
    """

    hard_iron_uT: Vector | None = None  # None: the magnetometer is not calibrated
    matrix_x: Vector = (1.0, 0.0, 0.0)
    matrix_y: Vector = (0.0, 1.0, 0.0)
    matrix_z: Vector = (0.0, 0.0, 1.0)
    field_uT: float = 50.0  # strength of the earth's field where the calibration was recorded
    residual_uT: float = 1.0  # rms of what the calibration leaves of each reading
    dip_deg: float | None = None  # angle of the field below the horizon; None if it is unknown


@dataclass(frozen=True, slots=True)
class Baro:
    """The BMP180's pressure noise: standard deviation of one reading at rest (Pa); 3 Pa is 0.25 m."""

    pressure_noise_Pa: float = 3.0


@dataclass(frozen=True, slots=True)
class Mouse:
    """A mouse under the robot: position (m) and mounting angle (degrees) in the robot's frame, counts per metre."""

    x_m: float
    y_m: float
    angle_deg: float = 0.0
    counts_per_m: float = 8000.0


@dataclass(frozen=True, slots=True)
class Rig:
    """Sensor placement and calibration, the contents of a rig.toml. Every value has a default.

    `joint` holds J2S (the vector from the joint centre to the sensor) in the first sensor's axes (m), `chain` the joint
    between two links, `mouse` each mouse in the robot's frame (m, degrees). `imu`, `noise`, `mag` and `baro` are
    calibrations of the sensors. Raises InvalidValue for more mice than a board reads.
    """

    joint: Joint = field(default_factory=Joint)
    imu: Imu = field(default_factory=Imu)
    noise: Noise = field(default_factory=Noise)
    mag: Mag = field(default_factory=Mag)
    baro: Baro = field(default_factory=Baro)
    mouse: tuple[Mouse, ...] = ()
    chain: Chain = field(default_factory=Chain)

    def __post_init__(self) -> None:
        if len(self.mouse) > MAX_MICE:
            raise InvalidValue(
                "mouse", f"has {len(self.mouse)} entries, and a board reads {MAX_MICE} mice at most: delete the others"
            )

    def with_j2s(self, j2s_m: Vector) -> Rig:
        """The rig with another J2S, assumed accurate to 0.1 mm (1σ)."""
        return replace(self, joint=Joint(j2s_m))

    def with_delay(self, delay_s: float | None) -> Rig:
        """The rig for inertial readings of this mean age (s), None: unknown. A delay that the rig states is kept."""
        if delay_s is None or self.imu.delay_s is not None:
            return self
        return replace(self, imu=replace(self.imu, delay_s=delay_s))

    def as_dict(self) -> dict[str, Any]:
        """The rig as plain tables, for JSON and TOML."""
        tables = asdict(self)
        tables["mouse"] = list(tables["mouse"])
        if self.joint.j2s_m is None:
            del tables["joint"]
        if self.mag.hard_iron_uT is None:
            del tables["mag"]
        if self.chain == Chain():
            del tables["chain"]
        for name in ("chain", "imu", "noise", "mag"):
            if name in tables:
                tables[name] = {key: value for key, value in tables[name].items() if value is not None}
        if not tables["noise"]:
            del tables["noise"]
        return tables

    @staticmethod
    def from_dict(tables: Mapping[str, Any], origin: str) -> Rig:
        """The inverse of `as_dict`; `origin` names the file. Raises FileFormatError for an invalid key or value."""
        _refuse_unknown(tables, [f.name for f in fields(Rig)], origin, "")
        parts: dict[str, Any] = {}
        for name, cls in (
            ("joint", Joint),
            ("chain", Chain),
            ("imu", Imu),
            ("noise", Noise),
            ("mag", Mag),
            ("baro", Baro),
        ):
            if name in tables:
                parts[name] = _read_table(cls, tables[name], origin, name)
        mice = tables.get("mouse", [])
        if not isinstance(mice, list):
            raise FileFormatError(origin, f"{origin}: mouse is one table; write [[mouse]], once for each mouse")
        parts["mouse"] = tuple(_read_table(Mouse, table, origin, "mouse") for table in mice)
        try:
            return Rig(**parts)
        except InvalidValue as error:
            raise FileFormatError(origin, f"{origin}: {error}") from None

    @staticmethod
    def load(path: str | PathLike[str]) -> Rig:
        """Reads a rig file. Raises CannotRead, or FileFormatError naming the file, the key and the cure."""
        try:
            text = read_bytes(Path(path), "the rig file").decode()
            _check_keys(text)
            tables = tomllib.loads(text)
        except (tomllib.TOMLDecodeError, UnicodeDecodeError, ValueError, RecursionError) as error:
            raise FileFormatError(path, f"{path} is not a rig file: {str(error)[:200]}") from error
        return Rig.from_dict(tables, str(path))

    def save(self, path: str | PathLike[str]) -> None:
        """Writes a rig file, completely or not at all. An existing file keeps its mode, a symbolic link its target.

        Raises CannotWrite, also for a path that is a device or a folder.
        """
        try:
            replace_file(Path(path), self.to_toml())
        except OSError as error:
            raise CannotWrite(path, error.strerror, "the rig file") from error

    def to_toml(self) -> str:
        """The rig as the text of a rig.toml that `load` reads back to an equal rig."""
        lines: list[str] = []
        for name, table in self.as_dict().items():
            for row in table if isinstance(table, list) else [table]:
                lines.append(f"[[{name}]]" if isinstance(table, list) else f"[{name}]")
                lines += [f"{key} = {_toml(value)}" for key, value in row.items()]
                lines.append("")
        return "\n".join(lines)


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    return str(list(value) if isinstance(value, tuple) else value)


def to_vector(values: Iterable[float], decimals: int = 8) -> Vector:
    """Three numbers as a rig holds them."""
    x, y, z = (round(float(value), decimals) for value in values)
    return x, y, z


def to_quaternion(values: Iterable[float]) -> Quaternion:
    """Four numbers as a rig holds them."""
    w, x, y, z = (round(float(value), 8) for value in values)
    return w, x, y, z


def _refuse_unknown(table: Mapping[str, Any], known: list[str], origin: str, where: str) -> None:
    for key in table:
        if key not in known:
            near = difflib.get_close_matches(key, known, 1, 0.4)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
            raise FileFormatError(origin, f"{origin}: unknown key {where}{str(key)[:60]}; {hint}")


def _read_table(cls: type[Any], table: Any, origin: str, name: str) -> Any:
    if not isinstance(table, Mapping):
        raise FileFormatError(origin, f"{origin}: {name} must be a table: write [{name}]")
    known = {f.name: f for f in fields(cls)}
    _refuse_unknown(table, list(known), origin, f"{name}.")
    values: dict[str, Any] = {}
    for key, value in table.items():
        values[key] = _read_value(str(known[key].type), value, origin, f"{name}.{key}")
        if key.endswith(_POSITIVE) and _least(values[key]) <= 0:
            raise FileFormatError(origin, f"{origin}: {name}.{key} is {value}; it must be above 0")
        if name == "noise" and not key.endswith("degC") and min(values[key]) < 0:
            raise FileFormatError(origin, f"{origin}: {name}.{key} is {value}; no axis may be below 0")
        if key == "delay_s" and not 0.0 <= values[key] <= 0.1:
            raise FileFormatError(origin, f"{origin}: {name}.{key} is {value}; it must be between 0 and 0.1 s")
        if key == "accel_scale" and min(values[key]) <= 0:
            raise FileFormatError(origin, f"{origin}: {name}.{key} is {value}; each axis must be above 0")
    if _are_parallel(values.get("long_axis"), values.get("flexion_axis")):
        raise FileFormatError(origin, f"{origin}: {name}.long_axis and {name}.flexion_axis are parallel")
    try:
        made = cls(**values)
    except TypeError:
        missing = [k for k in ("x_m", "y_m") if k in known and k not in values]
        raise FileFormatError(
            origin, f"{origin}: [[{name}]] lacks {' and '.join(missing)}: where it sits in the robot's frame"
        ) from None
    if isinstance(made, Joint) and made.is_too_short:
        raise FileFormatError(origin, f"{origin}: joint.j2s_m is zero, the joint's centre; delete it if it is unknown")
    return made


def _are_parallel(one: Vector | None, other: Vector | None) -> bool:
    """Whether two axes are within 10° of one line."""
    if one is None or other is None:
        return False
    along = sum(a * b for a, b in zip(one, other, strict=True))
    return abs(along) > math.cos(math.radians(10)) * math.hypot(*one) * math.hypot(*other)


def _least(value: float | Vector) -> float:
    return min(value) if isinstance(value, tuple) else value


def _read_value(kind: str, value: Any, origin: str, where: str) -> Any:
    """A value of the type that the field declares."""
    if kind == "str":
        if value not in CHAIN_JOINTS:
            raise FileFormatError(origin, f'{origin}: {where} is {quoted(value)}; it must be "ball" or "hinge"')
        return value
    if "Quaternion" in kind:
        return _read_quaternion(value, origin, where)
    if "Vector" not in kind or ("float |" in kind and not isinstance(value, list | tuple)):
        return _read_number(value, origin, where)
    vector = _read_vector(value, origin, where)
    if "axis" in where and math.hypot(*vector) < _SHORTEST_AXIS:
        raise FileFormatError(origin, f"{origin}: {where} is {quoted(value)}; an axis must not be zero")
    return vector


def _read_number(value: Any, origin: str, where: str) -> float:
    if not isinstance(value, bool) and isinstance(value, int | float):
        with contextlib.suppress(OverflowError):  # an integer of hundreds of digits
            if math.isfinite(value) and abs(value) <= _LARGEST:
                return float(value)
    raise FileFormatError(origin, f"{origin}: {where} is {quoted(value)}; it must be a number")


def quoted(value: Any, most: int = 60) -> str:
    """A value from a file as a message shows it: bounded in length, without control characters."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, a nesting without end
        return f"a {type(value).__name__} that is too large"
    return text if len(text) <= most else text[: most - 1] + "…"


def _read_vector(value: Any, origin: str, where: str) -> Vector:
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise FileFormatError(origin, f"{origin}: {where} is {quoted(value)}; it must be three numbers: [x, y, z]")
    x, y, z = (_read_number(v, origin, where) for v in value)
    return x, y, z


def _read_quaternion(value: Any, origin: str, where: str) -> Quaternion:
    if not isinstance(value, list | tuple) or len(value) != 4:
        raise FileFormatError(origin, f"{origin}: {where} is {quoted(value)}; it must be four numbers: [w, x, y, z]")
    w, x, y, z = (_read_number(v, origin, where) for v in value)
    if abs(math.hypot(w, x, y, z) - 1) > _UNIT:
        raise FileFormatError(origin, f"{origin}: {where} is {quoted(value)}; a rotation must have length 1")
    return w, x, y, z


def as_rig(rig: Rig | str | PathLike[str] | None, own: Rig | None = None) -> Rig:
    """A rig given as such or as the path of a rig.toml; otherwise `own`, or defaults.

    `own` is the rig of a recording or of a simulated board.

    The delay of the readings belongs to the measurements: it comes from `own` where the rig does not state it.
    """
    if rig is None:
        return own or Rig()
    loaded = rig if isinstance(rig, Rig) else Rig.load(rig)
    if own is not None and loaded.imu.delay_s is None:
        loaded = replace(loaded, imu=replace(loaded.imu, delay_s=own.imu.delay_s))
    return loaded


def _check_keys(text: str) -> None:
    """Raises ValueError for a dotted key of too many parts: the time of tomllib grows with their square."""
    for number, line in enumerate(text.splitlines(), 1):
        if line.count(".") <= _MOST_PARTS or line.lstrip().startswith("#"):
            continue
        if any(part.count(".") > _MOST_PARTS for part in re.split(r"[,=\[\]{}]", line)):
            raise ValueError(f"line {number}: a key has more than {_MOST_PARTS} parts")
