"""Angles of a ball joint: flexion, abduction and axial rotation of link 2 relative to link 1.

D, the rotation of link 2 from the neutral pose in the axes of segment 1 (flexion f, abduction a = l × f, length l), is
split into a twist about the length of link 2 and a swing about an axis across it, D = swing · twist. Axial rotation is
the angle of the twist; flexion and abduction are the components of the swing's rotation vector. Unlike the three angles
of a joint coordinate system they have no singularity at an abduction of 90°, only at a swing of 180°.

Source: [Baerlocher2001], 3; axes and their senses as in [Wu2002].
"""

from __future__ import annotations

import math

from linkpose.compiling import inner
from linkpose.filters import _vector as vec
from linkpose.filters.chain.rotation import between, product, rotate, rotate_back, to_matrix, turn
from linkpose.filters.chain.state import OF_SENSOR, START, Floats, Record
from linkpose.filters.chain.update import clear_row, expected_square

_PARALLEL = 0.03  # sin² of 10°
# Variance of the first pose's heading over that in P. It comes from the seconds in which the heading is found; what
# later motion shows of it hardly reaches the first pose. At 1, axial rotations of simulated ball joints with data-sheet
# errors are within 2σ in 91 %. Doubled, σ of the axial rotation grows by up to 1.4.
_START_CORRELATION = 2.0
_STEP_RAD = 1e-4  # of the numerical derivative: truncation and rounding below 1e-7


@inner
def set_frame(bank: Record, up: Floats) -> None:
    """Axes of segment 1: what the rig states, at right angles.

    Otherwise the length is `up`, the vertical at the first sample in sensor 1's axes, and the flexion axis is the axis
    of the sensor that is farthest from the length.
    """
    frame = bank.frame
    for i in range(3):
        if not bank.knows_length:
            frame[i, 2] = up[i]
    if bank.knows_flexion and not bank.knows_length:
        _put_across(frame, 0, 2)
    else:
        _put_across(frame, 2, 0)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        frame[i, 1] = frame[j, 2] * frame[k, 0] - frame[k, 2] * frame[j, 0]


@inner
def _put_across(frame: Floats, fixed: int, moved: int) -> None:
    """Turn one column at right angles to another. One that is unknown (zero) or nearly parallel to it becomes the axis
    of the sensor that is farthest from it.
    """
    axis = 0
    for i in range(3):
        if abs(frame[i, fixed]) < abs(frame[axis, fixed]):
            axis = i
    for attempt in range(2):
        along = norm = 0.0
        for i in range(3):
            along += frame[i, moved] * frame[i, fixed]
        for i in range(3):
            frame[i, moved] -= along * frame[i, fixed]
            norm += frame[i, moved] ** 2
        if norm > _PARALLEL or attempt == 1:
            for i in range(3):
                frame[i, moved] /= math.sqrt(norm)
            return
        for i in range(3):
            frame[i, moved] = 1.0 if i == axis else 0.0


@inner
def swing_twist(q: Floats, out: Floats) -> None:
    """Flexion, abduction and axial rotation (rad) of the unit quaternion q in the axes of the segment."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    norm = math.sqrt(w * w + z * z)
    if norm < 1e-12:  # a swing of 180° leaves the twist undetermined
        c, s = 1.0, 0.0
    else:
        c, s = w / norm, z / norm
    # swing = q · twist⁻¹, twist = (c, 0, 0, s)
    u, v = c * x - s * y, c * y + s * x
    length = math.sqrt(u * u + v * v)
    scale = 2 * math.atan2(length, norm) / length if length > 1e-9 else 2.0
    out[0], out[1], out[2] = scale * u, scale * v, vec.wrapped(2 * math.atan2(s, c))


@inner
def angles_with_std(q: Floats, covariance: Floats, angles: Floats, std: Floats, scratch: Record) -> None:
    """Angles of q and their σ (rad); `covariance` (3, 3): of the error δ in q = exp(δ) q̂, in the segment's axes."""
    swing_twist(q, angles)
    moved, by_error = scratch.moved, scratch.by_error
    for j in range(3):
        for i in range(4):
            moved[i] = q[i]
        turn(moved, _STEP_RAD * (j == 0), _STEP_RAD * (j == 1), _STEP_RAD * (j == 2), 1.0)
        swing_twist(moved, std)
        for i in range(3):
            by_error[i, j] = vec.wrapped(std[i] - angles[i]) / _STEP_RAD
    for i in range(3):
        total = 0.0
        for a in range(3):
            for b in range(3):
                total += by_error[i, a] * covariance[a, b] * by_error[i, b]
        std[i] = min(math.sqrt(max(total, 0.0)), math.pi)


