"""`mice`: velocity of a robot from N optical mice by weighted least squares, and its path by dead reckoning.

Frames: n is the floor's, b the robot's (x ahead, y to the left, z up). Mouse i sits at p_i in b and is turned by φ_i:
it gives R(φ_i)ᵀ v_i, in counts. With the robot's velocity ẋ = (v_bx, v_by, ω_b),

    v_ix = v_bx − ω_b p_iy,   v_iy = v_by + ω_b p_ix                                      (6), (7)
    A ẋ = Θ,   ẋ = (Aᵀ W A)⁻¹ Aᵀ W Θ                                                      (8), (11), (12)

with W = diag(1/σ_i²). For equal mice on an equilateral triangle that is J of (14), (15), the means of (16), (17).
σ_i² = ⅙ (count / T)² + (κ ‖v_i‖)² + σ²: a count is kept by the mouse until it is whole, so the error of a step is the
difference of two roundings; and the surface scatters what a mouse sees in proportion to its speed. What the floor does
to all mice alike cannot be told from motion: it is not in W, and adds (κ_c ‖v‖)² to the variance of v_b.

A mouse that slips, is lifted or dies shows in the residual over a short, exponentially forgetting window, in which the
roundings cancel: Σ ‖S_i − A_i X‖² / σ_i² against χ² with 2N − 3 degrees of freedom. Each mouse is then left out in
turn. Two mice that are left explain many a fault of the third as a turn, so the explanation that wins is the one that
also agrees with the gyro and with what a robot can do in so short a time. The same test over a single step leaves a
mouse out for that step: one that must repeat a packet says nothing first, and all at once then. What lasts longer is a
fault. The mouse is excluded, watched, and taken back when it has agreed over a time and a distance; at rest all agree.

The equations are those of a reading of the mice, T the time between two. At high rates some samples come without one.

Source: the redundant-mice paper, equations (1)-(17).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inner
from linkpose.errors import CannotRun
from linkpose.filters import _vector as vec
from linkpose.filters._imu import LONGEST_STEP_S, Floats, ImuCalibration, read_gyro
from linkpose.filters._vector import Vec
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Mouse, Rig
from linkpose.wire.messages import SampleFlags

Bools = NDArray[np.bool_]

NEAREST_M = 1e-3  # mice closer than this to one another tell no rotation

_GAP_BEFORE = int(SampleFlags.GAP_BEFORE)
_STALE = int(SampleFlags.MICE_STALE)
_OVERFLOW = int(SampleFlags.MOUSE1_OVERFLOW)  # that of mouse i is shifted by i
_ROUNDING = 1.0 / 6.0  # counts²: variance of the difference of two roundings

_WINDOW_S = 0.05  # what the window remembers: long enough for a few counts, short enough to name a fault in 0.2 s
_FAULT_Z = 4.75  # of the standard normal: one false alarm in a million tests
_DECISIVE = 12.0  # by how much of χ² the best explanation must beat the second
_UNDECIDED_S = 0.1  # after which the best one is taken all the same
_LATE_S = 0.035  # a packet that is asked for again brings its counts within three samples: so long a fault is forgiven
_SILENT_S = 0.04  # a mouse without a single count for so long, while the others move, is lifted or dead ...
_SILENT_BONUS = 25.0  # ... rather than right, and so much of χ² says so
_AGREES = 9.2  # χ² with two degrees of freedom, 99 %
_AGREED_S, _AGREED_M = 0.2, 0.01  # over which a mouse has to agree before it is taken back
_HOLD_S = 0.5  # for which the last velocity stands in where no mouse can be used

# What a small robot's velocity may change by in a second (standard deviation).
_ACCEL_M_S2, _ANGULAR_RAD_S2 = 2.0, 4.0
# A gyro that was never calibrated is off by 20 °/s at most; one second of agreeing mice cuts that, to a floor.
_BIAS_RAD_S, _BIAS_FLOOR_RAD_S, _BIAS_MEMORY_S = 0.35, 0.01, 10.0


class MiceParameters(NamedTuple):
    """What the filter assumes of the mice: standard deviations, as a share of the speed or in m/s."""

    scatter: float = 0.01  # κ: of one mouse, from sample to sample
    floor: float = 0.005  # κ_c: of all mice alike
    mismatch: float = 0.02  # of one mouse, lasting: what its calibration has left; not a fault
    noise_m_s: float = 0.0  # of one mouse, from sample to sample, at any speed, beyond the rounding to counts


class Placement(NamedTuple):
    """The rig's [[mouse]] as the compiled steps read it; a row for each mouse."""

    position: Floats  # (M, 2) m
    axes: Floats  # (M, 2) cos φ, sin φ
    metres_per_count: Floats  # (M,)

    @staticmethod
    def of(mice: tuple[Mouse, ...]) -> Placement:
        angles = np.radians([mouse.angle_deg for mouse in mice])
        return Placement(
            np.array([(mouse.x_m, mouse.y_m) for mouse in mice]).reshape(-1, 2),
            np.column_stack([np.cos(angles), np.sin(angles)]),
            np.array([1.0 / mouse.counts_per_m for mouse in mice]),
        )


