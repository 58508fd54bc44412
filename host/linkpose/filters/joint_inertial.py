"""`joint-inertial`: the joint's constraint on the velocity, with the sensors' errors and J2S in the state.

Method A needs the derivative of the gyro. Here the accelerometer is integrated instead, and the velocity that comes of
it must be the one that the angular rate gives the sensor. The state, all in the sensor's frame s:

    Z    tilt, n's Z axis                       Ż = −(s_G − b_g) × Z
    v    velocity of the sensor (m/s)           v̇ = −(s_G − b_g) × v + s_A − b_a − g Z
    b_g  bias of the gyro (rad/s)               random walk
    b_a  bias of the accelerometer (m/s²)       first-order Gauss-Markov
    d    J2S as the gyro tells it (m)           constant

and at every sample the measurement  0 = v − (s_G − b_g) × d + n_G × d + e.  Over a step the frame turns by the exact
exponential of the mean rate, v is integrated by the trapezoid, and ‖Z‖ = 1 is kept. Nothing is differentiated, no rest
is needed, and motion tells the biases and d apart; a rest, where there is one, tells b_g outright. The height is Zᵀd.

A motion in a plane does not tell b_a across it from a leaning Z. There b_a keeps to what it can be (Gauss-Markov), and
Z is as good as that. A reading that repeats the last one to the last bit is an old one, read again by a logger that is
faster than the sensor: the step waits for the next new force, with the angle summed over the rates that came.

What the model leaves out is scale and alignment. Each sensor's is taken for noise in proportion to what it reads. A
gyro that reads 1 % more sees a lever that is 1 % shorter: d is J2S with such an error, and the height is
Zᵀ(d₀ + w(d − d₀)), with w the share of J2S's own doubt in that of d (0 for a J2S that was measured, 1 for one that is
unknown). What fits neither way (e) is measured: the share of ω×d that was left over in the last seconds.

Source: the constraint is (9) of the link paper, once integrated.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.filters import _vector as vec
from linkpose.filters._imu import (
    GRAVITY,
    Floats,
    ImuCalibration,
    read_accel,
    read_gyro,
    rotation_variance,
)
from linkpose.filters._vector import Vec, compiled, inlined
from linkpose.filters.tilt import start
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

_N = 15
_Z, _V, _BG, _BA, _D = 0, 3, 6, 9, 12  # where each begins in the state
_CLEAR = 30.0  # ‖ω‖² over its noise's, from which on it tells d; noise that is read as a rotation would, too
_GATE = 25.0  # χ² with 3 degrees of freedom: one sound sample in 65 000
_JUMP_RAD_S, _JUMP_M_S2 = 1.0, 10.0  # from one sample to the next: no motion of a link, but a spike
_SMALL_RAD2 = 0.01  # variance of a tilt up to which its error lies across it,
_NONE_RAD2 = 1e-6  # and has no more than this along it
_GAP_ACCEL_M_S2 = 10.0  # where the accelerometer did not see
_SNAP_M_S4 = 500.0  # of a hand's motion, the force's second derivative: between two readings h apart it bends by h²/12
_LONGEST_BLIND_S = 0.3  # without a rate, a moving link has turned by more than its tilt can be guessed to
LONGEST_HOLD_S = 0.1  # readings that stay the same, all axes to the last bit, for less are an old one read again
_REST_S = 0.5  # of stillness that tells the gyro's bias
_REST_STD_RAD_S = 0.001  # of a link that is held still
_REST_SIGMAS = 5.0  # within which the readings stay at rest
_LOST, _LOST_M2_S2 = 0.5, 0.01  # share of (ω×d)² left over for seconds, where there is that much: the tilt is wrong
_LARGEST = (1.0, 5.0, 10.0)  # gyro bias (rad/s), accelerometer bias (m/s²), J2S (m) that can be: else begin anew


class JointInertialParameters(NamedTuple):
    """What the filter assumes."""

    gyro_bias_std_rad_s: float = 0.35  # at switch-on: the data sheet's ±20 °/s
    gyro_bias_walk_rad_s: float = 1e-4  # in a second
    # The accelerometer's follows its temperature: the data sheet's ±35 mg over 70 °C (x, y; ±60 mg for z) are 6 mg in a
    # dozen degrees. The time is no data sheet's: within what the simulated Tests allow, both were chosen on recordings
    # of a pendulum.
    accel_bias_std_m_s2: float = 0.06
    accel_bias_time_s: float = 100.0  # after which e⁻¹ of it is left
    j2s_walk: float = 0.001  # of J2S in a second, as a share of what it was not known to at the start
    accel_misfit: float = 0.002  # noise in proportion to the force: scale and alignment
    gyro_misfit: float = 0.003  # noise of the rotation in proportion to it
    lever_misfit: float = 0.005  # of the lever that the gyro tells, as a share of ‖d₀‖
    least_misfit: float = 0.002  # of the constraint, as a share of ‖ω×d‖
    first_misfit: float = 0.03  # before it has been measured
    misfit_time_s: float = 4.0  # over which it is measured
    velocity_floor_m_s: float = 0.001  # play of the joint, bend of the link


class Lever(NamedTuple):
    """What is known of J2S beforehand."""

    j2s: Vec  # d₀ (m)
    variance: float  # of d about d₀, each axis (m²)
    share: float  # w: how much of d − d₀ is J2S's
    rest: float  # variance of J2S that d cannot take away (m²)


class State(NamedTuple):
    """What the filter remembers from one block to the next; changed in place."""

    time: Floats  # (4,) of the last step, NaN before the first; of no rate (s); of the last turn; its variance (rad²)
    mean: Floats  # (15,) Z, v, b_g, b_a, d
    covariance: Floats  # (15, 15)
    last: Floats  # (4, 3) force and rate at the last step (m/s², rad/s), newest rate, angle turned since (rad)
    rest: Floats  # (7,) for how long it has been still (s), first force, sum over time of the rate
    misfit: Floats  # (2,) mean squares of the excess innovation and of ‖ω‖‖d‖ (m/s)²
    work: Floats  # (6, 15) F P, within a step
    cross: Floats  # (15, 3) P Hᵀ, within a step
    gain: Floats  # (15, 3) within a step
    counts: NDArray[np.int64]  # (2,) rejected samples, restarts

    @staticmethod
    def fresh() -> State:
        return State(
            np.array([np.nan, 0.0, np.nan, 0.0]),
            np.zeros(_N),
            np.zeros((_N, _N)),
            np.zeros((4, 3)),
            np.zeros(7),
            np.zeros(2),
            np.zeros((6, _N)),
            np.zeros((_N, 3)),
            np.zeros((_N, 3)),
            np.zeros(2, np.int64),
        )


class JointInertialFilter:
    """The filter over blocks of samples. J2S is known to the rig's standard deviation, and estimated from there."""

    name = "joint-inertial"
    columns = (
        "joint_inertial_height_m",
        "joint_inertial_height_std_m",
        "joint_inertial_roll_deg",
        "joint_inertial_pitch_deg",
    )

    def __init__(self, rig: Rig, parameters: JointInertialParameters | None = None) -> None:
        """The rig must know J2S, be it as roughly as `j2s_std_m` says."""
        assert rig.joint.j2s_m is not None
        self.parameters = parameters or JointInertialParameters()
        self.state = State.fresh()
        self._imu = ImuCalibration.of(rig.imu)
        j2s, self._j2s_std = rig.joint.j2s_m, rig.joint.j2s_std_m
        own, gyros = self._j2s_std**2, self.parameters.lever_misfit**2 * sum(c * c for c in j2s)
        self._lever = Lever(j2s, own + gyros, own / (own + gyros), gyros * own / (own + gyros))

    @property
    def rejected(self) -> int:
        """Samples so far that could not be used, or whose innovation the gate refused."""
        return int(self.state.counts[0])

    @property
    def restarts(self) -> int:
        """How often the state ran away from what can be, and was begun anew."""
        return int(self.state.counts[1])

    @property
    def j2s_m(self) -> tuple[Floats, Floats]:
        """J2S as estimated so far, and its covariance: (3,) m, (3, 3) m². Before the first sample, the rig's."""
        nominal, _, share, rest = self._lever
        if math.isnan(self.state.time[0]):
            return np.array(nominal), self._j2s_std**2 * np.eye(3)
        mean = np.array(nominal) + share * (self.state.mean[_D:] - nominal)
        return mean, share**2 * self.state.covariance[_D:, _D:] + rest * np.eye(3)

    @property
    def gyro_bias_rad_s(self) -> Floats:
        """(3,) as estimated so far, over the rig's calibration."""
        return self.state.mean[_BG:_BA].copy()

    @property
    def accel_bias_m_s2(self) -> Floats:
        """(3,) as estimated so far, over the rig's calibration."""
        return self.state.mean[_BA:_D].copy()

    def process(self, block: Measurements) -> Floats:
        """Height and its standard deviation (m), roll and pitch (°) at each of the N samples: (N, 4)."""
        out = np.empty((len(block), 4))
        _process(
            block.time_s, block.accel_m_s2, block.gyro_rad_s, block.flags,
            self._imu, self.parameters, self._lever, self.state, out,
        )  # fmt: skip
        return out


