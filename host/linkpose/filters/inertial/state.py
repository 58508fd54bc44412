"""State, parameters and memory layout of the inertial core.

Frames: n is fixed with Z up; its X axis points where the sensor's x axis pointed, seen from above, at the first sample.
s is the sensor's frame. The mean holds, all in s:

    Z, X   n's Z and X axes (unit vectors)          Ż = −ω × Z
    v      velocity of the sensor (m/s)             v̇ = −ω × v + f − g Z
    b_g    gyro bias (rad/s)                        ω = (I − M_g) (s_G − b_g)
    b_a    accelerometer bias (m/s²)                f = (I − M_a) s_A − b_a
    M_a, M_g   scale, cross-axis sensitivity and misalignment of each sensor, nine numbers each
    d      J2S (m): the vector from the joint centre to the sensor; zero where there is no joint

All errors are additive, that of Z too: given the angular rate, Z and v propagate linearly and the measurements are
linear in them, so that even a tilt of which nothing is known converges like any linear Kalman filter. ‖Z‖ = 1 is kept
beside. The error of X is a rotation ψ about Z (rad). The covariance is of these 34 errors, in the order of the
constants below.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from linkpose.filters._records import zeros
from linkpose.filters.frozen import MEMORY, fresh_memory

Floats = NDArray[np.float64]
Record = Any  # one record of STATE, ESTIMATE or PARAMETERS; a pointer in compiled code


def _index(k: int) -> int:
    """A NumPy integer: the compiler would take each Python integer for a type of its own."""
    return cast(int, np.int64(k))


# First index of each part of the state.
Z, V, BG, BA, MA, MG, D, PSI = (_index(k) for k in (0, 3, 6, 9, 12, 21, 30, 33))
SIZE = 34

_VECTOR = ("f8", (3,))
_MATRIX = ("f8", (SIZE, SIZE))

_FIELDS = np.dtype(
    [
        # Nominal state.
        ("time", "f8"),  # of the last integrated sample (s); NaN before the first
        ("north", *_VECTOR),  # X
        ("nominal", "f8", (SIZE,)),  # Z, v, b_g, b_a, M_a, M_g, d; ψ is zero outside an update
        ("covariance", *_MATRIX),
        # Priors.
        ("start_mean", "f8", (SIZE,)),
        ("start_covariance", *_MATRIX),
        ("prior", "f8", (SIZE,)),  # variances of the sensor error parameters and of J2S
        ("switch_on_variance", "f8"),  # of a gyro bias that a rest since the first sample shows (rad²/s²)
        ("decay_s", "f8"),  # time constant with which they return to the prior (s)
        ("undecayed_s", "f8"),  # time since they last did (s)
        ("distance", "f8"),  # half the χ² of the estimated sensor errors under the prior
        ("tilt_level", "f8"),  # variance of unit weight of the accelerometer's estimated errors
        ("heading_level", "f8"),  # the same of the gyro's scale and alignment
        ("largest_distance", "f8"),  # beyond it the state is impossible
        # Last readings.
        ("force", *_VECTOR),  # specific force at `time` (m/s²)
        ("force_change", *_VECTOR),  # over the last step (m/s²)
        ("rate", *_VECTOR),  # angular rate at `time` (rad/s)
        ("newest_rate", *_VECTOR),  # may be newer than `time` while a held force is waited out (rad/s)
        ("rate_slope", *_VECTOR),  # between the last two rates; zero after a jump (rad/s²)
        ("rate_pace", "f8"),  # the largest such change since the last usable rate (rad/s²)
        ("turned_at", "f8"),  # time of the newest rate (s)
        ("angle", *_VECTOR),  # ∫ rate since `time`, gyro bias included (rad)
        ("angle_variance", "f8"),  # each axis (rad²)
        ("blind_s", "f8"),  # how long no usable rate has arrived (s)
        ("no_force_s", "f8"),  # how long no force has arrived (s)
        ("clipped_s", "f8"),  # how long the accelerometer has been saturated (s)
        ("last_readings", "f8", (MEMORY,)),  # of `frozen.is_frozen`
        # Increments accumulated since the last propagation of the covariance.
        ("span", "f8"),  # s
        ("turned", *_VECTOR),  # rotation (rad)
        ("impulse", *_VECTOR),  # ∫ force (m/s)
        ("rotation_variance", "f8"),  # each axis (rad²)
        ("velocity_variance", "f8"),  # each axis (m²/s²)
        # Noise of the readings.
        ("force_differences", "f8", (4, 3)),  # last force and its differences up to the third
        ("rate_differences", "f8", (4, 3)),
        ("force_noise", "f8"),  # measured variance of each axis (m²/s⁴)
        ("rate_noise", "f8"),  # rad²/s²
        # Memory of the measurement models.
        ("rest_s", "f8"),  # how long the sensor has been at rest (s)
        ("unmoved", "b1"),  # at rest since the first sample
        ("rest_north", *_VECTOR),  # X when it began
        ("rest_heading_variance", "f8"),  # rad²
        ("rest_force", *_VECTOR),  # first force of the rest (m/s²)
        ("rest_force_sum", *_VECTOR),  # ∫ force over the rest (m/s)
        ("rest_rate_sum", *_VECTOR),  # ∫ rate over the rest (rad)
        ("steady_force", *_VECTOR),  # force without its noise (m/s²)
        ("residual_square", *_VECTOR),  # mean square of the joint constraint's excess residual (m²/s²)
        ("reach_square", "f8"),  # mean of ‖ω‖² ‖d‖² (m²/s²)
        ("assumed", "f8"),  # share of these two means that is assumed rather than measured
        ("spread", "f8", (3, 3)),  # mean of ω ωᵀ (rad²/s²)
        ("swing", *_VECTOR),  # velocity that the acceleration of the last second adds up to (m/s)
        ("speed_square", "f8"),  # variance of the sensor's own velocity (m²/s²)
        ("accel_square", "f8"),  # mean square of its acceleration on each axis (m²/s⁴)
        ("mean_force", *_VECTOR),  # over the last tenth of a second (m/s²)
        ("mean_rate", *_VECTOR),  # rad/s
        ("unsteadiness", "f8"),  # mean square change of rate and tilt (rad²/s²)
        # Reported until the covariance changes.
        ("turn_covariance", "f8", (4, 4)),  # of XᵀδZ, YᵀδZ, ZᵀδZ and ψ (rad²)
        ("lever_covariance", "f8", (4, 3)),  # of these with the error of J2S (rad m)
        # Scratch.
        ("transition", "f8", (7, 13)),  # rows of Z, v and ψ, columns of Z, v, ω, f and ψ
        ("combined", "f8", (13, SIZE)),  # covariance of the errors of Z, v, ω, f and ψ with each error
        ("jacobian", "f8", (3, SIZE)),
        ("direction", "f8", (SIZE,)),  # the one that cannot be observed
        ("work", "f8", (7, SIZE)),
        # Counters.
        ("rejected", "i8"),
        ("restarts", "i8"),
    ],
    align=True,
)


def _with_parts(dtype: np.dtype[Any], whole: str, parts: dict[str, int]) -> np.dtype[Any]:
    """The record with names for vectors of three inside one of its arrays of floats."""
    names = list(dtype.names or ())
    offsets = [dtype.fields[name][1] for name in names] if dtype.fields else []
    begin = offsets[names.index(whole)]
    return np.dtype(
        {
            "names": names + list(parts),
            "formats": [dtype[name] for name in names] + [np.dtype(_VECTOR)] * len(parts),
            "offsets": offsets + [begin + 8 * int(k) for k in parts.values()],
            "itemsize": dtype.itemsize,
        },
        align=True,
    )


STATE = _with_parts(_FIELDS, "nominal", {"tilt": Z, "velocity": V, "gyro_bias": BG, "accel_bias": BA, "j2s": D})

# Places of the reported values; σ follow them in a table, in the same order.
HEIGHT, X, Y, ROLL, PITCH, YAW, SIGMA = (_index(k) for k in range(7))

ESTIMATE = np.dtype(
    [
        ("value", "f8", (6,)),  # height Zᵀd, x, y (m); roll, pitch, yaw (rad)
        ("std", "f8", (6,)),
        ("tilt", *_VECTOR),
        ("unmoved", "b1"),  # of the state, as are distance and levels
        ("distance", "f8"),
        ("tilt_level", "f8"),
        ("heading_level", "f8"),
        ("unknown", "f8"),  # share of the accelerometer's bias variance across Z that the motion has not resolved
    ],
    align=True,
)


class SensorErrors(NamedTuple):
    """How far the sensors may be off: standard deviations of one axis."""

    gyro_bias_rad_s: float
    gyro_scale: float
    gyro_cross: float
    accel_bias_m_s2: float
    accel_scale: float
    accel_cross: float
    decay_s: float  # time constant with which what was estimated returns to the prior (s)
    # Of the gyro bias, where a rest since switch-on shows it: the data sheet's, since it returns with each switch-on.
    # With a third of it, a bias of 20 °/s turns the filter that assumes a calibration by tens of degrees.
    switch_on_bias_rad_s: float = 0.2

    def variances(self) -> Floats:
        """Prior variance of each state (34,); 0 for attitude, velocity, J2S and heading."""
        accel = np.where(np.eye(3, dtype=bool), self.accel_scale, self.accel_cross)
        gyro = np.where(np.eye(3, dtype=bool), self.gyro_scale, self.gyro_cross)
        biases = 3 * [self.gyro_bias_rad_s] + 3 * [self.accel_bias_m_s2]
        return np.concatenate([np.zeros(6), biases, accel.ravel(), gyro.ravel(), np.zeros(4)]) ** 2


def fresh_state(
    errors: SensorErrors,
    j2s_m: tuple[float, float, float],
    j2s_std_m: float | tuple[float, float, float],
    largest_distance: float = np.inf,
) -> Any:
    """An array of one state record before the first sample; `j2s_std_m` is of all axes of J2S, or of each.

    `largest_distance`: half the χ² of the sensor errors beyond which the filter begins anew.
    """
    states = zeros(1, STATE)
    state: Any = states[0]
    state.time = np.nan
    state.last_readings[:] = fresh_memory()
    state.prior[:] = errors.variances()
    state.prior[D:PSI] = np.square(j2s_std_m)
    state.start_mean[D:PSI] = j2s_m
    state.start_covariance[:] = np.diag(state.prior)
    state.decay_s = errors.decay_s
    state.switch_on_variance = errors.switch_on_bias_rad_s**2
    state.largest_distance = largest_distance
    return states


def roll_pitch(tilt: Floats) -> tuple[Floats, Floats]:
    """roll = atan2(Z_y, Z_z), pitch = atan2(−Z_x, ‖(Z_y, Z_z)‖) (rad, (N,)) of tilts (N, 3) of any length."""
    roll = np.arctan2(tilt[:, 1], tilt[:, 2])
    return roll, np.arctan2(-tilt[:, 0], np.hypot(tilt[:, 1], tilt[:, 2]))
