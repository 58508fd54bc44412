"""`joint-inertial`: the joint's constraint on the velocity, with the sensors' errors and J2S in the state.

Method A needs the derivative of the gyro. Here the accelerometer is integrated instead, and the velocity that comes of
it must be the one that the angular rate gives the sensor. The state, all in the sensor's frame s:

    Z    tilt, n's Z axis                       Ż = −ω × Z
    v    velocity of the sensor (m/s)           v̇ = −ω × v + f − g Z
    b_g  bias of the gyro (rad/s)               ω = (I − M_g) (s_G − b_g)
    b_a  bias of the accelerometer (m/s²)       f = (I − M_a) s_A − b_a
    d    J2S (m)
    M_a, M_g   scale, cross-axis sensitivity and alignment of either sensor, nine numbers each

with the measurement  0 = v − ω × d + n_G × d + e.  The errors are constants, but for a slow walk of b_g, and what is
believed of them fades, so that an error of the model does not stay. Nothing is differentiated, no rest is needed, and
motion tells the errors and d apart; a rest, where there is one, tells b_g outright. Readings that may be noise alone
tell nothing of M_a, M_g and d: that noise is in v and ω too, and would be read as a motion. The height is Zᵀd.

The mean is brought forward at each sample: over a step the frame turns by the exact exponential of the mean rate, v is
integrated by the trapezoid with its ends corrected, and ‖Z‖ = 1 is kept. Covariance and measurement follow 25 times in
a second: a faster pace brings no more, since what the constraint leaves over (e) is no white noise. e is measured: the
share of ω×d that was left over in the last seconds. A reading that repeats the last one to the last bit is an old one,
read again by a logger that is faster than the sensor: the step waits for the next new force, with the angle summed over
the rates that came.

Whether the sensors were calibrated is not known, and the two beliefs differ in what they make of a first second. So two
filters run, one with the errors that a calibration leaves (`CALIBRATED`) and one with the data sheet's (`DATA_SHEET`).
A filter whose errors turn out far beyond what it allows for is believed less, and the estimate is the mean of both,
weighted by that belief: e^−χ²/2 of the errors found.

Sources: the constraint is (9) of the link paper, once integrated. The two filters are a multiple-model estimator: D. T.
Magill, "Optimal adaptive estimation of sampled stochastic processes", IEEE Trans. Automatic Control 10(4), 1965.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inlined
from linkpose.filters import _vector as vec
from linkpose.filters._imu import (
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
    OTHERS,
    PACE_S,
    SIZE,
    ZERO,
    D,
    SensorErrors,
    Since,
    V,
    Z,
    add_noise,
    catch_up,
    corrected,
    error,
    fade,
    height,
    keep_since,
    others,
    predict,
    put_errors,
    recall_since,
    set_upright,
    take,
    take_three,
    trace,
)
from linkpose.filters._vector import Vec
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

_CLEAR = 30.0  # square of a reading over its noise's, from which on it tells what multiplies it: noise would, too
_STEADY_SIGMAS = 5.0  # of a force that may be the same as before
_GATE = 25.0  # χ² with 3 degrees of freedom: one sound sample in 65 000
_JUMP_RAD_S, _JUMP_M_S2 = 1.0, 10.0  # from one sample to the next: no motion of a link, but a spike
_START_RAD_S2, _SWING_PER_S = 3.0, 5.0  # angular acceleration that the first sample may hold, and to a rate of 1 rad/s
_LONGEST_BLIND_S = 0.3  # without a rate, a moving link has turned by more than its tilt can be guessed to
LONGEST_HOLD_S = 0.1  # readings that stay the same, all axes to the last bit, for less are an old one read again
_REST_S = 0.5  # of stillness that tells the gyro's bias
_REST_STD_RAD_S = 0.001  # of a link that is held still
_REST_SIGMAS = 5.0  # within which the readings stay at rest
_TURN_SIGMAS = 3.0  # beyond which a rate is a turn, and no bias
_LOST, _LOST_M2_S2 = 0.5, 0.01  # share of (ω×d)² left over for seconds, where there is that much: the tilt is wrong
_LARGEST = (1.0, 5.0, 10.0)  # gyro bias (rad/s), accelerometer bias (m/s²), J2S (m) that can be: else begin anew


CALIBRATED = SensorErrors(0.03, 0.0015, 0.0007, 0.016, 0.0015, 0.0005, 200.0)
DATA_SHEET = SensorErrors(0.2, 0.02, 0.012, 0.3, 0.02, 0.012, 1000.0)
_BELIEFS = (CALIBRATED, DATA_SHEET)
_ODDS = 15.0  # logarithm of those of the first of them, before anything was measured
_OCCAM = 8.0  # the wider belief can explain what is no error of a sensor: what it finds must lie well within it


class JointInertialParameters(NamedTuple):
    """What the filter assumes."""

    gyro_bias_walk_rad_s: float = 3e-4  # in a second: 1 °/s in the hour of warming up
    j2s_walk: float = 0.001  # of J2S in a second, as a share of what it was not known to at the start
    least_misfit: float = 0.0013  # of the constraint, as a share of ‖ω×d‖
    first_misfit: float = 0.03  # before it has been measured
    misfit_time_s: float = 4.0  # over which it is measured
    velocity_floor_m_s: float = 0.001  # play of the joint, bend of the link


class Now(NamedTuple):
    """The registers, while a block is worked through."""

    time: float  # of the last step (s), NaN before the first
    held: float  # for how long the rate has had to do (s)
    turned_at: float  # of the newest rate (s)
    doubt: float  # variance of the angle turned since the last step (rad²)
    force: Vec  # at the last step (m/s²)
    rate: Vec  # at the last step (rad/s)
    newest: Vec  # rate
    angle: Vec  # turned since the last step, the gyro's bias in it (rad)
    change: Vec  # of the force in the last step (m/s²)
    since: Since


class State(NamedTuple):
    """What one filter remembers from one block to the next; changed in place."""

    now: Floats  # (28,) the fields of Now, one after the other
    mean: Floats  # (33,)
    covariance: Floats  # (33, 33)
    start_mean: Floats  # (33,) to begin with; of tilt and velocity it says nothing
    start_covariance: Floats  # (33, 33)
    prior: Floats  # (33,) variances of the sensors' errors, by what is believed of them
    belief: Floats  # (3,) time since it last faded (s); half the χ² of the errors found by it; how long it lasts (s)
    rest: Floats  # (7,) for how long it has been still (s), first force, sum over time of the rate
    steady: Floats  # (3,) force that the accelerometer's matrix is judged by (m/s²)
    misfit: Floats  # (2,) mean squares of the excess innovation and of ‖ω‖‖d‖ (m/s)²
    work: Floats  # (12, 33) F P; errors of ω and f, within a step
    cross: Floats  # (3, 33) H P, within a step
    counts: NDArray[np.int64]  # (2,) rejected samples, restarts

    @staticmethod
    def fresh(belief: SensorErrors, j2s_m: Vec, j2s_std_m: float) -> State:
        prior = belief.variances()
        mean = np.concatenate([np.zeros(D), j2s_m])
        covariance = np.diag(prior + np.repeat([0.0, j2s_std_m**2], [D, 3]))
        return State(
            np.concatenate([[np.nan], np.zeros(27)]),
            np.zeros(SIZE),
            np.zeros((SIZE, SIZE)),
            mean,
            covariance,
            prior,
            np.array([0.0, 0.0, belief.fade_s]),
            np.zeros(7),
            np.zeros(3),
            np.zeros(2),
            np.zeros((12, SIZE)),
            np.zeros((3, SIZE)),
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
        self.states = tuple(State.fresh(belief, rig.joint.j2s_m, rig.joint.j2s_std_m) for belief in _BELIEFS)
        self._imu = ImuCalibration.of(rig.imu)

    @property
    def state(self) -> State:
        """That of the filter that is believed more."""
        first, second = self.states
        return first if _odds(first.belief[1], second.belief[1]) >= 0.0 else second

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
        state = self.state
        begun = not math.isnan(state.now[0])
        mean = state.mean if begun else state.start_mean
        covariance = state.covariance if begun else state.start_covariance
        return mean[D:].copy(), covariance[D:, D:].copy()

    @property
    def gyro_bias_rad_s(self) -> Floats:
        """(3,) as estimated so far, over the rig's calibration."""
        return self.state.mean[BG:BA].copy()

    @property
    def accel_bias_m_s2(self) -> Floats:
        """(3,) as estimated so far, over the rig's calibration."""
        return self.state.mean[BA:MA].copy()

    def start_from(self, learned: JointInertialFilter, backwards: bool = False) -> None:
        """Begins with what another filter has found of J2S and of the sensors; `backwards`: with time reversed.

        The gyro's bias drifts: what was found of it is of the end, where only the reversed time begins.
        """
        first = BG if backwards else BA
        for own, other in zip(self.states, learned.states, strict=True):
            own.start_mean[first:] = other.mean[first:]
            own.start_covariance[first:, first:] = other.covariance[first:, first:]
            if backwards:
                own.start_mean[BG:BA] *= -1
                own.start_covariance[BG:BA] *= -1
                own.start_covariance[:, BG:BA] *= -1

    def process(self, block: Measurements) -> Floats:
        """Height and its standard deviation (m), roll and pitch (°) at each of the N samples: (N, 4)."""
        n = len(block)
        estimates = [np.empty((n, 6)) for _ in _BELIEFS]
        for state, estimate in zip(self.states, estimates, strict=True):
            _process(
                block.time_s, block.accel_m_s2, block.gyro_rad_s, block.flags,
                self._imu, self.parameters, state, estimate,
            )  # fmt: skip
        out = np.empty((n, 4))
        _mix(estimates[0], estimates[1], out)
        return out


