"""Motion of an underwater vehicle: dead reckoning of position, heading and yaw rate from a Doppler log and an attitude
sensor.

State (x, y, z, ψ, r): Z up, surface at z = 0. Control: body velocity (forward, left, up) from the DVL, roll and pitch
from the AHRS.

    p' = p + R(ψ + r T/2, pitch, roll) v T,  ψ' = ψ + r T,  r' = r + ṙ T

The noise adds to the velocity and is the yaw acceleration ṙ, since the AHRS gives angles but no rate. States after the
fifth are constants.
"""

from __future__ import annotations

import math

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats, wrap_angle

ID = 1


@compiled
def propagate(state: Floats, control: Floats, noise: Floats, interval: float, out: Floats) -> None:
    """control (v forward, left, up m/s, roll, pitch rad), noise (three velocities m/s, yaw acceleration rad/s²);
    interval in s.
    """
    for i in range(state.shape[0]):
        out[i] = state[i]
    forward, left, up = control[0] + noise[0], control[1] + noise[1], control[2] + noise[2]
    cr, sr, cp, sp = math.cos(control[3]), math.sin(control[3]), math.cos(control[4]), math.sin(control[4])
    heading = state[3] + 0.5 * state[4] * interval
    ahead = cp * forward + sp * (sr * left + cr * up)
    aside = cr * left - sr * up
    out[0] += interval * (math.cos(heading) * ahead - math.sin(heading) * aside)
    out[1] += interval * (math.sin(heading) * ahead + math.cos(heading) * aside)
    out[2] += interval * (cp * (sr * left + cr * up) - sp * forward)
    out[3] = wrap_angle(state[3] + state[4] * interval)
    out[4] += noise[3] * interval


@compiled
def jacobians(state: Floats, control: Floats, interval: float, by_state: Floats, by_noise: Floats) -> None:
    """Fills ∂out/∂state and ∂out/∂noise at zero noise."""
    cr, sr, cp, sp = math.cos(control[3]), math.sin(control[3]), math.cos(control[4]), math.sin(control[4])
    heading = state[3] + 0.5 * state[4] * interval
    c, s = math.cos(heading), math.sin(heading)
    ahead = cp * control[0] + sp * (sr * control[1] + cr * control[2])
    aside = cr * control[1] - sr * control[2]
    for i in range(state.shape[0]):
        by_state[i, i] = 1.0
    by_state[0, 3], by_state[1, 3] = -interval * (s * ahead + c * aside), interval * (c * ahead - s * aside)
    by_state[0, 4], by_state[1, 4] = 0.5 * interval * by_state[0, 3], 0.5 * interval * by_state[1, 3]
    by_state[3, 4] = interval
    by_noise[0, 0], by_noise[0, 1], by_noise[0, 2] = (
        interval * c * cp,
        interval * (c * sp * sr - s * cr),
        interval * (c * sp * cr + s * sr),
    )
    by_noise[1, 0], by_noise[1, 1], by_noise[1, 2] = (
        interval * s * cp,
        interval * (s * sp * sr + c * cr),
        interval * (s * sp * cr - c * sr),
    )
    by_noise[2, 0], by_noise[2, 1], by_noise[2, 2] = -interval * sp, interval * cp * sr, interval * cp * cr
    by_noise[4, 3] = interval
