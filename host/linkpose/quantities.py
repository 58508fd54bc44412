"""The vocabulary of quantities: what each column of an estimate, a reference or a recording holds.

A column is named `<prefix>_<quantity>_<unit>`; the prefix of an estimate is the filter's name with `_` for `-`, a
reference has none. The standard deviation (σ) of `height_m` is `height_std_m`: `std` stands before the unit.
Plots, the terminal view, scores, writers and converters look a column up here with `split` and keep no list of
suffixes of their own.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

_TO_DEGREES = math.degrees(1.0)


class Shown(NamedTuple):
    """How a value is presented: `scale` times the stored value is in `unit`, with `decimals` decimals."""

    unit: str
    scale: float = 1.0
    decimals: int = 3


@dataclass(frozen=True, slots=True, eq=False)  # each exists once: dictionaries find it by identity, without its fields
class Quantity:
    """One quantity: its column, how it is shown, and how it is scored."""

    name: str  # without unit: height
    unit: str  # as columns write it: m, m_s, rad_s; "" of a number without unit
    label: str  # in words: height over the joint
    value: Shown  # in plots and tables
    error: Shown  # the unit in which its errors are given
    panel: str = ""  # plots draw all quantities of one panel on the same axes; "": not over time
    period: float | None = None  # of an angle, in the column's unit: 360 or 2π
    decimals: int = 6  # that a file keeps: a micrometre, a microdegree
    std: str = ""  # column of σ where it does not follow the rule
    is_reading: bool = False  # measured by a sensor rather than estimated by a filter

    @property
    def column(self) -> str:
        """The column without prefix: height_m."""
        return _join(self.name, self.unit)

    @property
    def std_column(self) -> str:
        """The column of σ without prefix: height_std_m."""
        return self.std or _join(f"{self.name}_std", self.unit)

    @property
    def is_angle(self) -> bool:
        """Whether values that differ by whole turns are equal."""
        return self.period is not None

    @property
    def radians(self) -> float:
        """Radians in one unit of an angle's column."""
        return 2 * math.pi / self.period if self.period is not None else 1.0

    @property
    def axis_label(self) -> str:
        """The label of a plot's axis, for example: height over the joint (m)."""
        return f"{self.label} ({self.value.unit})" if self.value.unit else self.label


class Column(NamedTuple):
    """A column's name taken apart."""

    prefix: str  # joint_inertial; "" of a reference
    quantity: Quantity
    is_std: bool  # the column holds σ rather than the value

    @property
    def filter(self) -> str:
        """The filter's name: joint-inertial."""
        return self.prefix.replace("_", "-")


def _join(name: str, unit: str) -> str:
    return f"{name}_{unit}" if unit else name


def _length(name: str, label: str, panel: str = "") -> Quantity:
    return Quantity(name, "m", label, Shown("m", 1.0, 4), Shown("cm", 100.0, 2), panel)


def _degrees(name: str, label: str) -> Quantity:
    return Quantity(name, "deg", label, Shown("°", 1.0, 1), Shown("deg", 1.0, 2), name, 360.0)


def _radians(name: str, label: str) -> Quantity:
    shown = Shown("°", _TO_DEGREES, 1)
    return Quantity(name, "rad", label, shown, Shown("rad", 1.0, 4), name, 2 * math.pi)


def _place(name: str, label: str) -> Quantity:
    return Quantity(name, "m", label, Shown("m", 1.0, 3), Shown("m", 1.0, 4))


def _speed(name: str, label: str) -> Quantity:
    return Quantity(name, "m_s", label, Shown("m/s", 1.0, 3), Shown("m_s", 1.0, 4), "velocity")


def _rate(name: str, label: str) -> Quantity:
    return Quantity(name, "rad_s", label, Shown("°/s", _TO_DEGREES, 1), Shown("rad_s", 1.0, 4), "turn rate")


def _reading(name: str, unit: str, label: str, shown: Shown, panel: str) -> Quantity:
    """A column of a recording: no filter estimates it."""
    return Quantity(name, unit, label, shown, Shown(unit, shown.scale), panel, is_reading=True)


def _part_of_rotation(axis: str) -> Quantity:
    none = Shown("", 1.0, 4)
    return Quantity(f"q{axis}", "", f"quaternion {axis}", none, none, std="rotation_std_deg")


