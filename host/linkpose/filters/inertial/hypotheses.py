"""Two filters with different assumptions about the sensors, mixed by their probabilities.

Whether the sensors were calibrated is unknown, and the two hypotheses behave differently during start-up. Two filters
therefore run in parallel, one with the errors that a calibration leaves and one with the data sheet's. A filter whose
estimated sensor errors lie far outside its own prior becomes less probable: its likelihood is e^−χ²/2 of those
errors. The estimate is the mean of both.

The prior of a hypothesis holds for a kind of sensor, not for the specimen in use. Its errors, once estimated, show at
which level the specimen errs: the variance of unit weight is χ² over its expected value, and σ is scaled by its root.
The accelerometer decides the errors of the tilt and of the height, the scale and alignment of the gyro those of the
heading. Each has its own level.

Sources: D. T. Magill, "Optimal adaptive estimation of sampled stochastic processes", IEEE Trans. Automatic Control
10(4), 1965. The variance of unit weight: P. J. G. Teunissen, "Testing theory", Delft University Press, 2000, ch. 2.
"""

from __future__ import annotations

import math

from linkpose.compiling import compiled, inner
from linkpose.filters import _vector as vec
from linkpose.filters.inertial.state import HEIGHT, PITCH, ROLL, SIGMA, YAW, Floats, Record, SensorErrors, X, Y

# What a calibration leaves (simulated twelve-position calibration, ../simulation/link.py), and what the MPU-6050's data
# sheet allows (zero-rate output ±20 °/s, zero-g output ±50 mg, scale ±3 %, cross-axis ±2 %). The errors of a calibrated
# sensor drift with the temperature, in minutes. Its accelerometer bias decides σ of the tilt: with 0.016 m/s², 78 % of
# the simulated errors after the start are within 2σ; 0.03 m/s² costs 4 % of the tilt on a real pendulum. A part's
# tolerances are constant: a decay in 1000 s in place of 3000 s doubles the error of the height.
CALIBRATED = SensorErrors(0.03, 0.0015, 0.0007, 0.025, 0.0015, 0.0005, 200.0)
DATA_SHEET = SensorErrors(0.2, 0.02, 0.012, 0.3, 0.02, 0.012, 3000.0)

# Prior log odds of the calibrated hypothesis. Doubling it delays the change to the other on an uncalibrated sensor.
_LOG_ODDS = 15.0
# The wider hypothesis also fits what is no error of a sensor, so its own χ² counts this many times (Occam's factor).
_OCCAM = 8.0
_MOST = 50.0  # log odds beyond which the other filter has no weight
# σ of a hypothesis is scaled by the level at which its sensors err: sensors better than assumed reduce it, worse ones
# widen it.
_LEAST_LEVEL, _MOST_LEVEL = 0.2, 4.0  # of the variance: σ from 0.45 to 2 of its value
# The data sheet's range is a limit, which a single sensor's errors do not reduce. Large errors make the updates less
# linear: after a minute of Tests 1 to 3, an error of scale that both sensors have in common is 1.5 to 3 times its σ.
# With 1, eight run-quantities of 96 (seeds 100 to 107) have less than 85 % of their errors within 2σ, with 1.5 four,
# but σ of most others is 1.4 times too large.
_NO_LESS = 1.2


def log_odds(first: float, second: float) -> float:
    """Log odds of the first hypothesis, from half the χ² of the sensor errors that each filter has estimated."""
    return min(max(_LOG_ODDS + _OCCAM * second - first, -_MOST), _MOST)


_log_odds = inner(log_odds)


@compiled
def mix(first: Record, second: Record, out: Floats) -> None:
    """The mean of two filters' estimates (N,) of ESTIMATE: values and then σ (N, 12), in its order; angles in degrees.

    A variance includes how far the filters differ. Where one filter has no position, the other's counts alone.

    The prior odds choose between the filters before the motion shows what the sensors are; σ must not. As long as the
    accelerometer's bias is unknown to the second filter, σ is therefore that of even odds.
    """
    for i in range(len(first)):
        a, b = first[i], second[i]
        odds = _log_odds(a.distance, b.distance)
        probability = 1.0 / (1.0 + math.exp(-odds))
        unresolved = min(b.unknown * b.unknown, 1.0)
        weight = min(probability, 1.0 - 0.5 * unresolved)
        unknown_a, unknown_b = math.isnan(a.value[HEIGHT]), math.isnan(b.value[HEIGHT])
        share = 1.0 if unknown_b and not unknown_a else 0.0 if unknown_a and not unknown_b else probability
        position_weight = weight if share == probability else share
        for k in range(ROLL):
            out[i, k], out[i, SIGMA + k] = _mixed(share, position_weight, a, b, k, b.value[k] - a.value[k])
        for k in range(ROLL, SIGMA):
            angle, std = _mixed(probability, weight, a, b, k, vec.wrapped(b.value[k] - a.value[k]))
            out[i, k], out[i, SIGMA + k] = math.degrees(vec.wrapped(angle)), math.degrees(min(std, math.pi))
        # Near the vertical, the mean of two angles is not that of their tilts.
        tilt = (
            _mean(probability, a.tilt[0], b.tilt[0]),
            _mean(probability, a.tilt[1], b.tilt[1]),
            _mean(probability, a.tilt[2], b.tilt[2]),
        )
        out[i, ROLL], out[i, PITCH] = vec.roll_pitch(tilt)


@inner
def _level(estimate: Record, k: int, least: float) -> float:
    """Level of the sensor errors that value k depends on, `least` or more: x and y depend on those of both sensors."""
    tilt, heading = estimate.tilt_level, estimate.heading_level
    level = heading if k == YAW else 0.5 * (tilt + heading) if X <= k <= Y else tilt
    return float(min(max(level, least), _MOST_LEVEL))


@inner
def _mixed(share: float, weight: float, a: Record, b: Record, k: int, apart: float) -> tuple[float, float]:
    """Mean of value k with `share` of a, where b's is `apart` from a's, and its σ. `weight` is the probability of a."""
    mean = _mean(share, a.value[k], b.value[k] if share == 0.0 else a.value[k] + apart)
    off_a = 0.0 if share == 1.0 else (1.0 - share) * apart
    off_b = 0.0 if share == 0.0 else share * apart
    variance_a = _level(a, k, _LEAST_LEVEL) * a.std[k] * a.std[k]
    variance_b = _level(b, k, _NO_LESS) * b.std[k] * b.std[k]
    return mean, math.sqrt(_mean(weight, variance_a + off_a * off_a, variance_b + off_b * off_b))


@inner
def _mean(share: float, a: float, b: float) -> float:
    """`share` of a and the rest of b; one alone where its share is 1, whatever the other is."""
    return a if share == 1.0 else b if share == 0.0 else share * a + (1.0 - share) * b
