"""`tilt-inertial`: the tilt of a sensor whose velocity stays small, with the sensors' errors in the state.

Method B reads the acceleration off the tilt that it is to find, which suits accelerations of a few samples. Here the
accelerometer is integrated instead: a sensor that a hand, a robot or a pendulum moves comes back to where it was, so
its velocity is small and of short memory. No joint is needed. State and prediction are those of `joint-inertial`
(linkpose.filters._inertial) with no J2S, and the measurement is  0 = v + e  with e the velocity that the sensor really
has: zero in the mean, of standard deviation σ and correlation time T. To an estimate slower than T that is white noise
of the same density,

    R = σ² · 2T / Ts.

A wrong tilt lets g sin δ into v̇, and its integral grows where e does not. σ is measured: what the acceleration of the
last second adds up to, less the share of a tilt that is not known. What the state's scale and alignment leave over goes
in proportion to the motion, lasts as long, and counts in the same way. A velocity beyond what σ and the covariance
allow for lets the covariance grow, so that a start in motion with an unknown bias is found out.

Where rate and force stay the same, the rate is the bias:  s_G = b_g + e_ω.  The variance of e_ω is measured too, from
what rate and force have moved by over the memory M, and its noise is var(e_ω) · 2M / Ts. There is no threshold of rest,
but two limits: a rate that no bias reaches is a turn, and a bias that is known does not jump. A slow turn about the
vertical, at a constant rate from switch-on, cannot be told from a bias.

A low-pass filter in the sensor delays force and rate alike: the tilt that is given is turned on by the last rate for
that long (`delay_s` of the rig). The height is Zᵀd, of a J2S that is known.

Source: the sensor model is (2), (3) of the link paper. White noise of density 2σ²T stands for a first-order
Gauss-Markov process of variance σ² and correlation time T: it is that process's density at low frequencies.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inlined
from linkpose.filters import _vector as vec
from linkpose.filters._imu import (
    GRAVITY,
    LONGEST_GAP_S,
    Floats,
    ImuCalibration,
    blind_for,
    read_accel,
    read_gyro,
    rotation_variance,
)
from linkpose.filters._inertial import (
    AT_ONCE,
    BA,
    BG,
    MA,
    MG,
    PACE_S,
    SIZE,
    ZERO,
    D,
    SensorErrors,
    Since,
    V,
    Z,
    catch_up,
    corrected,
    fade,
    height,
    keep_since,
    predict,
    recall_since,
    set_upright,
    take,
    take_three,
    trace,
)
from linkpose.filters._vector import Vec
from linkpose.filters.tilt import unknown_accel
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

_DOUBT = 6.0  # times its mean square that a velocity may be before the covariance is doubted
_LARGEST_VARIANCE = 1e6  # of a tilt: of one that may be any it is 1
_GATE = 25.0  # χ² of a rate at rest, with one degree of freedom: five standard deviations
_LARGEST_RAD_S = 0.5  # gyro bias that can be, half as much again as the data sheet's ±20 °/s: else begin anew

# Without a joint little tells scale and alignment: they are believed to be those of a good part, the bias may be any
# that a part has at switch-on.
_BELIEF = SensorErrors(0.17, 0.003, 0.0015, 0.02, 0.0015, 0.0005, 200.0)


class TiltInertialParameters(NamedTuple):
    """What the filter assumes."""

    bias_walk_rad_s: float = 3e-4  # in a second: 1 °/s in the hour of warming up
    accel_misfit: float = 0.01  # what the state's scale and alignment leave over, as a share of the force,
    gyro_misfit: float = 0.005  # and of the rate
    first_speed_m_s: float = 0.5  # σ before it has been measured
    least_speed_m_s: float = 0.01  # σ at rest
    most_speed_m_s: float = 2.0  # σ of an arm that throws
    swing_time_s: float = 1.0  # over which acceleration is added up to measure σ,
    speed_memory_s: float = 2.0  # and over which that is averaged
    correlation_s: float = 0.15  # T of the velocity, and of the errors in proportion
    grow_s: float = 1.0  # in which a covariance that is doubted grows e-fold
    calm_memory_s: float = 0.1  # M, over which rate and force are to stay the same
    swing_share: float = 3.0  # a rate that moves by so much in M moves by this times as much in a whole motion
    least_turn_rad_s: float = 0.001  # standard deviation of the rate of a sensor that is held still


class Now(NamedTuple):
    """The registers, while a block is worked through."""

    time: float  # of the last sample (s), NaN before the first
    held: float  # for how long the rate has had to do (s)
    force: Vec  # last usable (m/s²)
    rate: Vec  # last usable (rad/s)
    change: Vec  # of the force in the last step (m/s²)
    since: Since


class State(NamedTuple):
    """What the filter remembers from one block to the next; changed in place."""

    now: Floats  # (20,) the fields of Now, one after the other
    mean: Floats  # (33,)
    covariance: Floats  # (33, 33)
    start_mean: Floats  # (33,) of the sensors' errors, before anything was measured: none
    prior: Floats  # (33,) their variances then
    speed: Floats  # (4,) velocity that the last second's acceleration adds up to (m/s), σ² (m²/s²)
    calm: Floats  # (7,) means of force and rate over M, mean square of what moved (rad²/s²)
    faded: Floats  # (1,) time since beliefs last faded (s)
    work: Floats  # (12, 33) F P; errors of ω and f, within a step
    cross: Floats  # (3, 33) H P, within a step
    counts: NDArray[np.int64]  # (2,) rejected samples, restarts

    @staticmethod
    def fresh() -> State:
        return State(
            np.concatenate([[np.nan], np.zeros(19)]),
            np.zeros(SIZE),
            np.zeros((SIZE, SIZE)),
            np.zeros(SIZE),
            _BELIEF.variances(),
            np.zeros(4),
            np.zeros(7),
            np.zeros(1),
            np.zeros((12, SIZE)),
            np.zeros((3, SIZE)),
            np.zeros(2, np.int64),
        )


class TiltInertialFilter:
    """The filter over blocks of samples. Without J2S there is no height, and its columns are NaN."""

    name = "tilt-inertial"
    columns = (
        "tilt_inertial_height_m",
        "tilt_inertial_height_std_m",
        "tilt_inertial_roll_deg",
        "tilt_inertial_pitch_deg",
    )

    def __init__(self, rig: Rig, parameters: TiltInertialParameters | None = None) -> None:
        self.parameters = parameters or TiltInertialParameters()
        self.state = State.fresh()
        self._imu = ImuCalibration.of(rig.imu)
        self._j2s = rig.joint.known_j2s_m or (math.nan, math.nan, math.nan)

    @property
    def rejected(self) -> int:
        """Samples so far whose accelerometer, gyro or time could not be used."""
        return int(self.state.counts[0])

    @property
    def restarts(self) -> int:
        """How often the state ran away from what can be, and was begun anew."""
        return int(self.state.counts[1])

    @property
    def gyro_bias_rad_s(self) -> Floats:
        """(3,) as estimated so far, over the rig's calibration."""
        return self.state.mean[BG:BA].copy()

    def process(self, block: Measurements) -> Floats:
        """Height and its standard deviation (m), roll and pitch (°) at each of the N samples: (N, 4)."""
        out = np.empty((len(block), 4))
        _process(
            block.time_s, block.accel_m_s2, block.gyro_rad_s, block.flags,
            self._imu, self.parameters, self._j2s, self.state, out,
        )  # fmt: skip
        return out