@compiled
def _minus(a: Vec, b: Vec) -> Vec:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@compiled
def _along(variance: float) -> float:
    """Variance of Z along itself when it is turned by angles of this variance: cosines fall short of 1."""
    return 0.5 * min(max(variance - _SMALL_RAD2, 0.0), 1.0) ** 2


@compiled
def _begin(
    x: Floats,
    p: Floats,
    misfit: Floats,
    force: Vec,
    rate: Vec,
    imu: ImuCalibration,
    q: JointInertialParameters,
    lever: Lever,
) -> None:
    """Mean and covariance from one sample and the priors."""
    x[:] = 0.0
    p[:] = 0.0
    for i in range(3):
        p[_BG + i, _BG + i] = q.gyro_bias_std_rad_s**2
        p[_BA + i, _BA + i] = q.accel_bias_std_m_s2**2
        p[_D + i, _D + i] = lever.variance
    vec.put(x, _D, lever.j2s)
    _set_upright(x, p, force, rate, imu)
    misfit[0], misfit[1] = 0.5 * q.first_misfit**2, 0.5


@compiled
def _set_upright(x: Floats, p: Floats, force: Vec, rate: Vec, imu: ImuCalibration) -> None:
    """Tilt from the force, velocity from the constraint, as if nothing had been known of them."""
    variance_a = p[_BA, _BA]
    tilt, s = start(force, rate, imu)
    vec.put(x, _Z, tilt)
    bias, d = vec.at(x, _BG), vec.at(x, _D)
    vec.put(x, _V, vec.cross(_minus(rate, bias), d))
    for i in range(6):
        for j in range(_N):
            p[i, j] = p[j, i] = 0.0
    tangent = vec.cross_square(tilt, 1.0)
    s = vec.add(s, variance_a / GRAVITY**2, tangent)
    s = vec.add(s, _along(0.5 * vec.trace(s)), vec.outer(tilt))
    reach = vec.dot(d, d) + p[_D, _D] + p[_D + 1, _D + 1] + p[_D + 2, _D + 2]
    speed = (vec.dot(rate, rate) + p[_BG, _BG] + p[_BG + 1, _BG + 1] + p[_BG + 2, _BG + 2]) * reach
    k = 0
    for i in range(3):
        p[_V + i, _V + i] = speed + 1e-4
        for j in range(i, 3):
            p[i, j] = p[j, i] = s[k]
            # A bias of the accelerometer leans the tilt that is read off it: δZ = −(I − ZZᵀ) δb_a / g
            p[i, _BA + j] = p[_BA + j, i] = -tangent[k] * variance_a / GRAVITY
            p[j, _BA + i] = p[_BA + i, j] = p[i, _BA + j]
            k += 1


