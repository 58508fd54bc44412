"""`imu-baro`: inertial sensor and barometer fused in two steps, Method C of [Link].

The tilt filter (Method B) first gives the vertical acceleration Zᵀs_A − g. A Kalman filter then estimates the height h,
the vertical velocity v and the bias b of the vertical acceleration,

    h_k = h_k−1 + Ts v_k−1 + ½ Ts² a_k,   v_k = v_k−1 + Ts a_k,   a_k = Zᵀs_A − g − b,   b a random walk,

propagated at the sampling rate and updated with each fresh pressure by the barometric formula of `baro`. With J2S (the
vector from the joint centre to the sensor) the height is relative to the joint centre, without J2S to the start.

The covariance covers the modelled noise. An error of the tilt causes a sustained acceleration, and the mean innovation
over half a second measures the resulting error of the height. The variance of the output adds the square of this mean
and the barometer's errors that are not noise (the air, a start in motion; see `baro`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY, LONGEST_STEP_S, Floats, ImuSamples
from linkpose.filters._records import fields, zeros
from linkpose.filters._vector import Sym, Vec
from linkpose.filters.baro import (
    START_S,
    BaroParameters,
    BaroSamples,
    average_start,
    fresh_start,
    measure,
    metres_per_pascal,
    start_height,
    start_variance,
    unpacked_baro,
)
from linkpose.filters.tilt import (
    TiltParameters,
    advance,
    correct_by_accel,
    describe,
    fresh_tilt,
    load_state,
    store_state,
)
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

_INNOVATION_S = 0.5  # s: averaging time of the innovation, some ten pressures; doubled, σ follows the error later


class VerticalParameters(NamedTuple):
    """Noise of the vertical acceleration, 1σ each. Doubled, the height follows the barometer more closely."""

    accel_noise_m_s2: float = 0.3  # m/s² per sample: noise, and gravity that leaks in through the error of the tilt
    bias_walk_m_s2: float = 0.02  # (m/s²)/√s: random walk of the bias
    bias_std_m_s2: float = 0.1  # m/s²: bias at the start: a tilt error of 0.6°
    gap_accel_m_s2: float = 5.0  # m/s²: unmeasured acceleration in a gap, that of hand motion


# Height, velocity, bias and their covariance; changed in place.
_VERTICAL = fields(
    mean=3,  # h (m), v (m/s), b (m/s²)
    covariance=6,  # hh hv hb vv vb bb
    innovation=3,  # mean innovation (m), time over which it has been averaged (s), time of the last one (s)
    other=1,  # variance of the last barometric height from other causes than noise (m²)
    started=1,  # 1 once the first second is over
)


class ImuBaroFilter:
    """Method C of [Link] over blocks of samples."""

    name = "imu-baro"
    columns = ("imu_baro_height_m", "imu_baro_height_std_m", "imu_baro_roll_deg", "imu_baro_pitch_deg")

    def __init__(
        self, rig: Rig, tilt: TiltParameters | None = None, vertical: VerticalParameters | None = None
    ) -> None:
        self.tilt_parameters = tilt or TiltParameters()
        self.vertical_parameters = vertical or VerticalParameters()
        self._tilt, self._start, self._vertical = fresh_tilt(), fresh_start(), zeros(1, _VERTICAL)
        self._baro_parameters = BaroParameters.of(rig).packed()

    @property
    def rejected(self) -> int:
        """Number of samples so far with an unusable accelerometer, gyro or time, and of unusable fresh pressures."""
        return int(self._tilt[0].rejected[0] + self._start[0].rejected[0])

    def process(self, block: Measurements) -> Floats:
        """Height and its standard deviation (m), roll and pitch (°) at each of the N samples: (N, 4).

        The height is NaN before the first pressure.
        """
        out = np.empty((len(block), 4))
        _process(
            block.time_s, block.accel_m_s2, block.gyro_rad_s, block.flags, block.pressure_Pa, block.baro_fresh,
            self._baro_parameters, self.tilt_parameters.accel_memory, self.vertical_parameters,
            self._tilt, self._start, self._vertical, out,
        )  # fmt: skip
        return out


@inner
def propagate(
    mean: Vec, p: Sym, accel: float, is_measured: bool, step_s: float, q: VerticalParameters
) -> tuple[Vec, Sym]:
    """One step of the model; `accel` is Zᵀs_A − g (m/s²), ignored unless it `is_measured`."""
    h, v, b = mean
    t = step_s
    a = accel - b if is_measured else 0.0
    noise = q.accel_noise_m_s2 if is_measured else q.gap_accel_m_s2
    # F = [1 t −t²/2; 0 1 −t; 0 0 1] on (h, v, b)
    s = 0.5 * t * t
    hh, hv, hb, vv, vb, bb = p
    m0, m1, m2 = hh + t * hv - s * hb, hv + t * vv - s * vb, hb + t * vb - s * bb
    n1, n2 = vv - t * vb, vb - t * bb
    impulse = noise * noise * t * t
    p = (
        m0 + t * m1 - s * m2 + 0.25 * t * t * impulse,
        m1 - t * m2 + 0.5 * t * impulse,
        m2,
        n1 - t * n2 + impulse,
        n2,
        bb + q.bias_walk_m_s2**2 * t,
    )
    return (h + t * v + s * a, v + t * a, b), p


@inner
def correct(mean: Vec, p: Sym, height: float, variance: float) -> tuple[Vec, Sym]:
    """Kalman update with a measured height, in Joseph's form."""
    gain = 1.0 / (p[0] + variance)
    k = (p[0] * gain, p[1] * gain, p[2] * gain)
    innovation = height - mean[0]
    mean = (mean[0] + k[0] * innovation, mean[1] + k[1] * innovation, mean[2] + k[2] * innovation)
    r = 1.0 - k[0]
    hv, hb = p[1] - k[1] * p[0], p[2] - k[2] * p[0]
    p = (
        r * r * p[0] + k[0] * k[0] * variance,
        r * hv + k[0] * k[1] * variance,
        r * hb + k[0] * k[2] * variance,
        p[3] - k[1] * p[1] - k[1] * hv + k[1] * k[1] * variance,
        p[4] - k[1] * p[2] - k[2] * hv + k[1] * k[2] * variance,
        p[5] - k[2] * p[2] - k[2] * hb + k[2] * k[2] * variance,
    )
    return mean, p


