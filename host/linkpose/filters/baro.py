"""`baro`: height from the barometer alone, the paper's Method D.

    h = 44330.77 (1 − (p / p₀)^0.190263)   (m)

over the mean pressure p₀ of the first second, when the link is expected to be at rest. With J2S the height is over the
joint's centre like that of the other filters: the tilt of that first second, from the mean accelerometer, says how high
the sensor stood. Without J2S the height is relative to the start.

The sensor's noise is not all of the error. The air's pressure changes with doors, wind and weather, a sensor that moves
through the air feels a part of ½ρv², and a link that was not at rest in the first second started from a height that is
as uncertain as the accelerometer was unsteady. All of it is in the standard deviation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY, Floats, ImuCalibration, read_accel, read_gyro
from linkpose.filters._vector import Vec
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

HEIGHT_SCALE_M = 44330.77
HEIGHT_EXPONENT = 0.190263
START_S = 1.0  # over which the start's pressure and tilt are averaged
# What a pressure says besides height and noise: standard deviations.
_SLOW_PA, _SLOW_S = 3.5, 5.0  # draughts, and what the compensation leaves of the temperature; half of it by when
_WEATHER_PA_S = 0.01  # 1 hPa in three hours
_SUCTION = 0.3  # of the dynamic pressure ½ρv²
_AIR_KG_M3 = 1.2


class StartState(NamedTuple):
    """What the first second said, and the last reading; changed in place."""

    time: Floats  # (1,) of the first sample (s), NaN before it
    force: Floats  # (3,) sum of the usable forces (m/s²)
    unsteady: Floats  # (3,) sum of their squares (m²/s⁴), how many, variance of the tilt by them (rad²)
    pressure: Floats  # (2,) sum of the usable pressures (Pa), and how many
    height: Floats  # (2,) last height and its standard deviation (m), NaN before the first pressure
    rejected: NDArray[np.int64]  # (1,) fresh pressures that could not be used

    @staticmethod
    def fresh() -> StartState:
        unsteady = np.array([0.0, 0.0, 1.0])  # without a force the tilt may be any
        return StartState(
            np.full(1, np.nan), np.zeros(3), unsteady, np.zeros(2), np.full(2, np.nan), np.zeros(1, np.int64)
        )


class BaroFilter:
    """Method D over blocks of samples."""

    name = "baro"
    columns = ("baro_height_m", "baro_height_std_m")

    def __init__(self, rig: Rig) -> None:
        self.state = StartState.fresh()
        self._imu = ImuCalibration.of(rig.imu)
        self._j2s = rig.joint.known_j2s_m or (0.0, 0.0, 0.0)
        self._noise_Pa = rig.baro.pressure_noise_Pa

    @property
    def rejected(self) -> int:
        """Fresh pressures so far that could not be used."""
        return int(self.state.rejected[0])

    def process(self, block: Measurements) -> Floats:
        """Height and its standard deviation (m) at each of the N samples: (N, 2), NaN before the first pressure.

        The standard deviation is that of the sensor's noise, of the air and of a start in motion.
        """
        out = np.empty((len(block), 2))
        _process(
            block.time_s, block.accel_m_s2, block.gyro_rad_s, block.flags, block.pressure_Pa, block.baro_fresh,
            self._imu, self._j2s, self._noise_Pa, self.state, out,
        )  # fmt: skip
        return out


@inner
def tilt_variance(force: Vec, squares: float, number: float) -> float:
    """Variance (rad²) of a mean force's direction: what varied was not gravity, and half of it may not average out."""
    varied = squares / number - vec.dot(force, force) / (number * number)
    return float(0.25 * max(varied, 0.0) / GRAVITY**2)