@inlined
def _spread(
    z: Vec, v: Vec, b: Vec, a: Vec, rows: tuple[Vec, Vec, Vec], tilt: Vec, velocity: Vec, h: float
) -> tuple[Vec, Vec]:
    """Errors of tilt and velocity after a step, from small ones of tilt, velocity and the biases before it."""
    z = (vec.dot(rows[0], z), vec.dot(rows[1], z), vec.dot(rows[2], z))
    g, by_tilt, by_velocity = GRAVITY * h, vec.cross(tilt, b), vec.cross(velocity, b)
    v = (
        vec.dot(rows[0], v) - g * z[0] - h * (by_velocity[0] + a[0]),
        vec.dot(rows[1], v) - g * z[1] - h * (by_velocity[1] + a[1]),
        vec.dot(rows[2], v) - g * z[2] - h * (by_velocity[2] + a[2]),
    )
    return (z[0] - h * by_tilt[0], z[1] - h * by_tilt[1], z[2] - h * by_tilt[2]), v


@inlined
def _predict_mean(x: Floats, turn: Vec, before: Vec, force: Vec, h: float) -> tuple[Vec, Vec]:
    """Tilt and velocity after a step `h` that turns the frame by `turn` (rad), with the forces at its ends."""
    tilt, velocity, bias = vec.at(x, _Z), vec.at(x, _V), vec.at(x, _BA)
    half = 0.5 * h
    velocity = (
        velocity[0] + half * (before[0] - bias[0] - GRAVITY * tilt[0]),
        velocity[1] + half * (before[1] - bias[1] - GRAVITY * tilt[1]),
        velocity[2] + half * (before[2] - bias[2] - GRAVITY * tilt[2]),
    )
    tilt, velocity = vec.unit(vec.turn_back(turn, tilt)), vec.turn_back(turn, velocity)
    velocity = (
        velocity[0] + half * (force[0] - bias[0] - GRAVITY * tilt[0]),
        velocity[1] + half * (force[1] - bias[1] - GRAVITY * tilt[1]),
        velocity[2] + half * (force[2] - bias[2] - GRAVITY * tilt[2]),
    )
    return tilt, velocity


