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

from linkpose.compiling import compiled, inner
from linkpose.errors import CannotRun
from linkpose.filters._records import record_of
from linkpose.filters._vector import wrapped
from linkpose.filters.mice.causes import causes
from linkpose.filters.mice.faults import ACCEL_M_S2, ANGULAR_RAD_S2
from linkpose.filters.mice.places import remarks_on_places
from linkpose.filters.mice.plane import scaled, turned, turned_mean, unit
from linkpose.filters.mice.reading import (
    BIAS_STD,
    HOLD_S,
    NEAREST_M,
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
    Records,
    fresh_state,
    mouse_records,
    sample_records,
)
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Mouse, Rig

__all__ = ["MiceFilter", "MiceParameters", "check_placement"]

ESTIMATE = np.dtype(
    [(name, "f8") for name in ("vx", "vy", "wz", "vx_std", "vy_std", "wz_std", "x", "y", "heading", "excluded")]
)


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
        self.state = fresh_state(len(rig.mouse), BIAS_STD)
        self._parameters, self._mice, self._imu = record_of(self.parameters), mouse_records(rig.mouse), rig.imu
        self._placed = self._mice.copy()

    @property
    def rejected(self) -> int:
        """Readings so far that gave no velocity, or whose time did not increase."""
        return int(self.state[0].rejected)

    @property
    def mouse_causes(self) -> dict[int, str]:
        """Why mice were excluded so far (1 for the first; 0: all together)."""
        return causes(self.state[0], self._mice)

    @property
    def mice_remarks(self) -> list[str]:
        """Mice that are exchanged, and a gyro that states the reverse."""
        return remarks_on_places(self.state[0], self._mice, self._placed)

    def process(self, block: Measurements) -> Floats:
        """Velocity in b and its standard deviations, pose in n, excluded mice, at each of the N samples: (N, 10).

        The velocity is the mean over the interval of the last reading; between two readings it stays, with a growing
        standard deviation. It is NaN at the first reading, and when no mouse was of use for half a second. The pose
        starts at 0, heading in [−π, π). Excluded is a bit mask, bit 0 is mouse 1. The standard deviation covers the
        modelled noise, not the error of the mice's calibration.
        """
        out = np.empty(len(block), ESTIMATE)
        _process(sample_records(block, self._imu), self._parameters, self._mice, self.state, out)
        return out.view(np.float64).reshape(len(block), len(self.columns))


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
def _advance_pose(state: Record, span: float) -> None:
    """The exact arc of a constant velocity in b over `span` (s)."""
    turn = state.turn_rate * span
    chord = scaled(span, turned(turned_mean(turn), state.velocity))
    state.position += turned(unit(state.heading), chord)
    state.heading = wrapped(state.heading + turn)


@inner
def _hold(state: Record, time_s: float, span: float) -> None:
    """A reading without a velocity of its own: the last one stands for a while, the heading follows the gyro."""
    if time_s - state.known_time <= HOLD_S:
        state.x_std += ACCEL_M_S2 * span
        state.y_std += ACCEL_M_S2 * span
        state.turn_std += ANGULAR_RAD_S2 * span
    else:
        state.velocity = 0j
        if not math.isfinite(state.mean_rate):
            state.turn_rate = 0.0
        state.known_time = math.nan
    _advance_pose(state, span)


@inner
def _advance(state: Record, mice: Records, p: Record, time_s: float) -> None:
    """Advance velocity and pose by one reading. Velocities at both ends bridge a gap."""
    if not begin_step(state, time_s):
        return
    half = 0.5 * state.missed if time_s - state.known_time <= HOLD_S else 0.0
    if half > 0.0:
        _advance_pose(state, half)
    if correct(state, mice, p, True):
        state.known_time = time_s
        _advance_pose(state, state.step + half)
    else:
        state.rejected += 1
        _hold(state, time_s, state.step + state.missed - half)


@inner
def _show(state: Record, time_s: float, out: Record) -> None:
    """The estimate at a sample: the velocity of the last reading, and the pose that it leads to."""
    since = time_s - state.time
    if not since > 0.0:
        since = 0.0
    turn = state.turn_rate * since
    chord = scaled(since, turned(turned_mean(turn), state.velocity))
    position = state.position + turned(unit(state.heading), chord)
    out.x, out.y, out.heading = position.real, position.imag, wrapped(state.heading + turn)
    out.excluded = ~(state.used | state.held) & ((1 << state.count) - 1)
    if math.isnan(state.known_time):
        out.vx = out.vy = out.wz = out.vx_std = out.vy_std = out.wz_std = math.nan
        return
    out.vx, out.vy, out.wz = state.velocity.real, state.velocity.imag, state.turn_rate
    change, angular = (ACCEL_M_S2 * since) ** 2, (ANGULAR_RAD_S2 * since) ** 2
    out.vx_std = math.sqrt(state.x_std**2 + change)
    out.vy_std = math.sqrt(state.y_std**2 + change)
    out.wz_std = math.sqrt(state.turn_std**2 + angular)


@compiled
def _process(samples: Records, parameters: Records, mice: Records, states: Records, out: Records) -> None:
    state, p = states[0], parameters[0]
    for k in range(len(samples)):
        sample = samples[k]
        follow_gyro(state, sample)
        if not sample.is_stale:
            read_counts(state, mice, sample)
            _advance(state, mice, p, sample.time)
            end_step(state)
        _show(state, sample.time, out[k])