@compiled
def _set_upright(state: State, force: Vec, rate: Vec, imu: ImuCalibration, q: TiltInertialParameters) -> None:
    """Tilt from the force, as if nothing had been known of it; a velocity that may be any."""
    square = max(q.first_speed_m_s**2, state.speed[3])  # what has been measured of it stays
    accel = imu.accel_variance + unknown_accel(force, rate)
    set_upright(state.mean, state.covariance, force, accel, ZERO, square)
    vec.put(state.speed, 0, ZERO)
    state.speed[3] = square
    vec.put(state.calm, 0, force)
    vec.put(state.calm, 3, rate)
    state.calm[6] = 1.0


@compiled
def _begin(state: State, force: Vec, rate: Vec, imu: ImuCalibration, q: TiltInertialParameters) -> None:
    """Mean and covariance from one sample and the priors."""
    state.mean[:] = 0.0
    state.covariance[:] = 0.0
    for i in range(BG, D):
        state.covariance[i, i] = state.prior[i]
    _set_upright(state, force, rate, imu, q)


@compiled
def _measure_speed(
    x: Floats, p: Floats, swing: Floats, turn: Vec, force: Vec, h: float, q: TiltInertialParameters
) -> None:
    """σ from what the last second's acceleration adds up to, less the share of a tilt that is not known."""
    u = vec.turn_back(turn, vec.at(swing, 0))
    keep = min(h / q.swing_time_s, 1.0)
    f = vec.minus(corrected(x, MA, force), vec.at(x, BA))
    accel = vec.plus(f, -GRAVITY, vec.at(x, Z))
    u = vec.plus(vec.plus(u, -keep, u), h, accel)
    vec.put(swing, 0, u)
    own = trace(p, Z) * (GRAVITY * q.swing_time_s) ** 2
    square = max(vec.dot(u, u) - own, 0.0) / 3.0
    swing[3] += min(h / q.speed_memory_s, 1.0) * (square - swing[3])
    swing[3] = min(max(swing[3], q.least_speed_m_s**2), q.most_speed_m_s**2)


