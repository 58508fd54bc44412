"""A speed above which the mice count too little: the sensor limit of all mice, which no flag shows.

On a straight, all mice lose the same share, and only the accelerometer can contradict them (see `acceleration`). In a
bend the mice have different speeds, and the gyro shows by how much: mice at their limit show the same speed instead, or
less than the slower ones imply. The limit is then the largest speed that has been seen. From there on, a mouse at the
limit is left out where another one is slower; where all are at the limit, they show a lower bound. The way driven at
the limit before it was found widens the position.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters.mice.plane import scaled, square, turned, unit
from linkpose.filters.mice.state import Record, Records
from linkpose.filters.planar.state import X, Y

# A mouse is at the limit from this share of the largest speed seen; a larger one by the second share is a new largest.
# Doubled distance to 1: slower ways count as limited, and the limit is found earlier.
_AT_LIMIT, _FASTER = 0.93, 1.03
_LEAST_M_S = 0.1  # no mouse has a lower limit (m/s); the data sheets of office mice give 0.3 m/s and more
# Two mice contradict the gyro's rate (rad/s, from the first number on) by this share of their relative velocity, and by
# this velocity (m/s) for rounding. Doubled: a limit is found in sharper bends only.
_LEAST_RAD_S, _SHARE, _NOISE_M_S = 0.15, 0.25, 0.02
_TOO_SLOW = 1.05  # expected speed of the mouse at the limit over the one that it shows
# Contradiction for so long (s), less the time, with this weight, of contradictions that a limit does not explain.
# Doubled time: a limit is found one bend later.
_EVIDENCE_S, _OTHERWISE = 0.3, 0.5
LIMITED_SHARE = 0.5  # of the way driven at the limit, as in the saturation of counters: its σ
_MARGIN = 0.95  # of the largest speed seen: from here on, counts are a lower bound


@inner
def watch_limit(state: Record, m: Record, mice: Records) -> None:
    """Compare the speeds of the mice over the window with each other and with the gyro."""
    if not m.step > 0.0 or m.missed > 0.0 or m.speed_limit > 0.0 or state.at_rest or not m.window_s > 0.0:
        return
    top = 0.0
    for i in range(m.count):
        if m.sound >> i & 1:
            top = max(top, math.sqrt(square(mice[i].window)) / m.window_s)
    if top < _LEAST_M_S:
        return
    if top > _FASTER * state.fastest:
        state.fastest = top
        state.limit_s = state.limited_x = state.limited_y = 0.0
    if are_at_limit(state, m, mice):
        way = scaled(m.step, turned(unit(state.at.heading), complex(state.at.vx, state.at.vy)))
        state.limited_x += abs(way.real)
        state.limited_y += abs(way.imag)
    verdict = _compare(state, m, mice)
    if verdict != 0:
        state.limit_s += m.step if verdict > 0 else -_OTHERWISE * m.step
        if state.limit_s > _EVIDENCE_S:
            accept_limit(state, m, LIMITED_SHARE)


@inner
def are_at_limit(state: Record, m: Record, mice: Records) -> bool:
    """Whether all mice move at about the largest speed so far, above the lowest limit that mice have."""
    limit = _AT_LIMIT * state.fastest
    is_at_limit = state.fastest > _LEAST_M_S
    for i in range(m.count):
        if m.sound >> i & 1:
            is_at_limit = is_at_limit & (square(mice[i].window) > (limit * m.window_s) ** 2)
    return bool(is_at_limit)


@inner
def accept_limit(state: Record, m: Record, share: float) -> None:
    """The largest speed so far is the mice's limit: `share` of the way at this speed is the σ of the position."""
    m.speed_limit, state.limited_share = _MARGIN * state.fastest, share
    state.covariance[X, X] += (share * state.limited_x) ** 2
    state.covariance[Y, Y] += (share * state.limited_y) ** 2


@inner
def _compare(state: Record, m: Record, mice: Records) -> int:
    """1 if mice contradict the gyro and mice at the limit explain it, −1 if they do not, 0 without a contradiction."""
    rate = m.window_turn / m.window_s - state.at.bias
    verdict = 0
    if not abs(rate) > _LEAST_RAD_S or not math.isfinite(m.mean_rate):
        return verdict
    for i in range(m.count):
        for k in range(i):
            if not m.sound >> i & m.sound >> k & 1:
                continue
            one, other = scaled(1.0 / m.window_s, mice[i].window), scaled(1.0 / m.window_s, mice[k].window)
            apart = scaled(rate, mice[i].arm - mice[k].arm)
            limit = _SHARE * math.sqrt(square(apart)) + _NOISE_M_S
            if square(one - other - apart) < limit * limit:
                continue
            if not (_is_too_slow(state, one, other + apart) or _is_too_slow(state, other, one - apart)):
                return -1
            verdict = 1
    return verdict


@inner
def _is_too_slow(state: Record, shown: complex, expected: complex) -> bool:
    """Whether a mouse at the limit shows less than another mouse and the gyro imply."""
    speed2 = square(shown)
    is_at_limit = speed2 > (_AT_LIMIT * state.fastest) ** 2
    return bool(is_at_limit and square(expected) > _TOO_SLOW * _TOO_SLOW * speed2)