class MiceState(NamedTuple):
    """What the filter remembers from one block to the next; changed in place. Vectors are in b."""

    time: Floats  # (3,) s: of the last reading, the usual interval, of the last reading with a velocity; NaN for none
    pose: Floats  # (3,) x, y (m), heading (rad) in n, at the last reading
    velocity: Floats  # (3,) v_bx, v_by (m/s), ω_b (rad/s)
    std: Floats  # (3,) of the velocity
    reference: Floats  # (3,) mean velocity over the window when the mice last agreed
    gyro: Floats  # (3,) last usable rate (rad/s, NaN for none), its bias beyond the rig's (rad/s), learnt over (s)
    window: Floats  # (M + 1, 2) m: each mouse's motion S_i; last row: the window's time (s) and the gyro's turn (rad)
    watch: Floats  # (M + 1, 4) s without a count, s and m of agreement, s of suspicion; last row: s of disagreement
    away: Bools  # (M,) whether a mouse had no counts at the last reading
    used: Bools  # (M,) whether a mouse counted for the estimate at the last reading
    distrusted: Bools  # (M,)
    lost: Bools  # (1,) whether samples were lost since the last reading
    rejected: NDArray[np.int64]  # (1,) readings in which no mouse was of use, or time did not go on

    @staticmethod
    def fresh(mice: int) -> MiceState:
        return MiceState(
            np.full(3, np.nan), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.array([np.nan, 0.0, 0.0]),
            np.zeros((mice + 1, 2)), np.zeros((mice + 1, 4)), np.zeros(mice, np.bool_), np.ones(mice, np.bool_),
            np.zeros(mice, np.bool_), np.zeros(1, np.bool_), np.zeros(1, np.int64),
        )  # fmt: skip


class MiceFilter:
    """The N-mouse least squares over blocks of samples."""

    name = "mice"
    columns = (
        "mice_vx_m_s", "mice_vy_m_s", "mice_wz_rad_s", "mice_vx_std_m_s", "mice_vy_std_m_s", "mice_wz_std_rad_s",
        "mice_x_m", "mice_y_m", "mice_heading_rad", "mice_excluded",
    )  # fmt: skip

    def __init__(self, rig: Rig, parameters: MiceParameters | None = None) -> None:
        """The rig must place at least one mouse. Raises CannotRun for mice that all sit at one place."""
        check_placement(rig.mouse)
        self.parameters = parameters or MiceParameters()
        self.state = MiceState.fresh(len(rig.mouse))
        self._placement = Placement.of(rig.mouse)
        self._imu = ImuCalibration.of(rig.imu)

    @property
    def rejected(self) -> int:
        """Readings so far in which no mouse could be used, or whose time could not."""
        return int(self.state.rejected[0])

    def process(self, block: Measurements) -> Floats:
        """Velocity in b and its standard deviations, pose in n, excluded mice, at each of the N samples: (N, 10).

        The velocity is the mean over the interval of the last reading, which at a sample between two readings stands
        with a growing standard deviation; NaN at the first reading, and when no mouse was of use for half a second.
        The pose starts at 0, heading in [−π, π). Excluded is a bit mask, bit 0 is mouse 1. The standard deviation is
        that of the modelled noise; what the calibration of the mice left is not in it.
        """
        out = np.empty((len(block), len(self.columns)))
        _process(
            block.time_s, block.mice_counts, block.gyro_rad_s, block.flags,
            self._placement, self._imu, self.parameters, self.state, out,
        )  # fmt: skip
        return out