@compiled
def _odds(first: float, second: float) -> float:
    """Logarithm of the odds of the first belief, from half the χ² of the sensors' errors that either has found."""
    return _ODDS + _OCCAM * second - first


@compiled
def _mix(first: Floats, second: Floats, out: Floats) -> None:
    """The mean of two filters' estimates, by how much each is believed; its deviation holds how far they differ."""
    for i in range(len(out)):
        odds = min(max(_odds(first[i, 5], second[i, 5]), -50.0), 50.0)
        share = 1.0 / (1.0 + math.exp(-odds))
        rest = 1.0 - share
        apart = first[i, 0] - second[i, 0]
        out[i, 0] = share * first[i, 0] + rest * second[i, 0]
        out[i, 1] = math.sqrt(share * first[i, 1] ** 2 + rest * second[i, 1] ** 2 + share * rest * apart * apart)
        x, y = share * first[i, 2] + rest * second[i, 2], share * first[i, 3] + rest * second[i, 3]
        z = share * first[i, 4] + rest * second[i, 4]
        out[i, 2], out[i, 3] = vec.roll_pitch((x, y, z))


@compiled
def _distance(x: Floats, prior: Floats) -> float:
    """Half the χ² of the errors that were found, by what is believed of the sensors; the gyro's bias may be any."""
    square = 0.0
    for i in range(BA, D):
        square += x[i] * x[i] / prior[i]
    return 0.5 * square