@inner
def report_angles(bank: Record, s: Record, constant: float, first: float, out: Record) -> None:
    """Angles of the best hypothesis s, with σ that includes the spread of the headings of all.

    `constant`: variance (rad²) about each axis that P does not hold, of the rotation now and of the neutral one;
    `first`: a further one of the first rotation.
    """
    between(s.attitude[0], s.attitude[1], s.relative)
    between(s.start[0], s.start[1], s.first)
    for i in range(4):
        if bank.knows_neutral:
            s.first[i] = bank.neutral[i]
        s.first[i] *= 1.0 if i == 0 else -1.0
    product(s.relative, s.first, bank.turned)  # D in sensor 1's axes
    _set_jacobian(bank, s)
    _set_covariance(bank, s, max(out.rotation_std**2 - s.rotation_std**2, 0.0))
    for i in range(3):
        bank.covariance[i, i] += constant + (0.0 if bank.knows_neutral else constant + first)
    for i in range(3):  # and in the segment's
        s.a[i] = bank.turned[1 + i]
    rotate_back(bank.frame, s.a, s.b)
    for i in range(3):
        bank.turned[1 + i] = s.b[i]
    angles_with_std(bank.turned, bank.covariance, out.joint, out.joint_std, bank)


@inner
def _set_jacobian(bank: Record, s: Record) -> None:
    """δ = Sᵀ (R_1ᵀ (δθ_2 − δθ_1) − D S_1ᵀ (δs_2 − δs_1)): rows of Sᵀ R_1ᵀ in `now`, of Sᵀ D S_1ᵀ in `before`."""
    to_matrix(bank.turned, bank.by_error)
    to_matrix(s.start[0], s.m)
    for i in range(3):
        for j in range(3):
            s.a[j] = bank.frame[j, i]
        rotate(s.rotation[0], s.a, bank.now[i])
        rotate_back(bank.by_error, s.a, s.b)
        rotate(s.m, s.b, bank.before[i])


@inner
def _set_covariance(bank: Record, s: Record, heading_square: float) -> None:
    """Covariance of δ (rad²) with a further variance about the vertical."""
    share, p = 0.0 if bank.knows_neutral else 1.0, s.covariance
    first = p[START + 2, START + 2] + p[START + 5, START + 5] - 2 * p[START + 2, START + 5]
    first *= share * (_START_CORRELATION - 1)
    for i in range(3):
        clear_row(s)
        for c in range(3):
            s.row[c], s.row[OF_SENSOR + c] = -bank.now[i, c], bank.now[i, c]
            s.row[START + c], s.row[START + 3 + c] = share * bank.before[i, c], -share * bank.before[i, c]
        expected_square(s, bank.length)
        for j in range(3):
            total = heading_square * bank.now[i, 2] * bank.now[j, 2] + first * bank.before[i, 2] * bank.before[j, 2]
            for c in range(3):
                total += bank.now[j, c] * (s.gain[OF_SENSOR + c] - s.gain[c])
                total += share * bank.before[j, c] * (s.gain[START + c] - s.gain[START + 3 + c])
            bank.covariance[i, j] = total
