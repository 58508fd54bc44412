"""The prior of a gyro bias: that of the data sheet until the bias shows that it has been subtracted.

Nobody states whether the gyros were calibrated. The variance of their biases is therefore either w² (data sheet) or t²
(after a subtraction at rest), the same along all axes of both sensors. The filter begins with w². From its estimate b̂
of one sensor's bias with covariance P, the likelihood of t² relative to w² is, with a = 1/t² − 1/w²,

    (w/t)³ |I + a P|^(−1/2) exp(−a/2 b̂ᵀ (I + a P)⁻¹ b̂)

Once the product of both sensors' is beyond doubt for some time, b = 0 with the variance 1/a turns the prior with w²
into the one with t², also along axes about which the motion has told nothing yet. Source: J. M. Dickey, "The weighted
likelihood ratio, linear hypotheses on normal location parameters", Annals of Mathematical Statistics 42(1), 1971.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters.chain.state import BG, OF_SENSOR, Record
from linkpose.filters.chain.update import clear_row, update


@inner
def narrow_prior(s: Record, size: int, h: float, q: Record) -> None:
    """Apply the prior after a subtraction, where the gyro biases of both sensors show that it holds.

    `h` (s) after the last time.
    """
    if s.is_narrow[0] and s.is_narrow[1]:
        return
    odds = 0.0
    for k in range(2):
        if not s.is_narrow[k]:
            odds += _log_odds(s, k, q)
    s.narrow_span = s.narrow_span + h if odds > q.prior_odds else 0.0
    if s.narrow_span < q.prior_s:
        return
    for k in range(2):
        if not s.is_narrow[k]:
            for row in range(3):
                clear_row(s)
                s.row[OF_SENSOR * k + BG + row] = 1.0
                update(s, size, -s.gyro_bias[k, row], 1 / _weight(q), q.huber)
            s.is_narrow[k] = 1


@inner
def _weight(q: Record) -> float:
    return float(1 / q.gyro_bias_rad_s**2 - 1 / q.first_gyro_bias_rad_s**2)


@inner
def _log_odds(s: Record, k: int, q: Record) -> float:
    """Of the narrow prior against the wide one, by the bias of sensor k."""
    p, o, weight = s.covariance, OF_SENSOR * k + BG, _weight(q)
    spread = (p[o, o], p[o, o + 1], p[o, o + 2], p[o + 1, o + 1], p[o + 1, o + 2], p[o + 2, o + 2])
    spread = vec.plus_diagonal(vec.scaled(weight, spread), 1.0)
    root, bias = vec.cholesky(spread), vec.load(s.gyro_bias[k])
    odds = 3 * math.log(q.first_gyro_bias_rad_s / q.gyro_bias_rad_s) - math.log(root[0] * root[3] * root[5])
    return float(odds - 0.5 * weight * vec.quadratic(vec.inverse(spread), bias))
