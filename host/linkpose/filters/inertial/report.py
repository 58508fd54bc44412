"""What is reported of a state at the time of a sample: position, angles and their σ.

The covariance changes some 25 times in a second. From one change to the next it is held: that of the attitude in n and
that of J2S in the sensor's axes, which the rotation of the sensor does not change. σ of position and angles follow from
it and the attitude at each sample. (A sensor one metre from the centre that turns by 40° meanwhile would otherwise have
σ of another direction.) Since the change, the attitude has gained the noise of the rates and the rotation by an unknown
gyro bias. After switch-on, 20 °/s turn it by 0.7° until the first propagation.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import LONGEST_HOLD_S, ImuCalibration
from linkpose.filters._vector import Sym, Vec
from linkpose.filters.inertial.propagate import corrected
from linkpose.filters.inertial.state import BA, BG, HEIGHT, MG, PITCH, PSI, ROLL, YAW, D, Record, X, Y, Z
from linkpose.filters.inertial.update import sub_covariance

_NO_SENSOR_S = 1.0  # without a usable sample for longer there is no estimate
_LEAST_LEVEL = 1e-4  # square of the horizontal part of an axis below which the angles that it gives are undefined
_UNKNOWN_HEIGHT_M = 0.1  # σ of the height through J2S alone, above which the height is not known


@inner
def report(s: Record, time_s: float, imu: ImuCalibration, row: Record) -> None:
    """The estimate at the time of the stamp: the readings' delay, and a step that waits, are extrapolated."""
    ahead = vec.turn_of(_rotation_until(s, time_s, imu))
    tilt, north = vec.turn_back(ahead, vec.load(s.tilt)), vec.turn_back(ahead, vec.load(s.north))
    west = vec.cross(tilt, north)
    _report_values(tilt, north, west, vec.load(s.j2s), row)
    if s.span == 0.0:  # the covariance belongs to this sample
        _follow_covariance(s)
    gained = s.rotation_variance + s.span * s.span * vec.trace(sub_covariance(s.covariance, BG)) / 3.0
    _report_position_stds(s, gained, tilt, north, west, row)
    _report_angle_stds(s, gained, tilt, north, west, row)
    row.unmoved = s.unmoved
    row.distance, row.tilt_level, row.heading_level = s.distance, s.tilt_level, s.heading_level
    bias = sub_covariance(s.covariance, BA)
    across = vec.trace(bias) - vec.quadratic(bias, tilt)
    row.unknown = 1.5 * across / (s.prior[BA] + s.prior[BA + 1] + s.prior[BA + 2])
    unknown = 0
    if math.isnan(s.time) or max(s.blind_s, s.no_force_s) > _NO_SENSOR_S:
        vec.store(row.tilt, (math.nan, math.nan, math.nan))
        unknown = YAW + 1
    elif vec.quadratic(sub_covariance(s.covariance, D), tilt) > _UNKNOWN_HEIGHT_M**2:
        unknown = Y + 1
    for i in range(unknown):
        row.value[i] = row.std[i] = math.nan


@inner
def _rotation_until(s: Record, time_s: float, imu: ImuCalibration) -> Vec:
    """Rotation from the last integrated sample until the time of the stamp (rad)."""
    bias, waited = vec.load(s.gyro_bias), 0.0
    ahead = vec.scale(imu.delay, vec.minus(vec.load(s.newest_rate), bias))
    if s.time < time_s < math.inf:  # while the step waits
        waited = time_s - s.turned_at
        ahead = vec.axpy(1.0, vec.load(s.angle), ahead)
        ahead = vec.axpy(waited, vec.load(s.newest_rate), ahead)
        ahead = vec.axpy(s.time - time_s, bias, ahead)
    if s.blind_s == 0.0:
        ahead = vec.axpy(0.5 * min(waited + imu.delay, LONGEST_HOLD_S) ** 2, vec.load(s.rate_slope), ahead)
    return corrected(s.nominal, MG, ahead)


@inner
def _report_values(tilt: Vec, north: Vec, west: Vec, d: Vec, row: Record) -> None:
    """Position of the sensor and the angles of its attitude R_z(yaw) R_y(pitch) R_x(roll)."""
    vec.store(row.tilt, tilt)
    row.value[HEIGHT], row.value[X], row.value[Y] = vec.dot(tilt, d), vec.dot(north, d), vec.dot(west, d)
    row.value[ROLL] = math.atan2(tilt[1], tilt[2])
    row.value[PITCH] = math.atan2(-tilt[0], math.sqrt(tilt[1] * tilt[1] + tilt[2] * tilt[2]))
    row.value[YAW] = math.atan2(west[0], north[0])


