"""Measurements in, estimates out: the filters side by side, live and over a recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from linkpose import filters, quantities
from linkpose.errors import LinkposeError
from linkpose.recording.csvfile import CsvFile
from linkpose.recording.fixedpoint import format_rows
from linkpose.sensors.conversion import TIME_DECIMALS
from linkpose.sensors.devices import Sensors
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.rig import Rig


def sensors_of(measurements: Measurements) -> Sensors:
    """Those that ever gave a value in these measurements."""
    imu = Sensors.MPU6050 if np.isfinite(measurements.gyro_rad_s).any() else Sensors(0)
    return imu | (Sensors.BMP180 if measurements.baro_fresh.any() else Sensors(0))


def mice_of(measurements: Measurements) -> int:
    """Mouse ports up to the last that ever gave a count."""
    counted = np.isfinite(measurements.mice_counts).any(axis=(0, 2))
    return int(np.flatnonzero(counted).max(initial=-1)) + 1


class FoundJ2s(NamedTuple):
    """J2S that was not known, as the motion has told it."""

    mean_m: Floats  # (3,)
    std_m: Floats  # (3,) of each axis
    worst_std_m: float  # in the direction that is known least
    worst_axis: str  # x, y or z, the one that this direction is nearest to

    @staticmethod
    def of(mean_m: Floats, covariance_m2: Floats) -> FoundJ2s:
        values, vectors = np.linalg.eigh(covariance_m2)
        axis = "xyz"[int(np.argmax(np.abs(vectors[:, -1])))]
        return FoundJ2s(mean_m, np.sqrt(np.diag(covariance_m2)), float(np.sqrt(values[-1])), axis)


class Estimator:
    """Runs filters over consecutive blocks of measurements."""

    def __init__(self, names: Sequence[str], rig: Rig, sensors: Sensors, mice: int = 0) -> None:
        """The filters of these names, or all that can run when there is none; `mice` is how many ports have one.

        Raises LinkposeError when a named one cannot run, or none at all; `left_out` tells why others do not.
        """
        self._rig = rig
        self.left_out: dict[str, str] = {}
        self.filters: list[filters.Filter] = []
        for name in dict.fromkeys(names or filters.NAMES):
            try:
                self.filters.append(filters.create(name, rig, sensors, mice))
            except filters.CannotRun as reason:
                if names:
                    raise LinkposeError(f"the filter {name} cannot run: {reason}") from None
                self.left_out[name] = str(reason)
        if not self.filters:
            reasons = "; ".join(f"{name}: {reason}" for name, reason in self.left_out.items())
            raise LinkposeError(f"no filter can run on this ({reasons})")
        self.columns = ["time_s", *(column for f in self.filters for column in f.columns)]
        self._decimals = np.array(
            [TIME_DECIMALS, *(quantities.decimals(name) for name in self.columns[1:])], dtype=np.int64
        )

    def smooth(self) -> None:
        """Puts a smoother in the place of each filter that has one: from here on, `process` takes a whole recording.

        Raises LinkposeError where none of the filters has one.
        """
        smoothable = [name for name, able in filters.REGISTRY.items() if able.smoother]
        names = [f.name for f in self.filters]
        if not set(smoothable) & set(names):
            reasons = "".join(f"; {self.left_out[name]}" for name in smoothable if name in self.left_out)
            raise LinkposeError(f"no filter that can be smoothed ({', '.join(smoothable)}) runs{reasons}")
        self.filters = [filters.create_smoother(f.name, self._rig) if f.name in smoothable else f for f in self.filters]

    def warm_up(self) -> None:
        """Compiles all that `process` and `text` need, or loads it compiled: no sample waits for a compiler."""
        filters.warm_up(f.name for f in self.filters)
        self.text(np.zeros((1, len(self.columns))))

    def process(self, block: Measurements) -> Floats:
        """The estimates (N, columns) at the next N samples."""
        return np.column_stack([block.time_s, *(f.process(block) for f in self.filters)])

    @property
    def found_j2s(self) -> FoundJ2s | None:
        """J2S as the filters have found it so far; None where it was known, or where none of them looks for it."""
        if self._rig.joint.known_j2s_m is not None:
            return None
        for f in self.filters:
            if isinstance(f, filters.FindsJ2s):
                return FoundJ2s.of(*f.j2s_m)
        return None

    def text(self, estimates: Floats) -> str:
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

    def __init__(self, path: Path, head: dict[str, Any], columns: Sequence[str], force: bool) -> None:
        super().__init__(path, "estimate", head, columns, force)
