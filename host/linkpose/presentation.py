"""What the live views on a terminal and in a browser have in common: rows by filter, faults, and numbers as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from linkpose import quantities
from linkpose.quantities import Quantity

if TYPE_CHECKING:
    from linkpose.device.session import Health
    from linkpose.exclusions import Exclusions
    from linkpose.sensors.measurements import Floats

# A row of estimates by filter: filter -> quantity -> (value, σ) in the column's unit; NaN where there is none.
Row = dict[str, dict[Quantity, tuple[float, float]]]
Value = TypeVar("Value")  # of a quantity: a value with its σ, or a series of values

_JOINT_ANGLES = (quantities.ANGLE, *quantities.BALL_ANGLES)


class _Digits(NamedTuple):
    """How a length and its standard deviation are written, for standard deviations below `below_m`."""

    below_m: float
    of_value: int  # decimals of the length (m)
    factor: float  # units a metre
    of_std: int  # decimals of the standard deviation
    unit: str


_LENGTH_DIGITS = (
    _Digits(0.000095, 5, 1e3, 2, "mm"),
    _Digits(0.00995, 4, 1e3, 1, "mm"),
    _Digits(0.995, 3, 1e2, 1, "cm"),
    _Digits(math.inf, 1, 1.0, 1, "m"),
)
UNKNOWN = "not known"  # in place of a value
_MOST_DECIMALS = 4  # that a column of lengths aligns
_MOST_ERROR_DECIMALS = 6
_ANGLE_DECIMALS = ((0.0095, 3), (0.095, 2), (9.95, 1), (math.inf, 0))  # σ (°) below -> decimals
STALE_S = 1.0  # without a sample, from which on estimates are out of date: a busy computer delays samples by less
_FINE = ("ok", "absent", "left out", None)  # states of a sensor that are no fault of its own
_WIRING, _MOUSE_WIRING = "check VCC, SDA=A4, SCL=A5", "check its cable and pull-ups"
_POWER = "unplug the board and plug it in again"


class RowReader:
    """Splits rows of estimates by filter and quantity."""

    def __init__(self, columns: Sequence[str]) -> None:
        at = {column: place for place, column in enumerate(columns)}
        nowhere = len(columns)  # of a σ without a column: `read` appends NaN
        self._of_filter = {
            name: [(q, at[c], at.get(quantities.std_column(c) or "", nowhere)) for q, c in found.items()]
            for name, found in quantities.by_filter(columns).items()
        }

    @property
    def filters(self) -> list[str]:
        """The filters in the order of their columns, the best first."""
        return list(self._of_filter)

    def series(self, rows: Floats) -> dict[str, dict[Quantity, Floats]]:
        """The values (N,) of each quantity in rows (N, columns) of estimates, by filter."""
        return {
            name: {quantity: rows[:, value] for quantity, value, _ in found} for name, found in self._of_filter.items()
        }

    def read(self, estimates: Sequence[float], names: Iterable[str] | None = None) -> Row:
        """One row of estimates (columns,), of all filters or of these."""
        known = [*estimates, math.nan]
        return {
            name: {quantity: (known[value], known[std]) for quantity, value, std in self._of_filter[name]}
            for name in (self._of_filter if names is None else names)
        }


def best_filter(row: Row, filters: Iterable[str], quantity: Quantity) -> str | None:
    """The first filter with a finite value of this quantity; otherwise the first that has the quantity at all."""
    able = [name for name in filters if quantity in row.get(name, {})]
    known = [name for name in able if math.isfinite(row[name][quantity][0])]
    return next(iter(known or able), None)


def fault_lines(health: Health, exclusions: Exclusions) -> list[str]:
    """One line for each sensor that does not work, with what to check, and for each mouse that is left out.

    Without samples nothing is known of the sensors.
    """
    faulty = faulty_sensors(health)
    if is_stale(health):
        lines = [f"NO SAMPLES ({health.silent_s:.1f} s): check the cable of the board"]
    else:
        lines = [_fault_line(name, health) for name in faulty]
    return lines + exclusions.lines(faulty)


def is_stale(health: Health) -> bool:
    """Whether no sample has arrived for so long that estimates and states of sensors are out of date."""
    return health.silent_s > STALE_S


def faulty_sensors(health: Health) -> list[str]:
    """The names of the sensors whose readings are missing or wrong: imu, mouse1, ..."""
    return [name for name, of in health.sensors.items() if of.get("state") not in _FINE]


def _fault_line(name: str, health: Health) -> str:
    of = health.sensors[name]
    state = state_text(of)
    if state == "being set up":
        return f"{name.upper()} is {state}"
    lasted = f" ({health.duration_s - of['since_s']:.1f} s)" if "since_s" in of else ""
    wiring = _MOUSE_WIRING if name.startswith("mouse") else _WIRING
    return f"{name.upper()} {state.upper()}{lasted}: {wiring if of['state'] in ('silent', 'blank') else _POWER}"


def state_text(sensor: Mapping[str, Any]) -> str:
    """The state of a sensor in words; `sensor` is its part of Health.sensors."""
    state = str(sensor.get("state"))
    return "not answering" if state == "silent" else state


def lost_since(name: str, health: Health, needed: Callable[[str], Iterable[str]]) -> float:
    """When (s) a filter lost a sensor that it needs; infinite where it has all of them."""
    faulty = set(faulty_sensors(health)).intersection(needed(name))
    return min((health.sensors[sensor].get("since_s", math.inf) for sensor in faulty), default=math.inf)


def lost_filters(names: Iterable[str], health: Health, needed: Callable[[str], Iterable[str]]) -> list[str]:
    """The filters that have lost what they need: samples, or one of the sensors `needed(filter)`."""
    faulty = set(faulty_sensors(health))
    return [name for name in names if is_stale(health) or faulty.intersection(needed(name))]


def current(row: Row, health: Health, needed: Callable[[str], Iterable[str]]) -> Row:
    """The row with NaN for each filter that has lost what it needs, as in `lost_filters`."""
    lost = lost_filters(row, health, needed)
    return row | {name: dict.fromkeys(row[name], (math.nan, math.nan)) for name in lost}


def working_sensors(health: Health) -> list[str]:
    """The names of the sensors that work; none is known to without samples."""
    return [name.upper() for name, of in health.sensors.items() if of.get("state") == "ok" and not is_stale(health)]


def signed_angle(value_deg: float, decimals: int = 1) -> str:
    """An angle with its sign: +13.1°; one that rounds to zero has none: 0.0°."""
    if not math.isfinite(value_deg):
        return UNKNOWN
    number = f"{value_deg:+.{decimals}f}"
    return (minus(number) if float(number) else number[1:]) + "°"


def angle_with_std(value_deg: float, std_deg: float) -> str:
    """An angle and its standard deviation (°), to the same digit: +13.1° ±0.4°, +13.12° ±0.05°."""
    if not math.isfinite(value_deg + std_deg):
        return signed_angle(value_deg)
    for below, decimals in _ANGLE_DECIMALS:  # noqa: B007  # the last one is infinite
        if std_deg < below:
            break
    bound = max(std_deg, 10.0**-decimals)  # ±0 would claim certainty
    return f"{signed_angle(value_deg, decimals)} ±{bound:.{decimals}f}°"


def joint_angle(values: Mapping[Quantity, Value]) -> Value | None:
    """The first angle (°) of a chain's joint; None of a filter that estimates no chain."""
    return next((values[q] for q in _JOINT_ANGLES if q in values), None)