HEIGHT = _length("height", "height over the joint", "height")
ROLL, PITCH, YAW = _degrees("roll", "roll"), _degrees("pitch", "pitch"), _degrees("yaw", "yaw since the start")
X, Y, Z = _place("x", "x"), _place("y", "y"), _place("z", "z")
HEADING = _radians("heading", "heading")
VX, VY, VZ = _speed("vx", "speed ahead"), _speed("vy", "speed to the left"), _speed("vz", "speed upwards")
WX, WY, WZ = _rate("wx", "turn rate about x"), _rate("wy", "turn rate about y"), _rate("wz", "turn rate")
ROLL_RAD, PITCH_RAD, YAW_RAD = _radians("roll", "roll"), _radians("pitch", "pitch"), _radians("yaw", "yaw")
DISTURBANCE = Quantity(
    "mag_disturbance",
    "uT",
    "magnetic disturbance",
    Shown("µT", 1.0, 1),
    Shown("uT"),
    "magnetic disturbance",
    decimals=3,
)
EXCLUDED = Quantity("excluded", "", "mice left out", Shown("", 1.0, 0), Shown(""), "mice left out", decimals=0)
ANGLE = _degrees("angle", "joint angle")
FLEXION, ABDUCTION = _degrees("flexion", "flexion"), _degrees("abduction", "abduction")
AXIAL_ROTATION = _degrees("axial_rotation", "axial rotation")
QW, QX, QY, QZ = (_part_of_rotation(axis) for axis in "wxyz")
# σ of the rotation of a chain's joint: the only uncertainty given for the quaternion.
ROTATION = _degrees("rotation", "joint rotation")
HEIGHT1 = _length("height1", "height of sensor 1", "height")
HEIGHT2 = _length("height2", "height of sensor 2", "height")

_AXES = ("x", "y", "z")
_READINGS = (
    *(_reading(f"accel_{a}", "m_s2", f"{a}", Shown("m/s²"), "specific force") for a in _AXES),
    *(_reading(f"gyro_{a}", "rad_s", f"{a}", Shown("°/s", _TO_DEGREES, 1), "angular rate") for a in _AXES),
    *(_reading(f"mag_{a}", "uT", f"{a}", Shown("µT", 1.0, 1), "magnetic field") for a in _AXES),
    _reading("pressure", "Pa", "pressure", Shown("hPa", 0.01, 2), "pressure"),
    _reading("temp", "degC", "temperature", Shown("°C", 1.0, 1), "temperature"),
    _reading("dx", "counts", "across", Shown("counts", 1.0, 0), "mouse counts"),
    _reading("dy", "counts", "ahead", Shown("counts", 1.0, 0), "mouse counts"),
)

# In the order in which plots and tables present them.
ALL: tuple[Quantity, ...] = (
    HEIGHT, HEIGHT1, HEIGHT2, ANGLE, FLEXION, ABDUCTION, AXIAL_ROTATION, ROTATION,
    X, Y, Z, ROLL, PITCH, YAW, HEADING, VX, VY, VZ,
    WX, WY, WZ, ROLL_RAD, PITCH_RAD, YAW_RAD, QW, QX, QY, QZ, EXCLUDED, DISTURBANCE, *_READINGS,
)  # fmt: skip
POSE = (X, Y, HEADING)  # of a robot in the plane
CHAIN_ROTATION = (QW, QX, QY, QZ)
BALL_ANGLES = (FLEXION, ABDUCTION, AXIAL_ROTATION)

_VALUES = {quantity.column: quantity for quantity in ALL}
_STDS = {quantity.std_column: quantity for quantity in reversed(ALL) if quantity not in CHAIN_ROTATION}


@functools.lru_cache(maxsize=1024)
def split(column: str) -> Column | None:
    """Takes a column's name apart; None for a column that holds no quantity (time_s, seq, flags, a covariance).

    The longest ending counts: `joint_inertial_height_std_m` is σ of the height, of the filter `joint-inertial`.
    """
    words = column.split("_")
    if "cov" in words:  # ekf_cov_x_m_y_m: the end of its name is that of y
        return None
    for first in range(len(words)):
        ending = "_".join(words[first:])
        found = _VALUES.get(ending) or _STDS.get(ending)
        if found is not None:
            return Column("_".join(words[:first]), found, ending not in _VALUES)
    return None


def unit_text(unit: str) -> str:
    """A unit as columns write it, for people: m/s for m_s, ° for deg."""
    return {"deg": "°", "m_s": "m/s", "rad_s": "rad/s", "m_s2": "m/s²"}.get(unit, unit)


def words(name: str) -> str:
    """A quantity's name for people: axial rotation for axial_rotation, height 1 for height1."""
    return re.sub(r"(?<=[a-z]{2})(?=\d)", " ", name.replace("_", " "))


def decimals(column: str) -> int:
    """Decimals that an estimate's file keeps of this column."""
    found = split(column)
    return found.quantity.decimals if found else 6


def by_filter(columns: Iterable[str]) -> dict[str, dict[Quantity, str]]:
    """Filter -> quantity -> column of its value, in the order of the columns. Readings, and columns without a prefix,
    belong to no filter.
    """
    found: dict[str, dict[Quantity, str]] = {}
    for column in columns:
        part = split(column)
        if part is not None and part.prefix and not (part.is_std or part.quantity.is_reading):
            found.setdefault(part.filter, {})[part.quantity] = column
    return found


def covariance_column(filter_name: str, first: Quantity, second: Quantity) -> str:
    """The column that holds the covariance of two quantities of a filter, such as `ekf_cov_x_m_y_m`."""
    return f"{filter_name.replace('-', '_')}_cov_{first.column}_{second.column}"


def std_column(column: str) -> str | None:
    """The column that holds σ of the value in `column`; None where `column` is no value of a quantity."""
    part = split(column)
    if part is None or part.is_std:
        return None
    return f"{part.prefix}_{part.quantity.std_column}" if part.prefix else part.quantity.std_column