def check_placement(mice: tuple[Mouse, ...]) -> None:
    """Raises CannotRun where A has not rank 3 and more than one mouse: rotation is not seen by mice at one place."""
    places = np.array([(mouse.x_m, mouse.y_m) for mouse in mice])
    if len(mice) > 1 and np.hypot(*(places - places[0]).T).max() < NEAREST_M:
        names = ", ".join(str(port) for port in range(1, len(mice) + 1))
        raise CannotRun(
            f"mice {names} all sit at ({places[0][0]:g}, {places[0][1]:g}) m, where they cannot tell a turn: "
            "correct their x_m and y_m in the rig file"
        )


# ---- compiled ----

# Σ w A_iᵀA_i and Σ w A_iᵀ s_i of some mice: (Σw, Σw p_x, Σw p_y, Σw ‖p‖²) and (Σw s_x, Σw s_y, Σw (p_x s_y − p_y s_x)).
Normal = tuple[float, float, float, float]


class Reading(NamedTuple):
    """What one reading of the mice says, made usable. Arrays are room that every reading fills anew."""

    moved: Floats  # (M, 2) m: motion of each mouse in b over the step
    sound: Bools  # (M,) whether a mouse has counts of this step
    trusted: Bools  # (M,) whether they count for the window
    weight: Floats  # (M,) 1/σ_i² over the window (1/m²)


@inner
def room(mice: int) -> Reading:
    """A reading to be filled."""
    return Reading(np.zeros((mice, 2)), np.zeros(mice, np.bool_), np.zeros(mice, np.bool_), np.zeros(mice))


@inner
def add_mouse(normal: Normal, right: Vec, w: float, p: Floats, sx: float, sy: float) -> tuple[Normal, Vec]:
    """One mouse more in the normal equations."""
    return (
        (normal[0] + w, normal[1] + w * p[0], normal[2] + w * p[1], normal[3] + w * (p[0] * p[0] + p[1] * p[1])),
        (right[0] + w * sx, right[1] + w * sy, right[2] + w * (p[0] * sy - p[1] * sx)),
    )


@inner
def solve(normal: Normal, extra: Vec, right: Vec) -> tuple[Vec, Vec]:
    """(12): ẋ and the diagonal of its covariance; `extra` are further weights on the diagonal of Aᵀ W A."""
    w, wx, wy, wpp = normal
    i = vec.inverse((w + extra[0], 0.0, -wy, w + extra[1], wx, wpp + extra[2]))
    return vec.apply(i, right), (i[0], i[3], i[5])


@inner
def at_mouse(motion: Vec, p: Floats) -> tuple[float, float]:
    """(6), (7): the motion of a point of the robot."""
    return motion[0] - motion[2] * p[1], motion[1] + motion[2] * p[0]


@inner
def variance(count: float, motion: Vec, p: Floats, share: float, more: float) -> float:
    """σ_i² of a mouse that moves with `motion`, in the square of its unit and that of a `count`: m or m/s."""
    x, y = at_mouse(motion, p)
    return _ROUNDING * count * count + share * share * (x * x + y * y) + more


@inner
def misfit(motion: Vec, p: Floats, s: Floats) -> float:
    """‖s − A_i x‖²"""
    x, y = at_mouse(motion, p)
    return float((s[0] - x) * (s[0] - x) + (s[1] - y) * (s[1] - y))


@inner
def bias_doubt(learnt_s: float) -> float:
    """Standard deviation (rad/s) of the gyro's bias when mice that agree have told it for so long."""
    return _BIAS_RAD_S / (1.0 + learnt_s) + _BIAS_FLOOR_RAD_S