@compiled
def _begin(state: State, force: Vec, rate: Vec, imu: ImuCalibration, q: JointInertialParameters) -> None:
    """Mean and covariance from one sample and the priors."""
    state.mean[:] = state.start_mean
    state.covariance[:] = state.start_covariance
    state.belief[1] = _distance(state.mean, state.prior)
    _set_upright(state.mean, state.covariance, force, rate, imu)
    state.misfit[0], state.misfit[1] = 0.5 * q.first_misfit**2, 0.5


@compiled
def _set_upright(x: Floats, p: Floats, force: Vec, rate: Vec, imu: ImuCalibration) -> None:
    """Tilt from the force, velocity from the constraint, as if nothing had been known of them."""
    w, d = corrected(x, MG, vec.minus(rate, vec.at(x, BG))), vec.at(x, D)
    # The acceleration that there may be: of a link that starts to turn, that swings, that whirls.
    reach, speed = vec.dot(d, d) + trace(p, D), vec.dot(w, w) + trace(p, BG)
    accel = imu.accel_variance + reach * (_START_RAD_S2**2 + speed * (_SWING_PER_S**2 + speed))
    set_upright(x, p, force, accel, vec.cross(w, d), speed * reach + 1e-4)


@compiled
def _correct(
    state: State, jumped: bool, before: Vec, rate: Vec, h: float, imu: ImuCalibration, q: JointInertialParameters
) -> bool:
    """The constraint 0 = v − ω×d as a measurement. False where the gate refused it, for a reading that jumped.

    d is corrected in the part that the rotation stands out of the gyro's noise.
    """
    x, p, work, cross, misfit = state.mean, state.covariance, state.work, state.cross, state.misfit
    d, velocity = vec.at(x, D), vec.at(x, V)
    reading = vec.minus(rate, vec.at(x, BG))
    w = corrected(x, MG, reading)
    y = vec.minus(vec.cross(w, d), velocity)
    clear = _clear(reading, imu.gyro_variance)
    put_errors(p, BG, MG, clear, work, 6)
    for c in range(3):
        (a, b), (ad, bd), (aw, bw) = OTHERS[c], others(d, c), others(w, c)
        for j in range(SIZE):
            by_lever = aw * p[D + b, j] - bw * p[D + a, j]
            cross[c, j] = p[V + c, j] + ad * work[6 + b, j] - bd * work[6 + a, j] - by_lever
    s = _innovation_covariance(cross, d, w, clear)
    # Beyond first order: the product of two unknowns, δb_g × δd, while both are wide.
    product = 0.5 * trace(p, BG) * trace(p, D)
    s = vec.add(vec.plus_diagonal(s, product + q.velocity_floor_m_s**2), imu.gyro_variance, vec.cross_square(d, 1.0))
    moved = vec.minus(before, vec.at(x, BG)) if jumped else w  # a spike must not excuse itself
    reach = vec.dot(moved, moved) * vec.dot(d, d)
    share = min(max(misfit[0] / misfit[1], q.least_misfit**2), 1.0)
    keep = min(h / q.misfit_time_s, 1.0)
    whole = vec.plus_diagonal(s, share * reach)
    inverse = vec.inverse(whole)
    distance = vec.quadratic(inverse, y)
    excess = (min(vec.dot(y, y), _GATE * (vec.trace(s) + 3.0 * share * reach)) - vec.trace(s)) / 3.0
    misfit[0] += keep * (excess - misfit[0])
    misfit[1] += keep * (reach - misfit[1])
    if not distance <= _GATE:
        if jumped:
            return False
        inverse = vec.scaled(_GATE / distance, inverse)  # it is the state that is doubted, but with care
    _take_constraint(x, p, cross, y, inverse, _share_told(vec.dot(w, w), 3.0 * imu.gyro_variance))
    return True


