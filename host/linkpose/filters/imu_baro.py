"""`imu-baro`: inertial sensor and barometer fused in two steps, the paper's Method C.

First the tilt filter (Method B) gives the vertical acceleration Zᵀs_A − g. Then a Kalman filter over (h, v, b), the
height, the vertical velocity and the bias of the vertical acceleration,

    h_k = h_k−1 + Ts v_k−1 + ½ Ts² a_k,   v_k = v_k−1 + Ts a_k,   a_k = Zᵀs_A − g − b,   b a random walk,

propagates it at the sampling rate and corrects it with each fresh pressure only, by the barometric formula of `baro`.
Height over the joint's centre with J2S, relative to the start without.

The covariance is that of the modelled noise. A wrong tilt makes an acceleration that lasts, and that shows in the
innovation: its mean over half a second is the error of the height against the barometer's. Its square is added to the
variance, and so is what the barometer itself is wrong by: the air and a start in motion, as in `baro`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY, LONGEST_STEP_S, Floats, ImuCalibration
from linkpose.filters._vector import Sym, Vec
from linkpose.filters.baro import (
    START_S,
    StartState,
    listen,
    measure,
    metres_per_pascal,
    start_height,
    start_variance,
)
from linkpose.filters.tilt import TiltParameters, TiltState, advance, correct_by_accel, describe, keep, recall
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

_LASTING_S = 0.5  # over which the innovation is averaged


class VerticalParameters(NamedTuple):
    """What the filter assumes of the vertical acceleration."""

    accel_noise_m_s2: float = 0.3  # one sample's, with what a wrong tilt lets through
    bias_walk_m_s2: float = 0.02  # of the bias in a second
    bias_std_m_s2: float = 0.1  # of the bias at the start
    gap_accel_m_s2: float = 5.0  # where the accelerometer did not see


class VerticalState(NamedTuple):
    """Height, velocity, bias and their covariance; changed in place."""

    mean: Floats  # (3,) h (m), v (m/s), b (m/s²)
    covariance: Floats  # (6,) hh hv hb vv vb bb
    lasting: Floats  # (3,) mean innovation (m), over how long it has been taken (s), time of the last (s)
    other: Floats  # (1,) variance of the last barometric height besides the noise's (m²)
    started: NDArray[np.bool_]  # (1,) whether the start has passed

    @staticmethod
    def fresh() -> VerticalState:
        return VerticalState(np.zeros(3), np.zeros(6), np.zeros(3), np.zeros(1), np.zeros(1, np.bool_))


class ImuBaroFilter:
    """Method C over blocks of samples."""

    name = "imu-baro"
    columns = ("imu_baro_height_m", "imu_baro_height_std_m", "imu_baro_roll_deg", "imu_baro_pitch_deg")

    def __init__(
        self, rig: Rig, tilt: TiltParameters | None = None, vertical: VerticalParameters | None = None
    ) -> None:
        self.tilt_parameters = tilt or TiltParameters()
        self.vertical_parameters = vertical or VerticalParameters()
        self._tilt = TiltState.fresh()
        self._start = StartState.fresh()
        self._vertical = VerticalState.fresh()
        self._imu = ImuCalibration.of(rig.imu)
        self._j2s = rig.joint.known_j2s_m or (0.0, 0.0, 0.0)
        self._noise_Pa = rig.baro.pressure_noise_Pa

    @property
    def rejected(self) -> int:
        """Samples so far whose accelerometer, gyro or time could not be used, and fresh pressures that could not."""
        return int(self._tilt.rejected[0] + self._start.rejected[0])

    def process(self, block: Measurements) -> Floats:
        """Height and its standard deviation (m), roll and pitch (°) at each of the N samples: (N, 4).

        The height is NaN before the first pressure.
        """
        out = np.empty((len(block), 4))
        _process(
            block.time_s, block.accel_m_s2, block.gyro_rad_s, block.flags, block.pressure_Pa, block.baro_fresh,
            self._imu, self.tilt_parameters, self.vertical_parameters, self._j2s, self._noise_Pa,
            self._tilt, self._start, self._vertical, out,
        )  # fmt: skip
        return out


@inner
def propagate(mean: Vec, p: Sym, accel: float, seen: bool, step_s: float, q: VerticalParameters) -> tuple[Vec, Sym]:
    """One step of the model; `accel` is Zᵀs_A − g (m/s²), of no use where not `seen`."""
    h, v, b = mean
    t = step_s
    a = accel - b if seen else 0.0
    noise = q.accel_noise_m_s2 if seen else q.gap_accel_m_s2
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
    """Kalman correction with a measured height, in Joseph's form."""
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
def hear(lasting: Vec, innovation: float, time_s: float) -> Vec:
    """The lasting innovation (m), over how long it has been taken and the time of the last (s), with one more."""
    mean, span_s, last_s = lasting
    step_s = time_s - last_s
    if not step_s > 0.0:
        return lasting
    span_s = min(span_s + step_s, _LASTING_S)
    return (mean + min(step_s / span_s, 1.0) * (innovation - mean), span_s, time_s)


