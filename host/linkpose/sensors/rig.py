"""rig.toml: where the sensors sit and how they err. Calibration writes it; the filters read it."""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from linkpose.errors import LinkposeError

Vector = tuple[float, float, float]

_GUESS_M = 0.1  # a J2S known no better is of no use but as a start


@dataclass(frozen=True, slots=True)
class Joint:
    """The link's joint."""

    j2s_m: Vector | None = None  # from the joint centre to the sensor, in the sensor's frame (m)
    j2s_std_m: float = 0.0001  # how well that is known, each axis (m)

    @property
    def known_j2s_m(self) -> Vector | None:
        """J2S, None where it is a guess from which it is to be estimated."""
        return self.j2s_m if self.j2s_std_m <= _GUESS_M else None


@dataclass(frozen=True, slots=True)
class Imu:
    """Calibration of the MPU-6050: acceleration = (measured - offset) / scale, rate = measured - bias.

    The noises are the standard deviations of one sample at rest. The defaults are the data sheet's typical figures.
    """

    gyro_bias_rad_s: Vector = (0.0, 0.0, 0.0)
    accel_offset_m_s2: Vector = (0.0, 0.0, 0.0)
    accel_scale: Vector = (1.0, 1.0, 1.0)
    gyro_noise_rad_s: float = math.radians(0.05)
    accel_noise_m_s2: float = 0.04
    delay_s: float | None = None  # of the low-pass filter that the readings went through; None: by the board's setting

    @property
    def known_delay_s(self) -> float:
        """The delay, none where nothing is said of it."""
        return self.delay_s or 0.0


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
    """All of a rig.toml."""

    joint: Joint = field(default_factory=Joint)
    imu: Imu = field(default_factory=Imu)
    baro: Baro = field(default_factory=Baro)
    mouse: tuple[Mouse, ...] = ()

    def with_j2s(self, j2s_m: Vector) -> Rig:
        return replace(self, joint=Joint(j2s_m))

    def with_delay_of(self, dlpf: int | None) -> Rig:
        """The rig for readings through this low-pass setting (DLPF_CFG, 0 to 6); a delay that the rig names stays."""
        from linkpose.sensors.mpu6050 import DLPF_DELAY_S

        if dlpf is None or self.imu.delay_s is not None:
            return self
        return replace(self, imu=replace(self.imu, delay_s=DLPF_DELAY_S[dlpf]))

    def as_dict(self) -> dict[str, Any]:
        """The rig as plain tables, for JSON and TOML."""
        tables = asdict(self)
        tables["mouse"] = list(tables["mouse"])
        if self.joint.j2s_m is None:
            del tables["joint"]
        if self.imu.delay_s is None:
            del tables["imu"]["delay_s"]
        return tables

    @staticmethod
    def from_dict(tables: Mapping[str, Any], origin: str) -> Rig:
        """The inverse of `as_dict`; `origin` names the file. Raises LinkposeError for what cannot be."""
        _refuse_unknown(tables, [f.name for f in fields(Rig)], origin, "")
        parts: dict[str, Any] = {}
        for name, cls in (("joint", Joint), ("imu", Imu), ("baro", Baro)):
            if name in tables:
                parts[name] = _read_table(cls, tables[name], origin, name)
        mice = tables.get("mouse", [])
        if not isinstance(mice, list):
            raise LinkposeError(f"{origin}: mouse is one table; write [[mouse]], once for each mouse")
        parts["mouse"] = tuple(_read_table(Mouse, table, origin, "mouse") for table in mice)
        return Rig(**parts)

    @staticmethod
    def load(path: Path) -> Rig:
        """Reads a rig file. Raises LinkposeError naming the file, the key and the cure."""
        try:
            tables = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise LinkposeError(f"cannot read the rig file {path}: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise LinkposeError(f"{path} is not a rig file: {error}") from error
        return Rig.from_dict(tables, str(path))

    def to_toml(self) -> str:
        """The rig as the text of a rig.toml that `load` reads back to an equal rig."""
        lines: list[str] = []
        for name, table in self.as_dict().items():
            for row in table if isinstance(table, list) else [table]:
                lines.append(f"[[{name}]]" if isinstance(table, list) else f"[{name}]")
                lines += [f"{key} = {list(value) if isinstance(value, tuple) else value}" for key, value in row.items()]
                lines.append("")
        return "\n".join(lines)


def to_vector(values: Iterable[float], decimals: int = 8) -> Vector:
    """Three numbers as a rig holds them."""
    x, y, z = (round(float(value), decimals) for value in values)
    return x, y, z


def _refuse_unknown(table: Mapping[str, Any], known: list[str], origin: str, where: str) -> None:
    for key in table:
        if key not in known:
            near = difflib.get_close_matches(key, known, 1, 0.4)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
            raise LinkposeError(f"{origin}: unknown key {where}{key}; {hint}")


def _read_table(cls: type[Any], table: Any, origin: str, name: str) -> Any:
    if not isinstance(table, Mapping):
        raise LinkposeError(f"{origin}: {name} must be a table: write [{name}]")
    known = {f.name: f for f in fields(cls)}
    _refuse_unknown(table, list(known), origin, f"{name}.")
    values: dict[str, Any] = {}
    for key, value in table.items():
        is_vector = "Vector" in str(known[key].type)
        values[key] = (
            _read_vector(value, origin, f"{name}.{key}") if is_vector else _read_number(value, origin, f"{name}.{key}")
        )
        if key.endswith(("_noise_rad_s", "_noise_m_s2", "_noise_Pa", "_std_m", "counts_per_m")) and values[key] <= 0:
            raise LinkposeError(f"{origin}: {name}.{key} is {value}; it must be above 0")
        if key == "delay_s" and not 0.0 <= values[key] <= 0.1:
            raise LinkposeError(f"{origin}: {name}.{key} is {value}; it must be between 0 and 0.1 s")
        if key == "accel_scale" and min(values[key]) <= 0:
            raise LinkposeError(f"{origin}: {name}.{key} is {value}; each axis must be above 0")
    try:
        return cls(**values)
    except TypeError:
        missing = [k for k in ("x_m", "y_m") if k in known and k not in values]
        raise LinkposeError(
            f"{origin}: [[{name}]] lacks {' and '.join(missing)}: where it sits in the robot's frame"
        ) from None


def _read_number(value: Any, origin: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise LinkposeError(f"{origin}: {where} is {value!r}; it must be a number")
    return float(value)


def _read_vector(value: Any, origin: str, where: str) -> Vector:
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise LinkposeError(f"{origin}: {where} is {value!r}; it must be three numbers: [x, y, z]")
    x, y, z = (_read_number(v, origin, where) for v in value)
    return x, y, z
