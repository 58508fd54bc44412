"""Motion of a link on a fixed ball joint, moved by hand: attitude as a smooth function of time with exact derivatives.

Frames: n is fixed with Z up, s is the sensor's. The attitude is R_ns = Rz(yaw) Ry(pitch) Rx(roll), so that the tilt
Z = R_nsᵀ e3 = (−sin pitch, cos pitch sin roll, cos pitch cos roll) gives roll and pitch back as
roll = atan2(Z_y, Z_z), pitch = atan2(−Z_x, hypot(Z_y, Z_z)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import LinkposeError

Floats = NDArray[np.float64]

STILL_S = 2.0  # rest at either end
RAMP_S = 2.0  # from rest to full motion
_TONES = 5  # harmonics to an axis
# Roll, pitch, yaw: a pole is swung to and fro at about half a hertz, and twisted less and more slowly.
_BAND_HZ = np.array([[0.30, 0.75], [0.30, 0.75], [0.20, 0.60]])
_WIDEST_RAD = 0.5  # rms of a swing
_SHARE = np.array([1.0, 1.0, 0.8])
SHORTEST_REST_S = 2.5  # on a side: `calibrate imu` leaves out half a second at either end of a rest


@dataclass(frozen=True, slots=True)
class Kinematics:
    """Attitude and angular motion at N instants."""

    yaw_rad: Floats  # (N,) about n's Z
    tilt: Floats  # (N, 3) n's Z axis seen in s
    rate_rad_s: Floats  # (N, 3) angular rate, in s
    rate_derivative_rad_s2: Floats  # (N, 3) angular acceleration, in s

    def horizontal(self, j2s_m: Floats) -> Floats:
        """x and y (N, 2), m, in n, of the point at `j2s_m` from the joint: those rows of R_ns d."""
        sine, cosine = -self.tilt[:, 0], np.hypot(self.tilt[:, 1], self.tilt[:, 2])  # of the pitch
        roll = np.arctan2(self.tilt[:, 1], self.tilt[:, 2])
        aside = np.sin(roll) * j2s_m[1] + np.cos(roll) * j2s_m[2]
        ahead, across = cosine * j2s_m[0] + sine * aside, np.cos(roll) * j2s_m[1] - np.sin(roll) * j2s_m[2]
        cos_yaw, sin_yaw = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return np.column_stack([cos_yaw * ahead - sin_yaw * across, sin_yaw * ahead + cos_yaw * across])

    def acceleration(self, j2s_m: Floats) -> Floats:
        """Linear acceleration (N, 3), m/s², in s, of the point at `j2s_m` from the fixed joint: ω̇×d + ω×(ω×d)."""
        inward = np.cross(self.rate_rad_s, np.cross(self.rate_rad_s, j2s_m))
        return np.asarray(np.cross(self.rate_derivative_rad_s2, j2s_m) + inward)


class HandMotion:
    """Sums of tones in roll, pitch and yaw under an envelope that keeps the link still at the start and at the end.

    All instants are functions of (seed, tempo, amplitude, duration): times may be evaluated in any order.
    """

    def __init__(self, rng: np.random.Generator, tempo: float, duration_s: float | None) -> None:
        """`tempo` multiplies the frequencies; `duration_s` None never ends."""
        self.duration_s = duration_s
        self.amplitude_rad = 0.3
        low, high = _BAND_HZ[:, :1], _BAND_HZ[:, 1:]
        # One tone to each part of the band, so that no seed is a single pure swing.
        place = (np.arange(_TONES) + rng.uniform(0.1, 0.9, (3, _TONES))) / _TONES
        self._omega = 2 * np.pi * tempo * (low + (high - low) * place)
        self._phase = rng.uniform(0, 2 * np.pi, (3, _TONES))
        weight = rng.uniform(0.5, 1.0, (3, _TONES))
        self._weight = _SHARE[:, None] * weight / np.sqrt(0.5 * (weight**2).sum(axis=1, keepdims=True))
        self._rest = rng.uniform(-1, 1, 3) * np.radians([8.0, 8.0, 180.0])

    def at(self, time_s: Floats) -> Kinematics:
        """Kinematics at `time_s` (N,), s."""
        return _kinematics(self.angles(time_s))

    def angles(self, time_s: Floats) -> Floats:
        """Roll, pitch and yaw (rad), each with two derivatives: (derivative order, angle, N)."""
        envelope = self._envelope(time_s)
        angle = np.empty((3, 3, len(time_s)))  # derivative order, axis, instant
        for axis in range(3):
            argument = np.outer(self._omega[axis], time_s) + self._phase[axis][:, None]
            weight, omega = self._weight[axis], self._omega[axis]
            sine, cosine = np.sin(argument), np.cos(argument)
            swing = np.stack([weight @ sine, (weight * omega) @ cosine, -(weight * omega**2) @ sine])
            angle[0, axis] = self._rest[axis] + self.amplitude_rad * envelope[0] * swing[0]
            angle[1, axis] = self.amplitude_rad * (envelope[1] * swing[0] + envelope[0] * swing[1])
            angle[2, axis] = self.amplitude_rad * (
                envelope[2] * swing[0] + 2 * envelope[1] * swing[1] + envelope[0] * swing[2]
            )
        return angle

    def scale_to(self, mean_accel_m_s2: float, j2s_m: Floats, over_s: float) -> None:
        """Sets the amplitude so that the mean ‖a‖ over the first `over_s` seconds is `mean_accel_m_s2`.

        A link much shorter than the paper's cannot be accelerated so by hand: then the widest swing is taken.
        """
        time_s = np.arange(0.0, over_s, max(0.04, over_s / 20_000))
        low, high = 0.0, _WIDEST_RAD
        for _ in range(25):
            self.amplitude_rad = 0.5 * (low + high)
            mean = np.linalg.norm(self.at(time_s).acceleration(j2s_m), axis=1).mean()
            low, high = (self.amplitude_rad, high) if mean < mean_accel_m_s2 else (low, self.amplitude_rad)

    def _envelope(self, time_s: Floats) -> Floats:
        """(3, N): 0 at rest, 1 in motion, and its two derivatives."""
        if self.duration_s is None:
            return _ramp(time_s - STILL_S, RAMP_S)
        still = min(STILL_S, self.duration_s / 8)
        ramp = min(RAMP_S, self.duration_s / 8)
        rise = _ramp(time_s - still, ramp)
        fall = _ramp(self.duration_s - still - time_s, ramp)
        fall[1] *= -1
        product = rise[0] * fall[0]
        first = rise[1] * fall[0] + rise[0] * fall[1]
        second = rise[2] * fall[0] + 2 * rise[1] * fall[1] + rise[0] * fall[2]
        return np.stack([product, first, second])


class SixSides:
    """A sensor laid on each of its six sides in turn, with a rest on each and a smooth turn between them.

    The rests are as `calibrate imu` needs them. The joint stays the centre of the turns.
    """

    _ROLL = np.radians([0.0, 90.0, 180.0, 180.0, 180.0, 270.0])
    _PITCH = np.radians([0.0, 0.0, 0.0, 88.0, -88.0, 0.0])  # at 90° roll and yaw are one
    _TURNING = 0.35  # share of a side's time that the turn to it takes

    def __init__(self, duration_s: float) -> None:
        """Raises LinkposeError where the sides have no second of rest each."""
        self._slot_s = duration_s / len(self._ROLL)
        if (1 - self._TURNING) * self._slot_s < SHORTEST_REST_S:
            shortest = len(self._ROLL) * SHORTEST_REST_S / (1 - self._TURNING)
            raise LinkposeError(f"six rests do not fit {duration_s:g} s: simulate {shortest:.0f} s or more")

    def at(self, time_s: Floats) -> Kinematics:
        """Kinematics at `time_s` (N,), s; after the end the sensor stays on its last side."""
        angle = np.zeros((3, 3, len(time_s)))  # derivative order, axis, instant
        for axis, sides in enumerate((self._ROLL, self._PITCH)):
            angle[0, axis] = sides[0]
            for side in range(1, len(sides)):
                start = side * self._slot_s
                angle[:, axis] += (sides[side] - sides[side - 1]) * _ramp(time_s - start, self._TURNING * self._slot_s)
        return _kinematics(angle)


def _ramp(time_s: Floats, length_s: float) -> Floats:
    """Step from 0 to 1 over `length_s` with three continuous derivatives, so that jerk is continuous; (3, N)."""
    u = np.clip(time_s / length_s, 0.0, 1.0)
    step = u**4 * (35 - 84 * u + 70 * u**2 - 20 * u**3)
    first = 140 * (u * (1 - u)) ** 3 / length_s
    second = 420 * (u * (1 - u)) ** 2 * (1 - 2 * u) / length_s**2
    return np.stack([step, first, second])


def _kinematics(angle: Floats) -> Kinematics:
    """From roll, pitch, yaw and two derivatives, (3, 3, N)."""
    roll, pitch, _ = angle[0]
    droll, dpitch, dyaw = angle[1]
    ddroll, ddpitch, ddyaw = angle[2]
    sr, cr, sp, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
    tilt = np.stack([-sp, cp * sr, cp * cr], axis=1)
    # ω = (roll', 0, 0) + Rx(roll)ᵀ (0, pitch', 0) + yaw' Z
    rate = np.stack([droll - dyaw * sp, dpitch * cr + dyaw * cp * sr, -dpitch * sr + dyaw * cp * cr], axis=1)
    derivative = np.stack(
        [
            ddroll - ddyaw * sp - dyaw * dpitch * cp,
            ddpitch * cr - dpitch * droll * sr + ddyaw * cp * sr + dyaw * (droll * cp * cr - dpitch * sp * sr),
            -ddpitch * sr - dpitch * droll * cr + ddyaw * cp * cr - dyaw * (droll * cp * sr + dpitch * sp * cr),
        ],
        axis=1,
    )
    return Kinematics(angle[0, 2], tilt, rate, derivative)
