"""`planar-ekf`, `planar-ukf`: the thesis's filters on this board's own sensors: the pose of a robot from mice and gyro.

The state is (x, y, θ, v_x, v_y, ω, b): pose on the floor, velocity in the robot's axes, bias of the gyro. The motion
model is a velocity that changes at random (`localization.models.planar_twist`). Measurements are the velocity of each
mouse and the rate about the vertical (`mouse_velocity`, `rate_gyro`). Every sample is taken at its own interval.

R of the mice is adaptive, as the thesis's is with the range: σ_i² = ⅙ (count / T)² + (κ ‖v_i‖)². It is not diagonal.
All mice run on one floor, and what that does to them, (κ_c ‖v‖)², is common to them. What calibration has left of each
mouse sets them apart, lasts, and looks like a turn: it is a variance of their differences, so that it weakens what they
say of ω against the gyro, and nothing of what they say of v. Which mice to take is the `mice` filter's finding.

The pose's standard deviation holds no error of scale that all mice share: no sensor here sees one.

Source: the thesis, equations (1)-(17); the redundant-mice paper, (6), (7).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled
from linkpose.filters import mice
from linkpose.filters._imu import Floats, ImuCalibration, read_gyro
from linkpose.filters.mice import Bools, MiceParameters, MiceState, Placement, Reading
from linkpose.localization import models
from linkpose.localization.ekf import ekf_step
from linkpose.localization.grid import no_map
from linkpose.localization.kalman import PLANAR_TWIST
from linkpose.localization.ukf import ukf_step
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

_STATES = len(PLANAR_TWIST.states)
_HEADING = PLANAR_TWIST.states.index("heading_rad")
_SHOWN = 6  # all but the bias
# At the start: the pose is the origin by definition; the gyro may never have been calibrated (±20 °/s).
_START_STD = (1e-6, 1e-6, 1e-6, 0.5, 0.5, 1.0, 0.35)
# Standard deviations of the motion's noise: accelerations that last _HOLD_S, and the drift of the gyro's bias.
_NOISE = (2.0, 2.0, 8.0, 1e-3)
_HOLD_S = 0.1
# The scale and angle that calibration has left of each mouse err for as long as a robot keeps to one motion (s).
_LASTS_S = 2.0


class PlanarState(NamedTuple):
    """What the filter remembers from one block to the next; changed in place."""

    mean: Floats  # (7,) x, y (m), θ (rad), v_x, v_y (m/s), ω, b (rad/s)
    covariance: Floats  # (7, 7)
    time: Floats  # (1,) s, of the last sample; NaN for none
    mice: MiceState  # of the filter that chooses the mice
    rejected: NDArray[np.int64]  # (1,) readings that brought no measurement, samples after which P was no covariance

    @staticmethod
    def fresh(count: int) -> PlanarState:
        return PlanarState(
            np.zeros(_STATES), np.diag(np.square(_START_STD)), np.full(1, np.nan), MiceState.fresh(count),
            np.zeros(1, np.int64),
        )  # fmt: skip


class World(NamedTuple):
    """What the filters' steps want to know beside the measurements.

    The models' numbers are here because a compiler that sees a constant makes a step for each.
    """

    motion: int
    mouse_velocity: int
    rate_gyro: int
    blocked: NDArray[np.uint8]  # no map
    geometry: Floats

    @staticmethod
    def make() -> World:
        grid = no_map()
        return World(models.PLANAR_TWIST, models.MOUSE_VELOCITY, models.RATE_GYRO, grid.blocked, grid.geometry)


class _PlanarFilter:
    """Either filter over blocks of samples."""

    name: str
    _is_ukf: bool

    def __init__(self, rig: Rig, parameters: MiceParameters | None = None) -> None:
        """The rig must place at least one mouse. Raises CannotRun for mice that all sit at one place."""
        mice.check_placement(rig.mouse)
        self.parameters = parameters or MiceParameters()
        self.state = PlanarState.fresh(len(rig.mouse))
        self._placement = Placement.of(rig.mouse)
        self._imu = ImuCalibration.of(rig.imu)
        self._world = World.make()

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the estimate's columns, the unit last."""
        prefix = self.name.replace("-", "_")
        quantities = [name.partition("_")[::2] for name in PLANAR_TWIST.states[:_SHOWN]]
        values = [f"{prefix}_{quantity}_{unit}" for quantity, unit in quantities]
        return (*values, *(f"{prefix}_{quantity}_std_{unit}" for quantity, unit in quantities))

    @property
    def rejected(self) -> int:
        """Readings of the mice so far that brought nothing, and samples after which the doubt had to start anew."""
        return int(self.state.rejected[0])

    def process(self, block: Measurements) -> Floats:
        """x, y, heading (in [−π, π)), v_x, v_y, ω and their standard deviations at each of the N samples: (N, 12)."""
        out = np.empty((len(block), 2 * _SHOWN))
        _process(
            block.time_s, block.mice_counts, block.gyro_rad_s, block.flags,
            self._is_ukf, self._placement, self._imu, self.parameters, self._world, self.state, out,
        )  # fmt: skip
        return out


