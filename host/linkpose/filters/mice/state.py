"""State, placement and memory layout of the `mice` filter, as records that compiled code reads through one pointer.

Frames: n is the floor's frame, b is the robot's (x ahead, y to the left, z up). All vectors are in b unless noted.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.rig import Mouse

Floats = NDArray[np.float64]
Record = Any  # one record of the types below; a pointer in compiled code

MOST = 4  # mice: the firmware's ports; records have room for so many

_TWIST = ("f8", (3,))  # v_x, v_y (m/s), ω (rad/s)
_EACH = ("f8", (MOST,))
_EACH_VECTOR = ("f8", (MOST, 2))

PLACEMENT = np.dtype(
    [
        ("count", "i8"),
        ("position", *_EACH_VECTOR),  # p_i (m)
        ("axes", *_EACH_VECTOR),  # cos φ_i, sin φ_i
        ("metres_per_count", *_EACH),
    ],
    align=True,
)

STATE = np.dtype(
    [
        # Time.
        ("time", "f8"),  # of the last reading (s); NaN before the first
        ("sample_time", "f8"),  # of the last sample (s)
        ("interval", "f8"),  # usual time between two readings (s); NaN until known
        ("known_time", "f8"),  # of the last reading that gave a velocity (s)
        ("lost", "?"),  # whether samples were lost since the last reading
        # Estimate.
        ("pose", "f8", (3,)),  # x, y (m), heading (rad) in n at the last reading
        ("velocity", *_TWIST),
        ("std", *_TWIST),
        # Gyro.
        ("rate", "f8"),  # last usable rate (rad/s); NaN without one
        ("turned", "f8"),  # ∫ rate since the last reading (rad), bias included
        ("turned_s", "f8"),  # time that the integral covers (s)
        ("mean_rate", "f8"),  # mean rate over the last step (rad/s); NaN without one
        ("rates", "i8"),  # number of rates since the last reading
        ("bias", "f8"),  # of the gyro beyond the rig's (rad/s)
        ("bias_std", "f8"),
        ("bias_s", "f8"),  # how long agreeing mice have shown the bias (s)
        # The last reading.
        ("moved", *_EACH_VECTOR),  # motion over the step (m)
        # Sets of mice as bit masks: bit 0 is the first mouse.
        ("sound", "i8"),  # have counts that cover this step
        ("used", "i8"),  # count for the estimate
        ("away", "i8"),  # had no counts
        ("distrusted", "i8"),  # excluded until they agree again
        # The window: an exponentially forgetting sum.
        ("window", *_EACH_VECTOR),  # S_i (m)
        ("window_s", "f8"),  # its length (s)
        ("window_turn", "f8"),  # ∫ rate (rad), bias included
        ("reference", *_TWIST),  # mean velocity over the window when the mice last agreed
        ("has_reference", "?"),
        # What the fault tests remember.
        ("silent_s", *_EACH),  # time without a count (s)
        ("agreed_s", *_EACH),  # time for which an excluded mouse has agreed (s)
        ("agreed_m", *_EACH),  # distance over which it has (m)
        ("suspects", "i8"),  # bit mask of the mice that the last test found at fault
        ("suspected_s", "f8"),  # for how long it has found the same (s)
        ("disagree_s", "f8"),  # for how long the mice have disagreed (s)
        # Scratch of the fault tests.
        ("sums", *_EACH_VECTOR),
        ("weight", *_EACH),
        ("normal", "f8", (4,)),
        ("right", *_TWIST),
        ("solution", *_TWIST),
        ("variance", *_TWIST),
        ("rejected", "i8"),  # readings that gave no velocity, or whose time did not increase
    ],
    align=True,
)


class MiceParameters(NamedTuple):
    """Noise of the mice: standard deviations, relative to the speed or in m/s."""

    scatter: float = 0.01  # κ: of one mouse, from sample to sample. Doubled: slow motion weighs more in the mean.
    floor: float = 0.005  # κ_c: common to all mice, from sample to sample. Doubled: so is the σ of v in fast motion.
    mismatch: float = 0.02  # of one mouse, constant: left by its calibration, no fault. Doubled: faults of 10 % pass.
    noise_m_s: float = 0.0  # of one mouse, from sample to sample, at any speed, beyond the rounding to counts


PARAMETERS = np.dtype([(name, "f8") for name in MiceParameters._fields], align=True)


def parameters_record(parameters: MiceParameters) -> Any:
    """The parameters as an array of one record."""
    return np.array([tuple(parameters)], PARAMETERS).view(np.recarray)


def placement_record(mice: tuple[Mouse, ...]) -> Any:
    """The rig's [[mouse]] tables as an array of one record."""
    records = np.zeros(1, PLACEMENT).view(np.recarray)
    place: Any = records[0]
    place.count = len(mice)
    for i, mouse in enumerate(mice):
        angle = math.radians(mouse.angle_deg)
        place.position[i] = mouse.x_m, mouse.y_m
        place.axes[i] = math.cos(angle), math.sin(angle)
        place.metres_per_count[i] = 1.0 / mouse.counts_per_m
    return records


def fresh_state(bias_std_rad_s: float) -> Any:
    """An array of one state record before the first sample."""
    records = np.zeros(1, STATE).view(np.recarray)
    state: Any = records[0]
    state.time = state.sample_time = state.interval = state.known_time = state.rate = state.mean_rate = np.nan
    state.bias_std = bias_std_rad_s
    return records
