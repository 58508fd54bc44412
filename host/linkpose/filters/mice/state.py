"""State, placement and memory layout of the `mice` filter, as records that compiled code reads through one pointer.

Frames: n is the floor's frame, b is the robot's (x ahead, y to the left, z up). A vector of the plane is a complex
number, x + jy, in b unless noted: turning it by φ multiplies it by e^{jφ}. Scalars and complex numbers in records
compile several times as fast as elements of arrays.
"""

from __future__ import annotations

import cmath
import math
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from linkpose.filters._records import zeros
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Imu, Mouse
from linkpose.wire.messages import SampleFlags

Floats = NDArray[np.float64]
Record = Any  # one record of the types below; a pointer in compiled code
Records = Any  # an array of them

MOST = 4  # mice: the firmware's ports; records have room for so many
# A NumPy integer, because the compiler gives each Python integer argument a type of its own.
NOBODY = cast(int, np.int64(0))

STALE = int(SampleFlags.MICE_STALE)
_GAP_BEFORE, _GYRO_SATURATED = int(SampleFlags.GAP_BEFORE), int(SampleFlags.GYRO_SATURATED)
_ACCEL_SATURATED = int(SampleFlags.ACCEL_SATURATED)
_OVERFLOW = int(SampleFlags.MOUSE1_OVERFLOW)  # for mouse i, shifted left by i
_MOST_RAD_S = 1e4  # beyond what any gyro reads

SAMPLE = np.dtype(
    [
        ("time", "f8"),  # s
        ("rate", "f8"),  # of the gyro about z, calibrated (rad/s); NaN where it cannot be used
        ("accel", "c16"),  # specific force along x and y of the sensor (m/s²); NaN where it cannot be used
        ("counts", "c16", (MOST,)),  # of each mouse, in its own axes; NaN without a mouse, or when its counter ran over
        ("is_stale", "?"),  # whether the mice were not read for this sample
        ("is_after_gap", "?"),
    ],
    align=True,
)

# Sums of a motion s and of the motion p that was expected, for s = g p + h p*, see `causes`.
_COMPARISON = np.dtype(
    [
        ("by_others", "f8"),  # Σ|p|² (m²)
        ("without_counts", "f8"),  # part of it in which s was 0 (m²)
        ("by_others_double", "c16"),  # Σp²
        ("direct", "c16"),  # Σ s p*
        ("mirrored", "c16"),  # Σ s p
    ],
    align=True,
)

