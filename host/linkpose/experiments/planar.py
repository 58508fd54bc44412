"""The planar filters beside a baseline of ten lines, on simulated drives with the gyro noise of a real MPU-6050.

The baseline takes the gyro's bias from the first second, the heading from the gyro and the way from the mean of the
mice. A filter that does not do better than this is not worth its name. `tests/bench/mice.py` prints the comparison.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from linkpose.rotations import wrapped
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.rig import Rig
from linkpose.simulation.drive import Hastened, Manoeuvres
from linkpose.simulation.gyro_noise import rate_noise
from linkpose.simulation.mice import Fault, MiceRun, MouseErrors, ring

RATE_HZ = 100.0
STILL_S = 1.0  # duration of the rest from which the baseline takes the gyro's bias
FAULT_FROM_S = 20.0
FLOOR_SCALE = 1.05  # the mice of the case "floor" count 5 % more than their calibration states
RESTS = 0.2  # share of the manoeuvres: a robot that works stops now and then
TURNING_RAD_S = 0.3  # at the start in motion, so that the gyro's bias does not show
FAST = 2.1  # hastens the drive that reaches 0.95 m/s to 2 m/s
EXACT = MouseErrors(scale=0.0, angle_deg=0.0)


@dataclass(frozen=True, slots=True)
class PlanarRun:
    """A simulated drive: what the filters read, and the truth (N, 3) of x, y (m) and heading (rad, not wrapped)."""

    rig: Rig
    measurements: Measurements
    pose: Floats


@dataclass(frozen=True, slots=True)
class PoseError:
    """Errors of a path against the truth: root mean square of position (m) and of heading (rad)."""

    position_m: float
    heading_rad: float


def drive(
    seed: int, duration_s: float = 60.0, faults: tuple[Fault, ...] = (), mice: int = 3, scale: float = 1.0,
    errors: MouseErrors = EXACT,
) -> PlanarRun:  # fmt: skip
    """A drive from a rest of 4 s on; the mice count `scale` times as much as the rig states."""
    path = Manoeuvres((seed, 0), RESTS)
    run = MiceRun(seed, duration_s, RATE_HZ, ring(mice), mouse_errors=errors, faults=faults, drive=path)
    return _driven(run, scale)


def drive_from_motion(seed: int) -> PlanarRun:
    """A drive at up to 2 m/s that begins at full speed."""
    whole = Manoeuvres((seed, 0), RESTS)
    instants = np.arange(0.0, 60.0, 0.1)
    twist = whole.twist(instants)
    speed = np.hypot(twist[:, 0], twist[:, 1]) * (np.abs(twist[:, 2]) > TURNING_RAD_S)
    fastest = float(instants[np.argmax(speed)])
    run = MiceRun(seed, 60.0, RATE_HZ, ring(3), mouse_errors=EXACT, drive=Hastened(whole, FAST, fastest))
    return _driven(run, 1.0)


def _driven(run: MiceRun, scale: float) -> PlanarRun:
    truth, block = run.truth(), run.measurements()
    rate = np.full_like(block.gyro_rad_s, 0.0)
    rate[:, 2] = truth.wz_rad_s + rate_noise(run.seed, len(block), run.rate_hz)
    rig = Rig(mouse=tuple(replace(mouse, counts_per_m=mouse.counts_per_m / scale) for mouse in run.mice))
    return PlanarRun(rig, replace(block, gyro_rad_s=rate), np.column_stack([truth.x_m, truth.y_m, truth.heading_rad]))


def _all(kind: str, seconds: float) -> tuple[Fault, ...]:
    return tuple(Fault(kind, mouse, FAULT_FROM_S, FAULT_FROM_S + seconds) for mouse in (1, 2, 3))


CASES: dict[str, Callable[[int], PlanarRun]] = {
    "three mice": drive,
    "ten minutes": lambda seed: drive(seed, 600.0),
    "all mice + 5 %": lambda seed: drive(seed, scale=1 / FLOOR_SCALE),
    "all slip 3 s": lambda seed: drive(seed, faults=_all("slip", 3.0)),
    "lifted 3 s": lambda seed: drive(seed, faults=_all("lift", 3.0)),
    "lifted 1 s": lambda seed: drive(seed, faults=_all("lift", 1.0)),
    "two of three lifted 3 s": lambda seed: drive(seed, faults=_all("lift", 3.0)[:2]),
    "one mouse": lambda seed: drive(seed, mice=1),
    "starts in motion": drive_from_motion,
}


def baseline(drive: PlanarRun) -> Floats:
    """x, y (m) and heading (rad) at each sample, (N, 3): the gyro for the heading, the mean of the mice for the way."""
    m, mice = drive.measurements, drive.rig.mouse
    step = np.diff(m.time_s, prepend=m.time_s[0])
    rate = m.gyro_rad_s[:, 2] - m.gyro_rad_s[m.time_s < m.time_s[0] + STILL_S, 2].mean()
    turn = 0.5 * (rate + np.r_[rate[:1], rate[:-1]]) * step
    heading = np.cumsum(turn)
    moved = (m.mice_counts @ [1.0, 1j]) * [np.exp(1j * math.radians(i.angle_deg)) / i.counts_per_m for i in mice]
    moved -= 1j * turn[:, None] * [complex(i.x_m, i.y_m) for i in mice]
    way = np.cumsum(moved.mean(axis=1) * np.exp(1j * (heading - 0.5 * turn)))
    return np.column_stack([way.real, way.imag, heading])


def pose_error(pose: Floats, truth: Floats) -> PoseError:
    """Of poses (N, 3) that count from the first sample, against a truth (N, 3) in any frame."""
    off = errors_from_first(pose, truth)
    return PoseError(float(np.sqrt(np.mean(off[:, 0] ** 2 + off[:, 1] ** 2))), float(np.sqrt(np.mean(off[:, 2] ** 2))))


def errors_from_first(pose: Floats, truth: Floats) -> Floats:
    """Errors (N, 3) in the frame of the first sample: x, y (m), heading (rad)."""
    c, s = math.cos(truth[0, 2]), math.sin(truth[0, 2])
    way = (truth[:, :2] - truth[0, :2]) @ np.array([[c, -s], [s, c]])
    turn = pose[:, 2] - (truth[:, 2] - truth[0, 2])
    return np.column_stack([pose[:, :2] - way, wrapped(turn)])