@inner
def listen(
    time_s: float, raw_accel: Vec, flags: int, pressure: float, fresh: bool, imu: ImuCalibration, state: StartState
) -> bool:
    """Takes one sample into the start's means while it lasts; whether there is a usable fresh pressure."""
    if math.isnan(state.time[0]):
        state.time[0] = time_s
    good = fresh and pressure > 0.0  # NaN is not
    if fresh and not good:
        state.rejected[0] += 1
    if time_s - state.time[0] <= START_S:
        has_force, force = read_accel(raw_accel, flags, imu)
        if has_force:
            for j in range(3):
                state.force[j] += force[j]
            state.unsteady[0] += vec.dot(force, force)
            state.unsteady[1] += 1.0
            state.unsteady[2] = tilt_variance(vec.load(state.force), state.unsteady[0], state.unsteady[1])
    elif state.pressure[1] > 0.0:
        return good
    if good:
        state.pressure[0] += pressure
        state.pressure[1] += 1.0
    return good


@inner
def start_height(state: StartState, j2s: Vec) -> float:
    """Height (m) of the sensor over the joint's centre at the start, 0 where no tilt is known."""
    force = vec.load(state.force)
    length = math.sqrt(vec.dot(force, force))
    return float(vec.dot(force, j2s) / length) if length > 0.0 else 0.0


@inner
def start_variance(state: StartState, height: float, j2s: Vec) -> float:
    """Variance (m²) of `start_height`, which is `height`."""
    return float(state.unsteady[2] * max(vec.dot(j2s, j2s) - height * height, 0.0))


@inner
def air_variance(since_s: float, raw_gyro: Vec, flags: int, imu: ImuCalibration, j2s: Vec) -> float:
    """Variance (Pa²) of what else than height a pressure differs by from the one `since_s` ago, at rest."""
    if not since_s > 0.0:
        return 0.0
    has_rate, rate = read_gyro(raw_gyro, flags, imu)
    velocity = vec.cross(rate, j2s)
    suction = _SUCTION * 0.5 * _AIR_KG_M3 * vec.dot(velocity, velocity) if has_rate else 0.0
    weather = _WEATHER_PA_S * since_s
    slow = _SLOW_PA**2 * since_s / (since_s + _SLOW_S)
    return float(slow + weather * weather + suction * suction)


@inner
def barometric_height(pressure: float, state: StartState) -> float:
    """Height (m) over the start's mean pressure."""
    ratio: float = pressure * state.pressure[1] / state.pressure[0]
    return float(HEIGHT_SCALE_M * (1.0 - ratio**HEIGHT_EXPONENT))


@inner
def metres_per_pascal(state: StartState) -> float:
    """|dh/dp| at the start's mean pressure."""
    return float(HEIGHT_SCALE_M * HEIGHT_EXPONENT * state.pressure[1] / state.pressure[0])


@inner
def measure(
    pressure: float,
    time_s: float,
    raw_gyro: Vec,
    flags: int,
    imu: ImuCalibration,
    j2s: Vec,
    noise_Pa: float,
    state: StartState,
) -> tuple[float, float, float]:
    """Height (m) by a fresh pressure, and its variance by the sensor's noise and by all else (m²)."""
    began, scale = start_height(state, j2s), metres_per_pascal(state)
    air = air_variance(time_s - state.time[0], raw_gyro, flags, imu, j2s)
    other = scale * scale * air + start_variance(state, began, j2s)
    return began + barometric_height(pressure, state), (noise_Pa * scale) ** 2, other


@compiled
def _process(
    time_s: Floats,
    accel: Floats,
    gyro: Floats,
    flags: NDArray[np.uint32],
    pressure_Pa: Floats,
    fresh: NDArray[np.bool_],
    imu: ImuCalibration,
    j2s: Vec,
    noise_Pa: float,
    state: StartState,
    out: Floats,
) -> None:
    for i in range(len(time_s)):
        a = (accel[i, 0], accel[i, 1], accel[i, 2])
        if listen(time_s[i], a, flags[i], pressure_Pa[i], fresh[i], imu, state):
            w = (gyro[i, 0], gyro[i, 1], gyro[i, 2])
            height, noise, other = measure(pressure_Pa[i], time_s[i], w, flags[i], imu, j2s, noise_Pa, state)
            state.height[0] = height
            state.height[1] = math.sqrt(noise * (1.0 + 1.0 / state.pressure[1]) + other)
        out[i, 0], out[i, 1] = state.height[0], state.height[1]