@inlined
def _predict_covariance(p: Floats, work: Floats, turn: Vec, tilt: Vec, velocity: Vec, h: float) -> None:
    """F P Fᵀ; only the rows and columns of tilt and velocity change."""
    back = (-turn[0], -turn[1], -turn[2])
    rows = (
        vec.turn_back(back, (1.0, 0.0, 0.0)),
        vec.turn_back(back, (0.0, 1.0, 0.0)),
        vec.turn_back(back, (0.0, 0.0, 1.0)),
    )
    for j in range(_N):
        z, v = _spread(
            (p[0, j], p[1, j], p[2, j]), (p[3, j], p[4, j], p[5, j]), (p[6, j], p[7, j], p[8, j]),
            (p[9, j], p[10, j], p[11, j]), rows, tilt, velocity, h,
        )  # fmt: skip
        work[0, j], work[1, j], work[2, j] = z
        work[3, j], work[4, j], work[5, j] = v
    for i in range(6):
        z, v = _spread(
            (work[i, 0], work[i, 1], work[i, 2]), (work[i, 3], work[i, 4], work[i, 5]),
            (work[i, 6], work[i, 7], work[i, 8]), (work[i, 9], work[i, 10], work[i, 11]), rows, tilt, velocity, h,
        )  # fmt: skip
        p[i, 0], p[i, 1], p[i, 2] = z
        p[i, 3], p[i, 4], p[i, 5] = v
        for j in range(6, _N):
            p[i, j] = p[j, i] = work[i, j]


