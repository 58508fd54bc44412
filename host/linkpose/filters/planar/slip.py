"""Slips in a turn: what all mice lose of the gyro's turn, they lose of the way too.

Mice that slip as the robot turns, or lose the surface then, lose a share that changes with the turn rate, the speed and
the side. No constant factor corrects it: one that is right for fast turns makes the way in slow ones too long. The way
is therefore corrected by the share that the mice show now, over a fraction of a second.

A small share that stays may be an error of the gyro's scale as well. Turns do not show which; σ includes both.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters.mice.plane import dot, scaled, square, turned, unit
from linkpose.filters.mice.state import NOBODY, Record, Records
from linkpose.filters.planar.gyro import is_turning, shown_in_turns

# Over which the share is averaged (s). Doubled: it lags where the turn rate changes.
_MEMORY_S = 0.3
# A rate that differs from its average by more than this share begins anew. Doubled: a bias of the gyro that has jumped
# in a fast turn is taken for a slip after it.
_CHANGED = 0.5
# This much of it is not corrected, because the gyro's scale may be off by so much (data sheet: 3 %), and so many
# standard deviations of its noise, and what a delay of the mice (s) shows where the rate changes.
_UNSURE, _Z, _DELAY_S = 0.03, 3.0, 0.015
# A smaller share is a lift, or a jump of the gyro. By more than the second one, nothing is corrected. Mice that slip
# show no more than without a slip; beyond the third number, they do not slip.
_LIFTED, _LEAST, _SWITCHED = 0.2, 0.4, 1.3
# A difference between all turns of gyro and mice may be the gyro's scale, from the first share, which calibrated mice
# do not reach, to the second one: the data sheet's 3 %, and what mice add. With this part of it as σ, it is just within
# 2σ. Before so much turning (rad²/s) it does not show. Doubled: σ of the heading is too small for longer.
_DOUBT_LEAST, _DOUBT_MOST, _DOUBT, _DOUBT_TURN = 0.01, 0.045, 0.6, 0.1
_ALONE_S = 0.2  # all mice excluded for so long (s): their velocity is better than a prediction that decays


@inner
def correct_slip(state: Record, m: Record, mice: Records, rig: Records, motion: int) -> None:
    """Correct the way of the last step by the share of the gyro's turn that the mice show.

    Their motion is in `m.fit` and `m.fit_turn` where `motion` is 1. Where all mice are excluded, their velocity is
    taken at this share instead of the prediction.
    """
    judges, share = state.dispute.judges, 0.0
    is_moving = m.step > 0.0 and m.missed == 0.0 and motion == 1 and not (m.is_saturated or state.at_rest)
    is_moving = is_moving and (m.used == judges or m.used == NOBODY) and state.slip_judges == judges
    state.slip_judges = judges
    changed = abs((m.mean_rate - state.at.bias) * state.slip_s - state.slip_turn)
    if is_moving and is_turning(state, m) and changed <= _CHANGED * abs(state.slip_turn):
        share = _share_now(state, m, mice, rig)
    else:
        state.slip_s = state.slip_turn = state.slip_shown = state.slip_placed = state.slip_variance = 0.0
        if is_moving and m.used == NOBODY and m.time - m.known_time > _ALONE_S:
            share = 1.0
    if share > 0.0:
        off_way = scaled(1.0 / share, m.fit) - complex(state.at.vx, state.at.vy)
        way = scaled(m.step, turned(unit(state.at.heading), off_way))
        state.at.x += way.real
        state.at.y += way.imag


@inner
def _share_now(state: Record, m: Record, mice: Records, rig: Records) -> float:
    """The share of the gyro's turn that the mice show, relative to that which is corrected already; 0 where unsure."""
    turn, keep = m.mean_rate - state.at.bias, math.exp(-m.step / _MEMORY_S)
    state.slip_s = keep * state.slip_s + m.step
    state.slip_turn = keep * state.slip_turn + turn * m.step
    state.slip_shown = keep * state.slip_shown + m.fit_turn * m.step
    as_placed = _turn_as_placed(state, mice, rig)
    state.slip_placed = keep * state.slip_placed + as_placed
    _doubt_gyro(state, turn, as_placed, m.step)
    state.slip_variance = keep * keep * state.slip_variance + m.step * m.step * m.fit_turn_variance
    total, shown = float(state.slip_turn), float(shown_in_turns(state))
    off, placed = state.slip_shown / total - 1.0, state.slip_placed / (shown * total) - 1.0
    if abs(placed) < abs(off):
        off = placed if off * placed > 0.0 else 0.0
    delayed = _DELAY_S * abs(turn - total / state.slip_s)
    unsure = _UNSURE + (_Z * math.sqrt(state.slip_variance) + delayed) / abs(total)
    if abs(off) < unsure:
        return 0.0
    share, most = 1.0 + off - unsure * unsure / off, max(1.0, 1.0 / shown)
    return max(min(share, most), _LEAST) if _LIFTED < share < _SWITCHED * most else 0.0


@inner
def _doubt_gyro(state: Record, turn: float, as_placed: float, step: float) -> None:
    """σ of the gyro's scale, where it may explain the share of all turns (rad/s) that the mice have shown so far."""
    state.all_square += turn * turn * step
    state.all_product += turn * as_placed
    off = abs(state.all_product / state.all_square - 1.0)
    is_doubtful = state.all_square > _DOUBT_TURN and _DOUBT_LEAST < off < _DOUBT_MOST
    state.gyro_std = _DOUBT * off if is_doubtful else 0.0


@inner
def _turn_as_placed(state: Record, mice: Records, rig: Records) -> float:
    """Turn in the last step by the mice that are compared with the gyro, calibrated and placed as in the rig (rad)."""
    count, product, square_sum, way, middle = 0.0, 0.0, 0.0, 0j, 0j
    for i in range(len(rig)):
        if state.dispute.judges >> i & 1:
            mouse, place = mice[i], rig[i]
            moved = scaled(mouse.share, turned(place.axis, mouse.counts))
            count += 1.0
            way += moved
            middle += place.arm
            product += dot(place.arm, moved)
            square_sum += square(place.arm)
    return (product - dot(middle, way) / count) / (square_sum - square(middle) / count)
