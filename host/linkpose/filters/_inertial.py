"""What `joint-inertial` and `tilt-inertial` share: the motion integrated, with the sensors' errors in the state.

The state, all in the sensor's frame s:

    Z    tilt, n's Z axis                       Ż = −ω × Z
    v    velocity of the sensor (m/s)           v̇ = −ω × v + f − g Z
    b_g  bias of the gyro (rad/s)               ω = (I − M_g) (s_G − b_g)
    b_a  bias of the accelerometer (m/s²)       f = (I − M_a) s_A − b_a
    M_a, M_g   scale, cross-axis sensitivity and alignment of either sensor, nine numbers each
    d    J2S (m), which stays 0 where there is no joint

The errors are constants, but for a slow walk of b_g, and what is believed of the others fades, so that an error of the
model does not stay.

The mean is brought forward at each sample: over a step the frame turns by the exact exponential of the mean rate, v is
integrated by the trapezoid with its ends corrected, and ‖Z‖ = 1 is kept. Covariance and corrections follow 25 times in
a second: a faster pace brings no more, since what a model leaves over is no white noise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from linkpose.compiling import compiled, inlined
from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY, Floats, ImuCalibration
from linkpose.filters._vector import Vec

Z, V, BG, BA, MA, MG, D = 0, 3, 6, 9, 12, 21, 30  # where each begins in the state
SIZE = 33
PACE_S = 0.035  # between two corrections, at least
_FADING_PACE_S = 0.5  # between two times that beliefs fade
GAP_ACCEL_M_S2 = 200.0  # where the accelerometer did not see, or beyond its range: a blow
_BEND = 1.0 / 12.0  # of the force's second difference: how far a trapezoid is off a parabola,
_BENT = 1.0 / 24.0  # and of the third, of the size of a second, how far that is off a cubic
_SMALL_RAD2 = 0.01  # variance of a tilt up to which its error lies across it,
_NONE_RAD2 = 1e-6  # and has no more than this along it
OTHERS = ((1, 2), (2, 0), (0, 1))  # components that a cross product's takes
ZERO = (0.0, 0.0, 0.0)
Rows = tuple[Vec, Vec, Vec]


class SensorErrors(NamedTuple):
    """How far off the sensors may be: standard deviations of one axis."""

    gyro_bias_rad_s: float
    gyro_scale: float
    gyro_cross: float
    accel_bias_m_s2: float
    accel_scale: float
    accel_cross: float
    fade_s: float  # after which e⁻¹ of what was found of them is left

    def variances(self) -> Floats:
        """Of each state (33,), before anything was measured; 0 for those that are no error of a sensor."""
        accel = np.where(np.eye(3, dtype=bool), self.accel_scale, self.accel_cross)
        gyro = np.where(np.eye(3, dtype=bool), self.gyro_scale, self.gyro_cross)
        biases = 3 * [self.gyro_bias_rad_s] + 3 * [self.accel_bias_m_s2]
        return np.concatenate([np.zeros(6), biases, accel.ravel(), gyro.ravel(), np.zeros(3)]) ** 2


class Since(NamedTuple):
    """What has come since the covariance was brought up to the mean."""

    span: float  # s
    turned: Vec  # angle (rad)
    impulse: Vec  # ∫ force (m/s)
    rotation: float  # variance of the angle, each axis (rad²)
    velocity: float  # variance of the velocity gained, each axis (m²/s²)


AT_ONCE = Since(0.0, ZERO, ZERO, 0.0, 0.0)


@inlined
def recall_since(a: Floats, k: int) -> Since:
    """As it was left in nine numbers of an array, from element k on."""
    return Since(a[k], vec.at(a, k + 1), vec.at(a, k + 4), a[k + 7], a[k + 8])


@inlined
def keep_since(a: Floats, k: int, since: Since) -> None:
    """For the next block: into nine numbers of an array, from element k on."""
    a[k], a[k + 7], a[k + 8] = since.span, since.rotation, since.velocity
    vec.put(a, k + 1, since.turned)
    vec.put(a, k + 4, since.impulse)


@inlined
def corrected(x: Floats, first: int, reading: Vec) -> Vec:
    """The reading less its share by the matrix in the state from `first` on."""
    m = (vec.at(x, first), vec.at(x, first + 3), vec.at(x, first + 6))
    return (
        reading[0] - vec.dot(m[0], reading),
        reading[1] - vec.dot(m[1], reading),
        reading[2] - vec.dot(m[2], reading),
    )


@inlined
def error(p: Floats, bias: int, matrix: int, reading: Vec, j: int) -> Vec:
    """Column j's error of ω or f: that of the bias and of the matrix's share of a reading, both taken off."""
    return (
        -p[bias, j] - p[matrix, j] * reading[0] - p[matrix + 1, j] * reading[1] - p[matrix + 2, j] * reading[2],
        -p[bias + 1, j] - p[matrix + 3, j] * reading[0] - p[matrix + 4, j] * reading[1] - p[matrix + 5, j] * reading[2],
        -p[bias + 2, j] - p[matrix + 6, j] * reading[0] - p[matrix + 7, j] * reading[1] - p[matrix + 8, j] * reading[2],
    )


@inlined
def put_errors(p: Floats, bias: int, matrix: int, reading: Vec, out: Floats, k: int) -> None:
    """`error` of all columns into three rows of `out` from k on. One row after the other, for the vector unit."""
    for c in range(3):
        for j in range(SIZE):
            by_matrix = p[matrix + 3 * c, j] * reading[0] + p[matrix + 3 * c + 1, j] * reading[1]
            out[k + c, j] = -p[bias + c, j] - by_matrix - p[matrix + 3 * c + 2, j] * reading[2]


@inlined
def others(a: Vec, c: int) -> tuple[float, float]:
    """The components of a vector that a cross product's component c takes."""
    return (a[1], a[2]) if c == 0 else (a[2], a[0]) if c == 1 else (a[0], a[1])