class PlanarEkf(_PlanarFilter):
    """The extended Kalman filter."""

    name = "planar-ekf"
    _is_ukf = False


class PlanarUkf(_PlanarFilter):
    """The unscented Kalman filter, with the thesis's plain transform."""

    name = "planar-ukf"
    _is_ukf = True


@compiled
def _measure(
    reading: Reading, used: Bools, step: float, place: Placement, p: MiceParameters, mean: Floats
) -> tuple[Floats, Floats, Floats]:
    """Velocities of the mice that count (2 m,), their R (2 m, 2 m), and their places (m, 2).

    `step` (s) is what the reading covers. No mouse counts where it is NaN: not known, or a sample without a reading.
    """
    count = mice.number(used) if step > 0.0 else 0
    values, covariance, places = np.empty(2 * count), np.zeros((2 * count, 2 * count)), np.empty((count, 2))
    square = mean[3] * mean[3] + mean[4] * mean[4]
    common, apart = p.floor * p.floor * square, p.mismatch * p.mismatch * square * _LASTS_S / step
    k = 0
    for i in range(used.shape[0]):
        if count and used[i]:
            at = place.position[i]
            own = mice.variance(
                place.metres_per_count[i] / step, (mean[3], mean[4], mean[5]), at, p.scatter, p.noise_m_s**2
            )
            for j in range(2):
                places[k, j] = at[j]
                values[2 * k + j] = reading.moved[i, j] / step
                covariance[2 * k + j, 2 * k + j] = own + apart
                for other in range(count):
                    covariance[2 * k + j, 2 * other + j] += common - apart / count
            k += 1
    return values, covariance, places


@compiled
def _step(
    is_ukf: bool, dt: float, model: int, values: Floats, covariance: Floats, parameters: Floats,
    world: World, mean: Floats, spread: Floats,
) -> bool:  # fmt: skip
    """Moves on by `dt` and corrects; False when the covariance is none any more."""
    control, noise = np.empty(0), np.zeros((len(_NOISE), len(_NOISE)))
    for i in range(noise.shape[0]):
        noise[i, i] = _NOISE[i] * math.sqrt(_HOLD_S / dt) if dt > 0.0 else 0.0
    is_angle = np.zeros(_STATES + values.shape[0], np.bool_)
    is_angle[_HEADING] = True
    d2 = np.empty(min(1, values.shape[0]))
    if is_ukf:
        return bool(ukf_step(
            world.motion, mean, spread, control, noise, dt, model, values, covariance, parameters, is_angle,
            math.inf, d2, world.blocked, world.geometry, 1.0, 0.0, 0.0,
        ))  # fmt: skip
    return bool(ekf_step(
        world.motion, mean, spread, control, noise, dt, model, values, covariance, parameters, is_angle,
        math.inf, d2, world.blocked, world.geometry,
    ))  # fmt: skip


@compiled
def _process(
    time_s: Floats,
    counts: Floats,
    gyro: Floats,
    flags: NDArray[np.uint32],
    is_ukf: bool,
    place: Placement,
    imu: ImuCalibration,
    p: MiceParameters,
    world: World,
    state: PlanarState,
    out: Floats,
) -> None:
    reading = mice.room(place.position.shape[0])
    rate, rate_noise, nothing = np.empty(1), np.full((1, 1), imu.gyro_variance), np.empty((0, 2))
    for i in range(len(time_s)):
        dt, since = time_s[i] - state.time[0], time_s[i] - state.mice.time[0]
        has_rate, turned = read_gyro((gyro[i, 0], gyro[i, 1], gyro[i, 2]), flags[i], imu)
        is_reading = mice.take(
            time_s[i], counts[i], flags[i], turned[2] if has_rate else math.nan, reading, place, p, state.mice
        )
        if not dt <= 0.0:
            state.time[0] = time_s[i]
        if dt > 0.0:  # not the first sample, whose interval nobody knows
            step = min(state.mice.time[1], since) if is_reading else math.nan
            values, covariance, places = _measure(reading, state.mice.used, step, place, p, state.mean)
            sound = _step(
                is_ukf, dt, world.mouse_velocity, values, covariance, places, world, state.mean, state.covariance
            )
            if has_rate:
                rate[0] = turned[2]
                sound = sound and _step(
                    is_ukf, 0.0, world.rate_gyro, rate, rate_noise, nothing, world, state.mean, state.covariance
                )
            if not sound:
                for j in range(_STATES):
                    for k in range(_STATES):
                        state.covariance[j, k] = _START_STD[j] ** 2 if j == k else 0.0
            state.rejected[0] += not (sound and (values.shape[0] or not is_reading))
        for j in range(_SHOWN):
            out[i, j] = state.mean[j]
            out[i, _SHOWN + j] = math.sqrt(state.covariance[j, j])
