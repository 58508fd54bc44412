"""The level of the model's errors, measured from innovations.

Nobody states whether the sensors were calibrated, and the errors of a calibrated MPU-6050 are a tenth of the data
sheet's. Scale and cross-axis errors turn with the link: they add innovations that last for a second, where noise and
play average out. The mean z̄ of innovations over σ, in an exponential window of T seconds, has the mean square

    E z̄² = h / 2T

for white noise. The level grows while z̄² exceeds its value for a right σ, and falls otherwise, faster the smaller it
is: calibrated sensors are a hundredth of the data sheet's variance, and seconds of motion show it. Source: R. K. Mehra,
"On the identification of variances and adaptive Kalman filtering", IEEE Trans. Automatic Control 15(2), 1970: adapt
the noise until innovations are as large and as white as their covariance states.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters.chain.state import Record

_LEAST_TURN_M_S3 = 1.0  # rate of the force in a sensor's axes, below which it rests: a turn of 6 °/s
_MOST_SQUARE = 25.0  # of one moving mean, as the average counts it: knocks
# Least mean square over its value for a right σ, as the fall of the level counts it: with a `level_rate` of 0.25/s, the
# level falls by e in 1.3 s at the fastest. Chosen without data.
_LEAST_RATIO = 0.05


@inner
def begin_level(s: Record, q: Record) -> None:
    """No innovations yet; the level is the data sheet's, or a higher one that was measured before."""
    s.level = max(s.level, 1.0)
    for part in range(2):
        for i in range(3):
            s.moving_mean[part, i] = 0.0
    s.moving_square[0], s.moving_square[1], s.level_span = q.level_square, 0.0, 0.0


@inner
def floor_level(s: Record, q: Record) -> float:
    """Factor of the least variances of the joint's residual and of a hinge's play."""
    return float(max(min(s.level, 1.0), q.least_floor_level))


@inner
def misalignment_variance(s: Record, q: Record) -> float:
    """Variance (rad²) of the relative rotation about one axis by constant errors of both sensors.

    The level falls for as long as innovations are smaller than those of data-sheet sensors, so that a level below 1 is
    an upper bound: the standard deviation, not the variance, follows it.
    """
    return float(2 * (min(s.level, 1.0) * q.misalignment_rad) ** 2)


@inner
def follow_innovation(s: Record, part: int, row: int, innovation: float, variance: float, h: float, q: Record) -> None:
    """Component `row` of an innovation of the joint (part 0) or of a hinge's axis (1), and its variance."""
    mean = s.moving_mean[part, row]
    mean += min(h / q.moving_mean_s, 1.0) * (innovation / math.sqrt(variance) - mean)
    s.moving_mean[part, row] = mean
    if s.rotation_std >= q.level_std_rad:  # innovations so far may be those of a wrong heading
        s.moving_square[part] = min(s.moving_square[part], q.level_square)
    elif _turns(s):
        square = min(mean * mean * 2 * q.moving_mean_s / h, _MOST_SQUARE)
        span = min(q.level_first_s + s.level_span, q.level_s)
        s.moving_square[part] += min(h / span, 1.0) / 3 * (square - s.moving_square[part])


@inner
def _turns(s: Record) -> bool:
    """Whether gravity turns in the axes of a sensor: at rest, scale and cross-axis errors add no innovations."""
    return bool(max(s.force_rate_square[0], s.force_rate_square[1]) > _LEAST_TURN_M_S3**2)


@inner
def follow_level(s: Record, h: float, q: Record) -> None:
    """Move the level, `h` (s) after the last time.

    A hinge with measured play has innovations of its axis that are no errors of sensors.
    """
    if not _turns(s):
        return
    axis = s.moving_square[1] / q.level_square * q.least_play_rad**2 / max(s.play_square, q.least_play_rad**2)
    ratio = min(max(s.moving_square[0] / q.level_square, axis), q.level_most_ratio)
    if s.rotation_std < q.level_std_rad:
        most = q.most_level if axis > 1.0 else max(s.level, 1.0)
        s.level_span += h
        pace = ratio - 1.0 if ratio > 1.0 else math.log(max(ratio, _LEAST_RATIO))
        s.level = min(max(s.level * math.exp(h * q.level_rate * pace), q.least_level), most)