@compiled
def _add_noise(
    p: Floats,
    tilt: Vec,
    velocity: Vec,
    rotation: float,
    accel: float,
    j2s: float,
    h: float,
    q: JointInertialParameters,
) -> None:
    """Noise of a step: variances of its rotation (rad²), of the velocity gained (m²/s²), of J2S (m²); random walks."""
    # The same wrong rotation turns tilt and velocity: [Z×][Z×]ᵀ, [v×][v×]ᵀ, and [Z×][v×]ᵀ = (Z·v) I − v Zᵀ.
    zz, vv, zv = vec.cross_square(tilt, rotation), vec.cross_square(velocity, rotation), vec.dot(tilt, velocity)
    zz = vec.add(zz, _along(rotation), vec.outer(tilt))
    k = 0
    for i in range(3):
        for j in range(i, 3):
            p[_Z + i, _Z + j] += zz[k]
            p[_V + i, _V + j] += vv[k]
            p[_Z + j, _Z + i], p[_V + j, _V + i] = p[_Z + i, _Z + j], p[_V + i, _V + j]
            k += 1
        p[_V + i, _V + i] += accel
        p[_BG + i, _BG + i] += q.gyro_bias_walk_rad_s**2 * h
        p[_D + i, _D + i] += j2s
        for j in range(3):
            share = rotation * ((zv if i == j else 0.0) - velocity[i] * tilt[j])
            p[_Z + i, _V + j] += share
            p[_V + j, _Z + i] = p[_Z + i, _V + j]


@compiled
def _forget_bias(x: Floats, p: Floats, h: float, q: JointInertialParameters) -> None:
    """The accelerometer's bias after a step: first-order Gauss-Markov, so that what no motion tells stays bounded."""
    kept = math.exp(-h / q.accel_bias_time_s)
    for i in range(_BA, _D):
        x[i] *= kept
        for j in range(_N):
            p[i, j] *= kept
            p[j, i] *= kept
        p[i, i] += (1.0 - kept * kept) * q.accel_bias_std_m_s2**2


@inlined
def _correct(
    x: Floats,
    p: Floats,
    ph: Floats,
    gain: Floats,
    misfit: Floats,
    jumped: bool,
    before: Vec,
    rate: Vec,
    h: float,
    imu: ImuCalibration,
    q: JointInertialParameters,
) -> bool:
    """The constraint 0 = v − ω×d as a measurement. False where the gate refused it, for a reading that jumped.

    d is corrected in the part that the rotation stands out of the gyro's noise: K's rows of d are scaled by it, and P
    follows as P − KHP − PHᵀKᵀ + KSKᵀ.
    """
    d, velocity = vec.at(x, _D), vec.at(x, _V)
    w = _minus(rate, vec.at(x, _BG))
    lever = vec.cross(w, d)
    y = _minus(lever, velocity)
    for i in range(_N):
        by_bias = vec.cross(d, (p[i, 6], p[i, 7], p[i, 8]))
        by_lever = vec.cross(w, (p[i, 12], p[i, 13], p[i, 14]))
        for c in range(3):
            ph[i, c] = p[i, 3 + c] - by_bias[c] - by_lever[c]
    s = _innovation_covariance(ph, d, w)
    # Beyond first order: the product of two unknowns, δb_g × δd, while both are wide.
    product = 0.5 * (p[6, 6] + p[7, 7] + p[8, 8]) * (p[12, 12] + p[13, 13] + p[14, 14])
    s = vec.add(vec.plus_diagonal(s, product + q.velocity_floor_m_s**2), imu.gyro_variance, vec.cross_square(d, 1.0))
    moved = _minus(before, vec.at(x, _BG)) if jumped else w  # a spike must not excuse itself
    reach = vec.dot(moved, moved) * vec.dot(d, d)
    share = min(max(misfit[0] / misfit[1], q.least_misfit**2), 1.0)
    keep = min(h / q.misfit_time_s, 1.0)
    inverse = vec.inverse(vec.plus_diagonal(s, share * reach))
    distance = vec.quadratic(inverse, y)
    excess = (min(vec.dot(y, y), _GATE * (vec.trace(s) + 3.0 * share * reach)) - vec.trace(s)) / 3.0
    misfit[0] += keep * (excess - misfit[0])
    misfit[1] += keep * (reach - misfit[1])
    if not distance <= _GATE:
        if jumped:
            return False
        inverse = vec.scaled(_GATE / distance, inverse)  # it is the state that is doubted, but with care
    told = min(max(vec.dot(w, w) / (_CLEAR * 3.0 * imu.gyro_variance) - 1.0, 0.0), 1.0)
    for i in range(_N):
        k = vec.apply(inverse, (ph[i, 0], ph[i, 1], ph[i, 2]))
        gain[i, 0], gain[i, 1], gain[i, 2] = k
        x[i] += vec.dot(k, y) if i < _D else told * vec.dot(k, y)
    for i in range(_N):
        for j in range(i, _N):
            part = 1.0 if i < _D else told * (2.0 - told)
            p[i, j] -= part * (gain[i, 0] * ph[j, 0] + gain[i, 1] * ph[j, 1] + gain[i, 2] * ph[j, 2])
            p[j, i] = p[i, j]
    tilt = vec.unit(vec.at(x, _Z))
    vec.put(x, _Z, tilt)
    block = (p[0, 0], p[0, 1], p[0, 2], p[1, 1], p[1, 2], p[2, 2])
    if vec.quadratic(block, tilt) > _NONE_RAD2 and vec.trace(block) < _SMALL_RAD2:
        _flatten(p, tilt)
    return True


