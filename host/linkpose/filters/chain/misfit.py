"""Readings that two links with one joint cannot give.

Wrong units, a gyro that repeats one value, a saturated sensor without flags, and a sensor that was remounted leave
the joint's constraint with innovations that last, with a large residual, or with accelerometer biases that no sensor
has. The estimates and their σ then mean nothing. They are blank until the readings fit again. After some seconds the
filter forgets the mounting and the biases, so that it recovers from a sensor that was remounted. Readings that keep
failing to fit have to fit for twice as long each time.
"""

from __future__ import annotations

from linkpose.compiling import inner
from linkpose.filters.chain.rotation import square
from linkpose.filters.chain.state import BA, BG, OF_SENSOR, Floats, R, Record

# Accelerometer bias: ten times the data sheet's 0.5 m/s². The largest of the recordings [D] and [O] is 1.0 m/s²; with
# accelerations of one sensor in g it is 8 m/s² and more.
_MOST_BIAS_M_S2 = 5.0
# Residual of the joint as a share of ‖ω‖ ‖r‖: at most 0.05 in [D] and [O], and 0.2 for some seconds while a simulated
# hinge follows a wrong heading; with rates of one sensor in °/s 0.3 to 1.2. It counts where the root mean square of
# ‖ω‖ ‖r‖ exceeds the second figure (m/s): below, noise and play are as large.
_MOST_RESIDUAL, _LEAST_REACH_M_S = 0.3, 0.1
# Mean norm of the rate (rad/s): a runner's shank has 5; a leg whose rates are in °/s has 50.
MOST_MEAN_RATE_RAD_S = 20.0
# Mean square of the joint's lasting innovations, in multiples of its value for a right σ: 6 at most in [D] and [O]; a
# gyro that repeats one value makes it 23, a sensor remounted 11 to 20.
_MOST_LASTING = 10.0
# Factor of the acceleration's noise that the innovations demand: 3 at most in [D] and [O], up to 100 for a sensor that
# was remounted.
_MOST_WIDENING = 15.0
_FORGET_S = 5.0  # of misfit before mounting and biases are forgotten; knocks are shorter
# Share of the misfit's time that as much time with a fit takes off. At 1, a sensor remounted that fits now and then
# has estimates with a wrong heading.
_RECOVERY = 0.5
_PROBATION_S = 10.0  # without estimates after that: a second misfit shows within it
_MOST_DOUBLINGS = 10


@inner
def follow_misfit(bank: Record, states: Record, h: float, q: Record) -> None:
    """Measure for how long the readings have not fitted two links with one joint, `h` (s) after the last time.

    While several headings are possible, lasting innovations show that the best one is wrong.
    """
    best, alive = states[bank.best], 0
    for i in range(states.shape[0]):
        alive += states[i].alive
    fits = best.moving_square[0] < _MOST_LASTING * q.level_square or alive > 1
    fits = fits and best.widening < _MOST_WIDENING
    reaches = best.reach_square > _LEAST_REACH_M_S**2
    fits = fits and not (reaches and best.residual_share > _MOST_RESIDUAL**2)
    for k in range(2):
        fits = fits and square(best.accel_bias[k]) < _MOST_BIAS_M_S2**2
        fits = fits and bank.rate_sum[k] < MOST_MEAN_RATE_RAD_S * max(bank.readings[k], 1)
    bank.misfit_s = max(bank.misfit_s - _RECOVERY * h, 0.0) if fits else bank.misfit_s + h
    if fits:
        bank.probation_s = max(bank.probation_s - h, 0.0)


@inner
def is_misfit(bank: Record) -> bool:
    """Whether the estimates mean nothing now."""
    return bool(bank.misfit_s > 0.0 or bank.probation_s > 0.0)


@inner
def has_to_forget(bank: Record) -> bool:
    """Whether the readings have not fitted for so long that the mounting may be another one."""
    return bool(bank.misfit_s > _FORGET_S)


@inner
def forget(bank: Record, states: Record, q: Record) -> None:
    """All hypotheses as before the first sample, with an unknown mounting.

    r_0 and its variance stay, and gyros that have turned out to be calibrated remain so.
    """
    size, base, best = bank.length, bank.fixed, states[bank.best]
    calibrated = (best.is_narrow[0], best.is_narrow[1])
    for i in range(states.shape[0]):
        s = states[i]
        p = s.covariance
        for a in range(size):
            for b in range(size):
                if base < 0 or a < base or b < base:
                    p[a, b] = 0.0
            s.correction[a] = 0.0
        for k in range(2):
            o = OF_SENSOR * k
            s.is_narrow[k] = calibrated[k]
            bias = q.gyro_bias_rad_s if calibrated[k] else q.first_gyro_bias_rad_s
            for j in range(3):
                s.gyro_bias[k, j] = s.accel_bias[k, j] = s.lever[k, j] = 0.0
                p[o + BG + j, o + BG + j] = bias**2
                p[o + BA + j, o + BA + j] = q.accel_bias_m_s2**2
                p[o + R + j, o + R + j] = q.lever_m**2
        _clear(s.relative_spread)
        s.has_axis, s.level, s.span = 0.0, 1.0, 0.0
    bank.begun, bank.misfit_s = 0, 0.0
    bank.probation_s = _PROBATION_S * 2.0 ** min(bank.forgotten, _MOST_DOUBLINGS)
    bank.forgotten += 1


@inner
def _clear(m: Floats) -> None:
    for i in range(3):
        for j in range(3):
            m[i, j] = 0.0