MOUSE = np.dtype(
    [
        # Placement.
        ("arm", "c16"),  # q_i = j p_i (m): the velocity of the mouse at 1 rad/s, (3) of [Mice]
        ("axis", "c16"),  # e^{jφ_i} times metres per count: turns counts into a motion in b (m)
        ("metres_per_count", "f8"),
        # Motion.
        ("moved", "c16"),  # over the last step (m)
        ("window", "c16"),  # over the window of the fault tests: an exponentially forgetting sum (m)
        ("counts", "c16"),  # of the last reading
        ("repeats", "i8"),  # readings in a row with the same counts
        ("change", "f8"),  # of the counts over about half a second: a forgetting sum
        ("silent_s", "f8"),  # time without a count (s)
        ("held_s", "f8"),  # time for which readings without counts have been taken for missing reports (s)
        ("reports", "i8"),  # readings with counts
        ("missing", "i8"),  # readings taken for missing reports
        ("creeps", "i8"),  # single counts at rest
        ("is_lone", "?"),  # whether the last count came alone after a silence
        ("share", "f8"),  # of the last counts that belongs to the last step
        ("agreed_s", "f8"),  # time for which an excluded mouse has agreed (s)
        ("agreed_m", "f8"),  # distance over which it has (m)
        ("while_excluded", _COMPARISON),  # its motion beside the motion that the others show at its place
        ("way", "c16"),  # sums over the steps of `turns`: of its counts, and of its counts times the turn (rad)
        ("way_by_turn", "c16"),
        ("snap_readings", "f8"),  # readings almost along an axis in which counts across it were expected
        ("snap_empty", "f8"),  # and those of them without such counts
        ("snaps", "?"),  # whether they show that the mouse snaps to its axes
        # Terms of a least-squares fit.
        ("sum", "c16"),  # motion (m) or velocity (m/s)
        ("weight", "f8"),  # 1 / its variance
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("count", "i8"),  # number of mice
        # Time.
        ("time", "f8"),  # of the last reading (s); NaN before the first
        ("sample_time", "f8"),  # of the last sample (s)
        ("interval", "f8"),  # usual time between two readings (s); NaN until known
        ("known_time", "f8"),  # of the last reading that gave a velocity (s)
        ("lost", "?"),  # whether samples were lost since the last reading
        ("step", "f8"),  # part of the time since the reading before that the counts cover (s)
        ("missed", "f8"),  # the rest of that time (s)
        # Estimate.
        ("position", "c16"),  # in n at the last reading (m)
        ("heading", "f8"),  # rad
        ("velocity", "c16"),  # m/s
        ("turn_rate", "f8"),  # rad/s
        ("x_std", "f8"),  # standard deviations of the velocity (m/s) and of the turn rate (rad/s)
        ("y_std", "f8"),
        ("turn_std", "f8"),
        # Gyro.
        ("rate", "f8"),  # last usable rate (rad/s); NaN without one
        ("last_rate", "f8"),  # of the last sample, usable or not (rad/s)
        ("same_rates", "i8"),  # how often, and for how long (s), it has been the same to the last bit
        ("same_s", "f8"),
        ("turned", "f8"),  # ∫ rate since the last reading (rad), bias included
        ("turned_s", "f8"),  # time that the integral covers (s)
        ("mean_rate", "f8"),  # mean rate over the last step (rad/s); NaN without one
        ("rates", "i8"),  # number of rates since the last reading
        ("bias", "f8"),  # of the gyro beyond the rig's (rad/s)
        ("bias_std", "f8"),
        ("bias_s", "f8"),  # how long agreeing mice have shown the bias (s)
        ("is_saturated", "?"),  # whether all mice count a lower bound of their motion in this step
        ("speed_limit", "f8"),  # above which a mouse counts too little (m/s); 0 until one has been found
        # Sets of mice as bit masks: bit 0 is the first mouse.
        ("sound", "i8"),  # have counts that cover this step
        ("used", "i8"),  # count for the estimate
        ("away", "i8"),  # had no counts
        ("held", "i8"),  # had a reading without counts between two reports
        ("excluded", "i8"),  # not used until they agree again
        # The window: an exponentially forgetting sum.
        ("window_s", "f8"),  # its length (s)
        ("window_turn", "f8"),  # ∫ rate (rad), bias included
        ("reference", "c16"),  # mean velocity over the window when the mice last agreed (m/s)
        ("reference_rate", "f8"),  # rad/s
        ("has_reference", "?"),
        # What the fault tests remember.
        ("suspects", "i8"),  # the mice that the last test found at fault
        ("suspected_s", "f8"),  # for how long it has found the same (s)
        ("disagree_s", "f8"),  # for how long the mice have disagreed (s)
        # While no mouse is used: motions of the mice relative to their mean, beside the gyro's turn.
        ("while_excluded", _COMPARISON),
        # Turns of the gyro (rad), bias included, in steps in which all mice count: how many, their sum, and of squares.
        ("turns", "f8"),
        ("turns_sum", "f8"),
        ("turns_squared", "f8"),
        # Result of a least-squares fit: motion (m, rad) or velocity (m/s, rad/s), and variances.
        ("fit", "c16"),
        ("fit_turn", "f8"),
        ("fit_x_variance", "f8"),
        ("fit_y_variance", "f8"),
        ("fit_turn_variance", "f8"),
        ("is_decisive", "?"),  # whether the faulty set is decisively more probable than every other
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


def mouse_records(mice: tuple[Mouse, ...]) -> Any:
    """The rig's [[mouse]] tables as an array of MOST records of MOUSE."""
    records = zeros(MOST, MOUSE)
    for i, mouse in enumerate(mice):
        metres = 1.0 / mouse.counts_per_m
        records[i].arm = complex(-mouse.y_m, mouse.x_m)
        records[i].axis = cmath.rect(metres, math.radians(mouse.angle_deg))
        records[i].metres_per_count = metres
        records[i].share = 1.0
    return records


def fresh_state(count: int, bias_std_rad_s: float) -> Any:
    """An array of one state record before the first sample, for so many mice."""
    records = zeros(1, STATE)
    state: Any = records[0]
    state.count = count
    state.time = state.sample_time = state.interval = state.known_time = state.rate = state.mean_rate = (
        state.last_rate
    ) = np.nan
    state.bias_std = bias_std_rad_s
    return records


def sample_records(block: Measurements, imu: Imu) -> NDArray[Any]:
    """What the compiled steps read of N samples: an array (N,) of SAMPLE."""
    samples = np.empty(len(block), SAMPLE)
    samples["time"] = block.time_s
    rate = block.gyro_rad_s - imu.gyro_bias_rad_s
    is_usable = (np.abs(rate) < _MOST_RAD_S).all(axis=1) & (block.flags & _GYRO_SATURATED == 0)
    samples["rate"] = np.where(is_usable, rate[:, 2], np.nan)
    force = block.accel_m_s2[:, 0] + 1j * block.accel_m_s2[:, 1]
    samples["accel"] = np.where(block.flags & _ACCEL_SATURATED == 0, force, np.nan)
    samples["is_stale"] = block.flags & STALE != 0
    samples["is_after_gap"] = block.flags & _GAP_BEFORE != 0
    ports = min(MOST, block.mice_counts.shape[1])
    samples["counts"][:, ports:] = np.nan
    for i in range(ports):
        samples["counts"][:, i] = block.mice_counts[:, i, 0] + 1j * block.mice_counts[:, i, 1]
        samples["counts"][block.flags & (_OVERFLOW << i) != 0, i] = np.nan
    return samples
