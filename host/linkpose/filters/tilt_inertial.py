"""`tilt-inertial`: the tilt of a sensor whose velocity stays small, with the sensor errors in the state.

Method B reads the acceleration off the tilt that it estimates, which suits accelerations of a few samples. Here the
accelerometer is integrated instead, and the velocity is assumed small (`inertial.free_velocity`). No joint is needed.
State and propagation are those of `joint-inertial` without J2S. Where rate and force stay the same, the rate is the
gyro bias (`inertial.rest`); a slow turn about the vertical at a constant rate from switch-on is indistinguishable from
one.

Without a joint, an offset of the accelerometer and a tilt look the same in most motions. The state therefore has the
accelerometer errors of a calibrated sensor. Where the rig file declares no σ of the offset, the sensor may be
uncalibrated, and σ of angles and height includes the tilt by the data sheet's errors, which the filter does not
estimate ("consider" parameters).

Source of these: S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in Control Systems
3, 1966.

The height is Zᵀ J2S, for a known J2S (the vector from the joint centre to the sensor).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from linkpose.compiling import compiled, inner
from linkpose.filters._imu import GRAVITY, ImuCalibration
from linkpose.filters._records import record_of
from linkpose.filters.inertial.hypotheses import DATA_SHEET
from linkpose.filters.inertial.process import process
from linkpose.filters.inertial.state import (
    BA,
    BG,
    ESTIMATE,
    HEIGHT,
    PITCH,
    PSI,
    ROLL,
    YAW,
    D,
    Floats,
    Record,
    SensorErrors,
    fresh_state,
)
from linkpose.filters.joint_inertial import InertialParameters, declared
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

# Without a joint, scale and misalignment are hardly observable: the values of a good part are assumed, with the full
# range of biases at switch-on.
ERRORS = SensorErrors(0.17, 0.006, 0.003, 0.02, 0.0015, 0.0005, 200.0)
# Half the χ² of 21 sensor errors: 3.8σ of all of them at once.
_LARGEST_DISTANCE = 150.0
# Without a joint, unmodelled errors appear in the bias only: its walk is that of a joint with much play. The largest
# bias is the data sheet's on all three axes (35 °/s) and a drift; with 0.5 rad/s (29 °/s), such a sensor restarts.
PARAMETERS = InertialParameters(
    has_joint=0.0, gyro_bias_walk_rad_s=3e-4, gyro_misfit=0.002, accel_misfit=0.01, largest_bias_rad_s=0.7
)
# Variance of the tilt about each axis by the errors of an uncalibrated accelerometer (rad²): 1.9° (1σ).
_UNCALIBRATED_RAD2 = (DATA_SHEET.accel_bias_m_s2 / GRAVITY) ** 2 + DATA_SHEET.accel_cross**2
# Variance of the heading by the data sheet's scale and cross-axis errors of the gyro over a rotation of 1 rad, that of
# a swung link (rad²): 1.3° (1σ). With them in the state, the heading of simulated links is 2 to 3 times worse, since
# the accelerometer's errors are taken for the gyro's.
_UNCALIBRATED_HEADING_RAD2 = DATA_SHEET.gyro_scale**2 + DATA_SHEET.gyro_cross**2
_LEAST_LEVEL = 0.01  # square of the cosine of the pitch below which roll and yaw are undefined

_DEGREES = 180.0 / math.pi


class TiltInertialFilter:
    """The filter over blocks of samples. Without J2S the columns of the height are NaN."""

    name = "tilt-inertial"
    columns = (
        "tilt_inertial_height_m",
        "tilt_inertial_height_std_m",
        "tilt_inertial_roll_deg",
        "tilt_inertial_pitch_deg",
        "tilt_inertial_roll_std_deg",
        "tilt_inertial_pitch_std_deg",
        "tilt_inertial_yaw_deg",
        "tilt_inertial_yaw_std_deg",
    )

    def __init__(self, rig: Rig, parameters: InertialParameters | None = None, errors: SensorErrors = ERRORS) -> None:
        """`errors`: the assumed sensor errors, where the rig declares none."""
        self.parameters = parameters or PARAMETERS
        self._record = record_of(self.parameters)
        j2s_m = rig.joint.known_j2s_m
        self._has_height = j2s_m is not None
        self._states = fresh_state(
            declared(errors, rig.imu), j2s_m or (0.0, 0.0, 0.0), rig.joint.j2s_std_m, _LARGEST_DISTANCE
        )
        is_calibrated = rig.imu.accel_offset_std_m_s2 is not None
        self._considered = (0.0, 0.0) if is_calibrated else (_UNCALIBRATED_RAD2, _UNCALIBRATED_HEADING_RAD2)
        self._imu = ImuCalibration.of(rig.imu).packed()

    @property
    def state(self) -> Any:
        """The state record (fields of `inertial.state.STATE`)."""
        return self._states[0]

    @property
    def rejected(self) -> int:
        """Number of samples so far whose accelerometer, gyro or time was not usable."""
        return int(self.state.rejected)

    @property
    def restarts(self) -> int:
        """Number of restarts after an impossible state."""
        return int(self.state.restarts)

    @property
    def gyro_bias_rad_s(self) -> Floats:
        """(3,) as estimated so far, beyond the rig's calibration."""
        return np.asarray(self.state.nominal[BG:BA].copy())

    def process(self, block: Measurements) -> Floats:
        """Estimates at each of the N samples: (N, 8) in the order of `columns`; NaN where not known yet."""
        estimates = np.empty(len(block), ESTIMATE)
        readings = block.time_s, block.accel_m_s2, block.gyro_rad_s, block.flags
        process(*readings, self._imu, self._record, self._states, estimates)
        out = np.empty((len(block), len(self.columns)))
        lever_square = float(np.square(self._states[0].start_mean[D:PSI]).sum())
        _fill(estimates, self._has_height, *self._considered, lever_square, out)
        return out


@compiled
def _fill(estimates: Record, has_height: bool, lean: float, heading: float, lever_square: float, out: Floats) -> None:
    """Estimates (N,) as columns; no σ of an angle exceeds half a turn.

    `lean` and `heading` are variances of the tilt about each axis, and of the heading since the first motion, by errors
    that the filter does not estimate (rad²); `lever_square` is the square of J2S (m²).
    """
    for i in range(len(estimates)):
        value, std, sine = estimates[i].value, estimates[i].std, estimates[i].tilt[0]
        level = max(1.0 - sine * sine, _LEAST_LEVEL)  # square of the cosine of the pitch
        height = value[HEIGHT]
        across = max(lever_square - height * height, 0.0)
        out[i, 0], out[i, 1] = (height, _more(std[HEIGHT], lean * across)) if has_height else (math.nan, math.nan)
        out[i, 2], out[i, 3] = value[ROLL] * _DEGREES, value[PITCH] * _DEGREES
        out[i, 4], out[i, 5] = _degrees_of(_more(std[ROLL], lean / level)), _degrees_of(_more(std[PITCH], lean))
        turned = 0.0 if estimates[i].unmoved else heading + lean * sine * sine / level
        out[i, 6], out[i, 7] = value[YAW] * _DEGREES, _degrees_of(_more(std[YAW], turned))


@inner
def _more(std: float, variance: float) -> float:
    """σ with a further variance."""
    return math.sqrt(std * std + variance)


@inner
def _degrees_of(std: float) -> float:
    """σ in degrees, at most that of half a turn; NaN stays NaN."""
    return _DEGREES * (math.pi if std > math.pi else std)