@compiled
def _take_constraint(x: Floats, p: Floats, cross: Floats, y: Vec, inverse: vec.Sym, told: float) -> None:
    """The Kalman correction by the innovation y, with H P in `cross`: d is corrected in the part that is `told`.

    K's rows of d are scaled by it, and P follows as P − KHP − PHᵀKᵀ + KSKᵀ.
    """
    before = vec.at(x, D)
    take_three(x, p, cross, y, inverse)
    if told == 1.0:
        return
    vec.put(x, D, vec.plus(vec.plus(ZERO, 1.0 - told, before), told, vec.at(x, D)))
    for i in range(D, SIZE):
        for j in range(D, SIZE):
            own = cross[0, i] * cross[0, j] + cross[1, i] * cross[1, j] + cross[2, i] * cross[2, j]
            p[i, j] += (1.0 - told) * (1.0 - told) * own


@inlined
def _clear(reading: Vec, variance: float) -> Vec:
    """The components that stand out of the noise. The same noise is in the innovation: times a scale of −1 it is 0."""
    return (
        reading[0] * _share_told(reading[0] * reading[0], variance),
        reading[1] * _share_told(reading[1] * reading[1], variance),
        reading[2] * _share_told(reading[2] * reading[2], variance),
    )


@inlined
def _share_told(square: float, variance: float) -> float:
    """From 0 for a reading that may be noise alone to 1 for one that is clear of it."""
    return min(max(square / (_CLEAR * variance) - 1.0, 0.0), 1.0)


