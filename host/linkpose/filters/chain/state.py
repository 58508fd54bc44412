"""State of the chain's filter: two links, a sensor on each, and the joint between them.

Frame n has Z upwards; its heading is arbitrary. Of each sensor k the filter estimates the rotation R_k from the
sensor's axes into n, the velocity v_k in n, the biases of gyro and accelerometer, and r_k, the vector from the joint
centre to the sensor in the sensor's axes. S_k are the R_k at the first sample, or at the end of a rest that begins
there; joint angles count from them. A hinge adds its axis j_k in either sensor's axes. A fixed first joint adds r_0,
the vector from that joint to sensor 1. Errors of rotations are in n: R = exp([δθ×]) R̂.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.filters._records import zeros
from linkpose.filters.frozen import MEMORY, fresh_memory
from linkpose.sensors.rig import Chain, Rig, Vector

Floats = NDArray[np.float64]
Record = Any  # a record of STATE, BANK or of the parameters, which compiled code reads by name

# Errors of one sensor, relative to OF_SENSOR * k: attitude, velocity, gyro bias, accelerometer bias, r_k.
TH, V, BG, BA, R = 0, 3, 6, 9, 12
OF_SENSOR = 15
START = 2 * OF_SENSOR  # of S_1, then S_2
BALL_SIZE = START + 6
HINGE_SIZE = 6  # of j_1, then j_2
MAX_SIZE = BALL_SIZE + HINGE_SIZE + 3
# Initial headings of sensor 2 relative to sensor 1, evenly spaced. With 5, a slow start of the robot arm in
# openaxes_robot converges to a wrong heading; with 12 the start costs more and no trial gains.
HYPOTHESES = 8
PATH = 768  # updates over which the first pose can be traced back: 30 s


class ChainParameters(NamedTuple):
    """Parameters of the chain's filter. Unit, meaning; origin; effect of doubling where it matters.

    Constants marked [D], [O], [E] were chosen on these recordings: [D] diodem_chain trial 1 in four joints, each from
    four starting times; [O] openaxes_robot circle-100; [E] the first 400 s of mpu6050_encoder roll_slow.
    """

    period_s: float = 0.039  # between two updates: 25 Hz, above the bandwidth of links that a body moves
    # Gyro scale and cross-axis errors as noise, share of the rate; correlated over 0.1 s. [D, O, E]; doubled: σ +20 %.
    gyro_misfit: float = 0.015
    # Scale and cross-axis errors of the accelerometer (data sheet: 3 %, 2 %) as a walk of its bias, share of the rate
    # at which the force turns in the sensor's axes. The walk returns to the prior: these errors are bounded. Without
    # the return, ball joints of [D] lose a third of their accuracy. [O]; doubled, σ +20 %.
    accel_scale: float = 0.02
    accel_scale_s: float = 0.5  # over which that rate is averaged (s)
    # Time over which gravity turns to and fro in a sensor's axes, its deviation over its rate, at which gyro_misfit and
    # accel_scale hold: that of the simulated leg (seeds 400, 401). Errors of slower motion last longer, and their
    # densities grow with it.
    turning_s: float = 0.29
    accel_walk_m_s2_sqrts: float = 0.001  # of the accelerometer bias: [MPU-6050]'s 35 mg over 65 K, 10 K in 10 min
    accel_misfit: float = 0.02  # share of the linear acceleration that is noise, correlated over 0.05 s
    # 1 °/s in the hour in which a sensor warms up. Of a gyro whose bias has been subtracted, the square follows the
    # level, down to that of an MPU-6050 at constant temperature, 2e-5 (rad/s)/√s (Allan deviation). At 3e-4 throughout,
    # this walk is half of the variance of calibrated sensors after a minute.
    gyro_walk_rad_s_sqrts: float = 3e-4
    lever_walk_m_sqrts: float = 1e-4  # lets an error of the model leave r_k again
    # Residual of the joint: its floor (m/s), least share of ‖ω‖ ‖r‖, that share before it has been measured, and the
    # time over which it is measured (s).
    velocity_floor_m_s: float = 0.01
    least_residual: float = 0.01
    first_residual: float = 0.05
    residual_s: float = 4.0
    # Acceleration noise grows up to `most_widening` times where innovations exceed their σ, by e in 1/widening_rate s.
    widening_rate: float = 1.0
    most_widening: float = 100.0
    # Level of the model's errors: a factor of the squares of gyro_misfit, accel_scale and accel_misfit. Level 1
    # is the data sheet, the least level is calibrated sensors. Wrong rotations add innovations that last for a second,
    # so the level follows the square of the innovations' moving mean, each divided by its σ. Chosen on the simulated
    # leg (seeds 0-3, calibrated and data sheet) and [D]. At level 1 throughout, σ of calibrated sensors is 3 to 8
    # times their error; at 0.01 throughout, σ of data-sheet sensors is a fifth of it.
    moving_mean_s: float = 0.5
    # That square, where σ is right: 0.1 to 0.3 for all of these. Doubled, σ of the hinge [D] 3-4 is 25 % smaller than
    # its error.
    level_square: float = 0.25
    level_s: float = 10.0  # over which the square is averaged (s). At 4 s, short bad stretches of [D] set the level.
    # Until then the average is over the motion so far; seconds of motion for which its first value, that of the data
    # sheet's errors, counts. Chosen without data.
    level_first_s: float = 2.0
    # Rate (1/s) at which the level grows e-fold for each multiple of `level_square` beyond the first; below it, the
    # level falls e-fold for each factor of e. Chosen on the simulated leg, seeds 400-409: at 0.25, σ of calibrated
    # sensors is three times their error for half a minute; doubled, the level of [D] swings.
    level_rate: float = 0.35
    level_most_ratio: float = 8.0
    # Scale error of 0.1 %: twelve-position calibration. Chosen on the same seeds: at 0.01, σ is twice the error after
    # 30 s; at 0.001, σ of hinges is too small at times.
    least_level: float = 0.003
    # Reached by a hinge's axis only: errors of the accelerometer turn with the link, and the axis shows them.
    most_level: float = 10.0
    least_floor_level: float = 0.06  # the same for floors of the residual and of the play: (2.5 mm/s)², not 10 mm/s
    # Cross-axis errors of one sensor (data sheet: ±2 %, of which 1/√3 is the standard deviation) about one axis: a
    # constant rotation between its gyro and its accelerometer, which no motion averages out and P does not hold.
    # Doubled, σ of data-sheet sensors is twice their error after 30 s.
    misalignment_rad: float = 0.0115
    level_std_rad: float = 0.1  # σ of the rotation above which the level does not fall
    # Play of a hinge (rad): σ before it has been measured, and the least; time over which it is measured (s).
    first_play_rad: float = 0.01
    least_play_rad: float = 0.003
    play_s: float = 4.0
    # Play is correlated: one update counts as 1/10 of an independent one at 25 Hz. [D]; at 1, the heading follows a
    # play of 3°.
    play_correlation: float = 10.0
    # Of the first estimate of the axis, from the direction of the relative rate. At 0.3, σ of simulated hinges is too
    # small for a second or two after it.
    axis_std_rad: float = 0.5
    axis_rotation: float = 0.1  # ∫‖ω_rel‖² dt that the first estimate needs (rad²/s)
    axis_share: float = 0.8  # of ∫ω_rel ω_relᵀ in its largest eigenvalue, ditto
    axis_memory_s: float = 10.0
    # Velocity of a sensor that a person or a machine moves: bounds of its measured σ (m/s) and correlation time (s).
    least_speed_m_s: float = 0.1
    most_speed_m_s: float = 2.0
    least_correlation_s: float = 0.1
    most_correlation_s: float = 1.0
    # The heading follows from accelerations that both sensors measure. Slower motion of either (rms velocity gained in
    # 1 s) is what errors of an accelerometer look like (0.1 m/s²), and gives no heading. [E]: at 0, σ is too small.
    heading_speed_m_s: float = 0.1
    # Scale and cross-axis errors of the accelerometer (data sheet: 3 %, 2 %) while gravity turns in the sensor's axes
    # look like motion, too.
    heading_scale: float = 0.02
    swing_memory_s: float = 4.0  # over which the mean direction of gravity in the sensor's axes is taken
    shared_motion: float = 2.0  # both sensors measure the same motion: variance × 2
    swing_s: float = 1.0  # over which acceleration is integrated to measure that σ (s)
    speed_memory_s: float = 2.0  # over which the result is averaged (s)
    # Rest: deviation of rate (rad/s) and force (m/s²) from their mean over 0.5 s, for how long (s); σ of its rate.
    rest_gyro_rad_s: float = 0.02
    rest_accel_m_s2: float = 0.3
    rest_s: float = 0.3
    rest_std_rad_s: float = 0.001
    # Largest rate that may be a bias before the first rest (data sheet: ±20 °/s) and after it: slower turns of links at
    # a constant rate are rare.
    most_first_rest_rad_s: float = 0.35
    most_rest_rad_s: float = 0.03
    huber: float = 3.0  # innovations beyond so many σ count less (P. J. Huber, 1964)
    # Successive innovations are correlated: log likelihoods of hypotheses count by this factor. [O]; doubled, a slow
    # start drops the true heading.
    tempering: float = 0.1
    # Corrections move the heading and the axis away from where earlier measurements were linearised, so that these gave
    # less than P holds: the square of the move within the last second, times this, is added to P. Chosen on the
    # simulated leg, seeds 0-3: at 0, errors of a hinge after a start reach 8 σ; doubled, σ is the same 10 s later.
    relinearized_share: float = 3.0
    # The same for gyro biases that have not been measured yet, which a wrong heading explains: the square of the move
    # over `relinearized_rad`², times this, is the share by which their variances grow in 1 s. Chosen on the simulated
    # leg in motion, seeds 400-409: at 0, biases of a start in fast motion are wrong by 5 σ; doubled, one ball joint in
    # twenty follows a wrong heading for a minute.
    relinearized_bias: float = 0.1
    relinearized_s: float = 1.0  # over which corrections count as one move (s)
    # A move that counts in full (rad); smaller ones are noise, and the error of a Jacobian is of second order.
    # [O]: at 0.03, the slow robot arm loses half of its accuracy.
    relinearized_rad: float = 0.1
    most_odds: float = 12.0  # log odds against a hypothesis beyond which it is dropped
    # Two hypotheses whose rotations differ by less than the σ of either, and by less than this, are the same: half the
    # spacing of the first headings (π / 8).
    same_rad: float = 0.4
    longest_gap_s: float = 0.5  # beyond it the attitudes are lost and the headings start anew
    unknown_rad: float = 1.0  # σ of the relative rotation beyond which it is not reported
    unknown_m: float = 0.1  # ditto, of a height: an unknown r_k alone makes it 0.3 m
    # Prior standard deviations.
    tilt_rad: float = 0.1
    tilt_moving_s: float = 0.1  # of the tilt, for each rad/s of a start in motion: limbs of 0.3 m swung at 1 Hz
    speed_m_s: float = 0.3
    gyro_bias_rad_s: float = 0.02  # after a subtraction at rest, which the first estimates of the bias show
    first_gyro_bias_rad_s: float = 0.2  # before that: data sheet of [MPU-6050], ±20 °/s, uniform
    # Log odds of the former, by both sensors, from which on it counts; e : 1. Chosen on the simulated leg in motion,
    # seeds 400-409; at 3, calibrated sensors are recognised up to 20 s later.
    prior_odds: float = 1.0
    # For which they have to hold (s): in the first second of motion, wrong headings take the biases past zero with a
    # small σ. Same seeds; at 0 and for each sensor alone, 12 of 40 starts with the data sheet's biases seem calibrated.
    prior_s: float = 1.0
    accel_bias_m_s2: float = 0.3  # data sheet of [MPU-6050]: ±50 mg
    lever_m: float = 0.3  # of an unknown r_k: links of people and robots


_V3, _Q = ("f8", 3), ("f8", 4)
STATE = np.dtype(
    [
        ("attitude", "f8", (2, 4)),  # quaternions of R_k
        ("rotation", "f8", (2, 3, 3)),  # R_k as matrices
        ("velocity", "f8", (2, 3)),
        ("gyro_bias", "f8", (2, 3)),
        ("accel_bias", "f8", (2, 3)),
        ("narrow_span", "f8"),  # for how long the biases have shown that prior (s)
        ("is_narrow", "i8", 2),  # whether the prior of either gyro bias is the one after a subtraction
        ("lever", "f8", (2, 3)),  # r_k
        ("axis", "f8", (2, 3)),  # j_k
        ("start", "f8", (2, 4)),  # quaternions of S_k
        ("lever0", *_V3),  # r_0
        ("covariance", "f8", (MAX_SIZE, MAX_SIZE)),
        ("correction", "f8", MAX_SIZE),  # of the errors, by the updates since the last `apply_correction`
        ("row", "f8", MAX_SIZE),  # of H
        ("gain", "f8", MAX_SIZE),
        # Accumulated since the last propagation of the covariance.
        ("turned", "f8", (2, 3, 3)),  # ∫ R_k dt
        ("impulse", "f8", (2, 3)),  # ∫ R_k f_k dt
        ("span", "f8"),  # s
        ("rotation_variance", "f8", 2),
        ("path_square", "f8", 2),  # ∫ ‖ω‖² dt since the first sample,
        ("traced_square", "f8"),  # and of both sensors, over which S_k has been traced back (rad²/s)
        ("is_traced", "i8"),  # whether it has been since a first rest
        ("velocity_variance", "f8", 2),
        ("force_rate_square", "f8", 2),  # mean ‖ω × f‖²
        # Memory of the measurement models.
        ("swing", "f8", (2, 3)),  # velocity gained in 1 s,
        ("swing_mean", "f8", (2, 3)),  # and its mean, which an error of the tilt adds
        ("heading_share", "f8"),  # of the horizontal force that tells the heading, 0 to 1
        ("shared_square", "f8", 2),  # mean square of the velocity gained in 1 s, from zero
        ("up", "f8", (2, 3)),  # mean of Z of n in either sensor's axes,
        ("up_swing", "f8", (2, 3)),  # and its distance from that mean, integrated like the velocity (s),
        ("up_spread", "f8", 2),  # and its mean square
        ("up_square", "f8", 2),  # mean square of that distance
        ("speed_square", "f8", 2),
        ("accel_square", "f8", 2),
        ("excess_square", "f8"),  # mean square residual of the joint beyond its floor (m²/s²)
        ("reach_square", "f8"),  # mean of ‖ω‖² ‖r‖² (m²/s²)
        ("residual_share", "f8"),  # square of the measured share
        ("innovation_ratio", "f8"),  # mean square innovation over its expectation
        ("widening", "f8"),
        ("play_square", "f8"),
        ("level_span", "f8"),  # over which innovations have been averaged for it (s)
        ("level", "f8"),  # of the model's errors
        ("moving_mean", "f8", (2, 3)),  # of innovations over σ: of the joint, of a hinge's axis,
        ("moving_square", "f8", 2),  # and the mean of its square, 1 for white noise
        ("moved_heading", "f8"),  # corrections within the last second: of the relative heading (rad)
        ("moved_axis", "f8", (2, 3)),  # and of either axis
        ("relative_spread", "f8", (3, 3)),  # ∫ ω_rel ω_relᵀ dt
        ("has_axis", "f8"),
        # Turning points of a hinge: angle without wraps, side (0, 1) of the next one, farthest angle on that side and
        # its σ, the last one of each side.
        ("turn_angle", "f8"),
        ("turn_side", "i8"),
        ("turn_farthest", "f8"),
        ("turn_std", "f8"),
        ("turn_last", "f8", 2),
        # End stops by side: repeats, first angle, its σ, whether it is used.
        ("stop_count", "i8", 2),
        ("stop_angle", "f8", 2),
        ("stop_std", "f8", 2),
        ("stop_used", "i8", 2),
        # Hypothesis.
        ("alive", "i8"),
        ("log_likelihood", "f8"),
        ("odds", "f8"),  # log odds against the best
        ("apart", "f8"),  # angle between its relative rotation and the best's
        ("rotation_std", "f8"),
        ("angle_std", "f8"),
        # Scratch.
        ("a", *_V3),
        ("b", *_V3),
        ("c", *_V3),
        ("m", "f8", (3, 3)),
        ("by_bias", "f8", (2, 3, 3)),
        ("traced", "f8", (2, 4)),
        ("relative", *_Q),
        ("first", *_Q),
    ],
    align=True,
)

# What all hypotheses share.
BANK = np.dtype(
    [
        ("begun", "i8"),
        ("spread", "i8"),  # whether the headings have been spread over the hypotheses
        ("length", "i8"),  # of the error state
        ("hinge", "i8"),  # first index of the errors of a hinge's axes, or −1
        ("fixed", "i8"),  # first index of the error of r_0, or −1
        ("time", "f8"),
        ("since_update", "f8"),
        ("gyro", "f8", (2, 3)),  # last readings
        ("accel", "f8", (2, 3)),
        ("mean_gyro", "f8", (2, 3)),
        ("mean_accel", "f8", (2, 3)),
        ("lagging_gyro", "f8", (2, 3)),  # means of these means
        ("lagging_accel", "f8", (2, 3)),
        ("gyro_scatter", "f8", 2),  # mean square of the rate's distance from its mean along one axis (rad²/s²)
        ("turning_square", "f8", 2),  # square of the rate at which the mean force turns, less noise (rad²/s²)
        ("still_s", "f8", 2),
        ("rests", "i8"),  # whether both sensors have been at rest since the first sample
        ("new_gyro", "f8", (2, 3)),  # readings of the present sample, calibrated
        ("new_accel", "f8", (2, 3)),
        ("last_readings", "f8", (2, MEMORY)),  # of `frozen.is_frozen`
        ("rested", "i8"),  # whether S_k are of the end of such a rest,
        ("rest_force", "f8", (2, 3)),  # and the readings of either accelerometer there
        ("path_length", "i8"),
        ("path_s", "f8"),
        ("path_sum", "f8", (2, 3)),
        ("path_span", "f8", PATH),
        ("path", "f8", (PATH, 2, 3)),
        ("best", "i8"),
        ("rejected", "i8"),
        ("misfit_s", "f8"),  # for how long the readings have not fitted two links with one joint
        ("misfits", "i8"),  # samples without an estimate because of that
        ("probation_s", "f8"),  # for which readings have to fit until they give estimates again
        ("forgotten", "i8"),  # how often the mounting was forgotten
        ("samples", "i8"),
        ("force_sum", "f8", 2),  # of the norms of their specific forces (m/s²)
        ("rate_sum", "f8", 2),  # and of their rates (rad/s)
        ("readings", "i8", 2),  # how many these are
        ("restarts", "i8"),
        # Angles of a ball joint: axes of flexion, abduction and length of link 1 as columns, in sensor 1's axes;
        # whether the rig states the first and the last; the neutral rotation that it states.
        ("frame", "f8", (3, 3)),
        ("knows_flexion", "i8"),
        ("knows_length", "i8"),
        ("neutral", *_Q),
        ("knows_neutral", "i8"),
        ("turned", *_Q),  # scratch of `angles`
        ("moved", *_Q),
        ("by_error", "f8", (3, 3)),
        ("now", "f8", (3, 3)),
        ("before", "f8", (3, 3)),
        ("covariance", "f8", (3, 3)),
    ],
    align=True,
)

ESTIMATE = np.dtype(
    [
        ("q", *_Q),  # from sensor 2's axes into sensor 1's
        ("rotation_std", "f8"),  # rad
        ("angle", "f8"),
        ("angle_std", "f8"),
        ("joint", *_V3),  # flexion, abduction, axial rotation of a ball joint
        ("joint_std", *_V3),
        ("height", "f8", 2),  # m
        ("height_std", "f8", 2),
        ("tilt", "f8", (2, 3)),  # Z of n in either sensor's axes
        ("covariance", "f8", (3, 3)),  # of the relative rotation, in sensor 1's axes (rad²)
    ],
    align=True,
)


def fresh_bank(rig: Rig) -> Any:
    """The shared record of a chain that begins."""
    banks = zeros(1, BANK)
    bank: Any = banks[0]
    bank.last_readings[:] = fresh_memory()
    bank.length, bank.hinge, bank.fixed = BALL_SIZE, -1, -1
    if rig.chain.joint == "hinge":
        bank.hinge, bank.length = bank.length, bank.length + HINGE_SIZE
    else:
        _declare_segment(bank, rig.chain)
    if rig.joint.j2s_m is not None:
        bank.fixed, bank.length = bank.length, bank.length + 3
    return banks


def _declare_segment(bank: Any, chain: Chain) -> None:
    """What the rig states of the angles of a ball joint."""
    for at, axis in ((0, chain.flexion_axis), (2, chain.long_axis)):
        if axis is not None:
            bank.frame[:, at] = np.asarray(axis) / np.linalg.norm(axis)
    bank.knows_flexion, bank.knows_length = chain.flexion_axis is not None, chain.long_axis is not None
    if chain.neutral is not None:
        bank.neutral, bank.knows_neutral = np.asarray(chain.neutral) / np.linalg.norm(chain.neutral), 1


def fresh_states(rig: Rig, parameters: ChainParameters, bank: Any) -> Any:
    """The hypotheses before the first sample: mounting and sensor errors as the rig states them."""
    states = zeros(HYPOTHESES, STATE)
    chain = rig.chain
    gyro_std = _known(rig.imu.gyro_bias_std_rad_s, parameters.first_gyro_bias_rad_s)
    accel_std = _known(rig.imu.accel_offset_std_m_s2, parameters.accel_bias_m_s2)
    for state in states:
        variance = np.zeros(MAX_SIZE)
        levers = ((chain.r1_m, chain.r1_std_m), (chain.r2_m, chain.r2_std_m))
        for k, (lever, std) in enumerate(levers):
            first = OF_SENSOR * k
            state.lever[k] = (0.0, 0.0, 0.0) if lever is None else lever
            variance[first + BG : first + BA] = (gyro_std if k == 0 else parameters.first_gyro_bias_rad_s) ** 2
            state.is_narrow[k] = k == 0 and rig.imu.gyro_bias_std_rad_s is not None
            variance[first + BA : first + R] = (accel_std if k == 0 else parameters.accel_bias_m_s2) ** 2
            variance[first + R : first + OF_SENSOR] = np.square(parameters.lever_m if lever is None else std)
        if bank.fixed >= 0:
            state.lever0 = rig.joint.j2s_m
            variance[bank.fixed : bank.fixed + 3] = np.square(rig.joint.j2s_std_m)
        state.covariance[:] = np.diag(variance)
        if bank.hinge >= 0 and chain.axis1 is not None and chain.axis2 is not None:
            _set_axes(state, bank.hinge, chain)
    return states


def _known(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value


def _set_axes(state: Any, first: int, chain: Chain) -> None:
    """Both axes of a hinge, with variances across them."""
    axes: tuple[tuple[Vector | None, float], ...] = (
        (chain.axis1, chain.axis1_std_deg),
        (chain.axis2, chain.axis2_std_deg),
    )
    for k, (axis, std_deg) in enumerate(axes):
        unit = np.asarray(axis, dtype=np.float64) / np.linalg.norm(np.asarray(axis))
        at = slice(first + 3 * k, first + 3 * k + 3)
        state.axis[k] = unit
        state.covariance[at, at] = math.radians(std_deg) ** 2 * (np.eye(3) - np.outer(unit, unit))
    state.has_axis = 1.0
