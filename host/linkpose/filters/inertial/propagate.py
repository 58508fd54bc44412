"""Propagation of mean and covariance between corrections.

The mean advances at each sample: the exact rotation of the mean rate over the step, the velocity by the trapezoid with
its ends corrected. The covariance follows some 25 times in a second, over the accumulated increments.
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters._imu import GRAVITY, ImuCalibration
from linkpose.filters._vector import Turn, Vec
from linkpose.filters.inertial.state import BA, BG, MA, MG, PSI, SIZE, D, Floats, Record, V, Z

# Acceleration that a step without a force may hold (m/s², 1σ): a blow. The velocity is then unknown after a few
# samples, which is the intention. Doubling it changes nothing visible.
GAP_ACCEL_M_S2 = 200.0
# A saturated reading is the nearest value that there is. How far the true one is beyond it grows with the time clipped:
# a swinging link of 1 m at 6 rad/s changes its acceleration by some 100 m/s² in a second (m/s³, 1σ).
_CLIPPED_M_S3 = 100.0
# And it may be a glitch: this share of its change since the last reading counts as σ.
_CLIPPED_SHARE = 0.5
_BEND = 1.0 / 12.0  # trapezoid against a parabola: share of the force's second difference (Euler-Maclaurin)
_BENT = 1.0 / 24.0  # parabola against a cubic: share of the third difference, which the second bounds
# Interval between two decays of the sensor errors (s): it saves time only, decay constants are 200 s and more.
_DECAY_INTERVAL_S = 0.5


@inner
def corrected(mean: Floats, matrix: int, reading: Vec) -> Vec:
    """(I − M) reading, with M in the mean from index `matrix` on."""
    m, x, y, z = matrix, reading[0], reading[1], reading[2]
    return (
        x - mean[m] * x - mean[m + 1] * y - mean[m + 2] * z,
        y - mean[m + 3] * x - mean[m + 4] * y - mean[m + 5] * z,
        z - mean[m + 6] * x - mean[m + 7] * y - mean[m + 8] * z,
    )


@inner
def specific_force(s: Record, reading: Vec) -> Vec:
    """f = (I − M_a) s_A − b_a (m/s²)."""
    return vec.minus(corrected(s.nominal, MA, reading), vec.load(s.accel_bias))


@inner
def angular_rate(s: Record, reading: Vec) -> Vec:
    """ω = (I − M_g) (s_G − b_g) (rad/s)."""
    return corrected(s.nominal, MG, vec.minus(reading, vec.load(s.gyro_bias)))


@inner
def rotate_attitude(s: Record, turn: Turn) -> None:
    """Z and X after a turn of the sensor, orthonormal again."""
    tilt = vec.unit(vec.turn_back(turn, vec.load(s.tilt)))
    north = vec.turn_back(turn, vec.load(s.north))
    vec.store(s.tilt, tilt)
    vec.store(s.north, vec.unit(vec.axpy(-vec.dot(north, tilt), tilt, north)))


@inner
def integrate(s: Record, rotation: Vec, begin: Vec, end: Vec, bend: Vec, h: float) -> None:
    """Attitude and velocity after a step `h` that turns the sensor by `rotation`, with f `begin` and `end` at its ends.

    `bend` is the second difference of f. Summed over many steps its share is the Euler-Maclaurin correction of the
    trapezoid, the first difference at either end.
    """
    g, turn = -GRAVITY, vec.turn_of(rotation)
    v = vec.axpy(0.5 * h, vec.axpy(g, vec.load(s.tilt), begin), vec.load(s.velocity))
    v = vec.turn_back(turn, v)
    rotate_attitude(s, turn)
    v = vec.axpy(0.5 * h, vec.axpy(g, vec.load(s.tilt), end), v)
    vec.store(s.velocity, vec.axpy(-_BEND * h, bend, v))


@inner
def velocity_variance(s: Record, change: Vec, bend: Vec, h: float, imu: ImuCalibration) -> float:
    """Variance (m²/s²) of the velocity gained over a step: noise, and a second difference that may change."""
    unknown = _BENT * math.sqrt(vec.dot(bend, bend))
    if s.clipped_s > 0.0:
        unknown += _CLIPPED_M_S3 * s.clipped_s + _CLIPPED_SHARE * math.sqrt(vec.dot(change, change))
    if s.no_force_s > 0.0:
        unknown = GAP_ACCEL_M_S2
    return (imu.accel_variance + min(unknown, GAP_ACCEL_M_S2) ** 2) * h * h


# Where each of thirteen errors begins that the propagation combines: of Z, v, ω and f, and last ψ.
_Z, _V, _RATE, _FORCE, _PSI = 0, 3, 6, 9, 12


@inner
def fill_transition(s: Record) -> None:
    """Rows of the transition matrix for the errors of Z, v and ψ over the accumulated increments.

    Its columns are for the errors of Z, v, ω, f and ψ. With R = exp(−[turned×]),

        δZ' = R δZ + h Z × δω                                 δω = −δb_g − δM_g s_G
        δv' = R δv − g h R δZ + h (v × δω + δf)               δf = −δb_a − δM_a s_A
        ψ' = ψ + h Zᵀδω
    """
    f, h, x = s.transition, s.span, s.nominal
    for i in range(7):
        for j in range(13):
            f[i, j] = 0.0
    turn = vec.turn_of(vec.load(s.turned))
    for k in range(3):
        column = vec.turn_back(turn, (1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0))
        for c in range(3):
            f[c, _Z + k] = f[3 + c, _V + k] = column[c]
            f[3 + c, _Z + k] = -GRAVITY * h * column[c]
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        f[3 + c, _FORCE + c] = h
        f[6, _RATE + c] = h * x[Z + c]
        for first in range(0, 6, 3):  # Z × δω, v × δω
            f[first + c, _RATE + b] = h * x[first + a]
            f[first + c, _RATE + a] = -h * x[first + b]
    f[6, _PSI] = 1.0


@inner
def apply_transition(s: Record, rate: Vec, force: Vec) -> None:
    """P ← F P Fᵀ; only the rows and columns of Z, v and ψ change.

    `rate` (rad/s) and `force` (m/s²) are the mean readings, which multiply M_g and M_a.
    """
    p, f, w = s.covariance, s.transition, s.work
    _combine_rows(p, s.combined, rate, force)
    for i in range(7):
        _multiply_combined(f[i], s.combined, w[i])
    for i in range(7):
        row = i if i < 6 else PSI
        for j in range(6, PSI):
            p[row, j] = p[j, row] = w[i, j]
        _combine_columns(w[i], s.combined[0], rate, force)
        for k in range(i + 1):
            total = 0.0
            for j in range(13):
                total += s.combined[0, j] * f[k, j]
            column = k if k < 6 else PSI
            p[row, column] = p[column, row] = total


@inner
def _combine_rows(p: Floats, out: Floats, rate: Vec, force: Vec) -> None:
    """Covariance (13, 34) of the errors of Z, v, ω, f and ψ with each error of the state."""
    for j in range(SIZE):
        for i in range(6):
            out[i, j] = p[i, j]
        out[_PSI, j] = p[PSI, j]
    for c in range(3):
        m, a = MG + 3 * c, MA + 3 * c
        for j in range(SIZE):
            out[_RATE + c, j] = -p[BG + c, j] - rate[0] * p[m, j] - rate[1] * p[m + 1, j] - rate[2] * p[m + 2, j]
            out[_FORCE + c, j] = -p[BA + c, j] - force[0] * p[a, j] - force[1] * p[a + 1, j] - force[2] * p[a + 2, j]


@inner
def _combine_columns(w: Floats, out: Floats, rate: Vec, force: Vec) -> None:
    """The same of one row (34,): its covariances with the errors of Z, v, ω, f and ψ, into the first 13 of `out`."""
    for i in range(6):
        out[i] = w[i]
    for c in range(3):
        m, a = MG + 3 * c, MA + 3 * c
        out[_RATE + c] = -w[BG + c] - rate[0] * w[m] - rate[1] * w[m + 1] - rate[2] * w[m + 2]
        out[_FORCE + c] = -w[BA + c] - force[0] * w[a] - force[1] * w[a + 1] - force[2] * w[a + 2]
    out[_PSI] = w[PSI]


@inner
def _multiply_combined(factors: Floats, rows: Floats, out: Floats) -> None:
    """out ← factors rows: 13 factors, some of them zero, times 13 rows of 34."""
    for j in range(SIZE):
        out[j] = factors[_PSI] * rows[_PSI, j]
    for k in range(0, _PSI, 3):
        a, b, c = factors[k], factors[k + 1], factors[k + 2]
        if a != 0.0 or b != 0.0 or c != 0.0:
            for j in range(SIZE):
                out[j] = out[j] + a * rows[k, j] + b * rows[k + 1, j] + c * rows[k + 2, j]


@inner
def add_noise(s: Record, rotation: float, velocity: float) -> None:
    """Add the noise of a step: variances, on each axis, of its rotation (rad²) and of the velocity gained (m²/s²).

    A wrong rotation n turns all: δZ += Z × n, δv += v × n, ψ += Zᵀn.
    """
    p, z, v = s.covariance, vec.load(s.tilt), vec.load(s.velocity)
    zz, zv, vv, heading = vec.dot(z, z), vec.dot(z, v), vec.dot(v, v), vec.cross(v, z)
    p[PSI, PSI] += rotation * zz
    for i in range(3):
        p[Z + i, Z + i] += rotation * zz
        p[V + i, V + i] += rotation * vv + velocity
        p[Z + i, V + i] += rotation * zv
        p[V + i, Z + i] += rotation * zv
        p[V + i, PSI] += rotation * heading[i]
        p[PSI, V + i] += rotation * heading[i]
        for j in range(3):
            p[Z + i, Z + j] -= rotation * z[i] * z[j]
            p[V + i, V + j] -= rotation * v[i] * v[j]
            p[Z + i, V + j] -= rotation * v[i] * z[j]
            p[V + j, Z + i] -= rotation * v[i] * z[j]


@inner
def propagate_covariance(s: Record, force: Vec, rotation: float, velocity: float, bias_walk: float) -> None:
    """P ← F P Fᵀ + Q over the accumulated increments.

    `force` (m/s²) is the mean reading; `rotation` (rad²), `velocity` (m²/s²) and `bias_walk` ((rad/s)²) are added to
    the variances of the readings' noise.
    """
    fill_transition(s)
    apply_transition(s, vec.scale(1.0 / s.span, vec.load(s.turned)), force)
    add_noise(s, s.rotation_variance + rotation, s.velocity_variance + velocity)
    for i in range(BG, BA):
        s.covariance[i, i] += bias_walk


@inner
def clear_increments(s: Record) -> None:
    """Start to accumulate anew."""
    s.span = s.rotation_variance = s.velocity_variance = 0.0
    vec.store(s.turned, (0.0, 0.0, 0.0))
    vec.store(s.impulse, (0.0, 0.0, 0.0))


@inner
def decay_to_prior(s: Record, h: float) -> None:
    """Return the estimated sensor errors, gyro bias excepted, towards their start: a first-order Gauss-Markov process.

    An error of the model therefore does not stay in them for ever.
    """
    s.undecayed_s += h
    if s.undecayed_s <= _DECAY_INTERVAL_S:
        return
    p, kept = s.covariance, math.exp(-s.undecayed_s / s.decay_s)
    s.undecayed_s = 0.0
    for i in range(BA, D):
        s.nominal[i] = s.start_mean[i] + kept * (s.nominal[i] - s.start_mean[i])
        for j in range(SIZE):
            p[i, j] *= kept
        for j in range(SIZE):
            p[j, i] *= kept
        p[i, i] += (1.0 - kept * kept) * s.prior[i]
