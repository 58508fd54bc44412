"""`joint-inertial`: the joint's constraint on the velocity, with the sensor errors and J2S in the state.

J2S is the vector from the joint centre to the sensor. Method A of the link paper needs the derivative of the gyro. Here
the accelerometer is integrated instead, and the resulting velocity must equal ω × J2S. Nothing is differentiated, and
no rest is needed; a rest, where there is one, gives the gyro bias directly. The state and its propagation are in
`linkpose.filters.inertial`; the measurement is `inertial.joint_velocity`; two filters with different assumptions about
the sensors run in parallel (`inertial.hypotheses`). The height is Zᵀd; x, y and yaw are relative to the first sample.

Source: (9) of [Link], once integrated.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from linkpose.filters._imu import ImuCalibration
from linkpose.filters._records import record_of
from linkpose.filters.inertial.hypotheses import CALIBRATED, DATA_SHEET, log_odds, mix
from linkpose.filters.inertial.process import process
from linkpose.filters.inertial.state import (
    BA,
    BG,
    ESTIMATE,
    HEIGHT,
    MA,
    PITCH,
    PSI,
    ROLL,
    SIGMA,
    YAW,
    D,
    Floats,
    SensorErrors,
    X,
    Y,
    fresh_state,
)  # fmt: skip
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Imu, Rig

_HYPOTHESES = (CALIBRATED, DATA_SHEET)
# Of `mix`'s table, in the order of the columns below.
_COLUMNS = np.array(
    [
        HEIGHT, SIGMA + HEIGHT, ROLL, PITCH, YAW, SIGMA + YAW, X, Y, HEIGHT,
        SIGMA + ROLL, SIGMA + PITCH, SIGMA + X, SIGMA + Y, SIGMA + HEIGHT,
    ]
)  # fmt: skip


class InertialParameters(NamedTuple):
    """Parameters of the inertial core. Unit, meaning; origin; effect of doubling where it matters."""

    has_joint: float = 1.0  # 1: joint constraint; 0: small velocity
    # (rad/s)/√s: twice the rate random walk of an MPU-6050 at constant temperature (its Allan deviation is 0.003 °/s at
    # 100 s), since it also warms up. Doubled, the heading drifts by 10 % more.
    gyro_bias_walk_rad_s: float = 2e-5
    # (rad/s)/√s: upper bound, used where the residual of the constraint exceeds its floor. Chosen on a real pendulum:
    # a quarter of it costs 5 % of the tilt there.
    most_bias_walk_rad_s: float = 4e-4
    # 1/√s, share of J2S's initial σ: lets an error of the model leave J2S again. Doubled, the height's σ grows by 10 %.
    j2s_walk: float = 0.001
    # Least residual of the constraint, as a share of ‖ω×d‖: the sampling error of a trapezoid at 100 Hz.
    least_residual: float = 0.0013
    first_residual: float = 0.03  # the same share before it has been measured
    # Correlation time of what the constraint leaves over (s): 1/w of a swing of 0.8 Hz. Doubled, the tilt of a real
    # pendulum is 1 % worse, that of `--smooth` 0.5 % better.
    residual_correlation_s: float = 0.2
    residual_time_s: float = 4.0  # averaging time of its measurement (s): some swings
    # Play of the joint, bending of the link. At 1 mm/s the NEES of an uncalibrated height is 2.4, at 2.5 mm/s 1.4.
    velocity_floor_m_s: float = 0.0025
    # Parts of rate and force that scale and misalignment in the state do not explain (nonlinearity, vibration).
    gyro_misfit: float = 0.0
    accel_misfit: float = 0.0
    # Bounds of the measured correlation time of the free velocity and of the misfits (s): taps of 2 Hz to slow circles.
    least_correlation_s: float = 0.1
    most_correlation_s: float = 1.0
    largest_bias_rad_s: float = 1.0  # a larger gyro bias is impossible and restarts the filter
    # Free velocity (unused with a joint).
    first_speed_m_s: float = 0.5  # σ before it has been measured
    least_speed_m_s: float = 0.1  # σ at rest
    most_speed_m_s: float = 2.0  # σ of a throwing arm
    swing_time_s: float = 1.0  # over which acceleration is integrated to measure σ (s)
    # Over which the result is averaged (s): some swings. At 2 s a chain of links is 5 % worse, BROAD the same.
    speed_memory_s: float = 5.0
    # A squared velocity beyond this many times its expected mean square shows a covariance that is too small.
    suspect: float = 6.0
    grow_s: float = 1.0  # in which a covariance that is too small grows e-fold (s)
    steady_memory_s: float = 0.1  # over which rate and force must stay the same (s)
    swing_share: float = 3.0  # a rate that changes by so much in that time changes by this times as much in a motion
    least_turn_rad_s: float = 0.001  # σ of the rate of a sensor that is held still


def declared(errors: SensorErrors, imu: Imu) -> SensorErrors:
    """The errors with the standard deviations of bias and offset that a rig file declares; others as they were."""
    gyro, accel = imu.gyro_bias_std_rad_s, imu.accel_offset_std_m_s2
    return errors._replace(
        gyro_bias_rad_s=errors.gyro_bias_rad_s if gyro is None else gyro,
        switch_on_bias_rad_s=errors.switch_on_bias_rad_s if gyro is None else gyro,
        accel_bias_m_s2=errors.accel_bias_m_s2 if accel is None else accel,
    )


class JointInertialFilter:
    """The filter over blocks of samples. J2S starts from the rig's value and standard deviation and is refined."""

    name = "joint-inertial"
    columns = (
        "joint_inertial_height_m",
        "joint_inertial_height_std_m",
        "joint_inertial_roll_deg",
        "joint_inertial_pitch_deg",
        "joint_inertial_yaw_deg",
        "joint_inertial_yaw_std_deg",
        "joint_inertial_x_m",
        "joint_inertial_y_m",
        "joint_inertial_z_m",
        "joint_inertial_roll_std_deg",
        "joint_inertial_pitch_std_deg",
        "joint_inertial_x_std_m",
        "joint_inertial_y_std_m",
        "joint_inertial_z_std_m",
    )

    def __init__(self, rig: Rig, parameters: InertialParameters | None = None) -> None:
        """Raises ValueError where the rig has no J2S, not even a rough one with a large `j2s_std_m`."""
        if rig.joint.j2s_m is None:
            raise ValueError("joint-inertial needs J2S, at least a rough value")
        self.parameters = parameters or InertialParameters()
        self._record = record_of(self.parameters)
        self._states = [
            fresh_state(declared(errors, rig.imu), rig.joint.j2s_m, rig.joint.j2s_std_m) for errors in _HYPOTHESES
        ]
        self._imu = ImuCalibration.of(rig.imu).packed()

    @property
    def states(self) -> tuple[Any, Any]:
        """State records (fields of `inertial.state.STATE`) under the two hypotheses."""
        return self._states[0][0], self._states[1][0]

    @property
    def state(self) -> Any:
        """The state record under the more probable hypothesis."""
        first, second = self.states
        return first if log_odds(first.distance, second.distance) >= 0.0 else second

    @property
    def rejected(self) -> int:
        """Number of samples so far that were unusable or whose innovation the gate rejected."""
        return int(self.state.rejected)

    @property
    def restarts(self) -> int:
        """Number of restarts after an impossible state."""
        return int(self.state.restarts)

    @property
    def j2s_m(self) -> tuple[Floats, Floats]:
        """J2S as estimated so far and its covariance: (3,) m, (3, 3) m². Before the first sample, the rig's."""
        state = self.state
        begun = not math.isnan(state.time)
        mean = state.nominal if begun else state.start_mean
        covariance = state.covariance if begun else state.start_covariance
        return mean[D:PSI].copy(), covariance[D:PSI, D:PSI].copy()

    @property
    def gyro_bias_rad_s(self) -> Floats:
        """(3,) as estimated so far, beyond the rig's calibration."""
        return np.asarray(self.state.nominal[BG:BA].copy())

    @property
    def accel_bias_m_s2(self) -> Floats:
        """(3,) as estimated so far, beyond the rig's calibration."""
        return np.asarray(self.state.nominal[BA:MA].copy())

    def start_from(self, other_filter: JointInertialFilter, backwards: bool = False) -> None:
        """Begin with another filter's estimates of J2S and of the sensor errors; `backwards`: with time reversed.

        The gyro bias drifts. The other filter's estimate belongs to the end of the recording, where this one starts.
        """
        first = BG if backwards else BA
        for own, other in zip(self.states, other_filter.states, strict=True):
            own.start_mean[first:PSI] = other.nominal[first:PSI]
            own.start_covariance[first:PSI, first:PSI] = other.covariance[first:PSI, first:PSI]
            if backwards:
                own.start_mean[BG:BA] *= -1
                own.start_covariance[BG:BA] *= -1
                own.start_covariance[:, BG:BA] *= -1
                own.switch_on_variance = float(np.diag(own.start_covariance)[BG:BA].max())

    def process(self, block: Measurements) -> Floats:
        """Estimates at each of the N samples: (N, 14) in the order of `columns`; NaN where unknown so far."""
        readings = block.time_s, block.accel_m_s2, block.gyro_rad_s, block.flags
        first, second = np.empty(len(block), ESTIMATE), np.empty(len(block), ESTIMATE)
        process(*readings, self._imu, self._record, self._states[0], first)
        process(*readings, self._imu, self._record, self._states[1], second)
        mixed = np.empty((len(block), 2 * SIGMA))
        mix(first, second, mixed)
        return mixed.take(_COLUMNS, axis=1)
