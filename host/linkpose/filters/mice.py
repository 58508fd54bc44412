"""`mice`: velocity of a robot from N optical mice by weighted least squares, and its path by dead reckoning.

Frames: n is the floor's, b the robot's (x ahead, y to the left, z up). Mouse i sits at p_i in b and is turned by φ_i: it
gives R(φ_i)ᵀ v_i, in counts. With the robot's velocity ẋ = (v_bx, v_by, ω_b),

    v_ix = v_bx − ω_b p_iy,   v_iy = v_by + ω_b p_ix                                      (6), (7)
    A ẋ = Θ,   ẋ = (Aᵀ W A)⁻¹ Aᵀ W Θ                                                      (8), (11), (12)

with W = diag(1/σ_i²). For equal mice on an equilateral triangle that is J of (14), (15), the means of (16), (17).
σ_i² = ⅙ (count / T)² + (κ ‖v_i‖)²: a count is kept by the mouse until it is whole, so the error of a step is the
difference of two roundings; and the surface scatters what a mouse sees in proportion to its speed. What the floor does to
all mice alike cannot be told from motion: it is not in the weights, and adds (κ_c ‖v‖)² to the variance of v_b.

A mouse that slips, is lifted or dies shows in the residual over a short, exponentially forgetting window, in which the
roundings cancel: Σ ‖S_i − A_i X‖² / σ_i² against χ² with 2N − 3 degrees of freedom. Each mouse is then left out in turn.
Two mice that are left explain many a fault of the third as a turn, so the explanation that wins is the one that also
agrees with the gyro and with what a robot can do in so short a time. A mouse that is excluded is watched, and taken back
when it has agreed over a time and a distance; at rest everything agrees.

Source: the redundant-mice paper, equations (1)-(17).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.filters import CannotRun
from linkpose.filters import _vector as vec
from linkpose.filters._imu import Floats, ImuCalibration
from linkpose.filters._vector import Vec, compiled, inlined
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Mouse, Rig
from linkpose.wire.messages import SampleFlags

Flags = NDArray[np.uint16]

NEAREST_M = 1e-3  # mice closer than this to one another tell no rotation

_GAP_BEFORE = int(SampleFlags.GAP_BEFORE)
_OVERFLOW = int(SampleFlags.MOUSE1_OVERFLOW)  # that of mouse i is shifted by i
_ROUNDING = 1.0 / 6.0  # counts²: variance of the difference of two roundings

_WINDOW_S = 0.05  # what the window remembers: long enough for a few counts, short enough to name a fault in 0.2 s
_FAULT_Z = 4.75  # of the standard normal: one false alarm in a million tests
_DECISIVE = 12.0  # by how much of χ² the best explanation must beat the second
_UNDECIDED_S = 0.1  # after which the best one is taken all the same
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
    """What the filter assumes. Both are standard deviations as a share of the speed."""

    scatter: float = 0.02  # κ: of one mouse by itself
    floor: float = 0.005  # κ_c: of all mice alike


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
    """What the filter remembers from one block to the next; changed in place. All vectors are in b."""

    time: Floats  # (3,) s: of the last sample, the usual interval, since when no mouse was of use; NaN before the first
    pose: Floats  # (3,) x, y (m), heading (rad) in n
    velocity: Floats  # (3,) v_bx, v_by (m/s), ω_b (rad/s)
    variance: Floats  # (3,) of the velocity
    gyro: Floats  # (4,) last usable rate, its bias less the rig's, how long that was learnt (s), window's turn (rad)
    moved: Floats  # (3,) the window's motion X by the mice that count: m, m, rad
    window: Floats  # (M + 1, 2) each mouse's motion S_i in the window (m); last, (the window's time (s), suspicion (s))
    watch: Floats  # (M, 3) s without a count, s and m of agreement
    distrusted: NDArray[np.bool_]  # (M,)
    rejected: NDArray[np.int64]  # (1,) samples in which no mouse was of use, or time did not go on

    @staticmethod
    def fresh(mice: int) -> MiceState:
        return MiceState(
            np.full(3, np.nan), np.zeros(3), np.zeros(3), np.zeros(3), np.array([np.nan, 0.0, 0.0, 0.0]), np.zeros(3),
            np.zeros((mice + 1, 2)), np.zeros((mice, 3)), np.zeros(mice, np.bool_), np.zeros(1, np.int64),
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
        """Samples so far in which no mouse could be used, or whose time could not."""
        return int(self.state.rejected[0])

    def process(self, block: Measurements) -> Floats:
        """Velocity in b and its standard deviations, pose in n, excluded mice, at each of the N samples: (N, 10).

        The velocity is the mean over the sample's interval; NaN at the first sample, and when no mouse was of use for
        half a second. The pose starts at 0, heading in [−π, π). Excluded is a bit mask, bit 0 is mouse 1. The
        standard deviation is that of the modelled noise; what the calibration of the mice left is not in it.
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