@inlined
def _follow(steady: Floats, force: Vec, slack: float) -> Vec:
    """The force, as far as it has moved by more than noise does; the rest of the way is slack.

    At rest a force that kept its noise would tell the accelerometer's matrix by that: the same noise is in v.
    """
    ahead = vec.minus(force, vec.at(steady, 0))
    distance = math.sqrt(vec.dot(ahead, ahead))
    if distance > slack:
        vec.put(steady, 0, vec.plus(vec.at(steady, 0), 1.0 - slack / distance, ahead))
    return vec.at(steady, 0)


@inlined
def _innovation_covariance(cross: Floats, d: Vec, w: Vec, reading: Vec) -> vec.Sym:
    """H P Hᵀ from H P."""
    turned = cross.T
    c0 = _column(turned, 0, d, w, reading)
    c1 = _column(turned, 1, d, w, reading)
    c2 = _column(turned, 2, d, w, reading)
    return (c0[0], 0.5 * (c0[1] + c1[0]), 0.5 * (c0[2] + c2[0]), c1[1], 0.5 * (c1[2] + c2[1]), c2[2])


@inlined
def _column(ph: Floats, c: int, d: Vec, w: Vec, reading: Vec) -> Vec:
    by_rate = vec.cross(d, error(ph, BG, MG, reading, c))
    by_lever = vec.cross(w, (ph[D, c], ph[D + 1, c], ph[D + 2, c]))
    return (
        ph[3, c] + by_rate[0] - by_lever[0],
        ph[4, c] + by_rate[1] - by_lever[1],
        ph[5, c] + by_rate[2] - by_lever[2],
    )


@inlined
def _watch_rest(rest: Floats, force: Vec, rate: Vec, h: float, imu: ImuCalibration) -> None:
    """Follows how long neither force nor rate has left the noise."""
    still = rest[0]
    change = vec.minus(force, vec.at(rest, 1))
    drift = (rate[0] * still - rest[4], rate[1] * still - rest[5], rate[2] * still - rest[6])
    width = 3.0 * _REST_SIGMAS**2
    steady = vec.dot(change, change) < width * imu.accel_variance
    steady = steady and vec.dot(drift, drift) < width * (imu.gyro_variance + _REST_STD_RAD_S**2) * still * still
    if still > 0.0 and not steady:
        rest[0] = 0.0
        return
    if still == 0.0:
        vec.put(rest, 1, force)
        vec.put(rest, 4, ZERO)
    rest[0] = still + h
    for j in range(3):
        rest[4 + j] += rate[j] * h


@compiled
def _take_bias_from_rest(x: Floats, p: Floats, rest: Floats) -> None:
    """The gyro's bias is its mean since the rest began, where that says more than is known and can be."""
    variance = _REST_STD_RAD_S**2
    if rest[0] <= _REST_S or trace(p, BG) <= 6.0 * variance:
        return
    for c in range(BG, BA):
        innovation = rest[4 + c - BG] / rest[0] - x[c]
        if innovation * innovation > _TURN_SIGMAS**2 * (p[c, c] + variance):
            return  # no rest, but a turn at a constant rate
    for c in range(BG, BA):
        take(x, p, c, rest[4 + c - BG] / rest[0] - x[c], variance)


@inlined
def _runs_away(x: Floats, found: float) -> bool:
    """Whether the mean or the χ² of the errors found is beyond what can be; NaN is."""
    bg, ba, d = vec.at(x, BG), vec.at(x, BA), vec.at(x, D)
    can_be = (
        vec.dot(bg, bg) < _LARGEST[0] ** 2 and vec.dot(ba, ba) < _LARGEST[1] ** 2 and vec.dot(d, d) < _LARGEST[2] ** 2
    )
    return not (can_be and math.isfinite(x[0] + x[3] + x[4] + x[5] + found))


@inlined
def _same(a: Vec, b: Vec) -> bool:
    return bool(a[0] == b[0] and a[1] == b[1] and a[2] == b[2])


