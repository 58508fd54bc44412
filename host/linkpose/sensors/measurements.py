"""Measurements in SI units: what the filters read, whatever they came from (port, recording, simulation)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Measurements:
    """N consecutive samples in the sensors' own axes, before the rig's calibration. A value that is missing is NaN.

    All arrays are C-contiguous. A block of one sample and a whole recording have the same form.
    """

    time_s: Floats  # (N,) device clock fitted to the host's, 0 at the recording's start, increasing
    accel_m_s2: Floats  # (N, 3) specific force, +g along the upward axis at rest
    gyro_rad_s: Floats  # (N, 3) angular rate
    imu_temp_degC: Floats  # (N,)
    pressure_Pa: Floats  # (N,) the last compensated pressure, repeated until the next
    baro_temp_degC: Floats  # (N,)
    baro_fresh: NDArray[np.bool_]  # (N,) True at the first sample that carries a new pressure
    mice_counts: Floats  # (N, M, 2) counts dx, dy of each mouse since it was last read; 0 where flags say MICE_STALE
    flags: NDArray[np.uint16]  # (N,) wire.messages.SampleFlags

    def __len__(self) -> int:
        return len(self.time_s)

    def __getitem__(self, rows: slice) -> Measurements:
        """The samples of a slice, as views."""
        return Measurements(*(getattr(self, field.name)[rows] for field in fields(self)))


class Block(NamedTuple):
    """Consecutive measurements together with their tick numbers."""

    seq: NDArray[np.int64]  # (N,) ticks since START, without wraps; a lost sample leaves a gap
    measurements: Measurements
