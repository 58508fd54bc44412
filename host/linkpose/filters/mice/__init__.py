"""`mice`: velocity of a robot from N optical mice by weighted least squares, and its path by dead reckoning.

Mouse i sits at p_i in the robot's frame b (x ahead, y to the left, z up) and is turned by φ_i: it counts R(φ_i)ᵀ v_i.
`least_squares` holds the paper's equations, `faults` the search for mice that slip, are lifted or dead.

σ_i² = ⅙ (count / T)² + (κ ‖v_i‖)² + σ²: a mouse keeps a fraction of a count until it is whole, so the error of a step
is the difference of two roundings; and the surface scatters a mouse's reading in proportion to its speed. Noise that
the floor adds to all mice alike does not show in their motion: it is not in W, and adds (κ_c ‖v‖)² to the variance
of v_b.

Source: S. Kim, I. Jeong, S. Lee, "Mobile Robot Velocity Estimation Using Redundant Number of Optical Mice" [Mice],
equations (1)-(17).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inner
from linkpose.errors import CannotRun
from linkpose.filters._imu import ImuCalibration, read_gyro
from linkpose.filters.mice.faults import ACCEL_M_S2, ANGULAR_RAD_S2
from linkpose.filters.mice.reading import (
    BIAS_STD,
    HOLD_S,
    NEAREST_M,
    STALE,
    begin_step,
    correct,
    end_step,
    follow_gyro,
    read_counts,
)
from linkpose.filters.mice.state import (
    Floats,
    MiceParameters,
    Record,
    fresh_state,
    parameters_record,
    placement_record,
)
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Mouse, Rig

__all__ = ["MiceFilter", "MiceParameters", "check_placement"]


class MiceFilter:
    """The N-mouse least squares over blocks of samples."""

    name = "mice"
    columns = (
        "mice_vx_m_s", "mice_vy_m_s", "mice_wz_rad_s", "mice_vx_std_m_s", "mice_vy_std_m_s", "mice_wz_std_rad_s",
        "mice_x_m", "mice_y_m", "mice_heading_rad", "mice_excluded",
    )  # fmt: skip

    def __init__(self, rig: Rig, parameters: MiceParameters | None = None) -> None:
        """The rig must place at least one mouse. Raises CannotRun for mice that all sit at one place."""
        check_placement(rig.mouse)
        self.parameters = parameters or MiceParameters()
        self.state = fresh_state(BIAS_STD)
        self._parameters = parameters_record(self.parameters)
        self._placement = placement_record(rig.mouse)
        self._imu = ImuCalibration.of(rig.imu)

    @property
    def rejected(self) -> int:
        """Readings so far that gave no velocity, or whose time did not increase."""
        return int(self.state[0].rejected)

    def process(self, block: Measurements) -> Floats:
        """Velocity in b and its standard deviations, pose in n, excluded mice, at each of the N samples: (N, 10).

        The velocity is the mean over the interval of the last reading; between two readings it stays, with a growing
        standard deviation. It is NaN at the first reading, and when no mouse was of use for half a second. The pose
        starts at 0, heading in [−π, π). Excluded is a bit mask, bit 0 is mouse 1. The standard deviation covers the
        modelled noise, not the error of the mice's calibration.
        """
        out = np.empty((len(block), len(self.columns)))
        _process(
            block.time_s, block.mice_counts, block.gyro_rad_s, block.flags,
            self._placement[0], self._imu, self._parameters[0], self.state[0], out,
        )  # fmt: skip
        return out


def check_placement(mice: tuple[Mouse, ...]) -> None:
    """Raises CannotRun where A has not rank 3 and more than one mouse: mice at one place show no rotation."""
    places = np.array([(mouse.x_m, mouse.y_m) for mouse in mice])
    if len(mice) > 1 and np.hypot(*(places - places[0]).T).max() < NEAREST_M:
        names = ", ".join(str(port) for port in range(1, len(mice) + 1))
        raise CannotRun(
            f"mice {names} all sit at ({places[0][0]:g}, {places[0][1]:g}) m, where they cannot measure a turn. "
            "Correct their x_m and y_m in the rig file."
        )


@inner
def advance_pose(pose: Floats, velocity: Floats, step: float) -> None:
    """The exact arc of a constant velocity in b over `step` (s)."""
    half = 0.5 * velocity[2] * step
    reach = step * (math.sin(half) / half if abs(half) > 1e-6 else 1.0)
    c, s = math.cos(pose[2] + half), math.sin(pose[2] + half)
    pose[0] += reach * (c * velocity[0] - s * velocity[1])
    pose[1] += reach * (s * velocity[0] + c * velocity[1])
    heading = pose[2] + 2.0 * half
    pose[2] = heading - 2.0 * math.pi * math.floor((heading + math.pi) / (2.0 * math.pi))


@inner
def _hold(state: Record, time_s: float, dt: float) -> None:
    """A reading without a velocity of its own: the last one stands for a while, the heading follows the gyro."""
    if time_s - state.known_time <= HOLD_S:
        for j in range(3):
            state.std[j] += (ACCEL_M_S2 if j < 2 else ANGULAR_RAD_S2) * dt
    else:
        state.velocity[0] = state.velocity[1] = 0.0
        if not math.isfinite(state.mean_rate):
            state.velocity[2] = 0.0
        state.known_time = math.nan
    advance_pose(state.pose, state.velocity, dt)


@inner
def _advance(state: Record, place: Record, p: Record, time_s: float) -> None:
    """Advance velocity and pose by one reading. Velocities at both ends bridge a gap."""
    dt, step = begin_step(state, time_s)
    if not dt > 0.0:
        return
    missed = dt - step if time_s - state.known_time <= HOLD_S else 0.0
    if missed > 0.0:
        advance_pose(state.pose, state.velocity, 0.5 * missed)
    if correct(state, place, p, dt, step, True):
        state.known_time = time_s
        advance_pose(state.pose, state.velocity, step + 0.5 * missed)
    else:
        state.rejected += 1
        _hold(state, time_s, dt - 0.5 * missed)


@inner
def _show(state: Record, place: Record, time_s: float, out: Floats) -> None:
    """The estimate at a sample: the velocity of the last reading, and the pose that it leads to."""
    since = time_s - state.time
    if not since > 0.0:
        since = 0.0
    is_known = not math.isnan(state.known_time)
    for j in range(3):
        change = (ACCEL_M_S2 if j < 2 else ANGULAR_RAD_S2) * since
        out[j] = state.velocity[j] if is_known else math.nan
        out[3 + j] = math.sqrt(state.std[j] ** 2 + change * change) if is_known else math.nan
        out[6 + j] = state.pose[j]
    advance_pose(out[6:9], state.velocity, since)
    out[9] = excluded(state, place)


@inner
def excluded(state: Record, place: Record) -> float:
    """Bit mask of the mice that were not used at the last reading."""
    return float(~state.used & ((1 << place.count) - 1))


@compiled
def _process(
    time_s: Floats,
    counts: Floats,
    gyro: Floats,
    flags: NDArray[np.uint32],
    place: Record,
    imu: ImuCalibration,
    p: Record,
    state: Record,
    out: Floats,
) -> None:
    for i in range(len(time_s)):
        has_rate, rate = read_gyro((gyro[i, 0], gyro[i, 1], gyro[i, 2]), flags[i], imu)
        follow_gyro(state, time_s[i], rate[2] if has_rate else math.nan, flags[i])
        if not flags[i] & STALE:
            read_counts(state, place, counts[i], flags[i])
            _advance(state, place, p, time_s[i])
            end_step(state)
        _show(state, place, time_s[i], out[i])