@compiled
def _close(
    state: State, since: Since, has_rate: bool, jumped: bool, before: Vec, rate: Vec, imu: ImuCalibration,
    q: JointInertialParameters,
) -> bool:  # fmt: skip
    """Brings the covariance up to the mean, and corrects both. False where the correction was refused."""
    x, p, h = state.mean, state.covariance, since.span
    slack = _STEADY_SIGMAS * math.sqrt(imu.accel_variance)
    force = _follow(state.steady, vec.plus(ZERO, 1.0 / h, since.impulse), slack)
    since = Since(h, since.turned, vec.plus(ZERO, h, force), since.rotation, since.velocity)
    catch_up(x, p, state.work, since, 0.0, 0.0, q.gyro_bias_walk_rad_s**2 * h)
    for i in range(D, SIZE):
        p[i, i] += q.j2s_walk**2 * state.start_covariance[D, D] * h
    fade(x, p, state.belief, h, state.belief[2], state.start_mean, state.prior)
    _take_bias_from_rest(x, p, state.rest)
    taken = _correct(state, jumped, before, rate, h, imu, q) if has_rate else True
    sound = math.isfinite(trace(p, Z) + trace(p, V) + trace(p, D))
    state.belief[1] = _distance(x, state.prior) if sound else math.inf  # which is to begin anew
    return taken


@inlined
def _start(
    state: State, first: bool, time_s: float, force: Vec, rate: Vec, imu: ImuCalibration, q: JointInertialParameters
) -> Now:
    """From one sample, for the first time or after a gap that leaves nothing of the attitude."""
    if first:
        _begin(state, force, rate, imu, q)
    else:
        _set_upright(state.mean, state.covariance, force, rate, imu)
    return Now(time_s, 0.0, time_s, 0.0, force, rate, rate, ZERO, ZERO, AT_ONCE)


@inlined
def _turn(now: Now, step: float, has_rate: bool, rate: Vec, jerk: Vec, jumped: bool, imu: ImuCalibration) -> Now:
    """Adds to the angle, the gyro's bias in it, what the frame turned by up to a new rate, and to its variance."""
    held = blind_for(now.held, step, has_rate, _LONGEST_BLIND_S)
    angle = vec.plus(now.angle, 0.5 * step, now.newest)
    angle = vec.plus(angle, 0.5 * step, now.newest if jumped else rate)
    doubt = now.doubt + rotation_variance(step, held, imu)
    if jumped:
        doubt += 0.25 * step * step * vec.dot(jerk, jerk)
    return Now(now.time, held, now.turned_at + step, doubt, now.force, now.rate, rate, angle, now.change, now.since)


@inlined
def _advance(
    state: State, x: Floats, now: Now, time_s: float, has_force: bool, force: Vec, has_rate: bool, rate: Vec,
    imu: ImuCalibration, q: JointInertialParameters,
) -> tuple[Now, bool]:  # fmt: skip
    """One sample later. False where what it read was refused."""
    before_a, before_w, had_rate = now.force, now.rate, now.held == 0.0
    force = force if has_force else before_a
    rate = rate if has_rate else now.newest
    h, step = time_s - now.time, time_s - now.turned_at
    waits = has_force and has_rate and _same(force, before_a) and h < LONGEST_HOLD_S
    jerk = vec.minus(rate, now.newest)
    jumped = vec.dot(jerk, jerk) > _JUMP_RAD_S**2
    if step > 0.0 and not (waits and (jumped or _same(rate, now.newest))):
        now = _turn(now, step, has_rate, rate, jerk, jumped, imu)
    taken = True
    if not waits:
        change, since = vec.minus(force, before_a), now.since
        jumped = jumped or vec.dot(change, change) > _JUMP_M_S2**2
        if jumped and since.span > 0.0:  # that this reading be judged alone
            _close(state, since, had_rate, False, before_w, before_w, imu, q)
            now = Now(
                now.time, now.held, now.turned_at, now.doubt, before_a, before_w, now.newest, now.angle, now.change,
                AT_ONCE,
            )  # fmt: skip
        bend = vec.minus(change, now.change)
        since = predict(x, now.since, now.angle, now.doubt, before_a, force, bend, has_force, h, imu)
        if has_force and has_rate:
            _watch_rest(state.rest, force, rate, h, imu)
        if jumped or since.span > PACE_S:
            taken = _close(state, since, has_rate, jumped, before_w, rate, imu, q)
            since = AT_ONCE
        if not taken:
            # A spike: what it did to this step is in doubt, and the next step goes without it.
            gained = 0.25 * h * h * vec.dot(change, change)
            add_noise(state.covariance, vec.at(x, Z), vec.at(x, V), 0.0, gained)
            rate, force, change = before_w, before_a, ZERO
        lost = state.misfit[0] > _LOST * max(state.misfit[1], _LOST_M2_S2)
        if lost or _runs_away(x, state.belief[1]):
            _begin(state, force, rate, imu, q)
            state.counts[1] += 1
            since = AT_ONCE
        now = Now(time_s, now.held, now.turned_at, 0.0, force, rate, rate, ZERO, change, since)
    return now, taken