@inlined
def trace(p: Floats, k: int) -> float:
    """The sum of the variances of three states from k on."""
    return float(p[k, k] + p[k + 1, k + 1] + p[k + 2, k + 2])


@compiled
def _along(variance: float) -> float:
    """Variance of Z along itself when it is turned by angles of this variance: cosines fall short of 1."""
    return 0.5 * min(max(variance - _SMALL_RAD2, 0.0), 1.0) ** 2


@compiled
def set_upright(x: Floats, p: Floats, reading: Vec, accel: float, velocity: Vec, speed: float) -> None:
    """Tilt from what the accelerometer reads, as if nothing had been known of it; `velocity` (m/s).

    `accel` (m²/s⁴) and `speed` (m²/s²) are the variances, on each axis, of the acceleration in the reading and of the
    velocity.
    """
    force = vec.minus(corrected(x, MA, reading), vec.at(x, BA))
    tilt = vec.unit(force) if vec.dot(force, force) > 0.0 else (0.0, 0.0, 1.0)
    vec.put(x, Z, tilt)
    vec.put(x, V, velocity)
    for i in range(6):
        p[i, :] = 0.0
        p[:, i] = 0.0
    # An error of the accelerometer leans the tilt that is read off it: δZ = (I − ZZᵀ) δf / g
    tangent = vec.cross_square(tilt, 1.0 / GRAVITY)
    for j in range(BG, SIZE):
        vec.put(p[:, j], Z, vec.apply(tangent, error(p, BA, MA, reading, j)))
        vec.put(p[j], Z, vec.at(p[:, j], Z))
    for j in range(3):
        vec.put(p[:, j], Z, vec.apply(tangent, error(p, BA, MA, reading, j)))
    variance = min(accel / GRAVITY**2, 1.0)
    s, k = vec.add(vec.cross_square(tilt, variance), _along(variance), vec.outer(tilt)), 0
    for i in range(3):
        p[V + i, V + i] = speed
        for j in range(i, 3):
            p[i, j] = p[j, i] = 0.5 * (p[i, j] + p[j, i]) + s[k]
            k += 1


