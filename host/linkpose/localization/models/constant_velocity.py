"""Motion of a tag without odometry: a velocity in the map's frame that changes at random (white acceleration) and
returns to 0 with a time constant τ, as one that stays in its area does.

State (x, y, v_x, v_y): v' = φ v, x' = x + τ (1 − φ) v with φ = exp(−T/τ), and y alike. The noise is that of the
acceleration on each axis, in two independent parts each: (velocity with its place, place alone). States after the
fourth are constants, as in `unicycle`. Source: Johnson, London, Lea and Durban, "Continuous-time correlated random walk
model for animal telemetry data", Ecology 89 (2008), pages 1208-1215, an integrated Ornstein-Uhlenbeck process.
"""

from __future__ import annotations

import math

from linkpose.compiling import compiled, inner
from linkpose.localization.linalg import Floats

ID = 2
_SHORT = 1e-3  # T/τ below which the differences of exponentials lose digits


@inner
def _terms(interval: float, time: float) -> tuple[float, float, float, float, float]:
    """φ, the way per velocity (s), and the factors of the noise, times √T: velocity, place with it, place alone."""
    x = interval / time
    keep = math.exp(-x)
    if x < _SHORT:
        way = interval * (1.0 - 0.5 * x)
        variance_v, both = interval * (1.0 - x), 0.5 * interval**2 * (1.0 - x)
        variance_x = interval**3 / 3.0 * (1.0 - 0.75 * x)
    else:
        way = time * (1.0 - keep)
        variance_v = 0.5 * time * (1.0 - keep * keep)
        both = 0.5 * way * way
        variance_x = time * time * (interval - 2.0 * way + variance_v)
    root_v = math.sqrt(variance_v)
    alone = max(variance_x - both * both / variance_v, 0.0)
    root_t = math.sqrt(interval)
    return keep, way, root_t * root_v, root_t * both / root_v, root_t * math.sqrt(alone)


@compiled
def propagate(state: Floats, control: Floats, noise: Floats, interval: float, out: Floats) -> None:
    """control (τ s); noise (m/s²) of x in two parts, then of y: over the interval, a part is a draw of the acceleration
    of one second divided by √T; interval in s.
    """
    for i in range(state.shape[0]):
        out[i] = state[i]
    if interval > 0.0:
        keep, way, speed, with_speed, alone = _terms(interval, control[0])
        for i in range(2):
            out[i] += way * state[2 + i] + with_speed * noise[2 * i] + alone * noise[2 * i + 1]
            out[2 + i] = keep * state[2 + i] + speed * noise[2 * i]


@compiled
def jacobians(state: Floats, control: Floats, interval: float, by_state: Floats, by_noise: Floats) -> None:
    """Fills ∂out/∂state and ∂out/∂noise."""
    for i in range(state.shape[0]):
        by_state[i, i] = 1.0
    if interval > 0.0:
        keep, way, speed, with_speed, alone = _terms(interval, control[0])
        for i in range(2):
            by_state[i, 2 + i], by_state[2 + i, 2 + i] = way, keep
            by_noise[i, 2 * i], by_noise[i, 2 * i + 1], by_noise[2 + i, 2 * i] = with_speed, alone, speed
