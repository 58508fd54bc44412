"""What the live views on a terminal and in a browser have in common: rows by filter, faults, and numbers as text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from linkpose import quantities
from linkpose.quantities import Quantity

if TYPE_CHECKING:
    from linkpose.device.session import Health

# A row of estimates by filter: filter -> quantity -> (value, σ) in the column's unit; NaN where there is none.
Row = dict[str, dict[Quantity, tuple[float, float]]]

_JOINT_ANGLES = (quantities.ANGLE, *quantities.BALL_ANGLES)
_STATES = ("being set up", "left out")  # that need no cure here


class RowReader:
    """Splits rows of estimates by filter and quantity."""

    def __init__(self, columns: Sequence[str]) -> None:
        self._of_filter = quantities.by_filter(columns)
        self._at = {column: at for at, column in enumerate(columns)}

    @property
    def filters(self) -> list[str]:
        """The filters in the order of their columns, the best first."""
        return list(self._of_filter)

    def read(self, estimates: Sequence[float]) -> Row:
        """One row of estimates (columns,)."""

        def of(column: str) -> tuple[float, float]:
            std = self._at.get(quantities.std_column(column) or "")
            return estimates[self._at[column]], math.nan if std is None else estimates[std]

        return {
            name: {quantity: of(column) for quantity, column in found.items()}
            for name, found in self._of_filter.items()
        }


def best_filter(row: Row, filters: Iterable[str], quantity: Quantity) -> str | None:
    """The first filter with a finite value of this quantity; otherwise the first that has the quantity at all."""
    able = [name for name in filters if quantity in row.get(name, {})]
    known = [name for name in able if math.isfinite(row[name][quantity][0])]
    return next(iter(known or able), None)


class Exclusions:
    """The mice that a filter leaves out, and since when."""

    def __init__(self) -> None:
        self._since_s: dict[int, float] = {}

    def follow(self, time_s: float, row: Row) -> None:
        """Takes the next row."""
        now = set()
        for values in row.values():
            mask = values.get(quantities.EXCLUDED, (math.nan, 0.0))[0]
            if math.isfinite(mask):
                now |= {mouse for mouse in range(1, 9) if int(mask) >> (mouse - 1) & 1}
        self._since_s = {mouse: self._since_s.get(mouse, time_s) for mouse in now}

    def lines(self) -> list[str]:
        """One line for each mouse that is left out."""
        return [
            f"mouse {mouse} LEFT OUT since {since:.1f} s (disagrees)" for mouse, since in sorted(self._since_s.items())
        ]


def fault_lines(health: Health) -> list[str]:
    """One line for each sensor that does not work, with what to check."""
    lines = []
    for name, of in health.sensors.items():
        state = of.get("state")
        if state in ("ok", "absent", None):
            continue
        cure = "check VCC, SDA=A4, SCL=A5" if not name.startswith("mouse") else "check its cable and pull-ups"
        if state in _STATES:
            lines.append(f"{name.upper()} is {state}")
        else:
            lines.append(f"{name.upper()} {state.upper()}: {cure}")
    return lines


def working_sensors(health: Health) -> list[str]:
    """The names of the sensors that work."""
    return [name.upper() for name, of in health.sensors.items() if of.get("state") == "ok"]


def signed_angle(value_deg: float) -> str:
    """An angle with its sign: +13.1°."""
    return f"{value_deg:+.1f}°".replace("-", "−") if math.isfinite(value_deg) else "not known yet"


def angle_with_std(value_deg: float, std_deg: float) -> str:
    """An angle with its standard deviation (°): +13.1° ±0.4°."""
    bound = f" ±{std_deg:.2g}°" if math.isfinite(value_deg + std_deg) else ""
    return signed_angle(value_deg) + bound


def joint_angle(values: Mapping[Quantity, tuple[float, float]]) -> tuple[float, float] | None:
    """The first angle (°) of a chain's joint and its σ; None of a filter that estimates no chain."""
    return next((values[q] for q in _JOINT_ANGLES if q in values), None)


def joint_texts(values: Mapping[Quantity, tuple[float, float]]) -> list[str]:
    """The angles of a chain's joint: that of a hinge, or flexion, abduction and axial rotation of a ball joint."""
    return [f"{q.label} {angle_with_std(*values[q])}" for q in _JOINT_ANGLES if q in values]


def pose_text(values: Mapping[Quantity, tuple[float, float]]) -> list[str]:
    """Place, heading and speed of a robot, each as a text."""
    parts = [
        f"{q.name} {with_std(*values[q], 'm', 3)}" for q in (quantities.X, quantities.Y) if q in values
    ]  # fmt: skip
    parts.append(f"heading {signed_angle(math.degrees(values[quantities.HEADING][0]))}")
    speeds = [values[q][0] for q in (quantities.VX, quantities.VY) if q in values]
    if speeds and math.isfinite(sum(speeds)):
        parts.append(f"{math.hypot(*speeds):.2f} m/s")
    return parts


def with_std(value: float, std: float, unit: str, decimals: int) -> str:
    """A value with its standard deviation (m): 1.5906 m ±0.4 mm."""
    if not math.isfinite(value):
        return "not known yet"
    return number_text(value, unit, decimals) + (f" ±{std_text(std)}" if math.isfinite(std) else "")


def number_text(value: float, unit: str, decimals: int) -> str:
    """A number with its unit, or a dash where it is not finite."""
    return f"{value:.{decimals}f} {unit}" if math.isfinite(value) else "–"


def counted(number: int, noun: str) -> str:
    """A number with its noun: 1 gap, 2 gaps."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def std_text(std: float) -> str:
    """A standard deviation (m) in mm, cm or m, with two or three digits."""
    if not math.isfinite(std):
        return "–"
    if std < 0.00995:
        return f"{1e3 * std:.1f} mm"
    return f"{1e2 * std:.1f} cm" if std < 0.995 else f"{std:.1f} m"
