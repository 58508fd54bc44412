"""`chain`: two links with a sensor on each, joined by a ball joint or a hinge.

The filter estimates the orientation of sensor 2 relative to sensor 1, its heading from the joint's constraint alone,
and for a hinge the joint angle. Mounting (r_k, the vectors from the joint centre to the sensors, and the hinge axis)
may be unknown: it is estimated beside both tilts and the biases of both sensors. State, measurements and start are in
`state`, `joint`, `hinge`, `motion` and `process`.

Source: M. Kok, K. Eckhoff, I. Weygers, T. Seel, "Observability of the relative motion from inertial data in kinematic
chains", Control Engineering Practice 125, 2022; the constraint is used once integrated.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from linkpose.filters._imu import GRAVITY, ImuSamples
from linkpose.filters._records import record_of
from linkpose.filters.chain.misfit import MOST_MEAN_RATE_RAD_S
from linkpose.filters.chain.process import process
from linkpose.filters.chain.state import (
    BA,
    BG,
    ESTIMATE,
    OF_SENSOR,
    START,
    TH,
    ChainParameters,
    Floats,
    V,
    fresh_bank,
    fresh_states,
)
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

_ROTATION = ("chain_qw", "chain_qx", "chain_qy", "chain_qz", "chain_rotation_std_deg")
_ANGLE = ("chain_angle_deg", "chain_angle_std_deg")
_ANGLES = (
    "chain_flexion_deg", "chain_flexion_std_deg", "chain_abduction_deg", "chain_abduction_std_deg",
    "chain_axial_rotation_deg", "chain_axial_rotation_std_deg",
)  # fmt: skip
_HEIGHTS = ("chain_height1_m", "chain_height1_std_m", "chain_height2_m", "chain_height2_std_m")

# Mean specific force over gravity, and its inverse, beyond which the unit or the sensor is wrong: a runner's shank has
# 1.5. Samples from which on the mean counts, and the share of samples from which on a fault is reported.
_LEAST_SHARE, _FEWEST, _MANY = 0.4, 100, 0.02


class ChainFilter:
    """The filter over blocks of samples, for the joint and the mounting in the rig's [chain].

    With a first joint that is fixed (the rig's [joint]) it also estimates the heights of both sensors over that joint.
    """

    name = "chain"

    def __init__(self, rig: Rig, parameters: ChainParameters | None = None) -> None:
        self.parameters = parameters or ChainParameters()
        self._record = record_of(self.parameters)
        self._bank = fresh_bank(rig)
        self._states = fresh_states(rig, self.parameters, self._bank[0])
        self._noise = np.square([rig.imu.gyro_noise_rad_s, rig.imu.accel_noise_m_s2])
        self._calibration = np.array(  # offset and scale of the accelerometer, gyro bias; of each sensor
            [
                [rig.imu.accel_offset_m_s2, rig.imu.accel_scale, rig.imu.gyro_bias_rad_s],
                [[0.0] * 3, [1.0] * 3, [0.0] * 3],
            ]
        )
        self.is_hinge, self._is_fixed = bool(self._bank[0].hinge >= 0), bool(self._bank[0].fixed >= 0)

    @property
    def columns(self) -> tuple[str, ...]:
        """The rotation from sensor 2's axes into sensor 1's, the joint's angles, heights over a fixed first joint."""
        return _ROTATION + (_ANGLE if self.is_hinge else _ANGLES) + _HEIGHTS * self._is_fixed

    @property
    def rejected(self) -> int:
        """Samples so far of which one sensor or both could not be used."""
        return int(self._bank[0].rejected)

    @property
    def restarts(self) -> int:
        """How often a gap made the attitudes start anew."""
        return int(self._bank[0].restarts)

    @property
    def remarks(self) -> list[str]:
        """What is wrong with the readings, one sentence with its cure for each fault."""
        bank, found = self._bank[0], []
        samples = max(int(bank.samples), 1)
        for k in range(2):
            readings = max(int(bank.readings[k]), 1)
            mean, rate = float(bank.force_sum[k]) / readings, float(bank.rate_sum[k]) / readings
            if readings >= _FEWEST and not _LEAST_SHARE < mean / GRAVITY < 1 / _LEAST_SHARE:
                found.append(
                    f"chain: the mean acceleration of sensor {k + 1} is {mean:.3g} m/s², and gravity alone is 9.81 "
                    "m/s². Check that the sensor works and that its unit is m/s²."
                )
            if readings >= _FEWEST and rate > MOST_MEAN_RATE_RAD_S:
                found.append(
                    f"chain: the mean rate of sensor {k + 1} is {rate:.3g} rad/s, more than a joint turns. Check that "
                    "its unit is rad/s, not °/s."
                )
        if self.rejected > _MANY * samples:
            found.append(
                f"chain: {self.rejected} of {samples} samples could not be used. A sensor was absent, repeated one "
                "reading, or was saturated. Check its wiring and its range."
            )
        if self.restarts > _MANY * samples:
            found.append(
                f"chain: the attitudes started again {self.restarts} times after gaps of more than "
                f"{self.parameters.longest_gap_s:g} s. Check that the times are in seconds."
            )
        if bank.misfits:
            found.append(
                f"chain: for {100 * int(bank.misfits) / samples:.0f} % of the samples the readings do not fit two "
                "links with one joint, so their estimates are blank. Check that the units are m/s² and rad/s, that "
                "both sensors are firm on links that share a joint, and that neither sensor has failed."
            )
        return found

    @property
    def hypotheses(self) -> int:
        """How many relative headings are still possible."""
        return int(np.count_nonzero(self._states["alive"]))

    @property
    def knows_heading(self) -> bool:
        """Whether the motion has given the relative heading."""
        return bool(self._bank[0].spread) and self.hypotheses == 1

    @property
    def state(self) -> Any:
        """The record (fields of `state.STATE`) of the most probable hypothesis."""
        return self._states[self._bank[0].best]

    @property
    def segment_axes(self) -> Floats:
        """(3, 3) flexion, abduction and length of link 1 as columns, in sensor 1's axes; 0 before the first sample."""
        return np.array(self._bank[0].frame)

    @property
    def size(self) -> int:
        """Length of the error state."""
        return int(self._bank[0].length)

    def start_from(self, learned: ChainFilter, backwards: bool = False) -> None:
        """Begin with another filter's mounting and accelerometer biases; `backwards`: with time reversed.

        Gyro biases drift: only reversed time begins with those of the other filter's end.
        """
        other, hinge = learned.state, int(self._bank[0].hinge)
        not_constant = {TH, V, OF_SENSOR + TH, OF_SENSOR + V, START, START + 3}
        if not backwards:
            not_constant |= {BG, OF_SENSOR + BG}
        if hinge >= 0 and not learned.knows_heading:  # the axis in sensor 1's axes depends on it
            not_constant |= {hinge, hinge + 3}
        for state in self._states:
            for name in ("accel_bias", "lever", "lever0"):
                setattr(state, name, getattr(other, name))
            if learned.knows_heading:
                state.axis, state.has_axis = other.axis, other.has_axis
            state.level = max(other.level, 1.0)
            for k in np.flatnonzero(other.is_narrow > state.is_narrow).tolist():
                at = slice(OF_SENSOR * k + BG, OF_SENSOR * k + BA)
                state.covariance[at, at] = self.parameters.gyro_bias_rad_s**2 * np.eye(3)
            state.is_narrow = other.is_narrow
            if backwards:
                state.gyro_bias = -other.gyro_bias
            for first in set(range(0, self.size, 3)) - not_constant:
                at = slice(first, first + 3)
                state.covariance[at, at] = other.covariance[at, at]

    def process(self, block: Measurements) -> Floats:
        """Estimates at each of the N samples: (N, len(columns)); NaN where not known yet."""
        return self.table(self.estimates(block))

    def estimates(self, block: Measurements) -> NDArray[Any]:
        """Estimates at each of the N samples as records of `state.ESTIMATE` (N,); NaN where not known yet."""
        estimates = np.empty(len(block), ESTIMATE)
        # A sensor that is absent has arrays without memory of their own.
        accel2, gyro2 = np.ascontiguousarray(block.accel2_m_s2), np.ascontiguousarray(block.gyro2_rad_s)
        second = ImuSamples(block.time_s, accel2, gyro2, block.flags)
        process(
            ImuSamples.of(block), second, self._calibration, self._bank, self._states, self._record, self._noise,
            estimates,
        )  # fmt: skip
        return estimates

    def table(self, found: NDArray[Any]) -> Floats:
        """Records of ESTIMATE (N,) as columns."""
        table = np.empty((len(found), len(self.columns)))
        table[:, :4] = found["q"]
        np.degrees(found["rotation_std"], out=table[:, 4])
        at = len(_ROTATION)
        if self.is_hinge:
            np.degrees(found["angle"], out=table[:, at])
            np.degrees(found["angle_std"], out=table[:, at + 1])
            at += len(_ANGLE)
        else:
            np.degrees(found["joint"], out=table[:, at : at + 6 : 2])
            np.degrees(found["joint_std"], out=table[:, at + 1 : at + 7 : 2])
            at += len(_ANGLES)
        if self._is_fixed:
            table[:, at::2], table[:, at + 1 :: 2] = found["height"], found["height_std"]
        return table