@compiled
def _flatten(p: Floats, tilt: Vec) -> None:
    """‖Z‖ = 1 into the covariance: a tilt that is nearly known errs across itself alone."""
    for _ in range(2):  # rows, then by the transposed matrix columns
        for j in range(_N):
            along = vec.dot(tilt, (p[0, j], p[1, j], p[2, j]))
            for i in range(3):
                p[i, j] -= along * tilt[i]
        for i in range(_N):
            for j in range(i):
                p[i, j], p[j, i] = p[j, i], p[i, j]


@inlined
def _innovation_covariance(ph: Floats, d: Vec, w: Vec) -> vec.Sym:
    """H P Hᵀ from P Hᵀ."""
    c0 = _column(ph, 0, d, w)
    c1 = _column(ph, 1, d, w)
    c2 = _column(ph, 2, d, w)
    return (c0[0], 0.5 * (c0[1] + c1[0]), 0.5 * (c0[2] + c2[0]), c1[1], 0.5 * (c1[2] + c2[1]), c2[2])


@inlined
def _column(ph: Floats, c: int, d: Vec, w: Vec) -> Vec:
    by_bias = vec.cross(d, (ph[6, c], ph[7, c], ph[8, c]))
    by_lever = vec.cross(w, (ph[12, c], ph[13, c], ph[14, c]))
    return (
        ph[3, c] - by_bias[0] - by_lever[0],
        ph[4, c] - by_bias[1] - by_lever[1],
        ph[5, c] - by_bias[2] - by_lever[2],
    )


@inlined
def _watch_rest(rest: Floats, force: Vec, rate: Vec, h: float, imu: ImuCalibration) -> bool:
    """Follows how long neither force nor rate has left the noise; True when that is long enough to be a rest."""
    still = rest[0]
    change = _minus(force, vec.at(rest, 1))
    drift = (rate[0] * still - rest[4], rate[1] * still - rest[5], rate[2] * still - rest[6])
    width = 3.0 * _REST_SIGMAS**2
    steady = vec.dot(change, change) < width * imu.accel_variance
    steady = steady and vec.dot(drift, drift) < width * (imu.gyro_variance + _REST_STD_RAD_S**2) * still * still
    if still > 0.0 and not steady:
        rest[0] = 0.0
        return False
    if still == 0.0:
        vec.put(rest, 1, force)
        vec.put(rest, 4, (0.0, 0.0, 0.0))
    rest[0] = still + h
    for j in range(3):
        rest[4 + j] += rate[j] * h
    return bool(rest[0] > _REST_S)


@compiled
def _take_bias_from_rest(x: Floats, p: Floats, rest: Floats) -> None:
    """The gyro's bias is its mean since the rest began, where that says more than is known."""
    variance = _REST_STD_RAD_S**2
    if p[_BG, _BG] + p[_BG + 1, _BG + 1] + p[_BG + 2, _BG + 2] <= 6.0 * variance:
        return
    for i in range(3):
        x[_BG + i] = rest[4 + i] / rest[0]
        for j in range(_N):
            p[_BG + i, j] = p[j, _BG + i] = 0.0
        p[_BG + i, _BG + i] = variance
        x[_V + i] = 0.0