def joint_texts(values: Mapping[Quantity, tuple[float, float]]) -> list[str]:
    """The angles of a chain's joint: that of a hinge, or flexion, abduction and axial rotation of a ball joint."""
    return [f"{q.label} {angle_with_std(*values[q])}" for q in _JOINT_ANGLES if q in values]


def pose_text(values: Mapping[Quantity, tuple[float, float]]) -> list[str]:
    """Place, heading and speed of a robot, each as a text."""
    parts = [f"{q.name} {length_with_std(*values[q])}" for q in (quantities.X, quantities.Y) if q in values]
    parts.append(f"heading {angle_with_std(*map(math.degrees, values[quantities.HEADING]))}")
    speeds = [values[q][0] for q in (quantities.VX, quantities.VY) if q in values]
    if speeds and math.isfinite(sum(speeds)):
        parts.append(f"{math.hypot(*speeds):.2f} m/s")
    return parts


def length_with_std(value_m: float, std_m: float) -> str:
    """A length and its standard deviation (m), to the same digit: 1.5906 m ±0.4 mm, 1.591 m ±1.2 cm."""
    if not math.isfinite(value_m):
        return UNKNOWN
    return length_text(value_m, std_m) + (f" ±{std_text(std_m)}" if math.isfinite(std_m) else "")


def length_text(value_m: float, std_m: float) -> str:
    """A length to the last digit of its standard deviation (m); a dash where it is not finite."""
    if not math.isfinite(value_m):
        return "–"
    decimals = _digits(std_m).of_value
    return minus(f"{value_m:z.{decimals}f} m")  # z: no "−0.00"


def aligned_length(value_m: float, std_m: float) -> str:
    """`length_text` for a column: the decimal points stand below each other."""
    text = length_text(value_m, std_m)
    return text.replace(" m", " " * max(1, 1 + _MOST_DECIMALS - _digits(std_m).of_value) + "m")


def std_text(std_m: float) -> str:
    """A standard deviation (m) in mm, cm or m, with two or three digits."""
    digits = _digits(std_m)
    bound = max(digits.factor * std_m, 10.0**-digits.of_std)  # ±0 would claim certainty
    return f"{bound:.{digits.of_std}f} {digits.unit}" if math.isfinite(std_m) else "–"


def _digits(std_m: float) -> _Digits:
    """An unknown σ gives a value in mm."""
    for digits in _LENGTH_DIGITS:
        if std_m < digits.below_m:
            return digits
    return _LENGTH_DIGITS[-2]


def same_digits(first: float, *others: float) -> list[str]:
    """Errors as texts that end at the same digit, the third one of the first."""
    decimals = max(0, min(_MOST_ERROR_DECIMALS, 2 - math.floor(math.log10(first)))) if first > 0 else 0
    return [f"{value:z.{decimals}f}" for value in (first, *others)]  # z: no "-0.00"


def minus(number: str) -> str:
    """A number with a minus sign, which is as wide as a plus sign, in place of the hyphen."""
    return number.replace("-", "−")


def with_unit(number: str, unit: str) -> str:
    """A number with its unit; the degree sign stands without a space: 0.4 cm, 0.4°."""
    return number + ("" if unit == "°" else " ") + unit


def counted(number: int, noun: str) -> str:
    """A number with its noun: 1 gap, 2 gaps."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
