"""State, parameters and memory layout of the planar filters.

The state is (x, y, θ, v_x, v_y, ω, b) and, for each mouse, (ε_i, α_i, δx_i, δy_i):

    x, y, θ      pose on the floor (m, rad), 0 at the first sample
    v_x, v_y, ω  mean velocity over the last step, in the robot's axes (m/s, rad/s)
    b            gyro bias beyond the rig's (rad/s)
    ε_i, α_i     logarithm of the mouse's metres per count, and its angle (rad), relative to the rig
    δx_i, δy_i   position of the mouse relative to the rig (m)
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, cast

import numpy as np

from linkpose.filters._records import zeros
from linkpose.filters.mice.state import MOST


def _index(k: int) -> int:
    """A NumPy integer, because the compiler gives each Python integer constant a type of its own."""
    return cast(int, np.int64(k))


# First index of each part of the state.
X, Y, HEADING, VX, VY, WZ, BIAS, MICE = (_index(k) for k in range(8))
SCALE, ANGLE, POSITION, OF_MOUSE = (_index(k) for k in (0, 1, 2, 4))
SIZE = int(MICE) + int(OF_MOUSE) * MOST
ROWS = 2 * MOST + 1  # of the largest measurement
QUEUE = 4  # blocks of the gyro's rate at rest

_VECTOR = ("f8", (SIZE,))
_MATRIX = ("f8", (SIZE, SIZE))

_CALIBRATION = np.dtype([(name, "f8") for name in ("scale", "angle", "dx", "dy")])
# A state by names: the same memory as SIZE numbers.
POINT = np.dtype(
    [
        *((name, "f8") for name in ("x", "y", "heading", "vx", "vy", "wz", "bias")),
        ("mice", _CALIBRATION, (MOST,)),
    ]
)
# By a mouse, in b as the rig places it: velocity (m/s), its variance along each axis ((m/s)²), and a further σ (m/s)
# along the direction of this vector.
_SEEN = np.dtype([("velocity", "c16"), ("variance", "f8"), ("across", "c16")])
_REST_BLOCK = np.dtype([("mean", "f8"), ("count", "i8"), ("squares", "f8")])  # of the gyro's rate (rad/s)

# Turns in which the mice show another share of the gyro's turn, see `gyro`.
_RESOLUTION = np.dtype(
    [
        ("square", "f8"),  # of the current turn: ∫ ω² dt of the gyro (rad²/s)
        ("product", "f8"),  # ∫ ω ω_mice dt (rad²/s)
        ("share", "f8"),  # of the gyro's turn that the mice showed in the last turn
        ("start", "c16"),  # position in n (m) up to which the way is certain, or its uncertainty stated
        ("changes", "i8"),  # how often the resolution has changed
        ("factor", "f8"),  # counts after the last change over counts before it
        ("time", "f8"),  # when it was found (s)
    ],
    align=True,
)

CAUSES = 5  # terms of the turn by which mice err, see `gyro`

# Gyro and mice that turn by different amounts: sums since the last agreement, see `gyro`.
_DISPUTE = np.dtype(
    [
        ("start", "c16"),  # position then, in n (m)
        ("position", "c16"),  # by the mice alone since then, in n (m)
        ("heading", "f8"),  # rad
        ("age", "f8"),  # time since then (s)
        ("calm", "i8"),  # blocks in a row in which gyro and mice agreed
        ("judges", "i8"),  # bit mask of the mice that are compared with the gyro
        # The current block.
        ("block_s", "f8"),
        ("block_gyro", "f8"),  # turn by the gyro, less its bias (rad)
        ("block_mice", "f8"),  # turn by the mice (rad)
        ("block_way", "f8"),  # ahead, by the mice (m)
        ("block_moved_s", "f8"),  # time in which the mice counted (s)
        ("block_variance", "f8"),  # of the difference of both turns, by noise that accumulates (rad²)
        ("block_rounding", "f8"),  # and by whole counts (rad²)
        # Cumulative sums of the difference over its σ, for either sign.
        ("up", "f8"),
        ("down", "f8"),
        # Terms of the fits to the blocks since then.
        ("blocks", "i8"),
        ("span", "f8"),  # s
        ("jump_square", "f8"),
        ("jump_product", "f8"),
        ("sums", "f8", (CAUSES + 1, CAUSES + 1)),  # weighted products of the terms of the mice's errors, and of `off`
        ("left", "f8", (CAUSES + 1, CAUSES + 1)),  # of them after an elimination
        ("terms", "f8", (CAUSES + 1,)),  # of the last block
        # Change of the turn by the mice with the scale and the angle of each (rad).
        ("by_scale", "f8", (MOST,)),
        ("by_angle", "f8", (MOST,)),
    ],
    align=True,
)

# The accelerometer against the mice, see `acceleration`. b are the axes of the sensor, n those in which the turn was 0.
SLOTS = 14
_SLOT = np.dtype(
    [
        ("span", "f8"),  # length (s)
        ("force", "c16"),  # ∫ specific force dt in b (m/s)
        ("way", "c16"),  # ∫ velocity by the mice dt in b (m)
        ("facing", "c16"),  # ∫ e^{jψ} dt of the turn ψ (s)
        ("force_n", "c16"),  # as `force` and `way`, in n
        ("way_n", "c16"),
        ("turn", "f8"),  # ψ at the end (rad)
        ("rate", "f8"),  # largest turn rate, without its sign (rad/s)
    ],
    align=True,
)
_ACCELERATION = np.dtype(
    [
        ("last", "c16"),  # value of the accelerometer (m/s²)
        ("repeats", "i8"),  # how often it has been the same to the last bit
        ("turn", "f8"),  # by the gyro, less its bias (rad)
        ("noise", "f8"),  # variance of one value, both axes together ((m/s²)²)
        ("filled", "i8"),  # slots without a gap between them
        ("slots", _SLOT, (SLOTS,)),
    ],
    align=True,
)

_FIELDS = [
    ("size", "i8"),  # of the state with the rig's mice
    ("mean", *_VECTOR),
    ("covariance", *_MATRIX),
    ("fresh", *_MATRIX),  # covariance to begin with
    ("gyro_variance", "f8"),  # of one sample ((rad/s)²), as the rests show it
    ("gyro_samples", "f8"),  # weight of that estimate
    # Rest.
    ("rest_s", "f8"),  # how long no mouse has counted (s)
    ("at_rest", "?"),
    ("block_s", "f8"),  # of the current block
    ("block_sum", "f8"),  # of its rates (rad/s)
    ("block_squares", "f8"),
    ("block_count", "i8"),
    ("queue", _REST_BLOCK, (QUEUE,)),  # finished blocks
    ("queued", "i8"),
    ("queued_at_rest", "i8"),  # those of them during which the filter took the robot to stand still
    # Common scale of the mice against the gyro: sums over the last turns.
    ("turn_square", "f8"),  # ∫ ω² dt of the gyro (rad²/s)
    ("turn_product", "f8"),  # ∫ ω ω_mice dt (rad²/s)
    ("turn_variance", "f8"),  # variance of turn_product (rad⁴/s²)
    ("lever_of_each", "c16", (MOST,)),  # ∫ ω s dt of each mouse's motion s relative to the mean (m rad/s)
    ("moved", "i8"),  # bit mask of the mice whose places the turns have corrected
    ("recent_square", "f8"),  # turn_square and turn_product over the current turn only
    ("recent_product", "f8"),
    ("turn_rate", "f8"),  # of the gyro, less its bias, in the last step (rad/s)
    ("off_of_turn", "f8"),  # share by which the mice turned more than the gyro in the last turn
    ("off_of_turn_before", "f8"),  # and in the one before
    ("recent_variance", "f8"),  # variance of recent_product ((rad²/s)²)
    ("turn_end", "c16"),  # position at the end of the last turn, in n (m)
    ("turn_spread", "f8"),  # mean square deviation of the share from turn to turn, beyond noise
    ("turns", "i8"),  # number of turns that have been compared
    ("is_off", "?"),  # whether the last turn was off by more than calibration and noise explain
    ("dispute", _DISPUTE),
    ("acceleration", _ACCELERATION),
    ("resolution", _RESOLUTION),
    ("jumps", "i8"),  # how often the gyro's bias has jumped
    ("jump", "f8"),  # the last jump (rad/s)
    ("jump_time", "f8"),  # and when it was found (s)
    ("floor_start", "c16"),  # position after the last turn in which the mice showed the gyro's turn, in n (m)
    ("floors", "i8"),  # how often the floor has changed
    # Turns in which all mice show another share of the gyro's turn than their calibration explains, see `gyro`.
    ("turn_factor", "f8"),  # counts per metre in turns over those on straights
    ("grip", "f8"),  # the same in the current step: 1 on a straight
    ("straight_std", "f8"),  # of the scale on straights, as a share, by what the turns do not show of it
    ("straight_way", "c16"),  # way on straights at this scale, in n (m)
    # Share of the gyro's turn that the mice show now, see `slip`: forgetting sums.
    ("slip_judges", "i8"),  # bit mask of the mice that are compared
    ("slip_s", "f8"),  # time (s)
    ("slip_turn", "f8"),  # turn by the gyro (rad)
    ("slip_shown", "f8"),  # by the mice (rad)
    ("slip_placed", "f8"),  # by the mice calibrated and placed as in the rig (rad)
    ("slip_variance", "f8"),  # of the turn by the mice (rad²)
    # The gyro's scale.
    ("all_square", "f8"),  # ∫ ω² dt of all turns of the gyro (rad²/s)
    ("all_product", "f8"),  # ∫ ω ω_mice dt, with the mice as the rig states them (rad²/s)
    ("gyro_std", "f8"),  # σ of the gyro's scale, as a share
    ("swept", "c16"),  # ∂(x + jy) / ∂(the gyro's scale) (m)
    ("dead_turn", "f8"),  # turn of the mice beyond a gyro that repeats one value (rad)
    ("rested_s", "f8"),  # time since the end of the last rest (s)
    ("rested_bias", "f8"),  # bias then (rad/s)
    ("rested_variance", "f8"),  # and its variance ((rad/s)²)
    ("drift2", "f8"),  # square of the bias's drift, as the rests show it ((rad/s²)²)
    ("since_rest_s", "f8"),  # time since the bias was last seen at a rest (s)
    ("strange_s", "f8"),  # how long a silent robot's gyro has shown one rate that is not its bias (s)
    ("strange", "f8"),  # that rate (rad/s)
    ("chi2", "f8"),  # of the last innovation
    ("refused_s", "f8"),  # how long the mice have contradicted the prediction (s)
    # A sudden change of velocity that only the mice show: a collision, or a lift or slip on a straight.
    ("held", "c16"),  # velocity before it, in the robot's axes (m/s)
    ("shown", "c16"),  # velocity of the last reading (m/s)
    ("earlier", "c16"),  # the filter's velocity before the last reading (m/s)
    ("jumped_to", "f8"),  # speed after the last such change on a straight, as a share of that before it; 0: none
    ("unconfirmed_s", "f8"),  # since then (s); 0: there is none; below 0: the end of one spreads
    ("unconfirmed_turn", "f8"),  # turning since then in which mice and gyro agree (rad)
    ("unconfirmed_m", "f8"),  # way that the robot went if the mice are wrong (m)
    ("unconfirmed_way", "c16"),  # the same as a vector in n (m)
    ("saturated_m", "f8"),  # way that saturated mice may have missed (m)
    # A speed limit of the mice, see `limit`.
    ("fastest", "f8"),  # largest speed of a mouse so far (m/s)
    ("limited_x", "f8"),  # way at about that speed, along either axis of n (m)
    ("limited_y", "f8"),
    ("limited_share", "f8"),  # σ of the way at the limit, as a share of it; 0 until a limit has been found
    ("limit_s", "f8"),  # how long mice at that speed have contradicted the gyro (s)
    # The measurement of a step. At rest: v_x, v_y, ω. Else the gyro's rate, if any, x and y of mice in `seen_by`.
    ("rows", "i8"),
    ("always", "i8"),  # rows that count whatever the innovation
    ("seen_by", "i8"),  # bit mask
    ("is_blind", "?"),  # whether no mouse counted in the last update
    ("has_snapping", "?"),  # whether a mouse has been found that snaps to its axes
    ("snapped", "i8"),  # bit mask of mice whose last counts were snapped to an axis
    ("rate_variance", "f8"),  # of the gyro's mean rate ((rad/s)²)
    ("seen", _SEEN, (MOST,)),
    # The innovation: z − ẑ, its covariance S, and its covariances with the state, row by row.
    ("residual", "f8", (ROWS,)),
    ("innovation", "f8", (ROWS, ROWS)),
    ("cross", "f8", (ROWS, SIZE)),
    ("predicted", "f8", (ROWS,)),  # ẑ
    # Counters.
    ("rejected", "i8"),  # readings that gave no measurement
    ("restarts", "i8"),  # of a covariance that was not positive definite
]


def _with_alias(fields: list[Any], whole: str, name: str, dtype: Any) -> np.dtype[Any]:
    """A record in which the memory of a field has a second name and type."""
    plain = np.dtype(fields, align=True)
    names = list(plain.names or ())
    places: Any = plain.fields
    return np.dtype(
        {
            "names": [*names, name],
            "formats": [*(plain[each] for each in names), dtype],
            "offsets": [*(places[each][1] for each in names), places[whole][1]],
            "itemsize": plain.itemsize,
        },
        align=True,
    )


STATE = _with_alias(_FIELDS, "mean", "at", POINT)

# Jacobian of the extended filter.
TANGENT = np.dtype([("jacobian", "f8", (ROWS, SIZE))], align=True)

# Sigma points of the unscented filter, two for each number of the state.
SIGMA = _with_alias(
    [
        ("points", "f8", (2 * SIZE, SIZE)),
        ("root", *_MATRIX),  # of the covariance
        ("shown", "f8", (2 * SIZE, ROWS)),  # measurement at each point
        ("moved", "f8", (2 * SIZE, 3)),  # pose of each point, later
    ],
    "points",
    "at",
    np.dtype((POINT, (2 * SIZE,))),
)

ESTIMATE = np.dtype(
    [
        (name, "f8")
        for name in (
            "x",
            "y",
            "heading",
            "vx",
            "vy",
            "wz",
            "x_std",
            "y_std",
            "heading_std",
            "vx_std",
            "vy_std",
            "wz_std",
            "excluded",  # bit mask of the mice, bit 0 is mouse 1
        )
    ]
)


class PlanarParameters(NamedTuple):
    """What the filters assume of the robot, the gyro and the calibration of the mice: standard deviations (1σ)."""

    # Motion: velocities of a small robot and how long they last (s). Halving the times doubles the variance with which
    # a velocity may change, and the error while no mouse is of use.
    speed_m_s: float = 0.6
    speed_s: float = 1.5
    turn_rad_s: float = 2.5
    turn_s: float = 1.0
    # Gyro: random walk of the bias (rad/s per √s) with an Allan deviation of 0.0023 °/s at 100 s; the axes of a real
    # MPU-6050 had 0.003, 0.0013 and 0.0007 °/s. Doubled: a rest is trusted a quarter as long.
    noise_factor: float = 2.5  # of the rig's gyro noise, until the first rest shows it: real sensors reach 0.13 °/s
    bias_rad_s: float = 0.35  # never calibrated: ±20 °/s (data sheet)
    bias_walk: float = math.radians(4e-4)
    # Mice: what `calibrate mice` leaves common to all mice: its line of 2 m, measured and driven straight to 2 mm ...
    common_scale: float = 0.0012
    common_angle_rad: float = math.radians(0.06)
    # ... what may set them apart, as bought and mounted by eye: the drive determines it ...
    own_scale: float = 0.03
    own_angle_rad: float = math.radians(3.0)
    # ... where a ruler puts them (±1 mm), and how fast height and floor change them (per √s). With 2 mm, another floor
    # is taken for positions and is not found.
    position_m: float = 0.0006
    scale_walk: float = 1e-4
    angle_walk: float = 1e-4
    # Share of the way that all mice lose or add unnoticed, constant over so much way (m): light slips and a floor that
    # varies. A slip of 10 % over 2 m of a drive of 24 m is 2.4 σ. Doubled: σ of the position on sound floors doubles.
    slip: float = 0.01
    slip_m: float = 3.0


def fresh_state(mice: int, p: PlanarParameters, gyro_variance: float) -> Any:
    """An array of one state record before the first sample; `gyro_variance` is the rig's, of one sample ((rad/s)²)."""
    records = zeros(1, STATE)
    state: Any = records[0]
    state.size = int(MICE) + int(OF_MOUSE) * mice
    state.gyro_variance, state.gyro_samples = p.noise_factor**2 * gyro_variance, 20.0
    state.resolution.share = state.turn_factor = state.grip = 1.0
    covariance = state.covariance
    for index, std in (
        *((k, 1e-6) for k in (X, Y, HEADING)),
        *((k, p.speed_m_s) for k in (VX, VY)),
        (WZ, p.turn_rad_s),
        (BIAS, p.bias_rad_s),
    ):
        covariance[index, index] = std * std
    for i in range(mice):
        a = MICE + OF_MOUSE * i
        for j in range(mice):
            b = MICE + OF_MOUSE * j
            apart = (i == j) - 1.0 / mice
            covariance[a + SCALE, b + SCALE] = p.common_scale**2 + apart * p.own_scale**2
            covariance[a + ANGLE, b + ANGLE] = p.common_angle_rad**2 + apart * p.own_angle_rad**2
        for k in range(2):
            covariance[a + POSITION + k, a + POSITION + k] = p.position_m**2
    state.fresh[:] = covariance
    return records
