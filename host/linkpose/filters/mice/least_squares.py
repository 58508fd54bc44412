"""Equations (6)-(12) of the redundant-mice paper [Mice]: the robot's velocity from the motion of its mice.

    v_ix = v_bx − ω_b p_iy,   v_iy = v_by + ω_b p_ix                                      (6), (7)
    A ẋ = Θ,   ẋ = (Aᵀ W A)⁻¹ Aᵀ W Θ                                                      (8), (11), (12)

with W = diag(1/σ_i²). The normal equations of any set of mice have four numbers, Σw (1, p_x, p_y, ‖p‖²), and three on
the right, Σw (s_x, s_y, p_x s_y − p_y s_x).
"""

from __future__ import annotations

from linkpose.compiling import inner
from linkpose.filters.mice.state import Record

# Variance (counts²) of a step's count: the difference of two roundings, each uniform over one count.
ROUNDING = 1.0 / 6.0


@inner
def clear(state: Record) -> None:
    """Set the normal equations to zero."""
    for j in range(4):
        state.normal[j] = 0.0
    for j in range(3):
        state.right[j] = 0.0


@inner
def add_mouse(state: Record, place: Record, i: int, weight: float, x: float, y: float) -> None:
    """Add mouse i, which moved by (x, y), to the normal equations."""
    px, py = place.position[i, 0], place.position[i, 1]
    state.normal[0] += weight
    state.normal[1] += weight * px
    state.normal[2] += weight * py
    state.normal[3] += weight * (px * px + py * py)
    state.right[0] += weight * x
    state.right[1] += weight * y
    state.right[2] += weight * (px * y - py * x)


@inner
def solve(state: Record, linear: float, angular: float) -> None:
    """(12): solution and its variances; `linear` and `angular` are further weights on the diagonal of Aᵀ W A."""
    w, wx, wy, wpp = state.normal[0], state.normal[1], state.normal[2], state.normal[3]
    # [[a, 0, −wy], [0, a, wx], [−wy, wx, d]] by elimination of the first two unknowns.
    a, d = w + linear, wpp + angular
    rest = 1.0 / (d - (wx * wx + wy * wy) / a)
    turn = rest * (state.right[2] + (wy * state.right[0] - wx * state.right[1]) / a)
    state.solution[0] = (state.right[0] + wy * turn) / a
    state.solution[1] = (state.right[1] - wx * turn) / a
    state.solution[2] = turn
    state.variance[0] = (1.0 + wy * wy * rest / a) / a
    state.variance[1] = (1.0 + wx * wx * rest / a) / a
    state.variance[2] = rest


@inner
def squared_speed(place: Record, i: int, vx: float, vy: float, w: float) -> float:
    """‖v_i‖² of (6), (7)."""
    x, y = vx - w * place.position[i, 1], vy + w * place.position[i, 0]
    return float(x * x + y * y)


@inner
def misfit(place: Record, i: int, vx: float, vy: float, w: float, x: float, y: float) -> float:
    """‖s_i − A_i ẋ‖² for s_i = (x, y)."""
    ex, ey = x - (vx - w * place.position[i, 1]), y - (vy + w * place.position[i, 0])
    return float(ex * ex + ey * ey)