@inner
def average_innovation(average: Vec, innovation: float, time_s: float) -> Vec:
    """Include an innovation (m) in the average: its mean (m), the averaging time and the time of the last one (s)."""
    mean, span_s, last_s = average
    step_s = time_s - last_s
    if not step_s > 0.0:
        return average
    span_s = min(span_s + step_s, _INNOVATION_S)
    return (mean + min(step_s / span_s, 1.0) * (innovation - mean), span_s, time_s)


@compiled
def _process(
    times_s: Floats,
    accel: Floats,
    gyro: Floats,
    flags: NDArray[np.uint32],
    pressure_Pa: Floats,
    fresh: NDArray[np.bool_],
    parameters: Floats,
    accel_memory: float,
    q: VerticalParameters,
    tilt_states: Any,
    starts: Any,
    verticals: Any,
    out: Floats,
) -> None:
    samples, baro = ImuSamples(times_s, accel, gyro, flags), BaroSamples(pressure_Pa, fresh)
    rig = unpacked_baro(parameters)
    now, start, vertical = load_state(tilt_states[0]), starts[0], verticals[0]
    mean, covariance = vec.load(vertical.mean), vec.load_sym(vertical.covariance)
    innovation = vec.load(vertical.innovation)
    rejected = 0
    for i in range(len(samples.time_s)):
        before, time_s = now.time, samples.time_s[i]
        now, has_force, force, has_rate = advance(now, samples, i, rig.imu)
        rejected += not (has_force and has_rate)
        if has_force:
            now = correct_by_accel(now, force, accel_memory, rig.imu)
        has_pressure = average_start(samples, baro, i, rig.imu, start)
        known = start.pressure[1] > 0.0
        if known and vertical.started[0] == 0.0:
            # During the first second the link is assumed at rest: the height follows from the mean tilt.
            variance = (rig.noise_Pa * metres_per_pascal(start)) ** 2
            mean = (start_height(start, rig.j2s), 0.0, 0.0)
            covariance = (variance / start.pressure[1], 0.0, 0.0, 0.01, 0.0, q.bias_std_m_s2**2)
            vertical.other[0] = start_variance(start, mean[0], rig)
            innovation = (0.0, 0.0, time_s)
            vertical.started[0] = 1.0 if time_s - start.time[0] > START_S else 0.0
        elif known:
            if now.time > before:
                step_s = now.time - before
                lifted = vec.dot(now.tilt, force) - GRAVITY
                is_measured = has_force and step_s <= LONGEST_STEP_S
                mean, covariance = propagate(mean, covariance, lifted, is_measured, step_s, q)
            if has_pressure:
                height, noise, vertical.other[0] = measure(samples, baro, i, rig, start)
                innovation = average_innovation(innovation, height - mean[0], time_s)
                mean, covariance = correct(mean, covariance, height, noise)
        out[i, 0] = mean[0] if known else np.nan
        out[i, 1] = math.sqrt(covariance[0] + innovation[0] ** 2 + vertical.other[0]) if known else np.nan
        if math.isnan(now.time):
            out[i, 2] = out[i, 3] = np.nan
        else:
            _, out[i, 2], out[i, 3] = describe(now, rig.imu.delay, rig.j2s)
    store_state(tilt_states[0], now, rejected)
    vec.store(vertical.mean, mean)
    vec.store(vertical.innovation, innovation)
    for j in range(6):
        vertical.covariance[j] = covariance[j]