@compiled
def _measure_calm(calm: Floats, force: Vec, rate: Vec, h: float, imu: ImuCalibration, memory: float) -> None:
    """What rate and force have moved by over the memory."""
    keep = min(h / memory, 1.0)
    moved, turned = vec.minus(force, vec.at(calm, 0)), vec.minus(rate, vec.at(calm, 3))
    vec.put(calm, 0, vec.plus(vec.at(calm, 0), keep, moved))
    vec.put(calm, 3, vec.plus(vec.at(calm, 3), keep, turned))
    # A force that turns by so much in this time is that rate of turn.
    leaning = max(vec.dot(moved, moved) - 6.0 * imu.accel_variance, 0.0) / (GRAVITY * memory) ** 2
    calm[6] += keep * (vec.dot(turned, turned) + leaning - calm[6])


@compiled
def _correct_by_speed(state: State, h: float, q: TiltInertialParameters) -> None:
    """0 = v + e"""
    x, p, cross, square = state.mean, state.covariance, state.cross, state.speed[3]
    v, s = vec.at(x, V), (p[V, V], p[V, V + 1], p[V, V + 2], p[V + 1, V + 1], p[V + 1, V + 2], p[V + 2, V + 2])
    for c in range(3):
        for j in range(SIZE):
            cross[c, j] = p[V + c, j]
    noise = square * max(2.0 * q.correlation_s / h, 1.0)
    take_three(x, p, cross, (-v[0], -v[1], -v[2]), vec.inverse(vec.plus_diagonal(s, noise)))
    # A velocity that the covariance does not allow for: tilt or bias were believed too early (a start in motion).
    if vec.dot(v, v) > _DOUBT * (vec.trace(s) + 3.0 * square):
        grow = 1.0 + min(h / q.grow_s, 1.0)
        for i in range(SIZE):
            for j in range(SIZE):
                p[i, j] *= grow


@compiled
def _correct_by_calm(
    x: Floats, p: Floats, calm: Floats, rate: Vec, h: float, imu: ImuCalibration, q: TiltInertialParameters
) -> None:
    """Where rate and force stay the same, the rate is the gyro's bias: the less they move, the more it is."""
    moving = max(calm[6] - 6.0 * imu.gyro_variance, 0.0)
    variance = q.swing_share**2 * moving + q.least_turn_rad_s**2
    steady = vec.at(calm, 3)
    if vec.dot(steady, steady) > _LARGEST_RAD_S**2:
        return  # no bias, but a turn at a constant rate
    noise = variance * max(2.0 * q.calm_memory_s / h, 1.0)
    for j in range(3):
        c = BG + j
        innovation = rate[j] - x[c]
        if innovation * innovation < _GATE * (p[c, c] + variance):  # a bias does not jump
            take(x, p, c, innovation, noise)
    vec.put(x, Z, vec.unit(vec.at(x, Z)))


@inlined
def _runs_away(x: Floats, p: Floats) -> bool:
    """Whether mean or covariance is beyond what can be; NaN is."""
    b = vec.at(x, BG)
    can_be = vec.dot(b, b) < _LARGEST_RAD_S**2 and trace(p, Z) < _LARGEST_VARIANCE
    return not (can_be and math.isfinite(x[0] + x[3] + x[4] + x[5]))