@inlined
def _report(x: Floats, p: Floats, now: Now, found: float, time_s: float, delay_s: float, out: Floats, i: int) -> None:
    """Row i: height and its standard deviation (m), Z at the time of the stamp, how far off the sensors are found."""
    bias = vec.at(x, BG)
    ahead = vec.plus(ZERO, delay_s, vec.minus(now.newest, bias))
    if now.time < time_s < math.inf:  # while the step waits
        ahead = vec.plus(vec.plus(ahead, 1.0, now.angle), time_s - now.turned_at, now.newest)
        ahead = vec.plus(ahead, now.time - time_s, bias)
    ahead = corrected(x, MG, ahead)
    tilt = vec.turn_back(ahead, vec.at(x, Z))
    out[i, 0], out[i, 1] = height(tilt, vec.at(x, D), p, vec.plus(now.since.turned, 1.0, ahead))
    out[i, 2], out[i, 3], out[i, 4] = tilt
    out[i, 5] = found


@inlined
def _recall(a: Floats) -> Now:
    """The registers as they were left."""
    return Now(
        a[0], a[1], a[2], a[3], vec.at(a, 4), vec.at(a, 7), vec.at(a, 10), vec.at(a, 13), vec.at(a, 16),
        recall_since(a, 19),
    )  # fmt: skip


@inlined
def _keep(a: Floats, now: Now) -> None:
    """The registers for the next block."""
    a[0], a[1], a[2], a[3] = now.time, now.held, now.turned_at, now.doubt
    vec.put(a, 4, now.force)
    vec.put(a, 7, now.rate)
    vec.put(a, 10, now.newest)
    vec.put(a, 13, now.angle)
    vec.put(a, 16, now.change)
    keep_since(a, 19, now.since)


@compiled
def _process(
    time_s: Floats,
    accel: Floats,
    gyro: Floats,
    flags: NDArray[np.uint16],
    imu: ImuCalibration,
    q: JointInertialParameters,
    state: State,
    out: Floats,
) -> None:
    x, p, found = state.mean, state.covariance, state.belief
    now, rejected = _recall(state.now), 0
    for i in range(len(time_s)):
        has_force, force = read_accel((accel[i, 0], accel[i, 1], accel[i, 2]), flags[i], imu)
        has_rate, rate = read_gyro((gyro[i, 0], gyro[i, 1], gyro[i, 2]), flags[i], imu)
        h, good, first = time_s[i] - now.time, has_force and has_rate, math.isnan(now.time)
        if good and (first or max(h, now.held) > _LONGEST_BLIND_S) and math.isfinite(time_s[i]):
            now = _start(state, first, time_s[i], force, rate, imu, q)
        elif 0.0 < h < math.inf:
            now, taken = _advance(state, x, now, time_s[i], has_force, force, has_rate, rate, imu, q)
            good = good and taken
        else:
            good = False
        rejected += not good
        if math.isnan(now.time):
            out[i, :] = np.nan
        else:
            _report(x, p, now, found[1], time_s[i], imu.delay, out, i)
    _keep(state.now, now)
    state.counts[0] += rejected
