"""`baro`: height from the barometer alone, Method D of [Link].

    h = 44330.77 (1 − (p / p₀)^0.190263)   (m)

relative to the mean pressure p₀ of the first second, in which the link should be at rest. With J2S (the vector from the
joint centre to the sensor) the height is that above the joint centre, as in the other filters: the mean accelerometer
reading of the first second gives the tilt and so the height at the start. Without J2S the height is relative to the
start.

The standard deviation includes the sensor's noise and three further errors. Doors, wind and weather change the air
pressure. A sensor that moves through the air measures a share of the dynamic pressure ½ρv². If the link moves in the
first second, the height at the start is as uncertain as the accelerometer is unsteady.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY, Floats, ImuCalibration, ImuSamples, read_accel, read_gyro, unpacked
from linkpose.filters._records import fields, zeros
from linkpose.filters._vector import Vec
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

HEIGHT_SCALE_M = 44330.77  # m, T₀/L of the standard atmosphere
HEIGHT_EXPONENT = 0.190263  # R L/g of the standard atmosphere
START_S = 1.0  # s: averaging time of pressure and tilt at the start
# Pressure changes with other causes than height, 1σ each. Doubled, the height's σ grows in proportion.
_SLOW_PA, _SLOW_S = 3.5, 5.0  # Pa, s: draughts and residual temperature compensation; time in which half of it develops
_WEATHER_PA_S = 0.01  # Pa/s: 1 hPa in three hours
_SUCTION = 0.3  # share of the dynamic pressure ½ρv² that reaches the sensor's hole
_AIR_KG_M3 = 1.2  # kg/m³ at 20 °C


# Sums over the first second, and the latest height; changed in place.
_START = fields(
    time=1,  # of the first sample (s), NaN before it
    force=3,  # sum of the usable forces (m/s²)
    unsteady=3,  # sum of their squares (m²/s⁴), their number, variance of the tilt (rad²)
    pressure=2,  # sum of the usable pressures (Pa), their number
    height=2,  # last height and its standard deviation (m), NaN before the first pressure
    rejected=1,  # unusable fresh pressures
)


def fresh_start() -> Any:
    """An array of one _START before the first sample."""
    states = zeros(1, _START)
    states["time"] = states["height"] = math.nan
    states["unsteady"] = 0.0, 0.0, 1.0  # without a force the tilt is unknown: 1 rad
    return states


class BaroSamples(NamedTuple):
    """The arrays of a block with the barometer's readings, for compiled code."""

    pressure_Pa: Floats  # (N,)
    fresh: NDArray[np.bool_]  # (N,) whether the pressure was measured since the sample before


class BaroParameters(NamedTuple):
    """The rig's parameters that Methods C and D share."""

    imu: ImuCalibration
    j2s: Vec  # m; 0 without one: heights are then above the start
    j2s_std: Vec  # m, 1σ along each axis
    noise_Pa: float  # 1σ of one pressure

    @staticmethod
    def of(rig: Rig) -> BaroParameters:
        nothing = (0.0, 0.0, 0.0)
        j2s, std = (nothing, nothing) if rig.joint.j2s_m is None else (rig.joint.j2s_m, rig.joint.std_of_axes_m)
        return BaroParameters(ImuCalibration.of(rig.imu), j2s, std, rig.baro.pressure_noise_Pa)

    def packed(self) -> Floats:
        """(19,) its numbers in order: see `ImuCalibration.packed`."""
        return np.array([*self.imu.packed(), *self.j2s, *self.j2s_std, self.noise_Pa])


class BaroFilter:
    """Method D of [Link] over blocks of samples."""

    name = "baro"
    columns = ("baro_height_m", "baro_height_std_m")

    def __init__(self, rig: Rig) -> None:
        self._states = fresh_start()
        self._parameters = BaroParameters.of(rig).packed()

    @property
    def rejected(self) -> int:
        """Number of unusable fresh pressures so far."""
        return int(self._states[0].rejected[0])

    def process(self, block: Measurements) -> Floats:
        """Height and its standard deviation (m) at each of the N samples: (N, 2), NaN before the first pressure.

        The standard deviation covers the sensor's noise, the air and a start in motion.
        """
        out = np.empty((len(block), 2))
        _process(
            block.time_s, block.accel_m_s2, block.gyro_rad_s, block.flags, block.pressure_Pa, block.baro_fresh,
            self._parameters, self._states, out,
        )  # fmt: skip
        return out


@inner
def unpacked_baro(a: Floats) -> BaroParameters:
    """The parameters that `packed` gave."""
    return BaroParameters(unpacked(a), (a[12], a[13], a[14]), (a[15], a[16], a[17]), a[18])


