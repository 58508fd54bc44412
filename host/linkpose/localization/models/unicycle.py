"""Motion of a wheeled robot: dead reckoning of (x, y, θ) from forward speed v and turn rate ω, the thesis's indoor
model.

    θ' = θ + ω T,  (x', y') = (x, y) + v T sinc(ω T/2) (cos, sin)(θ + ω T/2)

The arc is exact for a speed and a rate held over the interval. The noise adds to (v, ω). States after the third are
constants that the filter estimates beside the pose, such as the scale error of a range sensor.
"""

from __future__ import annotations

import math

from numba import njit

from linkpose.localization.linalg import Floats, wrap_angle

ID = 0


@njit(cache=True)
def sinc(angle: float) -> float:
    """sin(angle)/angle."""
    return math.sin(angle) / angle if abs(angle) > 1e-4 else 1.0 - angle * angle / 6.0


@njit(cache=True)
def sinc_slope(angle: float) -> float:
    """The derivative of `sinc`."""
    return (math.cos(angle) - sinc(angle)) / angle if abs(angle) > 1e-4 else -angle / 3.0


@njit(cache=True)
def propagate(state: Floats, control: Floats, noise: Floats, interval: float, out: Floats) -> None:
    """control (v m/s, ω rad/s), noise alike; interval in s."""
    for i in range(state.shape[0]):
        out[i] = state[i]
    turn = (control[1] + noise[1]) * interval
    chord = (control[0] + noise[0]) * interval * sinc(0.5 * turn)
    out[0] += chord * math.cos(state[2] + 0.5 * turn)
    out[1] += chord * math.sin(state[2] + 0.5 * turn)
    out[2] = wrap_angle(state[2] + turn)


@njit(cache=True)
def jacobians(state: Floats, control: Floats, interval: float, by_state: Floats, by_noise: Floats) -> None:
    """Fills ∂out/∂state and ∂out/∂noise at zero noise."""
    turn = control[1] * interval
    way = control[0] * interval
    heading = state[2] + 0.5 * turn
    c, s, chord = math.cos(heading), math.sin(heading), way * sinc(0.5 * turn)
    bend = 0.5 * way * interval * sinc_slope(0.5 * turn)
    for i in range(state.shape[0]):
        by_state[i, i] = 1.0
    by_state[0, 2], by_state[1, 2] = -chord * s, chord * c
    by_noise[0, 0], by_noise[1, 0] = interval * sinc(0.5 * turn) * c, interval * sinc(0.5 * turn) * s
    by_noise[0, 1] = bend * c - 0.5 * interval * chord * s
    by_noise[1, 1] = bend * s + 0.5 * interval * chord * c
    by_noise[2, 1] = interval