@inlined
def _runs_away(x: Floats) -> bool:
    """Whether the state is beyond what can be; NaN is."""
    bg, ba, d = vec.at(x, _BG), vec.at(x, _BA), vec.at(x, _D)
    can_be = (
        vec.dot(bg, bg) < _LARGEST[0] ** 2 and vec.dot(ba, ba) < _LARGEST[1] ** 2 and vec.dot(d, d) < _LARGEST[2] ** 2
    )
    return not (can_be and math.isfinite(x[0] + x[3] + x[4] + x[5]))


@inlined
def _describe(tilt: Vec, x: Floats, p: Floats, lever: Lever) -> tuple[float, float, float, float]:
    """Height Zᵀ(d₀ + w(d − d₀)) and its standard deviation (m), roll and pitch (°)."""
    w = lever.share
    change = _minus(vec.at(x, _D), lever.j2s)
    d = (lever.j2s[0] + w * change[0], lever.j2s[1] + w * change[1], lever.j2s[2] + w * change[2])
    variance = lever.rest
    for i in range(3):
        for j in range(3):
            variance += d[i] * d[j] * p[_Z + i, _Z + j] + w * w * tilt[i] * tilt[j] * p[_D + i, _D + j]
            variance += 2.0 * w * d[i] * tilt[j] * p[_Z + i, _D + j]
    return (
        vec.dot(tilt, d),
        math.sqrt(max(variance, 0.0)),
        math.degrees(math.atan2(tilt[1], tilt[2])),
        math.degrees(math.atan2(-tilt[0], math.sqrt(tilt[1] * tilt[1] + tilt[2] * tilt[2]))),
    )


@inlined
def _same(a: Vec, b: Vec) -> bool:
    return bool(a[0] == b[0] and a[1] == b[1] and a[2] == b[2])


@inlined
def _add_turn(angle: Vec, before: Vec, rate: Vec, step: float) -> Vec:
    """The angle turned (rad), the gyro's bias in it, after one more step between two rates."""
    half = 0.5 * step
    return (
        angle[0] + half * (before[0] + rate[0]),
        angle[1] + half * (before[1] + rate[1]),
        angle[2] + half * (before[2] + rate[2]),
    )


@inlined
def _less(angle: Vec, h: float, bias: Vec) -> Vec:
    return (angle[0] - h * bias[0], angle[1] - h * bias[1], angle[2] - h * bias[2])


@inlined
def _velocity_variance(force: Vec, has_force: bool, h: float, imu: ImuCalibration, q: JointInertialParameters) -> float:
    """Variance (m²/s²) of the velocity gained over a step: noise, misfit, what a trapezoid leaves of the force."""
    bent = _SNAP_M_S4 / 12.0 * h * h if has_force else _GAP_ACCEL_M_S2
    variance = imu.accel_variance + q.accel_misfit**2 * vec.dot(force, force) + min(bent, _GAP_ACCEL_M_S2) ** 2
    return variance * h * h