@inlined
def predict_mean(x: Floats, turn: Vec, before: Vec, force: Vec, bend: Vec, h: float) -> None:
    """Tilt and velocity after a step `h` that turns the frame by `turn` (rad), with f (m/s²) at both its ends.

    The rotation is exact, the velocity by the trapezoid with Euler and Maclaurin's correction of its ends: `bend` is
    the second difference of f, and what it adds up to over many steps is the first difference at either end.
    """
    tilt, v, half = vec.at(x, Z), vec.at(x, V), 0.5 * h
    v = (
        v[0] + half * (before[0] - GRAVITY * tilt[0]),
        v[1] + half * (before[1] - GRAVITY * tilt[1]),
        v[2] + half * (before[2] - GRAVITY * tilt[2]),
    )
    tilt, v = vec.unit(vec.turn_back(turn, tilt)), vec.turn_back(turn, v)
    vec.put(x, Z, tilt)
    x[V] = v[0] + half * (force[0] - GRAVITY * tilt[0]) - _BEND * h * bend[0]
    x[V + 1] = v[1] + half * (force[1] - GRAVITY * tilt[1]) - _BEND * h * bend[1]
    x[V + 2] = v[2] + half * (force[2] - GRAVITY * tilt[2]) - _BEND * h * bend[2]


@inlined
def _velocity_variance(bend: Vec, has_force: bool, h: float, imu: ImuCalibration) -> float:
    """Variance (m²/s²) of the velocity gained over a step: noise, and a bend that may be another than before."""
    bent = _BENT * math.sqrt(vec.dot(bend, bend)) if has_force else GAP_ACCEL_M_S2
    return (imu.accel_variance + min(bent, GAP_ACCEL_M_S2) ** 2) * h * h


@inlined
def predict(
    x: Floats, since: Since, angle: Vec, doubt: float, before: Vec, force: Vec, bend: Vec, has_force: bool, h: float,
    imu: ImuCalibration,
) -> Since:  # fmt: skip
    """The mean over a step `h`, and what the covariance will need of it.

    The gyro read `angle` (rad, its bias in it; `doubt`: variance), the accelerometer `before` and `force` at the ends,
    with `bend` the second difference.
    """
    turn = corrected(x, MG, vec.plus(angle, -h, vec.at(x, BG)))
    begin = vec.minus(corrected(x, MA, before), vec.at(x, BA))
    predict_mean(x, turn, begin, vec.minus(corrected(x, MA, force), vec.at(x, BA)), bend if has_force else ZERO, h)
    return Since(
        since.span + h,
        vec.plus(since.turned, 1.0, turn),
        vec.plus(vec.plus(since.impulse, 0.5 * h, before), 0.5 * h, force),
        since.rotation + doubt,
        since.velocity + _velocity_variance(bend, has_force, h, imu),
    )


@compiled
def catch_up(x: Floats, p: Floats, work: Floats, since: Since, rotation: float, gained: float, walk: float) -> None:
    """Brings the covariance up to the mean: F P Fᵀ + Q over all that has come `since`.

    `rotation` (rad²) and `gained` (m²/s²) are variances of the model's own, `walk` (rad²/s²) that of the gyro's bias.
    """
    tilt, velocity = vec.at(x, Z), vec.at(x, V)
    rate, force = vec.plus(ZERO, 1.0 / since.span, since.turned), vec.plus(ZERO, 1.0 / since.span, since.impulse)
    _predict_covariance(p, work, since.turned, tilt, velocity, rate, force, since.span)
    add_noise(p, tilt, velocity, since.rotation + rotation, since.velocity + gained)
    for i in range(BG, BA):
        p[i, i] += walk


@inlined
def rotation_rows(turn: Vec) -> Rows:
    """Rows of the matrix exp(−[turn×])."""
    back = (-turn[0], -turn[1], -turn[2])
    return (
        vec.turn_back(back, (1.0, 0.0, 0.0)),
        vec.turn_back(back, (0.0, 1.0, 0.0)),
        vec.turn_back(back, (0.0, 0.0, 1.0)),
    )


