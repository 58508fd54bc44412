"""What the simulated rig makes the emulated sensors feel: the truth is that of linkpose.simulation.link."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from linkpose.simulation import imu
from linkpose.simulation.baro import PRESSURE_NOISE_PA
from linkpose.simulation.link import LinkRun
from virtual_uno import VirtualUno

RATE_HZ = 1000  # rows of the tables, the MPU-6050's own sample rate
_TEMPERATURE_OFFSET, _TEMPERATURE_SCALE = 36.53, 340.0  # product specification 6.3
_AIR_NOISE_STREAM = 100  # apart from the streams of the simulation

Floats = NDArray[np.float64]


def imu_rows(run: LinkRun, first: int, count: int) -> tuple[Floats, Floats]:
    """Times (N,) s and rows (N, 7) for `VirtualUno.imu.feed`: rows `first` … of the run's signal at RATE_HZ.

    The run's own counts (noise and errors in them) are turned back to g and deg/s: a board in the run's ranges gives
    exactly these counts.
    """
    time_s = np.arange(first, first + count) / RATE_HZ
    counts = run.imu_counts(time_s, first).astype(np.float64)
    rows = np.empty((count, 7))
    rows[:, :3] = counts[:, :3] * run.accel_range_g / 32768
    rows[:, 3:6] = counts[:, 4:] * run.gyro_range_deg_s / 32768
    rows[:, 6] = counts[:, 3] / _TEMPERATURE_SCALE + _TEMPERATURE_OFFSET
    return time_s, rows


def air_rows(run: LinkRun, first: int, count: int) -> tuple[Floats, Floats]:
    """Times (N,) s and rows (N, 2) for `VirtualUno.baro.feed`: pressure in Pa with the sensor's noise, degC."""
    time_s = np.arange(first, first + count) / RATE_HZ
    truth = run.at(time_s)
    noise = imu.white((run.seed, _AIR_NOISE_STREAM, run.test), first, count, 1)[:, 0]
    pressure = truth.pressure_Pa + (run.errors != "none") * PRESSURE_NOISE_PA * noise
    return time_s, np.column_stack([pressure, truth.temp_degC])


class RigFeed:
    """Keeps the emulated sensors supplied with a run of any length, a stretch at a time."""

    STRETCH_S = 10

    def __init__(self, uno: VirtualUno, run: LinkRun) -> None:
        self._uno, self._run = uno, run
        self._fed_until = 0.0
        self.restart()

    def restart(self) -> None:
        """The run's time zero is now."""
        self.start_s = self._fed_until = self._uno.time_s
        self.supply()

    def supply(self) -> None:
        """Feeds the next stretch when the present one runs out; to be called often."""
        if self._uno.time_s + 1 < self._fed_until:
            return
        first = max(0, round((self._uno.time_s - self.start_s - 1) * RATE_HZ))
        count = (self.STRETCH_S + 2) * RATE_HZ
        self._uno.imu.feed(*imu_rows(self._run, first, count), start_s=self.start_s)
        self._uno.baro.feed(*air_rows(self._run, first, count), start_s=self.start_s)
        self._fed_until = self.start_s + (first + count) / RATE_HZ