@compiled
def _close(state: State, since: Since, good: bool, rate: Vec, imu: ImuCalibration, q: TiltInertialParameters) -> None:
    """Brings the covariance up to the mean, and corrects both."""
    x, p, h = state.mean, state.covariance, since.span
    lasting = max(2.0 * q.correlation_s / h, 1.0)
    rotation = lasting * q.gyro_misfit**2 * vec.dot(since.turned, since.turned)
    gained = lasting * q.accel_misfit**2 * vec.dot(since.impulse, since.impulse)
    catch_up(x, p, state.work, since, rotation, gained, q.bias_walk_rad_s**2 * h)
    fade(x, p, state.faded, h, _BELIEF.fade_s, state.start_mean, state.prior)
    _correct_by_speed(state, h, q)
    if good:
        _correct_by_calm(x, p, state.calm, rate, h, imu, q)


@inlined
def _advance(
    state: State, x: Floats, p: Floats, now: Now, time_s: float, has_force: bool, force: Vec, has_rate: bool, rate: Vec,
    imu: ImuCalibration, q: TiltInertialParameters,
) -> Now:  # fmt: skip
    """One sample later."""
    h, good = time_s - now.time, has_force and has_rate
    force = force if has_force else now.force
    held = blind_for(now.held, h, has_rate, LONGEST_GAP_S)
    rate = rate if has_rate else now.rate
    angle = vec.plus(vec.plus(ZERO, 0.5 * h, now.rate), 0.5 * h, rate)
    change, doubt = vec.minus(force, now.force), rotation_variance(h, held, imu)
    bend = vec.minus(change, now.change)
    since = predict(x, now.since, angle, doubt, now.force, force, bend, has_force, h, imu)
    _measure_speed(x, p, state.speed, vec.plus(since.turned, -1.0, now.since.turned), force, h, q)
    if good:
        _measure_calm(state.calm, force, rate, h, imu, q.calm_memory_s)
    if since.span > PACE_S:
        _close(state, since, good, rate, imu, q)
        since = AT_ONCE
    if _runs_away(x, p):
        _begin(state, force, rate, imu, q)
        state.counts[1] += 1
        since = AT_ONCE
    return Now(time_s, held, force, rate, change, since)


@inlined
def _recall(a: Floats) -> Now:
    """The registers as they were left."""
    return Now(a[0], a[1], vec.at(a, 2), vec.at(a, 5), vec.at(a, 8), recall_since(a, 11))


@inlined
def _keep(a: Floats, now: Now) -> None:
    """The registers for the next block."""
    a[0], a[1] = now.time, now.held
    vec.put(a, 2, now.force)
    vec.put(a, 5, now.rate)
    vec.put(a, 8, now.change)
    keep_since(a, 11, now.since)


@compiled
def _process(
    time_s: Floats,
    accel: Floats,
    gyro: Floats,
    flags: NDArray[np.uint16],
    imu: ImuCalibration,
    q: TiltInertialParameters,
    j2s: Vec,
    state: State,
    out: Floats,
) -> None:
    x, p = state.mean, state.covariance
    now, rejected = _recall(state.now), 0
    for i in range(len(time_s)):
        has_force, force = read_accel((accel[i, 0], accel[i, 1], accel[i, 2]), flags[i], imu)
        has_rate, rate = read_gyro((gyro[i, 0], gyro[i, 1], gyro[i, 2]), flags[i], imu)
        h, good, first = time_s[i] - now.time, has_force and has_rate, math.isnan(now.time)
        if good and (first or max(h, now.held) > LONGEST_GAP_S) and math.isfinite(time_s[i]):
            if first:
                _begin(state, force, rate, imu, q)
            else:
                _set_upright(state, force, rate, imu, q)
            now = Now(time_s[i], 0.0, force, rate, ZERO, AT_ONCE)
        elif 0.0 < h < math.inf:
            now = _advance(state, x, p, now, time_s[i], has_force, force, has_rate, rate, imu, q)
        else:
            good = False
        rejected += not good
        if math.isnan(now.time):
            out[i, :] = np.nan
        else:
            ahead = corrected(x, MG, vec.plus(ZERO, imu.delay, vec.minus(now.rate, vec.at(x, BG))))
            tilt = vec.turn_back(ahead, vec.at(x, Z))
            out[i, 0], out[i, 1] = height(tilt, j2s, p, vec.plus(now.since.turned, 1.0, ahead))
            out[i, 2], out[i, 3] = vec.roll_pitch(tilt)
    _keep(state.now, now)
    state.counts[0] += rejected
