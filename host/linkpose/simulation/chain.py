"""Two links with a sensor on each: a leg that hangs from a first joint, with a hinge or a ball joint at the knee.

Link 1 moves about its first joint as the link of `simulation.link` does. The first joint is fixed, or free: carried to
and fro as a hip is. Link 2 turns relative to link 1. All move under one envelope: at rest at the start and at the end.
Rotations R take vectors of sensor 2's axes into sensor 1's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import LinkposeError
from linkpose.quantities import BALL_ANGLES
from linkpose.rotations import of_matrices, swing_twist
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import CHAIN_JOINTS, FIRST_JOINTS, Chain, Imu, Joint, Rig, Vector, to_quaternion, to_vector
from linkpose.simulation.link import LinkRun
from linkpose.simulation.mag import axes
from linkpose.simulation.motion import HandMotion, Kinematics

Floats = NDArray[np.float64]

DURATION_S = 60.0
J2S_M: Vector = (0.03, 0.06, -0.25)  # from the fixed joint to sensor 1, half-way down a thigh of 0.45 m
R1_M: Vector = (0.03, 0.06, 0.20)  # from the knee to sensor 1
_R2_ALIGNED_M = np.array([0.02, 0.05, -0.15])  # from the knee to sensor 2, in sensor 1's axes while the leg is straight
_AXIS1 = np.array([0.05, 1.0, 0.10])  # of the hinge, in sensor 1's axes: to the side, as a strap leaves it
_LONG_AXIS = np.array([0.0, 0.0, 1.0])  # of link 1, in sensor 1's axes
_STRAP = ((2, 0.45), (0, 0.2))  # how sensor 2 is turned on its link: about z, then about x (rad)
_SWING1_RAD, _SWING2_RAD = 0.35, 0.4  # rms of the angles of link 1, and of link 2 relative to it: a brisk walk
# A free first joint: rms of its path (m) along x and y of n (0.8 of it along z), and tempo; 1 m/s² rms along each, as
# at the hip of a person who walks.
_CARRIED_M, _CARRIED_TEMPO = 0.05, 1.5
_RELATIVE_MOTION, _CARRIED_MOTION = 10, 11  # streams of random numbers, apart from those of the link
_RIG_STD_M, _RIG_STD_DEG = 0.002, 0.5  # that a rig file states of the mounting

_OVER_FIXED_JOINT = ("height_m", "x_m", "y_m")
_BALL_COLUMNS = tuple(quantity.column for quantity in BALL_ANGLES)


class Relative(NamedTuple):
    """Link 2 relative to link 1 at N instants."""

    rotation: Floats  # (N, 3, 3) R
    angle_rad: Floats  # (N,) of a hinge since the start
    rate_rad_s: Floats  # (N, 3) in sensor 1's axes
    rate_derivative_rad_s2: Floats  # (N, 3) of these components


class ChainRun(LinkRun):
    """A run of the simulated chain. Pure, as `LinkRun`; sensor 1 is the link's, sensor 2 sits on link 2."""

    def __init__(
        self,
        joint: str = "hinge",
        seed: int = 0,
        duration_s: float | None = DURATION_S,
        rate_hz: float = 100.0,
        errors: str = "calibrated",
        *,
        accel_range_g: int = 8,
        gyro_range_deg_s: int = 1000,
        oversampling: int = 1,
        noise_of: Rig | None = None,
        first_joint: str = "fixed",
    ) -> None:
        """`joint` is "ball" or "hinge", `first_joint` "fixed" or "free"; the other arguments are those of `LinkRun`.

        Raises LinkposeError as it does.
        """
        if joint not in CHAIN_JOINTS:
            raise LinkposeError(f"there is no joint {joint!r}: take {' or '.join(CHAIN_JOINTS)}")
        if first_joint not in FIRST_JOINTS:
            raise LinkposeError(f"there is no first joint {first_joint!r}: take {' or '.join(FIRST_JOINTS)}")
        super().__init__(
            1, seed, duration_s, rate_hz, errors, J2S_M, accel_range_g=accel_range_g, gyro_range_deg_s=gyro_range_deg_s,
            oversampling=oversampling, imu2=True, noise_of=noise_of, swing_rad=_SWING1_RAD,
        )  # fmt: skip
        self.joint, self.first_joint = joint, first_joint
        self._carried = HandMotion(np.random.default_rng([seed, _CARRIED_MOTION]), _CARRIED_TEMPO, duration_s)
        self._carried.amplitude_rad = _CARRIED_M * (first_joint == "free")  # its angles serve as metres
        self._turned = HandMotion(np.random.default_rng([seed, _RELATIVE_MOTION]), 1.0, duration_s)
        self._turned.amplitude_rad = _SWING2_RAD
        self._first_angles = self._turned.angles(np.zeros(1))[0]
        self._axes = np.stack([_AXIS1 / np.linalg.norm(_AXIS1), *np.eye(3)[[0, 2]]])
        self._mount = np.eye(3)
        for axis, angle in _STRAP:
            self._mount = self._mount @ about(np.eye(3)[axis], np.array([angle]))[0]
        self._r1, self._r2 = np.array(R1_M), self._mount.T @ _R2_ALIGNED_M

    @property
    def description(self) -> str:
        return f"sim://chain?joint={self.joint}&first_joint={self.first_joint}&seed={self.seed}&errors={self.errors}"

    @property
    def rig(self) -> Rig:
        """What is known without a calibration of the chain: a fixed first joint, and which joint the chain has."""
        return Rig(self._fixed_joint, Imu(delay_s=0.0), chain=self._stated)

    @property
    def _fixed_joint(self) -> Joint:
        return Joint(self.j2s_m) if self.first_joint == "fixed" else Joint()

    @property
    def _stated(self) -> Chain:
        """The kind of the joint, and the axes from which the angles of a ball joint count."""
        if self.joint == "hinge":
            return Chain(self.joint)
        return Chain(self.joint, long_axis=to_vector(_LONG_AXIS), flexion_axis=to_vector(self._axes[0]))

    @property
    def calibrated_rig(self) -> Rig:
        """The rig file with the mounting of both sensors."""
        axis1 = self._axes[0]
        levers = to_vector(self._r1), _RIG_STD_M, to_vector(self._r2), _RIG_STD_M
        neutral = to_quaternion(of_matrices(self._mount[None])[0])
        stated = self._stated if self.joint == "hinge" else replace(self._stated, neutral=neutral)
        chain = replace(stated, r1_m=levers[0], r1_std_m=levers[1], r2_m=levers[2], r2_std_m=levers[3])
        if self.joint == "hinge":
            chain = replace(chain, axis1=to_vector(axis1), axis1_std_deg=_RIG_STD_DEG)
            chain = replace(chain, axis2=to_vector(self._mount.T @ axis1), axis2_std_deg=_RIG_STD_DEG)
        return Rig(self._fixed_joint, Imu(delay_s=0.0), chain=chain)

    def relative(self, time_s: Floats) -> Relative:
        """Link 2 relative to link 1 at any instants (N,), s.

        R = Π exp([a_k×] θ_k) R_mount over the joint's axes a_k: one of a hinge, three of a ball joint.
        """
        angles = self._turned.angles(time_s)
        angles[0] -= self._first_angles
        rotation = np.broadcast_to(np.eye(3), (len(time_s), 3, 3))
        rate, derivative = np.zeros((len(time_s), 3)), np.zeros((len(time_s), 3))
        for k in range(1 if self.joint == "hinge" else 3):
            axis = rotation @ self._axes[k]
            turning = angles[1, k][:, None] * axis
            derivative = derivative + angles[2, k][:, None] * axis + np.cross(rate, turning)
            rate = rate + turning
            rotation = rotation @ about(self._axes[k], angles[0, k])
        return Relative(rotation @ self._mount, angles[0, 0], rate, derivative)

    def second_link(self, time_s: Floats) -> Kinematics:
        """Kinematics of link 2 in sensor 2's axes; its yaw is not given."""
        first, relative = self._motion.at(time_s), self.relative(time_s)
        rate = first.rate_rad_s + relative.rate_rad_s
        derivative = first.rate_derivative_rad_s2 + relative.rate_derivative_rad_s2
        derivative = derivative + np.cross(first.rate_rad_s, relative.rate_rad_s)
        turned = (_back(relative.rotation, vectors) for vectors in (first.tilt, rate, derivative))
        return Kinematics(np.full(len(time_s), np.nan), *turned)

    def _felt(self, time_s: Floats, at_m: Floats) -> tuple[Floats, Floats]:
        force, rate = super()._felt(time_s, at_m)
        return force + self._carried_accel(time_s), rate

    def _carried_accel(self, time_s: Floats) -> Floats:
        """Acceleration of the first joint (N, 3), m/s², in sensor 1's axes. The barometer does not follow its path."""
        accel = self._carried.angles(time_s)[2]
        north, east, up = axes(self._motion.at(time_s))
        return np.asarray(accel[0][:, None] * north + accel[1][:, None] * east + accel[2][:, None] * up)

    def _second(self, time_s: Floats) -> tuple[Floats, Floats]:
        knee = self._motion.at(time_s).acceleration(self._d - self._r1) + self._carried_accel(time_s)
        link = self.second_link(time_s)
        accel = _back(self.relative(time_s).rotation, knee) + link.acceleration(self._r2)
        return STANDARD_GRAVITY * link.tilt + accel, link.rate_rad_s

    def truth_columns(self, time_s: Floats) -> Mapping[str, Floats]:
        """R as a quaternion, the joint's angles; sensor 1 as a link's, and with a fixed first joint both heights."""
        link, relative = self.at(time_s), self.relative(time_s)
        columns = dict(super().truth_columns(time_s))
        columns |= dict(zip(("qw", "qx", "qy", "qz"), of_matrices(relative.rotation).T, strict=True))
        if self.joint == "ball":
            columns |= dict(zip(_BALL_COLUMNS, np.degrees(self._ball_angles(relative)).T, strict=True))
        else:
            columns["angle_deg"] = (np.degrees(relative.angle_rad) + 180.0) % 360.0 - 180.0
        if self.first_joint == "free":
            return {name: column for name, column in columns.items() if name not in _OVER_FIXED_JOINT}
        below = link.tilt @ (self._d - self._r1) + self.second_link(time_s).tilt @ self._r2
        return columns | {"height1_m": link.height_m, "height2_m": below}

    def _ball_angles(self, relative: Relative) -> Floats:
        """(N, 3) flexion, abduction and axial rotation (rad) from the first pose, about the leg's own axes."""
        flexion = self._axes[0] - (self._axes[0] @ _LONG_AXIS) * _LONG_AXIS
        flexion /= np.linalg.norm(flexion)
        axes = np.column_stack([flexion, np.cross(_LONG_AXIS, flexion), _LONG_AXIS])
        return swing_twist(of_matrices(axes.T @ relative.rotation @ self._mount.T @ axes))


def about(axis: Floats, angle_rad: Floats) -> Floats:
    """Rotation matrices (N, 3, 3) about a unit axis (3,), by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, cosine = np.sin(angle_rad)[:, None, None], np.cos(angle_rad)[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + (1 - cosine) * (cross @ cross))


def _back(rotation: Floats, vectors: Floats) -> Floats:
    """Rᵀ v for N rotations (N, 3, 3) and vectors (N, 3)."""
    return np.asarray(np.einsum("nji,nj->ni", rotation, vectors))