@inlined
def spread(z: Vec, v: Vec, w: Vec, f: Vec, rows: Rows, tilt: Vec, velocity: Vec, h: float) -> tuple[Vec, Vec]:
    """Errors of tilt and velocity after a step, from small ones before it and of ω (`w`) and f over it."""
    z = (vec.dot(rows[0], z), vec.dot(rows[1], z), vec.dot(rows[2], z))
    g, by_tilt, by_velocity = GRAVITY * h, vec.cross(tilt, w), vec.cross(velocity, w)
    v = (
        vec.dot(rows[0], v) - g * z[0] + h * (by_velocity[0] + f[0]),
        vec.dot(rows[1], v) - g * z[1] + h * (by_velocity[1] + f[1]),
        vec.dot(rows[2], v) - g * z[2] + h * (by_velocity[2] + f[2]),
    )
    return (z[0] + h * by_tilt[0], z[1] + h * by_tilt[1], z[2] + h * by_tilt[2]), v


@compiled
def _predict_covariance(
    p: Floats, work: Floats, turn: Vec, tilt: Vec, velocity: Vec, rate: Vec, force: Vec, h: float
) -> None:
    """F P Fᵀ over a step of mean rate and force; only the rows and columns of tilt and velocity change."""
    rows, g = rotation_rows(turn), GRAVITY * h
    put_errors(p, BG, MG, rate, work, 6)
    put_errors(p, BA, MA, force, work, 9)
    for c in range(3):
        r, (a, b), (at, bt), (av, bv) = rows[c], OTHERS[c], others(tilt, c), others(velocity, c)
        for j in range(SIZE):
            turned = r[0] * p[0, j] + r[1] * p[1, j] + r[2] * p[2, j]
            work[c, j] = turned + h * (at * work[6 + b, j] - bt * work[6 + a, j])
            work[3 + c, j] = -g * turned + h * (av * work[6 + b, j] - bv * work[6 + a, j] + work[9 + c, j])
        for j in range(SIZE):
            work[3 + c, j] += r[0] * p[3, j] + r[1] * p[4, j] + r[2] * p[5, j]
    turned_ = work.T
    for i in range(6):
        z, v = spread(
            (work[i, 0], work[i, 1], work[i, 2]), (work[i, 3], work[i, 4], work[i, 5]),
            error(turned_, BG, MG, rate, i), error(turned_, BA, MA, force, i), rows, tilt, velocity, h,
        )  # fmt: skip
        p[i, 0], p[i, 1], p[i, 2] = z
        p[i, 3], p[i, 4], p[i, 5] = v
        for j in range(6, SIZE):
            p[i, j] = work[i, j]
        for j in range(6, SIZE):
            p[j, i] = work[i, j]


@compiled
def add_noise(p: Floats, tilt: Vec, velocity: Vec, rotation: float, gained: float) -> None:
    """Noise of a step: variances, on each axis, of its rotation (rad²) and of the velocity gained (m²/s²)."""
    # The same wrong rotation turns tilt and velocity: [Z×][Z×]ᵀ, [v×][v×]ᵀ, and [Z×][v×]ᵀ = (Z·v) I − v Zᵀ.
    zz, vv, zv = vec.cross_square(tilt, rotation), vec.cross_square(velocity, rotation), vec.dot(tilt, velocity)
    k = 0
    for i in range(3):
        for j in range(i, 3):
            p[Z + i, Z + j] += zz[k]
            p[V + i, V + j] += vv[k]
            p[Z + j, Z + i], p[V + j, V + i] = p[Z + i, Z + j], p[V + i, V + j]
            k += 1
        p[V + i, V + i] += gained
        for j in range(3):
            p[Z + i, V + j] += rotation * ((zv if i == j else 0.0) - velocity[i] * tilt[j])
            p[V + j, Z + i] = p[Z + i, V + j]