@compiled
def _process(
    time_s: Floats,
    accel: Floats,
    gyro: Floats,
    flags: NDArray[np.uint16],
    imu: ImuCalibration,
    q: JointInertialParameters,
    lever: Lever,
    state: State,
    out: Floats,
) -> None:
    x, p, work, ph, gain, misfit = state.mean, state.covariance, state.work, state.cross, state.gain, state.misfit
    rest = state.rest
    last, held, turned_at, spread = state.time[0], state.time[1], state.time[2], state.time[3]
    before_a, before_w = vec.load(state.last[0]), vec.load(state.last[1])
    newest_w, angle = vec.load(state.last[2]), vec.load(state.last[3])
    rejected, restarts = state.counts[0], state.counts[1]
    for i in range(len(time_s)):
        has_force, force = read_accel((accel[i, 0], accel[i, 1], accel[i, 2]), flags[i], imu)
        has_rate, rate = read_gyro((gyro[i, 0], gyro[i, 1], gyro[i, 2]), flags[i], imu)
        h = time_s[i] - last
        good = has_force and has_rate
        begins = math.isnan(last) or (good and max(h, held) > _LONGEST_BLIND_S)
        if begins and good and math.isfinite(time_s[i]):
            if math.isnan(last):
                _begin(x, p, misfit, force, rate, imu, q, lever)
            else:
                _set_upright(x, p, force, rate, imu)
            last, turned_at, held, spread = time_s[i], time_s[i], 0.0, 0.0
            before_a, before_w, newest_w, angle = force, rate, rate, (0.0, 0.0, 0.0)
        elif h > 0.0:
            force = force if has_force else before_a
            rate = rate if has_rate else newest_w
            step = time_s[i] - turned_at
            waits = good and _same(force, before_a) and h < LONGEST_HOLD_S
            jerk = _minus(rate, newest_w)
            jumped = vec.dot(jerk, jerk) > _JUMP_RAD_S**2
            if step > 0.0 and not (waits and (jumped or _same(rate, newest_w))):
                held = 0.0 if has_rate else held + step
                angle = _add_turn(angle, newest_w, newest_w if jumped else rate, step)
                spread += rotation_variance(step, held, imu)
                if jumped:
                    spread += 0.25 * step * step * vec.dot(jerk, jerk)
                turned_at, newest_w = time_s[i], rate
            if not waits:
                turn = _less(angle, h, vec.at(x, _BG))
                tilt, velocity = _predict_mean(x, turn, before_a, force, h)
                _predict_covariance(p, work, turn, tilt, velocity, h)
                vec.put(x, _Z, tilt)
                vec.put(x, _V, velocity)
                noise = _velocity_variance(force, has_force, h, imu, q)
                _forget_bias(x, p, h, q)
                spread += q.gyro_misfit**2 * vec.dot(turn, turn)
                _add_noise(p, tilt, velocity, spread, noise, q.j2s_walk**2 * lever.variance * h, h, q)
                if good and _watch_rest(rest, force, rate, h, imu):
                    _take_bias_from_rest(x, p, rest)
                if has_rate:
                    jump = _minus(force, before_a)
                    jumped = jumped or vec.dot(jump, jump) > _JUMP_M_S2**2
                    if not _correct(x, p, ph, gain, misfit, jumped, before_w, rate, h, imu, q):
                        # A spike: what it did to this step is in doubt, and the next step goes without it.
                        good = False
                        _add_noise(p, tilt, velocity, 0.0, 0.25 * h * h * vec.dot(jump, jump), 0.0, 0.0, q)
                        rate, force = before_w, before_a
                last, before_a, before_w, newest_w = time_s[i], force, rate, rate
                angle, spread = (0.0, 0.0, 0.0), 0.0
                if _runs_away(x) or misfit[0] > _LOST * max(misfit[1], _LOST_M2_S2):
                    _begin(x, p, misfit, force, rate, imu, q, lever)
                    restarts += 1
        else:
            good = False
        rejected += not good
        if math.isnan(last):
            out[i, 0] = out[i, 1] = out[i, 2] = out[i, 3] = np.nan
        else:
            tilt = vec.at(x, _Z)
            if time_s[i] > last:  # while the step waits
                since = _add_turn(angle, newest_w, newest_w, time_s[i] - turned_at)
                tilt = vec.turn_back(_less(since, time_s[i] - last, vec.at(x, _BG)), tilt)
            out[i, 0], out[i, 1], out[i, 2], out[i, 3] = _describe(tilt, x, p, lever)
    state.time[0], state.time[1], state.time[2], state.time[3] = last, held, turned_at, spread
    vec.put(state.last[0], 0, before_a)
    vec.put(state.last[1], 0, before_w)
    vec.put(state.last[2], 0, newest_w)
    vec.put(state.last[3], 0, angle)
    state.counts[0], state.counts[1] = rejected, restarts


