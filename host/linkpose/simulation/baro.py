"""The air around the rig, and the BMP180's raw values: its data sheet's compensation (3.5) turned round."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.bmp180 import Bmp180Calibration

Floats = NDArray[np.float64]

# The data sheet's worked example.
DATASHEET_WORDS = Bmp180Calibration(408, -72, -14383, 32741, 32757, 23153, 6190, 4, -32768, -8711, 2868)
PRESSURE_NOISE_PA = 3.0  # 0.25 m
_CONVERSION_S = (0.0045, 0.0075, 0.0135, 0.0255)  # at oversampling 0 to 3; a temperature takes as long as the first
_SETTLE_S = 0.0005  # the bus is silent for this long before the result is read
PRESSURES_PER_TEMPERATURE = 9

_HEIGHT_SCALE_M = 44330.77
_HEIGHT_EXPONENT = 0.190263
_AIR_DENSITY_KG_M3 = 1.2


def pressure_at_height(height_m: Floats, reference_Pa: float) -> Floats:
    """Pressure (Pa) `height_m` above the place where it is `reference_Pa`: the barometric formula."""
    return np.asarray(reference_Pa * (1 - height_m / _HEIGHT_SCALE_M) ** (1 / _HEIGHT_EXPONENT))


@dataclass(frozen=True, slots=True)
class Weather:
    """Slow drift of the room's pressure (doors, wind), and the suction at a sensor that moves through the air."""

    reference_Pa: float
    amplitude_Pa: Floats  # (K,)
    omega_rad_s: Floats  # (K,)
    phase_rad: Floats  # (K,)
    suction: float  # share of the dynamic pressure ½ρv²

    @staticmethod
    def draw(rng: np.random.Generator, disturbed: bool) -> Weather:
        period_s = np.geomspace(15.0, 600.0, 6) * rng.uniform(0.8, 1.25, 6)
        amplitude = 1.0 * rng.uniform(0.6, 1.4, 6) * disturbed
        phase = rng.uniform(0, 2 * np.pi, 6)
        return Weather(rng.uniform(99_000, 102_000), amplitude, 2 * np.pi / period_s, phase, 0.3 * disturbed)

    def pressure(self, time_s: Floats, height_m: Floats, speed_m_s: Floats) -> Floats:
        """Pressure (Pa) at the sensor, all (N,)."""
        drift = self.amplitude_Pa @ np.sin(np.outer(self.omega_rad_s, time_s) + self.phase_rad[:, None])
        suction = self.suction * 0.5 * _AIR_DENSITY_KG_M3 * speed_m_s**2
        return pressure_at_height(height_m, self.reference_Pa) + drift - suction


@dataclass(frozen=True, slots=True)
class Schedule:
    """When the firmware converts what: one conversion after each IMU read, one temperature to nine pressures.

    Conversions that are longer than the gap take several ticks. Result k is in the SAMPLE of the tick that reads it.
    The board has measured since it was switched on: the first SAMPLE carries the first pressure already.
    """

    tick_s: float
    oversampling: int

    @property
    def temperature_ticks(self) -> int:
        return self._ticks(0)

    @property
    def pressure_ticks(self) -> int:
        return self._ticks(self.oversampling)

    @property
    def cycle_ticks(self) -> int:
        return self.temperature_ticks + PRESSURES_PER_TEMPERATURE * self.pressure_ticks

    @property
    def _lead(self) -> int:
        """Ticks before the first SAMPLE at which the first conversion was started."""
        return self.temperature_ticks + self.pressure_ticks

    def _ticks(self, oversampling: int) -> int:
        return int(np.ceil((_CONVERSION_S[oversampling] + _SETTLE_S) / self.tick_s - 1e-9))

    def pressures_read(self, tick: NDArray[np.int64]) -> NDArray[np.int64]:
        """How many pressures have been read when the SAMPLE of each tick is made."""
        cycle, rest = np.divmod(tick + self._lead, self.cycle_ticks)
        within = np.clip((rest - self.temperature_ticks) // self.pressure_ticks, 0, PRESSURES_PER_TEMPERATURE)
        return np.asarray(cycle * PRESSURES_PER_TEMPERATURE + within)

    def temperatures_read(self, tick: NDArray[np.int64]) -> NDArray[np.int64]:
        """How many temperatures have been read when the SAMPLE of each tick is made."""
        cycle, rest = np.divmod(tick + self._lead, self.cycle_ticks)
        return np.asarray(cycle + (rest >= self.temperature_ticks))

    def pressure_time(self, number: NDArray[np.int64]) -> Floats:
        """Middle of the conversion of pressure `number` (from 0), s."""
        cycle, place = np.divmod(number, PRESSURES_PER_TEMPERATURE)
        start = cycle * self.cycle_ticks + self.temperature_ticks + place * self.pressure_ticks - self._lead
        return np.asarray(start * self.tick_s + 0.5 * _CONVERSION_S[self.oversampling])

    def temperature_time(self, number: NDArray[np.int64]) -> Floats:
        """Middle of the conversion of temperature `number` (from 0), s."""
        return np.asarray((number * self.cycle_ticks - self._lead) * self.tick_s + 0.5 * _CONVERSION_S[0])


def raw_temperature(temp_degC: Floats, words: Bmp180Calibration = DATASHEET_WORDS) -> NDArray[np.int64]:
    """UT whose compensated temperature is `temp_degC`."""
    b5 = temp_degC * 160 - 8
    # B5 = X1 + MC 2^11 / (X1 + MD), solved for X1
    half = 0.5 * (b5 - words.md)
    x1 = half + np.sqrt(half**2 + b5 * words.md - words.mc * 2.0**11)
    return np.asarray(np.rint(x1 * 2.0**15 / words.ac5 + words.ac6), dtype=np.int64)


def raw_pressure(
    pressure_Pa: Floats,
    temp_degC: Floats,
    oversampling: int,
    words: Bmp180Calibration = DATASHEET_WORDS,
    *,
    noise_counts: Floats | float = 0.0,
) -> NDArray[np.int64]:
    """UP whose compensated pressure is `pressure_Pa` at `temp_degC`, with this noise added before it is rounded."""
    ac1, ac2, ac3, ac4, b1, b2 = words.ac1, words.ac2, words.ac3, words.ac4, words.b1, words.b2
    b6 = temp_degC * 160 - 8 - 4000
    b3 = ((ac1 * 4 + (b2 * (b6**2 / 2**12) + ac2 * b6) / 2**11) * 2**oversampling + 2) / 4
    b4 = ac4 * ((ac3 * b6 / 2**13 + b1 * (b6**2 / 2**12) / 2**16 + 2) / 4 + 32768) / 2**15
    # p = q + ((q/2^8)² 3038/2^16 − 7357 q/2^16 + 3791) / 2^4, solved for q
    square, linear = 3038 / 2**36, 1 - 7357 / 2**20
    q = (-linear + np.sqrt(linear**2 - 4 * square * (3791 / 16 - pressure_Pa))) / (2 * square)
    return np.asarray(np.rint(q * b4 / 2 / (50000 >> oversampling) + b3 + noise_counts), dtype=np.int64)
