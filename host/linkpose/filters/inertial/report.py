"""What is reported of a state at the time of a sample: position, angles and their σ.

The covariance changes some 25 times in a second. From one change to the next, σ of the position and the covariance of
the attitude are held, the latter in n, where the rotation of the sensor does not change it. σ of the angles follow the
attitude at each sample, since they grow without bound towards the vertical.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import LONGEST_HOLD_S, ImuCalibration
from linkpose.filters._vector import Vec
from linkpose.filters.inertial.propagate import corrected
from linkpose.filters.inertial.state import BA, HEIGHT, MG, PITCH, PSI, ROLL, YAW, D, Record, X, Y, Z
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
    _report_stds(s, tilt, north, west, row)
    row.distance, row.resolved = s.distance, s.resolved
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
    """σ of height, x and y, and the covariance of the attitude error in n.

    The attitude error is the rotation θ = ψ Z − Z × δZ, which turns X by X × θ and Y by Y × θ. Its components in n are
    Yᵀδz, −XᵀδZ and ψ. The gradient of Xᵀd is d × X, that of Yᵀd is d × Y, and δ(Zᵀd) = dᵀδZ + Zᵀδd.
    """
    tilt, north, d = vec.load(s.tilt), vec.load(s.north), vec.load(s.j2s)
    west, p = vec.cross(tilt, north), s.covariance
    s.position_std[HEIGHT] = _std(s, d, 0.0, tilt)
    slope = vec.cross(d, north)
    s.position_std[X] = _std(s, vec.cross(tilt, slope), vec.dot(slope, tilt), north)
    slope = vec.cross(d, west)
    s.position_std[Y] = _std(s, vec.cross(tilt, slope), vec.dot(slope, tilt), west)
    block, heading, t = sub_covariance(p, Z), vec.load(p[PSI]), s.turn_covariance
    to_north, to_west = vec.apply(block, north), vec.apply(block, west)
    t[0], t[1], t[2] = vec.dot(west, to_west), -vec.dot(west, to_north), vec.dot(west, heading)
    t[3], t[4], t[5] = vec.dot(north, to_north), -vec.dot(north, heading), p[PSI, PSI]


@inner
def _report_stds(s: Record, tilt: Vec, north: Vec, west: Vec, row: Record) -> None:
    """σ of each reported value.

    With h = (X_x, Y_x), the horizontal part of the sensor's x axis in n, and θ in n, the angles change by
    h·θ / ‖h‖² (roll), (h × θ)_z / ‖h‖ (pitch) and θ_z − Z_x h·θ / ‖h‖² (yaw).
    """
    for i in range(ROLL):
        row.std[i] = s.position_std[i]
    xx, xy, xz, yy, yz, zz = vec.load_sym(s.turn_covariance)
    x, y = north[0], west[0]
    level = max(x * x + y * y, _LEAST_LEVEL)
    along = x * x * xx + 2.0 * x * y * xy + y * y * yy
    across = y * y * xx - 2.0 * x * y * xy + x * x * yy
    lean = tilt[0] / level
    row.std[ROLL] = math.sqrt(max(along, 0.0)) / level
    row.std[PITCH] = math.sqrt(max(across / level, 0.0))
    row.std[YAW] = math.sqrt(max(zz - 2.0 * lean * (x * xz + y * yz) + lean * lean * along, 0.0))


@inner
def _std(s: Record, across: Vec, along: float, towards: Vec) -> float:
    """σ of a value with the gradients `across` (of Z), `along` (of ψ) and `towards` (of J2S)."""
    g, p, variance = s.gradient, s.covariance, 0.0
    for i in range(3):
        g[i], g[3 + i] = across[i], towards[i]
    g[6] = along
    for i in range(7):
        if g[i] == 0.0:  # an angle does not depend on J2S
            continue
        row = i if i < 3 else i + D - 3  # J2S and ψ are neighbours
        part = 0.5 * g[i] * p[row, row]
        for j in range(i):
            part += g[j] * p[row, j if j < 3 else j + D - 3]
        variance += 2.0 * g[i] * part
    return math.sqrt(max(variance, 0.0))