@compiled
def fault_limit(freedom: int) -> float:
    """χ² that sound mice exceed once in a million tests, or less (Wilson and Hilferty 1931)."""
    part = 2.0 / (9.0 * freedom)
    return float(freedom * (1.0 - part + _FAULT_Z * math.sqrt(part)) ** 3)


@inner
def fuse(reading: Reading, step: float, rate: float, place: Placement, p: MiceParameters, state: MiceState) -> bool:
    """(11), (12) for one step: velocity and its standard deviation. False where the mice that are left cannot tell it.

    `rate` is the gyro's (rad/s), NaN without one.
    """
    normal, right, before = (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), vec.load(state.velocity)
    for i in range(state.used.shape[0]):
        if state.used[i]:
            at = place.position[i]
            w = 1.0 / variance(place.metres_per_count[i] / step, before, at, p.scatter, p.noise_m_s**2)
            normal, right = add_mouse(normal, right, w, at, reading.moved[i, 0] / step, reading.moved[i, 1] / step)
    w, wx, wy, wpp = normal
    extra = (0.0, 0.0, 0.0)
    # The weighted spread of the places about their mean: 0 where A has not rank 3.
    if not (w > 0.0 and wpp - (wx * wx + wy * wy) / w > w * NEAREST_M * NEAREST_M):
        if not (w > 0.0 and math.isfinite(rate)):
            return False
        extra = (0.0, 0.0, 1.0 / bias_doubt(state.gyro[2]) ** 2)
        right = (right[0], right[1], right[2] + extra[2] * (rate - state.gyro[1]))
    velocity, spread = solve(normal, extra, right)
    common = p.floor * p.floor * (velocity[0] * velocity[0] + velocity[1] * velocity[1])
    for j in range(3):
        state.velocity[j] = velocity[j]
        state.std[j] = math.sqrt(spread[j] + (common if j < 2 else 0.0))
    return True


@inner
def number(mice: Bools) -> int:
    """How many are True."""
    count = 0
    for i in range(mice.shape[0]):
        count += mice[i]
    return count