# Σ w A_iᵀA_i and Σ w A_iᵀ s_i of some mice: (Σw, Σw p_x, Σw p_y, Σw ‖p‖²), (Σw s_x, Σw s_y, Σw (p_x s_y − p_y s_x)).
Normal = tuple[float, float, float, float]


@inlined
def add_mouse(normal: Normal, right: Vec, w: float, p: Floats, sx: float, sy: float) -> tuple[Normal, Vec]:
    """One mouse more in the normal equations."""
    return (
        (normal[0] + w, normal[1] + w * p[0], normal[2] + w * p[1], normal[3] + w * (p[0] * p[0] + p[1] * p[1])),
        (right[0] + w * sx, right[1] + w * sy, right[2] + w * (p[0] * sy - p[1] * sx)),
    )


@compiled
def tells_rotation(normal: Normal) -> bool:
    """Whether A has rank 3: the weighted spread of the places about their mean."""
    w, wx, wy, wpp = normal
    return w > 0.0 and wpp - (wx * wx + wy * wy) / w > w * NEAREST_M * NEAREST_M


@compiled
def solve(normal: Normal, extra: Vec, right: Vec) -> tuple[Vec, Vec]:
    """(12): ẋ and the diagonal of its covariance; `extra` are more weights on the diagonal of Aᵀ W A."""
    w, wx, wy, wpp = normal
    i = vec.inverse((w + extra[0], 0.0, -wy, w + extra[1], wx, wpp + extra[2]))
    return vec.apply(i, right), (i[0], i[3], i[5])


@compiled
def variance(step: float, count_m: float, moved: Vec, p: Floats, scatter: float) -> float:
    """σ_i² of a mouse's motion over `step` (s), in (unit of `moved` / s · s)²: that of `moved` is m or m/s."""
    vx, vy = moved[0] - moved[2] * p[1], moved[1] + moved[2] * p[0]
    return _ROUNDING * (count_m / step) ** 2 + scatter * scatter * (vx * vx + vy * vy)


@compiled
def misfit(total: Vec, p: Floats, sx: float, sy: float) -> float:
    """‖s − A_i x‖²"""
    ex, ey = sx - (total[0] - total[2] * p[1]), sy - (total[1] + total[2] * p[0])
    return ex * ex + ey * ey


@compiled
def bias_doubt(learnt_s: float) -> float:
    """Standard deviation (rad/s) of the gyro's bias after mice that agree have watched it for so long."""
    return _BIAS_RAD_S / (1.0 + learnt_s) + _BIAS_FLOOR_RAD_S


