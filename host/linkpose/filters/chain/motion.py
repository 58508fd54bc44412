"""What each sensor's own motion gives: a velocity that stays small, and the gyro bias at rest.

The velocity is the measurement of `inertial.free_velocity`: 0 = v + e with the measured variance σ² of e and its
correlation time T, to a slower estimate white noise of variance σ² 2T/h. It levels the tilts.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters._imu import GRAVITY
from linkpose.filters.chain.state import BG, OF_SENSOR, Floats, Record, V
from linkpose.filters.chain.update import clear_row, update

_UNLEARNED = 0.5  # share of the prior variance above which a gyro bias has not been measured
_REST_MEAN_S = 0.5  # over which readings are averaged to find rests
# Within which a slow turn changes its rate: a rate that changes by e in this time may be a turn of that rate. Chosen on
# slow simulated links (seeds 0-5 of the test).
_TURN_S = 1.0
_OF_NOISE = 8.0  # χ² with three degrees of freedom, 95 %: changes of mean force and mean rate that are noise


@inner
def update_velocity(s: Record, size: int, k: int, h: float, q: Record) -> float:
    """Apply 0 = v_k + e, `h` (s) after the last time. Returns its log likelihood.

    e has no direction, so that this also holds of v_k turned back by the error of the heading: a turn of the whole
    chain about the vertical, δθ = Z and δv = Z × v, must not change H x, or P holds a heading that nothing has shown.
    """
    time = q.most_correlation_s
    if s.accel_square[k] > 0:
        time = min(max(math.sqrt(s.speed_square[k] / s.accel_square[k]), q.least_correlation_s), time)
    speed = min(max(s.speed_square[k], q.least_speed_m_s**2), q.most_speed_m_s**2)
    variance = q.shared_motion * speed * max(2 * time / h, 1.0)
    likelihood = 0.0
    for row in range(3):
        clear_row(s)
        s.row[OF_SENSOR * k + V + row] = 1.0
        if row == 0:
            s.row[OF_SENSOR * k + 2] = s.heading_share * s.velocity[k, 1]
        elif row == 1:
            s.row[OF_SENSOR * k + 2] = -s.heading_share * s.velocity[k, 0]
        likelihood += update(s, size, -s.velocity[k, row], variance, q.huber)[0]
    return likelihood


@inner
def update_rest(s: Record, size: int, k: int, gyro: Floats, turning: float, h: float, q: Record, noise: Floats) -> None:
    """At rest the rate is the gyro bias, `h` (s) after the last time, but for a slow turn.

    `turning`: square of the rate of such a turn (rad²/s²), from `follow_rest`; it lasts as long as these means.
    """
    variance = noise[0] + q.rest_std_rad_s**2 + turning * max(2 * _REST_MEAN_S / h, 1.0)
    for row in range(3):
        at = OF_SENSOR * k + BG + row
        clear_row(s)
        s.row[at] = 1.0
        update(s, size, gyro[k, row] - s.gyro_bias[k, row], variance, q.huber)


@inner
def follow_rest(
    bank: Record, best: Record, k: int, gyro: Floats, accel: Floats, h: float, q: Record, noise: Floats
) -> None:
    """How long sensor k has been at rest: rate and force steady, and the rate explained by the bias's σ.

    A slow turn has a steady rate, too, but turns gravity or changes its rate. The square of the rate that this shows
    is in `turning_square`, less that of noise and of `rest_std_rad_s`.
    """
    p, o = best.covariance, OF_SENSOR * k + BG
    keep = min(h / _REST_MEAN_S, 1.0)
    rate_off = force_off = rate = turning = scatter = 0.0
    for i in range(3):
        bank.mean_gyro[k, i] += keep * (gyro[k, i] - bank.mean_gyro[k, i])
        bank.mean_accel[k, i] += keep * (accel[k, i] - bank.mean_accel[k, i])
        lag = bank.mean_accel[k, i] - bank.lagging_accel[k, i]
        bank.lagging_accel[k, i] += keep * lag
        turning += (lag / (GRAVITY * _REST_MEAN_S)) ** 2
        lag = bank.mean_gyro[k, i] - bank.lagging_gyro[k, i]
        bank.lagging_gyro[k, i] += keep * lag
        turning += (lag * _TURN_S / _REST_MEAN_S) ** 2
        scatter += (gyro[k, i] - bank.mean_gyro[k, i]) ** 2 / 3
        rate_off = max(rate_off, abs(gyro[k, i] - bank.mean_gyro[k, i]))
        force_off = max(force_off, abs(accel[k, i] - bank.mean_accel[k, i]))
        rate = max(rate, abs(bank.mean_gyro[k, i] - best.gyro_bias[k, i]))
    std = math.sqrt(p[o, o] + p[o + 1, o + 1] + p[o + 2, o + 2])
    allowed = min(q.most_rest_rad_s, 3 * std + 5 * q.rest_std_rad_s)
    if std**2 > 3 * _UNLEARNED * q.first_gyro_bias_rad_s**2:
        allowed = q.most_first_rest_rad_s
    bank.gyro_scatter[k] += keep * (scatter - bank.gyro_scatter[k])
    # The gyro's noise may exceed its data sheet.
    own = max(noise[0], bank.gyro_scatter[k]) * _TURN_S**2 + noise[1] / GRAVITY**2
    own *= _OF_NOISE * h / (4 * _REST_MEAN_S**3)
    bank.turning_square[k] = max(turning - own - q.rest_std_rad_s**2, 0.0)
    steady = rate_off < q.rest_gyro_rad_s and force_off < q.rest_accel_m_s2 and rate < allowed
    steady = steady and bank.turning_square[k] < q.rest_gyro_rad_s**2
    bank.still_s[k] = bank.still_s[k] + h if steady else 0.0