@inner
def explain(left_out: int, sums: Floats, reading: Reading, place: Placement, state: MiceState) -> tuple[float, Vec]:
    """χ² of some motion without one mouse (M: with all), and the X that fits it best; `sums` are as the window is.

    Where too few mice are left for themselves, X has to agree also with the gyro, and with the reference as far as a
    robot keeps its velocity.
    """
    mice = reading.trusted.shape[0]
    span, turn = sums[mice, 0], sums[mice, 1] - state.gyro[1] * sums[mice, 0]
    normal, right, chi2 = (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
    for i in range(mice):
        if reading.trusted[i] and i != left_out:
            s = sums[i]
            normal, right = add_mouse(normal, right, reading.weight[i], place.position[i], s[0], s[1])
    r, linear, angular, by_gyro = vec.load(state.reference), 0.0, 0.0, 0.0
    if left_out < mice or number(reading.trusted) < 2:
        linear = 1.0 / (_ACCEL_M_S2 * _WINDOW_S * span) ** 2
        angular = 1.0 / (_ANGULAR_RAD_S2 * _WINDOW_S * span) ** 2
        if math.isfinite(state.gyro[0]):
            by_gyro = 1.0 / (bias_doubt(state.gyro[2]) * span) ** 2
        right = (
            right[0] + linear * r[0] * span,
            right[1] + linear * r[1] * span,
            right[2] + angular * r[2] * span + by_gyro * turn,
        )
    x, _ = solve(normal, (linear, linear, angular + by_gyro), right)
    for i in range(mice):
        if reading.trusted[i] and i != left_out:
            chi2 += reading.weight[i] * misfit(x, place.position[i], sums[i])
    chi2 += linear * ((x[0] - r[0] * span) ** 2 + (x[1] - r[1] * span) ** 2)
    chi2 += angular * (x[2] - r[2] * span) ** 2 + by_gyro * (x[2] - turn) ** 2
    return chi2, x


@inner
def find_fault(
    sums: Floats, span: float, noise: float, p: MiceParameters, reading: Reading, place: Placement, state: MiceState
) -> tuple[bool, int, bool]:
    """Whether the mice disagree on some motion, who is most likely at fault, and whether that is beyond doubt.

    `span` is the time of the motion (s); `noise` is the variance (m²) that it has from sample to sample.
    """
    mice, count = reading.sound.shape[0], number(reading.trusted)
    usual = (state.reference[0] * span, state.reference[1] * span, state.reference[2] * span)
    for i in range(mice):
        per_count, at = place.metres_per_count[i], place.position[i]
        reading.weight[i] = 1.0 / variance(per_count, usual, at, p.mismatch, noise)
    # Of two mice one can go only where the gyro takes its part.
    if count < 2 or (count == 2 and not math.isfinite(state.gyro[0])):
        return False, 0, False
    if not explain(mice, sums, reading, place, state)[0] > fault_limit(2 * count - 3):
        return False, 0, False
    best, second, worst = math.inf, math.inf, 0
    for i in range(mice):
        if reading.trusted[i]:
            chi2, _ = explain(i, sums, reading, place, state)
            if state.watch[i, 0] >= _SILENT_S:
                chi2 -= _SILENT_BONUS
            if chi2 < best:
                best, second, worst = chi2, best, i
            else:
                second = min(second, chi2)
    return True, worst, second - best > _DECISIVE


@inner
def remember(reading: Reading, dt: float, step: float, rate: float, place: Placement, state: MiceState) -> None:
    """Takes the step into the window. A mouse that is away moves there as the others say: it returns in good order."""
    mice = reading.sound.shape[0]
    keep, velocity = math.exp(-dt / _WINDOW_S), vec.load(state.velocity)
    for i in range(mice):
        if not reading.sound[i]:
            x, y = at_mouse(velocity, place.position[i])
            reading.moved[i, 0], reading.moved[i, 1] = x * step, y * step
        silent = reading.moved[i, 0] == 0.0 and reading.moved[i, 1] == 0.0
        state.watch[i, 0] = state.watch[i, 0] + step if silent else 0.0
        for j in range(2):
            state.window[i, j] = keep * state.window[i, j] + reading.moved[i, j]
    turned = rate if math.isfinite(rate) else velocity[2] + state.gyro[1]
    state.window[mice, 0] = keep * state.window[mice, 0] + step
    state.window[mice, 1] = keep * state.window[mice, 1] + turned * step


@inner
def agree(reading: Reading, step: float, rate: float, place: Placement, state: MiceState) -> None:
    """What follows from mice that agree: the reference, the gyro's bias, and excluded mice that are taken back."""
    mice, count = reading.sound.shape[0], number(reading.trusted)
    span = state.window[mice, 0]
    _, x = explain(mice, state.window, reading, place, state)
    for j in range(3):
        state.reference[j] = x[j] / span
    if count >= 2 and math.isfinite(rate):
        state.gyro[2] = min(state.gyro[2] + step, _BIAS_MEMORY_S)
        state.gyro[1] += ((state.window[mice, 1] - x[2]) / span - state.gyro[1]) * step / state.gyro[2]
    for i in range(mice):
        if not (state.distrusted[i] and reading.sound[i]):
            continue
        # Twice, for the mice that it is compared with err as well.
        if misfit(x, place.position[i], state.window[i]) > 2.0 * _AGREES / reading.weight[i]:
            state.watch[i, 1] = state.watch[i, 2] = 0.0
            continue
        vx, vy = at_mouse(vec.load(state.velocity), place.position[i])
        state.watch[i, 1] += step
        state.watch[i, 2] += step * math.hypot(vx, vy)
        state.distrusted[i] = state.watch[i, 1] < _AGREED_S or state.watch[i, 2] < _AGREED_M


@inner
def leave_out_for_now(
    reading: Reading, step: float, rate: float, place: Placement, p: MiceParameters, state: MiceState
) -> None:
    """A mouse whose counts of this one step cannot be: late, and all at once when they come."""
    mice = reading.sound.shape[0]
    sums = np.empty((mice + 1, 2))
    for i in range(mice):
        sums[i, 0], sums[i, 1] = reading.moved[i, 0], reading.moved[i, 1]
    sums[mice, 0], sums[mice, 1] = step, rate * step if math.isfinite(rate) else 0.0
    disagree, worst, beyond_doubt = find_fault(sums, step, (step * p.noise_m_s) ** 2, p, reading, place, state)
    if disagree and beyond_doubt:
        state.used[worst] = False


@inner
def exclude(reading: Reading, step: float, place: Placement, p: MiceParameters, state: MiceState) -> bool:
    """Takes the trust from a mouse that has been at fault in the window for long enough; whether there is one."""
    mice = reading.sound.shape[0]
    span = state.window[mice, 0]
    noise = 0.5 * span * step * p.noise_m_s**2
    disagree, worst, beyond_doubt = find_fault(state.window, span, noise, p, reading, place, state)
    state.watch[mice, 0] = state.watch[mice, 0] + step if disagree else 0.0
    is_found = disagree and (beyond_doubt or state.watch[mice, 0] >= _UNDECIDED_S)
    for i in range(mice):
        state.watch[i, 3] = state.watch[i, 3] + step if is_found and i == worst else 0.0
    if not (is_found and state.watch[worst, 3] >= _LATE_S):
        return False
    state.distrusted[worst], reading.trusted[worst], state.used[worst] = True, False, False
    state.watch[worst, 1] = state.watch[worst, 2] = state.watch[worst, 3] = state.watch[mice, 0] = 0.0
    return True


@inner
def correct(
    reading: Reading, dt: float, step: float, rate: float, place: Placement, p: MiceParameters, state: MiceState
) -> bool:
    """Velocity from counts that cover the last `step` of `dt` (s); False where they do not tell it."""
    mice = reading.sound.shape[0]
    if dt == step:
        leave_out_for_now(reading, step, rate, place, p, state)
    if not (step > 0.0 and fuse(reading, step, rate, place, p, state)):
        return False
    remember(reading, dt, step, rate, place, state)
    if dt > step:  # a gap: what the robot did before it tells little of what it does now
        for j in range(3):
            state.reference[j] = state.velocity[j]
    if exclude(reading, step, place, p, state):
        fuse(reading, step, rate, place, p, state)
    if state.watch[mice, 0] == 0.0:
        agree(reading, step, rate, place, state)
    return True


@inner
def read_mice(counts: Floats, flags: int, place: Placement, reading: Reading) -> None:
    """The motion of each mouse in b. A mouse that is away, or overflowed, has none."""
    for i in range(reading.sound.shape[0]):
        reading.sound[i] = False
        if i < counts.shape[0] and not flags & (_OVERFLOW << i):
            x, y = counts[i, 0] * place.metres_per_count[i], counts[i, 1] * place.metres_per_count[i]
            reading.sound[i] = math.isfinite(x + y)
            c, s = place.axes[i, 0], place.axes[i, 1]
            reading.moved[i, 0], reading.moved[i, 1] = c * x - s * y, s * x + c * y


@inner
def advance_pose(pose: Floats, velocity: Floats, step: float) -> None:
    """The exact arc of a constant velocity in b over `step` (s)."""
    half = 0.5 * velocity[2] * step
    reach = step * (math.sin(half) / half if abs(half) > 1e-6 else 1.0)
    c, s = math.cos(pose[2] + half), math.sin(pose[2] + half)
    pose[0] += reach * (c * velocity[0] - s * velocity[1])
    pose[1] += reach * (s * velocity[0] + c * velocity[1])
    heading = pose[2] + 2.0 * half
    pose[2] = heading - 2.0 * math.pi * math.floor((heading + math.pi) / (2.0 * math.pi))


@inner
def hold(time_s: float, dt: float, state: MiceState) -> None:
    """A reading without a velocity of its own: for a while the last one stands, then nobody knows."""
    if time_s - state.time[2] <= _HOLD_S:
        state.std[0] += _ACCEL_M_S2 * dt
        state.std[1] += _ACCEL_M_S2 * dt
        state.std[2] += _ANGULAR_RAD_S2 * dt
        advance_pose(state.pose, state.velocity, dt)
    else:
        for j in range(3):
            state.velocity[j] = 0.0
        state.time[2] = math.nan


@inner
def advance(
    time_s: float, rate: float, reading: Reading, place: Placement, p: MiceParameters, state: MiceState
) -> None:
    """One reading. After a gap its counts cover one usual interval only: what the lost samples counted is lost."""
    dt = time_s - state.time[0]
    for i in range(reading.sound.shape[0]):
        was_away, state.away[i] = state.away[i], not reading.sound[i]
        reading.sound[i] = reading.sound[i] and not was_away  # who knows since when its first counts were gathered
        reading.trusted[i] = reading.sound[i] and not state.distrusted[i]
        state.used[i] = reading.trusted[i]
    if not dt > 0.0:  # also the first reading, whose interval nobody knows
        if math.isnan(state.time[0]):
            state.time[0] = time_s
        else:
            state.rejected[0] += 1
        return
    state.time[0] = time_s
    is_gap = state.lost[0] or dt > LONGEST_STEP_S
    state.lost[0] = False
    if not is_gap:
        state.time[1] = dt
    step = 0.0 if math.isnan(state.time[1]) else min(state.time[1], dt)
    mean_rate = 0.5 * (rate + state.gyro[0]) if not is_gap and math.isfinite(state.gyro[0]) else rate
    state.gyro[0] = rate
    missed = dt - step if time_s - state.time[2] <= _HOLD_S else 0.0  # bridged by the velocities at its ends
    if missed > 0.0:
        advance_pose(state.pose, state.velocity, 0.5 * missed)
    if correct(reading, dt, step, mean_rate, place, p, state):
        state.time[2] = time_s
        advance_pose(state.pose, state.velocity, step + 0.5 * missed)
    else:
        state.rejected[0] += 1
        hold(time_s, dt - 0.5 * missed, state)


@inner
def take(
    time_s: float, counts: Floats, flags: int, rate: float,
    reading: Reading, place: Placement, p: MiceParameters, state: MiceState,
) -> bool:  # fmt: skip
    """One sample; whether the mice were read for it. At high rates the board reads them at every n-th tick only."""
    state.lost[0] = state.lost[0] or bool(flags & _GAP_BEFORE)
    if flags & _STALE:
        return False
    read_mice(counts, flags, place, reading)
    advance(time_s, rate, reading, place, p, state)
    return True


@inner
def show(time_s: float, state: MiceState, out: Floats) -> None:
    """The estimate at a sample: from the last reading on its velocity stands."""
    since = time_s - state.time[0]
    if not since > 0.0:
        since = 0.0
    known = not math.isnan(state.time[2])
    for j in range(3):
        doubt = _ACCEL_M_S2 if j < 2 else _ANGULAR_RAD_S2
        out[j] = state.velocity[j] if known else math.nan
        out[3 + j] = math.hypot(state.std[j], doubt * since) if known else math.nan
        out[6 + j] = state.pose[j]
    advance_pose(out[6:9], state.velocity, since)
    out[9] = 0.0
    for j in range(state.used.shape[0]):
        if not state.used[j]:
            out[9] += 1 << j


@compiled
def _process(
    time_s: Floats,
    counts: Floats,
    gyro: Floats,
    flags: NDArray[np.uint32],
    place: Placement,
    imu: ImuCalibration,
    p: MiceParameters,
    state: MiceState,
    out: Floats,
) -> None:
    reading = room(place.position.shape[0])
    for i in range(len(time_s)):
        has_rate, rate = read_gyro((gyro[i, 0], gyro[i, 1], gyro[i, 2]), flags[i], imu)
        take(time_s[i], counts[i], flags[i], rate[2] if has_rate else math.nan, reading, place, p, state)
        show(time_s[i], state, out[i])