@inner
def tilt_variance(force: Vec, squares: float, number: float) -> float:
    """Variance (rad²) of a mean force's direction, assuming that half of the varying part does not average out."""
    varied = squares / number - vec.dot(force, force) / (number * number)
    return float(0.25 * max(varied, 0.0) / GRAVITY**2)


@inner
def average_start(samples: ImuSamples, baro: BaroSamples, i: int, imu: ImuCalibration, state: Any) -> bool:
    """Include a sample of the first second in the means; whether its pressure is fresh and usable."""
    time_s, pressure, fresh = samples.time_s[i], baro.pressure_Pa[i], baro.fresh[i]
    if math.isnan(state.time[0]):
        state.time[0] = time_s
    good: bool = fresh and pressure > 0.0  # False for NaN
    if fresh and not good:
        state.rejected[0] += 1
    if time_s - state.time[0] <= START_S:
        has_force, force = read_accel(vec.row(samples.accel, i), samples.flags[i], imu)
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
def start_height(state: Any, j2s: Vec) -> float:
    """Height (m) of the sensor above the joint centre at the start, 0 where the tilt is unknown."""
    force = vec.load(state.force)
    length = math.sqrt(vec.dot(force, force))
    return float(vec.dot(force, j2s) / length) if length > 0.0 else 0.0


@inner
def start_variance(state: Any, height: float, q: BaroParameters) -> float:
    """Variance (m²) of the height at the start, `height` (m): from the tilt, and from J2S along the vertical."""
    tilted = state.unsteady[2] * max(vec.dot(q.j2s, q.j2s) - height * height, 0.0)
    force = vec.load(state.force)
    length2 = vec.dot(force, force)
    if not length2 > 0.0:
        return float(tilted + vec.dot(q.j2s_std, q.j2s_std))
    along = (force[0] * q.j2s_std[0], force[1] * q.j2s_std[1], force[2] * q.j2s_std[2])
    return float(tilted + vec.dot(along, along) / length2)


@inner
def air_variance(since_s: float, samples: ImuSamples, i: int, q: BaroParameters) -> float:
    """Variance (Pa²) of the pressure change since the start, `since_s` ago, from other causes than height."""
    if not since_s > 0.0:
        return 0.0
    has_rate, rate = read_gyro(vec.row(samples.gyro, i), samples.flags[i], q.imu)
    velocity = vec.cross(rate, q.j2s)
    suction = _SUCTION * 0.5 * _AIR_KG_M3 * vec.dot(velocity, velocity) if has_rate else 0.0
    weather = _WEATHER_PA_S * since_s
    slow = _SLOW_PA**2 * since_s / (since_s + _SLOW_S)
    return float(slow + weather * weather + suction * suction)


@inner
def barometric_height(pressure: float, state: Any) -> float:
    """Height (m) above the start, from its mean pressure."""
    ratio: float = pressure * state.pressure[1] / state.pressure[0]
    return float(HEIGHT_SCALE_M * (1.0 - ratio**HEIGHT_EXPONENT))


@inner
def metres_per_pascal(state: Any) -> float:
    """|dh/dp| at the start's mean pressure."""
    return float(HEIGHT_SCALE_M * HEIGHT_EXPONENT * state.pressure[1] / state.pressure[0])


@inner
def measure(
    samples: ImuSamples, baro: BaroSamples, i: int, q: BaroParameters, state: Any
) -> tuple[float, float, float]:
    """Height (m) from a fresh pressure, and its variances (m²) from the sensor's noise and from all other causes."""
    first, scale = start_height(state, q.j2s), metres_per_pascal(state)
    air = air_variance(samples.time_s[i] - state.time[0], samples, i, q)
    other = scale * scale * air + start_variance(state, first, q)
    return first + barometric_height(baro.pressure_Pa[i], state), (q.noise_Pa * scale) ** 2, other


@compiled
def _process(
    time_s: Floats,
    accel: Floats,
    gyro: Floats,
    flags: NDArray[np.uint32],
    pressure_Pa: Floats,
    fresh: NDArray[np.bool_],
    parameters: Floats,
    states: Any,
    out: Floats,
) -> None:
    samples, baro, state = ImuSamples(time_s, accel, gyro, flags), BaroSamples(pressure_Pa, fresh), states[0]
    q = unpacked_baro(parameters)
    for i in range(len(samples.time_s)):
        if average_start(samples, baro, i, q.imu, state):
            height, noise, other = measure(samples, baro, i, q, state)
            state.height[0] = height
            state.height[1] = math.sqrt(noise * (1.0 + 1.0 / state.pressure[1]) + other)
        out[i, 0], out[i, 1] = state.height[0], state.height[1]
