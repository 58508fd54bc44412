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

from linkpose.filters.chain.process import process
from linkpose.filters.chain.state import ESTIMATE, ChainParameters, Floats, fresh_bank, fresh_states, record_of
from linkpose.sensors.frozen import FrozenDetector
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig
from linkpose.wire.messages import SampleFlags

_ROTATION = ("chain_qw", "chain_qx", "chain_qy", "chain_qz", "chain_rotation_std_deg")
_ANGLE = ("chain_angle_deg", "chain_angle_std_deg")
_HEIGHTS = ("chain_height1_m", "chain_height1_std_m", "chain_height2_m", "chain_height2_std_m")
_NEEDED = np.uint32(SampleFlags.IMU_VALID | SampleFlags.IMU2_VALID)
_CLIPPED = np.uint32(
    SampleFlags.ACCEL_SATURATED
    | SampleFlags.GYRO_SATURATED
    | SampleFlags.ACCEL2_SATURATED
    | SampleFlags.GYRO2_SATURATED
)
# Readings of a sensor at rest may repeat to the last bit (low-pass filter, little noise): below this rate of all axes
# they do not show a frozen sensor.
_RESTING_RAD_S = 0.05
_LARGEST = 1e4  # m/s² or rad/s: beyond what any sensor reads


class ChainFilter:
    """The filter over blocks of samples, for the joint and the mounting in the rig's [chain].

    With a first joint that is fixed (the rig's [joint]) it also estimates the heights of both sensors over that joint.
    """

    name = "chain"

    def __init__(self, rig: Rig, parameters: ChainParameters | None = None) -> None:
        self.parameters = parameters or ChainParameters()
        self._rig = rig
        self._record = record_of(self.parameters)
        self._bank = fresh_bank(rig)
        self._states = fresh_states(rig, self.parameters, self._bank[0])
        self._noise = np.square([rig.imu.gyro_noise_rad_s, rig.imu.accel_noise_m_s2])
        self._frozen = FrozenDetector(), FrozenDetector()
        self._is_hinge, self._is_fixed = bool(self._bank[0].hinge >= 0), bool(self._bank[0].fixed >= 0)

    @property
    def columns(self) -> tuple[str, ...]:
        """The rotation from sensor 2's axes into sensor 1's, a hinge's angle, heights over a fixed first joint."""
        return _ROTATION + _ANGLE * self._is_hinge + _HEIGHTS * self._is_fixed

    @property
    def rejected(self) -> int:
        """Samples so far of which one sensor or both could not be used."""
        return int(self._bank[0].rejected)

    @property
    def restarts(self) -> int:
        """How often a gap made the attitudes start anew."""
        return int(self._bank[0].restarts)

    @property
    def hypotheses(self) -> int:
        """How many relative headings are still possible."""
        return int(np.count_nonzero(self._states.alive))

    @property
    def state(self) -> Any:
        """The record (fields of `state.STATE`) of the most probable hypothesis."""
        return self._states[self._bank[0].best]

    @property
    def size(self) -> int:
        """Length of the error state."""
        return int(self._bank[0].length)

    def start_from(self, learned: ChainFilter, backwards: bool = False) -> None:
        """Begin with another filter's mounting and accelerometer biases; `backwards`: with time reversed.

        Gyro biases drift: only reversed time begins with those of the other filter's end.
        """
        other = learned.state
        for state in self._states:
            for name in ("accel_bias", "lever", "axis", "lever0", "has_axis"):
                setattr(state, name, getattr(other, name))
            for first in range(0, self.size, 3):
                is_gyro = first in (6, 21)
                if first in (0, 3, 15, 18, self._bank[0].hinge) or (is_gyro and not backwards):
                    continue
                at = slice(first, first + 3)
                state.covariance[at, at] = other.covariance[at, at]
            if backwards:
                state.gyro_bias = -other.gyro_bias

    def run(self, block: Measurements) -> Any:
        """The estimates (N,) as records of `state.ESTIMATE`."""
        accel, gyro, valid = self._readings(block)
        estimates = np.recarray(len(block), ESTIMATE)
        process(
            block.time_s, accel, gyro, valid, self._bank, self._states, self._record, self._noise, estimates
        )  # fmt: skip
        return estimates

    def process(self, block: Measurements) -> Floats:
        """Estimates at each of the N samples: (N, len(columns)); NaN where not known yet."""
        return self.table(self.run(block))

    def table(self, found: Any) -> Floats:
        """Records of ESTIMATE (N,) as columns."""
        parts = [found.q, np.degrees(found.rotation_std)[:, None]]
        if self._is_hinge:
            parts.append(np.degrees(np.column_stack([found.angle, found.angle_std])))
        if self._is_fixed:
            parts.append(np.stack([found.height, found.height_std], axis=2).reshape(-1, 4))
        return np.hstack(parts)

    def _readings(self, block: Measurements) -> tuple[Floats, Floats, Floats]:
        """Calibrated readings of both sensors (N, 2, 3), and which samples can be used (N,), 1 or 0."""
        imu = self._rig.imu
        accel = (block.accel_m_s2 - np.asarray(imu.accel_offset_m_s2)) / np.asarray(imu.accel_scale)
        gyro = block.gyro_rad_s - np.asarray(imu.gyro_bias_rad_s)
        both = np.stack([accel, block.accel2_m_s2], axis=1), np.stack([gyro, block.gyro2_rad_s], axis=1)
        with np.errstate(invalid="ignore"):
            in_range = np.logical_and.reduce([(np.abs(values) < _LARGEST).all(axis=(1, 2)) for values in both])
        raw = (
            np.hstack([block.accel_m_s2, block.gyro_rad_s]),
            np.hstack([block.accel2_m_s2, block.gyro2_rad_s]),
        )
        dead: NDArray[np.bool_] = np.zeros(len(block), np.bool_)
        for detector, values in zip(self._frozen, raw, strict=True):
            turns = (np.abs(values[:, 3:]) > _RESTING_RAD_S).any(axis=1)
            dead |= detector.frozen(block.time_s, values) & turns
        flagged = (block.flags & _NEEDED == _NEEDED) & (block.flags & _CLIPPED == 0)
        return both[0], both[1], (in_range & ~dead & flagged).astype(np.float64)