@inner
def _follow_covariance(s: Record) -> None:
    """Covariance of the attitude error (XᵀδZ, YᵀδZ, ZᵀδZ, ψ) in n, and with the error of J2S in the sensor's axes."""
    tilt, north, p = vec.load(s.tilt), vec.load(s.north), s.covariance
    west = vec.cross(tilt, north)
    _follow_axis(s, 0, north, north, west, tilt)
    _follow_axis(s, 1, west, north, west, tilt)
    _follow_axis(s, 2, tilt, north, west, tilt)
    s.turn_covariance[3, 3] = p[PSI, PSI]
    for k in range(3):
        s.lever_covariance[3, k] = p[PSI, D + k]


@inner
def _follow_axis(s: Record, i: int, axis: Vec, north: Vec, west: Vec, tilt: Vec) -> None:
    """Row i of both: of `axis` · δZ."""
    p, t = s.covariance, s.turn_covariance
    part = vec.apply(sub_covariance(p, Z), axis)
    t[i, 0], t[i, 1], t[i, 2] = vec.dot(part, north), vec.dot(part, west), vec.dot(part, tilt)
    t[i, 3] = t[3, i] = vec.dot(axis, vec.load(p[PSI]))
    for k in range(3):
        s.lever_covariance[i, k] = axis[0] * p[Z, D + k] + axis[1] * p[Z + 1, D + k] + axis[2] * p[Z + 2, D + k]


@inner
def _report_position_stds(s: Record, gained: float, tilt: Vec, north: Vec, west: Vec, row: Record) -> None:
    """σ of height, x and y; `gained`: variance of a rotation about each axis since the covariance changed (rad²).

    With δZ in n and ψ, and d = (x, y, h) in n, they change by d·δZ + Zᵀδd, −h XᵀδZ − y ψ + Xᵀδd and
    −h YᵀδZ + x ψ + Yᵀδd.
    """
    t, height, x, y = s.turn_covariance, row.value[HEIGHT], row.value[X], row.value[Y]
    lever = sub_covariance(s.covariance, D)
    to_x, to_y = vec.load(s.lever_covariance[0]), vec.load(s.lever_covariance[1])
    to_z, to_heading = vec.load(s.lever_covariance[2]), vec.load(s.lever_covariance[3])
    attitude = vec.quadratic((t[0, 0], t[0, 1], t[0, 2], t[1, 1], t[1, 2], t[2, 2]), (x, y, height))
    both = vec.axpy(x, to_x, vec.axpy(y, to_y, vec.scale(height, to_z)))
    row.std[HEIGHT] = _std(attitude + gained * (x * x + y * y), both, lever, tilt)
    attitude = height * height * (t[0, 0] + gained) + 2.0 * height * y * t[0, 3] + y * y * (t[3, 3] + gained)
    both = vec.axpy(-height, to_x, vec.scale(-y, to_heading))
    row.std[X] = _std(attitude, both, lever, north)
    attitude = height * height * (t[1, 1] + gained) - 2.0 * height * x * t[1, 3] + x * x * (t[3, 3] + gained)
    both = vec.axpy(-height, to_y, vec.scale(x, to_heading))
    row.std[Y] = _std(attitude, both, lever, west)


@inner
def _std(attitude: float, both: Vec, lever: Sym, axis: Vec) -> float:
    """σ from the variance by the attitude, its covariance with δd, and the covariance of δd along `axis`."""
    return math.sqrt(max(attitude + 2.0 * vec.dot(both, axis) + vec.quadratic(lever, axis), 0.0))


@inner
def _report_angle_stds(s: Record, gained: float, tilt: Vec, north: Vec, west: Vec, row: Record) -> None:
    """σ of roll, pitch and yaw; `gained` as above.

    The attitude error is the rotation θ = ψ Z − Z × δZ; in n, it is (YᵀδZ, −XᵀδZ, ψ). With h = (X_x, Y_x), the
    horizontal part of the sensor's x axis in n, the angles change by h·θ / ‖h‖² (roll), (h × θ)_z / ‖h‖ (pitch) and
    θ_z − Z_x h·θ / ‖h‖² (yaw).
    """
    t = s.turn_covariance
    xx, yy, zz = t[1, 1] + gained, t[0, 0] + gained, t[3, 3] + gained
    xy, xz, yz = -t[0, 1], t[1, 3], -t[0, 3]
    x, y = north[0], west[0]
    level = max(x * x + y * y, _LEAST_LEVEL)
    along = x * x * xx + 2.0 * x * y * xy + y * y * yy
    across = y * y * xx - 2.0 * x * y * xy + x * x * yy
    lean = tilt[0] / level
    row.std[ROLL] = math.sqrt(max(along, 0.0)) / level
    row.std[PITCH] = math.sqrt(max(across / level, 0.0))
    row.std[YAW] = math.sqrt(max(zz - 2.0 * lean * (x * xz + y * yz) + lean * lean * along, 0.0))