@compiled
def explain(
    left_out: int, use: NDArray[np.bool_], weight: Floats, place: Placement, state: MiceState, has_gyro: bool
) -> float:
    """χ² of the window without one mouse (−1: with all, and the mice alone): see the module's text."""
    normal, right = (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    mice = use.shape[0]
    for i in range(mice):
        if use[i] and i != left_out:
            normal, right = add_mouse(normal, right, weight[i], place.position[i], state.window[i, 0], state.window[i, 1])
    span = state.window[mice, 0]
    prior = (0.0, 0.0, 0.0)
    turn, turn_weight = 0.0, 0.0
    if left_out >= 0:
        linear, angular = 1.0 / (_ACCEL_M_S2 * _WINDOW_S * span) ** 2, 1.0 / (_ANGULAR_RAD_S2 * _WINDOW_S * span) ** 2
        if has_gyro:
            turn = state.gyro[3] - state.gyro[1] * span
            turn_weight = 1.0 / (bias_doubt(state.gyro[2]) * span) ** 2
        prior = (linear, linear, angular + turn_weight)
        right = (
            right[0] + linear * state.moved[0],
            right[1] + linear * state.moved[1],
            right[2] + angular * state.moved[2] + turn_weight * turn,
        )
    total, _ = solve(normal, prior, right)
    chi2 = 0.0
    for i in range(mice):
        if use[i] and i != left_out:
            chi2 += weight[i] * misfit(total, place.position[i], state.window[i, 0], state.window[i, 1])
    if left_out >= 0:
        chi2 += prior[0] * ((total[0] - state.moved[0]) ** 2 + (total[1] - state.moved[1]) ** 2)
        chi2 += (prior[2] - turn_weight) * (total[2] - state.moved[2]) ** 2 + turn_weight * (total[2] - turn) ** 2
        if state.watch[left_out, 0] >= _SILENT_S:
            chi2 -= _SILENT_BONUS
    return chi2


@compiled
def fault_limit(freedom: int) -> float:
    """χ² that sound mice exceed once in a million (Wilson and Hilferty 1931)."""
    part = 2.0 / (9.0 * freedom)
    return freedom * (1.0 - part + _FAULT_Z * math.sqrt(part)) ** 3


@compiled
def find_fault(
    use: NDArray[np.bool_], weight: Floats, place: Placement, state: MiceState, has_gyro: bool, step: float
) -> int:
    """The mouse to exclude, −1 for none. A lone mouse is no use without the gyro."""
    mice = use.shape[0]
    count = 0
    for i in range(mice):
        count += use[i]
    if count < 2 or (count == 2 and not has_gyro):
        return -1
    if not explain(-1, use, weight, place, state, has_gyro) > fault_limit(2 * count - 3):
        state.window[mice, 1] = 0.0
        return -1
    state.window[mice, 1] += step
    best, second, worst = math.inf, math.inf, -1
    for i in range(mice):
        if use[i]:
            chi2 = explain(i, use, weight, place, state, has_gyro)
            if chi2 < best:
                best, second, worst = chi2, best, i
            else:
                second = min(second, chi2)
    return worst if second - best > _DECISIVE or state.window[mice, 1] >= _UNDECIDED_S else -1


@compiled
def fuse(
    use: NDArray[np.bool_], counted: Floats, step: float, place: Placement, parameters: MiceParameters,
    state: MiceState, rate: float, has_gyro: bool,
) -> tuple[bool, Vec, Vec]:  # fmt: skip
    """Velocity and its variances from the motion `counted` (M, 2), m, of a step; False where it cannot be told."""
    normal, right = (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    before = vec.load(state.velocity)
    for i in range(use.shape[0]):
        if use[i]:
            w = 1.0 / variance(step, place.metres_per_count[i], before, place.position[i], parameters.scatter)
            vx, vy = counted[i, 0] / step, counted[i, 1] / step
            normal, right = add_mouse(normal, right, w, place.position[i], vx, vy)
    extra = (0.0, 0.0, 0.0)
    if not tells_rotation(normal):
        if not has_gyro or normal[0] == 0.0:
            return False, before, before
        by_gyro = 1.0 / bias_doubt(state.gyro[2]) ** 2
        extra = (0.0, 0.0, by_gyro)
        right = (right[0], right[1], right[2] + by_gyro * (rate - state.gyro[1]))
    velocity, spread = solve(normal, extra, right)
    common = parameters.floor**2 * (velocity[0] * velocity[0] + velocity[1] * velocity[1])
    return True, velocity, (spread[0] + common, spread[1] + common, spread[2])


@compiled
def advance_pose(pose: Floats, velocity: Floats, step: float) -> None:
    """The exact arc of a constant velocity in b over `step` (s)."""
    half = 0.5 * velocity[2] * step
    reach = step * (math.sin(half) / half if abs(half) > 1e-6 else 1.0 - half * half / 6.0)
    c, s = math.cos(pose[2] + half), math.sin(pose[2] + half)
    pose[0] += reach * (c * velocity[0] - s * velocity[1])
    pose[1] += reach * (s * velocity[0] + c * velocity[1])
    heading = pose[2] + 2.0 * half
    pose[2] = heading - 2.0 * math.pi * math.floor((heading + math.pi) / (2.0 * math.pi))


@compiled
def read_mice(counts: Floats, flags: int, place: Placement, counted: Floats, sound: NDArray[np.bool_]) -> None:
    """The motion of each mouse in b (m), and whether it has one: a mouse that is away or overflowed has none."""
    for i in range(sound.shape[0]):
        sound[i] = False
        if i < counts.shape[0] and not flags & (_OVERFLOW << i):
            x, y = counts[i, 0] * place.metres_per_count[i], counts[i, 1] * place.metres_per_count[i]
            sound[i] = math.isfinite(x + y)
            c, s = place.axes[i, 0], place.axes[i, 1]
            counted[i, 0], counted[i, 1] = c * x - s * y, s * x + c * y


@compiled
def remember(
    counted: Floats, sound: NDArray[np.bool_], step: float, turn: float, place: Placement, state: MiceState
) -> None:
    """The step goes into the window. A mouse that is away moves there as the others say, so it returns in good order."""
    mice = sound.shape[0]
    keep = math.exp(-step / _WINDOW_S)
    v = state.velocity
    for i in range(mice):
        p = place.position[i]
        if not sound[i]:
            counted[i, 0], counted[i, 1] = (v[0] - v[2] * p[1]) * step, (v[1] + v[2] * p[0]) * step
        state.watch[i, 0] = 0.0 if counted[i, 0] != 0.0 or counted[i, 1] != 0.0 else state.watch[i, 0] + step
        for j in range(2):
            state.window[i, j] = keep * state.window[i, j] + counted[i, j]
    state.window[mice, 0] = keep * state.window[mice, 0] + step
    state.gyro[3] = keep * state.gyro[3] + turn
    for j in range(3):
        state.moved[j] = keep * state.moved[j] + v[j] * step


@compiled
def take_back(
    sound: NDArray[np.bool_], step: float, place: Placement, parameters: MiceParameters, state: MiceState
) -> None:
    """Watches the excluded mice, and trusts again those that have agreed for long enough."""
    moved, v = vec.load(state.moved), state.velocity
    for i in range(sound.shape[0]):
        if state.distrusted[i] and sound[i]:
            p = place.position[i]
            doubt = 2.0 * variance(1.0, place.metres_per_count[i], moved, p, parameters.scatter)
            if misfit(moved, p, state.window[i, 0], state.window[i, 1]) > _AGREES * doubt:
                state.watch[i, 1] = state.watch[i, 2] = 0.0
                continue
            state.watch[i, 1] += step
            state.watch[i, 2] += step * math.hypot(v[0] - v[2] * p[1], v[1] + v[2] * p[0])
            state.distrusted[i] = not (state.watch[i, 1] >= _AGREED_S and state.watch[i, 2] >= _AGREED_M)


@compiled
def correct(
    counted: Floats, sound: NDArray[np.bool_], use: NDArray[np.bool_], weight: Floats, step: float, rate: float,
    has_gyro: bool, place: Placement, parameters: MiceParameters, state: MiceState,
) -> bool:  # fmt: skip
    """One sample's counts: velocity and its variance; False where they cannot tell it. `use` and `weight` are room."""
    mice = sound.shape[0]
    for i in range(mice):
        use[i] = sound[i] and not state.distrusted[i]
    known, velocity, spread = fuse(use, counted, step, place, parameters, state, rate, has_gyro)
    if not known:
        return False
    for j in range(3):
        state.velocity[j], state.variance[j] = velocity[j], spread[j]
    before = vec.load(state.moved)
    remember(counted, sound, step, rate * step if has_gyro else 0.0, place, state)
    for i in range(mice):
        weight[i] = 1.0 / variance(1.0, place.metres_per_count[i], vec.load(state.moved), place.position[i], parameters.scatter)
    fused = vec.load(state.moved)
    keep = math.exp(-step / _WINDOW_S)
    span = state.window[mice, 0]
    grow = span / max(span - step, step) * keep  # the motion before this step, carried on over it
    for j in range(3):
        state.moved[j] = before[j] * grow
    faulty = find_fault(use, weight, place, state, has_gyro, step)
    for j in range(3):
        state.moved[j] = fused[j]
    if faulty >= 0:
        state.distrusted[faulty] = True
        state.watch[faulty, 1] = state.watch[faulty, 2] = 0.0
        use[faulty] = False
    return True
