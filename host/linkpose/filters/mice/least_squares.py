"""Equations (3)-(12) of the redundant-mice paper [Mice]: the robot's velocity from the motion of its mice.

    v_i = v_b + ω_b q_i                                                                   (3)
    A ẋ = Θ,   ẋ = (Aᵀ W A)⁻¹ Aᵀ W Θ                                                      (8), (11), (12)

with W = diag(1/σ_i²), and vectors of the plane as complex numbers.
"""

from __future__ import annotations

from linkpose.compiling import inner
from linkpose.filters.mice.plane import dot, scaled, square
from linkpose.filters.mice.state import Record, Records

# Variance (counts²) of a step's count: the difference of two roundings, each uniform over one count.
ROUNDING = 1.0 / 6.0


@inner
def fit(state: Record, mice: Records, members: int, linear: float, v: complex, angular: float, turn: float) -> float:
    """(12) for the mice in `members`, from each one's `sum` and `weight`: motion and its variances into `state.fit…`.

    `linear` and `angular` are the weights (1/σ²) with which the motion v and the turn are known beforehand. Returns the
    weighted mean square distance of the mice from their common centre (m²): 0, or NaN, where A has not rank 3.
    """
    a, b, d = linear, 0j, angular
    right, right_turn = scaled(linear, v), angular * turn
    for i in range(state.count):
        if members >> i & 1:
            m = mice[i]
            a += m.weight
            b += scaled(m.weight, m.arm)
            d += m.weight * square(m.arm)
            right += scaled(m.weight, m.sum)
            right_turn += m.weight * dot(m.arm, m.sum)
    # [[a, 0, b_x], [0, a, b_y], [b_x, b_y, d]] by elimination of the first two unknowns.
    share = 1.0 / a
    pivot = d - square(b) * share
    rest = 1.0 / pivot
    turn = rest * (right_turn - dot(b, right) * share)
    state.fit = scaled(share, right - scaled(turn, b))
    state.fit_turn = turn
    state.fit_turn_variance = rest
    state.fit_x_variance = share * (1.0 + share * rest * b.real * b.real)
    state.fit_y_variance = share * (1.0 + share * rest * b.imag * b.imag)
    return share * (pivot - angular)


@inner
def squared_speed(m: Record, v: complex, turn_rate: float) -> float:
    """‖v_i‖² of (3)."""
    return square(v + scaled(turn_rate, m.arm))


@inner
def misfit(m: Record, v: complex, turn: float) -> float:
    """‖s_i − A_i ẋ‖², with s_i the mouse's `sum`."""
    return square(m.sum - v - scaled(turn, m.arm))