@compiled
def _process(
    time_s: Floats,
    accel: Floats,
    gyro: Floats,
    flags: NDArray[np.uint32],
    pressure_Pa: Floats,
    fresh: NDArray[np.bool_],
    imu: ImuCalibration,
    tilt_parameters: TiltParameters,
    q: VerticalParameters,
    j2s: Vec,
    noise_Pa: float,
    tilt_state: TiltState,
    start: StartState,
    vertical: VerticalState,
    out: Floats,
) -> None:
    now = recall(tilt_state)
    mean, covariance = vec.load(vertical.mean), vec.load_sym(vertical.covariance)
    lasting = vec.load(vertical.lasting)
    rejected = 0
    for i in range(len(time_s)):
        a = (accel[i, 0], accel[i, 1], accel[i, 2])
        w = (gyro[i, 0], gyro[i, 1], gyro[i, 2])
        before = now.time
        now, has_force, force, has_rate = advance(now, time_s[i], a, w, flags[i], imu)
        rejected += not (has_force and has_rate)
        if has_force:
            now = correct_by_accel(now, force, tilt_parameters.accel_memory, imu)
        measured = listen(time_s[i], a, flags[i], pressure_Pa[i], fresh[i], imu, start)
        known = start.pressure[1] > 0.0
        if known and not vertical.started[0]:
            # At rest until the start has passed: the height is where the tilt puts it, known as well as the mean is.
            variance = (noise_Pa * metres_per_pascal(start)) ** 2
            mean = (start_height(start, j2s), 0.0, 0.0)
            covariance = (variance / start.pressure[1], 0.0, 0.0, 0.01, 0.0, q.bias_std_m_s2**2)
            vertical.other[0] = start_variance(start, mean[0], j2s)
            lasting = (0.0, 0.0, time_s[i])
            vertical.started[0] = time_s[i] - start.time[0] > START_S
        elif known:
            if now.time > before:
                step_s = now.time - before
                lifted = vec.dot(now.tilt, force) - GRAVITY
                seen = has_force and step_s <= LONGEST_STEP_S
                mean, covariance = propagate(mean, covariance, lifted, seen, step_s, q)
            if measured:
                height, noise, vertical.other[0] = measure(
                    pressure_Pa[i], time_s[i], w, flags[i], imu, j2s, noise_Pa, start
                )
                lasting = hear(lasting, height - mean[0], time_s[i])
                mean, covariance = correct(mean, covariance, height, noise)
        out[i, 0] = mean[0] if known else np.nan
        out[i, 1] = math.sqrt(covariance[0] + lasting[0] ** 2 + vertical.other[0]) if known else np.nan
        if math.isnan(now.time):
            out[i, 2] = out[i, 3] = np.nan
        else:
            _, out[i, 2], out[i, 3] = describe(now, imu.delay, j2s)
    keep(tilt_state, now, rejected)
    for j in range(3):
        vertical.mean[j], vertical.lasting[j] = mean[j], lasting[j]
    for j in range(6):
        vertical.covariance[j] = covariance[j]
