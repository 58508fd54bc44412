"""What a simulated rig makes the emulated sensors feel: the truth is that of linkpose.simulation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.devices import Sensors
from linkpose.simulation import imu
from linkpose.simulation.baro import PRESSURE_NOISE_PA
from linkpose.simulation.link import LinkRun
from linkpose.simulation.mice import MiceRun
from virtual_uno import VirtualUno

RATE_HZ = 1000  # rows of the tables, the MPU-6050's own sample rate
STRETCH_S = 10  # fed at once, which takes 80 ms
_OVERLAP_S = 1
_TEMPERATURE_OFFSET, _TEMPERATURE_SCALE = 36.53, 340.0  # product specification 6.3
_AIR_NOISE_STREAM = 100  # apart from the streams of the simulation

Floats = NDArray[np.float64]


def imu_rows(run: LinkRun | MiceRun, first: int, count: int) -> tuple[Floats, Floats]:
    """Times (N,) s and rows (N, 7) for `VirtualUno.imu.feed`: rows `first` … of the run's signal at RATE_HZ.

    The run's own counts (noise and errors in them) are turned back to g and deg/s: a board in the run's ranges gives
    exactly these counts.
    """
    time_s = np.arange(first, first + count) / RATE_HZ
    return time_s, _imu_rows(run, run.imu_counts(time_s, first))


def imu2_rows(run: LinkRun, first: int, count: int) -> tuple[Floats, Floats]:
    """As `imu_rows`, of a run's second sensor, for `VirtualUno.imu2.feed`."""
    time_s = np.arange(first, first + count) / RATE_HZ
    return time_s, _imu_rows(run, run.imu2_counts(time_s, first))


def _imu_rows(run: LinkRun | MiceRun, raw: NDArray[np.int16]) -> Floats:
    """Raw counts (N, 7) in g, deg/s and degC."""
    counts = raw.astype(np.float64)
    rows = np.empty((len(counts), 7))
    rows[:, :3] = counts[:, :3] * run.accel_range_g / 32768
    rows[:, 3:6] = counts[:, 4:] * run.gyro_range_deg_s / 32768
    rows[:, 6] = counts[:, 3] / _TEMPERATURE_SCALE + _TEMPERATURE_OFFSET
    return rows


def mag_rows(run: LinkRun, first: int, count: int) -> tuple[Floats, Floats]:
    """Times (N,) s and the field (N, 3) in µT for `VirtualUno.mag.feed`."""
    time_s = np.arange(first, first + count) / RATE_HZ
    return time_s, run.mag_field(time_s, first)


def air_rows(run: LinkRun, first: int, count: int) -> tuple[Floats, Floats]:
    """Times (N,) s and rows (N, 2) for `VirtualUno.baro.feed`: pressure in Pa with the sensor's noise, degC."""
    time_s = np.arange(first, first + count) / RATE_HZ
    truth = run.at(time_s)
    noise = imu.white((run.seed, _AIR_NOISE_STREAM, run.test), first, count, 1)[:, 0]
    pressure = truth.pressure_Pa + (run.errors != "none") * PRESSURE_NOISE_PA * noise
    return time_s, np.column_stack([pressure, truth.temp_degC])


def room_rows(seed: int, first: int, count: int) -> tuple[Floats, Floats]:
    """As `air_rows`, in a room in which a robot drives: 1013.25 hPa and 25 °C."""
    noise = imu.white((seed, _AIR_NOISE_STREAM), first, count, 1)[:, 0]
    time_s = np.arange(first, first + count) / RATE_HZ
    return time_s, np.column_stack([101_325 + PRESSURE_NOISE_PA * noise, np.full(count, 25.0)])


def mouse_rows(run: MiceRun, first: int, count: int) -> tuple[Floats, list[Floats]]:
    """Times (N,) s and for each mouse its path (N, 2) in mm for `Mouse.feed`.

    The paths are the run's own counts: a mouse set to the resolution that the rig names gives exactly these.
    """
    time_s = np.arange(first, first + count) / RATE_HZ
    counts = run.counts(time_s)
    return time_s, [counts[:, i] * 1000 / mouse.counts_per_m for i, mouse in enumerate(run.mice)]


class RigFeed:
    """Keeps the emulated sensors supplied with a run of any length, a stretch at a time."""

    def __init__(
        self, uno: VirtualUno, run: LinkRun | MiceRun, drive: MiceRun | None = None, stretch_s: int = STRETCH_S
    ) -> None:
        """`drive`: how the mice move beside a link, which has none. `stretch_s`: fed at once, while the board waits."""
        self._uno, self._run = uno, run
        self._drive = run if isinstance(run, MiceRun) else drive
        self._stretch_s = stretch_s
        self.restart()

    def restart(self) -> None:
        """The run's time zero is now."""
        self.start_s = self._fed_until = self._uno.time_s
        self.supply()

    def supply(self) -> None:
        """Feeds the next stretch when the present one runs out; to be called often."""
        if self._uno.time_s + _OVERLAP_S < self._fed_until:
            return
        first = max(0, round((self._uno.time_s - self.start_s - _OVERLAP_S) * RATE_HZ))
        count = (self._stretch_s + 2 * _OVERLAP_S) * RATE_HZ
        self._uno.imu.feed(*imu_rows(self._run, first, count), start_s=self.start_s)
        if isinstance(self._run, LinkRun):
            self._feed_air(self._run, first, count)
        else:
            self._uno.baro.feed(*room_rows(self._run.seed, first, count), start_s=self.start_s)
        if self._drive is not None:
            self._feed_mice(self._drive, first, count)
        self._fed_until = self.start_s + (first + count) / RATE_HZ

    def _feed_air(self, run: LinkRun, first: int, count: int) -> None:
        self._uno.baro.feed(*air_rows(run, first, count), start_s=self.start_s)
        if run.hello_sensors & Sensors.IMU2:
            self._uno.imu2.feed(*imu2_rows(run, first, count), start_s=self.start_s)
        if run.hello_sensors & Sensors.MAG:
            self._uno.mag.feed(*mag_rows(run, first, count), start_s=self.start_s)

    def _feed_mice(self, drive: MiceRun, first: int, count: int) -> None:
        time_s, paths = mouse_rows(drive, first, count)
        for mouse, path in zip(self._uno.mice, paths, strict=True):
            mouse.feed(time_s, path, start_s=self.start_s)