@compiled
def fade(x: Floats, p: Floats, since: Floats, h: float, fade_s: float, start: Floats, prior: Floats) -> None:
    """First-order Gauss-Markov: what was found of the sensors' errors, but for b_g, returns to what it started from.

    `since[0]` holds the time since that was last done (s), `h` goes by: often is no better than now and then.
    """
    since[0] += h
    if since[0] <= _FADING_PACE_S:
        return
    kept = math.exp(-since[0] / fade_s)
    since[0] = 0.0
    for i in range(BA, D):
        x[i] = start[i] + kept * (x[i] - start[i])
        for j in range(SIZE):
            p[i, j] *= kept
        for j in range(SIZE):
            p[j, i] *= kept
        p[i, i] += (1.0 - kept * kept) * prior[i]


@compiled
def take_three(x: Floats, p: Floats, cross: Floats, y: Vec, inverse: vec.Sym) -> None:
    """The Kalman correction by an innovation y, with `cross` = H P (3, N) and the inverse of y's covariance S.

    Leaves C = Lᵀ H P in `cross`, with S⁻¹ = L Lᵀ: K S Kᵀ = Cᵀ C, which is symmetric to the last bit.
    """
    l00, l10, l20, l11, l21, l22 = vec.cholesky(inverse)
    z = (l00 * y[0] + l10 * y[1] + l20 * y[2], l11 * y[1] + l21 * y[2], l22 * y[2])
    for j in range(SIZE):
        cross[0, j] = l00 * cross[0, j] + l10 * cross[1, j] + l20 * cross[2, j]
        cross[1, j] = l11 * cross[1, j] + l21 * cross[2, j]
        cross[2, j] = l22 * cross[2, j]
    for j in range(SIZE):
        x[j] += z[0] * cross[0, j] + z[1] * cross[1, j] + z[2] * cross[2, j]
    for i in range(SIZE):
        c0, c1, c2 = cross[0, i], cross[1, i], cross[2, i]
        for j in range(SIZE):
            p[i, j] -= c0 * cross[0, j] + c1 * cross[1, j] + c2 * cross[2, j]
    tilt = vec.unit(vec.at(x, Z))
    vec.put(x, Z, tilt)
    block = (p[0, 0], p[0, 1], p[0, 2], p[1, 1], p[1, 2], p[2, 2])
    if vec.quadratic(block, tilt) > _NONE_RAD2 and vec.trace(block) < _SMALL_RAD2:
        _flatten(p, tilt)


@compiled
def _flatten(p: Floats, tilt: Vec) -> None:
    """‖Z‖ = 1 into the covariance: a tilt that is nearly known errs across itself alone."""
    for _ in range(2):  # rows, then by the transposed matrix columns
        for j in range(SIZE):
            along = vec.dot(tilt, (p[0, j], p[1, j], p[2, j]))
            for i in range(3):
                p[i, j] -= along * tilt[i]
        for i in range(SIZE):
            for j in range(i):
                p[i, j], p[j, i] = p[j, i], p[i, j]


@compiled
def take(x: Floats, p: Floats, c: int, innovation: float, noise: float) -> None:
    """The Kalman correction by a measurement of one component of the state, of that variance."""
    scale = 1.0 / (p[c, c] + noise)
    for i in range(SIZE):
        x[i] += p[i, c] * scale * innovation
    for i in range(SIZE):
        if i != c:
            k = p[i, c] * scale
            for j in range(i, SIZE):
                if j != c:
                    p[i, j] -= k * p[j, c]
                    p[j, i] = p[i, j]
    for i in range(SIZE):
        p[i, c] = p[c, i] = p[i, c] * noise * scale


@inlined
def height(tilt: Vec, d: Vec, p: Floats, turned: Vec) -> tuple[float, float]:
    """Height Zᵀd and its standard deviation (m), the frame having `turned` (rad) since the covariance was caught up."""
    back = (-turned[0], -turned[1], -turned[2])
    by_tilt, variance = vec.turn_back(back, d), 0.0
    for i in range(3):
        for j in range(3):
            variance += by_tilt[i] * by_tilt[j] * p[Z + i, Z + j] + tilt[i] * tilt[j] * p[D + i, D + j]
            variance += 2.0 * by_tilt[i] * tilt[j] * p[Z + i, D + j]
    return vec.dot(tilt, d), math.sqrt(max(variance, 0.0))
