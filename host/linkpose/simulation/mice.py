"""A robot on the floor with optical mice under it and an MPU-6050 on it.

A mouse gives the whole counts of the way it has seen; the rest stays in it, so nothing is lost however the time is cut.
The counts since the start are therefore a function of time, like the truth, and a run is the same whether it is made
whole, in blocks, or sample by sample.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import LinkposeError
from linkpose.sensors.barometer import Barometer
from linkpose.sensors.conversion import BoardSettings, Converter, RawSamples
from linkpose.sensors.devices import MAX_MICE, Sensors
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY
from linkpose.sensors.rig import Mouse, Rig
from linkpose.simulation import imu
from linkpose.simulation.drive import STILL_S, Drive, DrivenPath, Manoeuvres, Move, Steady
from linkpose.wire.frames import sample
from linkpose.wire.messages import DeviceFamily, DeviceState, HelloMouse, Sample, SampleFlags

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

PAPER_SIDE_M = 0.3
PAPER_TWIST = (0.01, 0.01, 0.0)  # m/s, m/s, rad/s
PAPER_NOISE_M_S = 0.0025
NOISE_S = 0.01  # for which a mouse's noise keeps its value
_POLL_S = 0.0075  # that the firmware allows the mice for an answer before it polls them again at a tick
_TEMPERATURE_DEGC = 27.0
_BLOCK = 1000  # samples, or draws of noise, made at once

# Streams of random numbers, apart from each other so that a setting changes only what it is about.
_DRIVE, _ERRORS, _PHASE, _SCATTER, _FLOOR, _IMU_NOISE, _MOUNTING = range(7)

PATHS = ("drive", "paper", "line", "turn")
SEEN = {"slip": 0.3, "lift": 0.0, "unplug": 0.0}  # kind of fault -> share of its way that the mouse counts


@dataclass(frozen=True, slots=True)
class Fault:
    """Something that befalls a mouse (1 for the first) from `start_s` to `end_s`."""

    kind: str
    mouse: int
    start_s: float
    end_s: float

    @staticmethod
    def parse(text: str) -> Fault:
        """From KIND:MOUSE:FROM-TO, such as lift:2:5-8 (s). Raises LinkposeError for anything else."""
        try:
            kind, mouse, times = text.split(":")
            start, end = times.split("-")
            fault = Fault(kind, int(mouse), float(start), float(end))
        except ValueError:
            raise LinkposeError(f"{text!r} is no fault; write KIND:MOUSE:FROM-TO in seconds, as lift:2:5-8") from None
        if kind not in SEEN or not 0 <= fault.start_s < fault.end_s < math.inf:
            raise LinkposeError(f"{text!r} is no fault; KIND is {', '.join(SEEN)}, and FROM is before TO")
        return fault


@dataclass(frozen=True, slots=True)
class MouseErrors:
    """How the mice err. `scatter` and `floor` are standard deviations as a share of the speed, drawn each NOISE_S: of
    each mouse by itself, and common to all. `uniform_m_s` is noise between ± that velocity. `scale` and `angle_deg` are
    standard deviations of the true scale and angle about the rig file's values.
    """

    scatter: float = 0.01
    floor: float = 0.003
    uniform_m_s: float = 0.0
    scale: float = 0.002
    angle_deg: float = 0.1


LEVELS = {
    "calibrated": MouseErrors(),
    "datasheet": MouseErrors(scale=0.04, angle_deg=3.0),  # as bought, and mounted by eye
    "none": MouseErrors(0.0, 0.0, 0.0, 0.0, 0.0),
}
PAPER_ERRORS = MouseErrors(0.0, 0.0, PAPER_NOISE_M_S, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class PlanarTruth:
    """The truth at N instants: pose in the floor's frame, velocity in the robot's (x ahead, y to the left, z up)."""

    time_s: Floats
    x_m: Floats
    y_m: Floats
    heading_rad: Floats  # not wrapped
    vx_m_s: Floats
    vy_m_s: Floats
    wz_rad_s: Floats

    def columns(self) -> dict[str, Floats]:
        """As a truth file has them."""
        return {name: getattr(self, name) for name in self.__slots__}


def ring(count: int, radius_m: float = PAPER_SIDE_M / math.sqrt(3), counts_per_m: float = 8000.0) -> tuple[Mouse, ...]:
    """Upright mice on a regular polygon about the robot's centre, the first one ahead: (1) of the paper with θ = 0."""
    angles = [2 * math.pi * i / count for i in range(count)]
    return tuple(Mouse(radius_m * math.cos(a), radius_m * math.sin(a), 0.0, counts_per_m) for a in angles)


class MiceRun:
    """A run of the simulated robot. Pure: every method gives the same for the same arguments, in any order."""

    hello_sensors = Sensors.MPU6050

    def __init__(
        self,
        seed: int = 0,
        duration_s: float | None = 60.0,
        rate_hz: float = 100.0,
        mice: tuple[Mouse, ...] | None = None,
        path: str = "drive",
        errors: str = "calibrated",
        *,
        mouse_errors: MouseErrors | None = None,
        faults: tuple[Fault, ...] = (),
        drive: Drive | None = None,
        length_m: float = 2.0,
        accel_range_g: int = 8,
        gyro_range_deg_s: int = 1000,
    ) -> None:
        """`mice` are what a user would write into a rig file, three on the paper's triangle unless given; what they are
        differs by `errors` ("calibrated", "datasheet", "none") or `mouse_errors`. `path` is "drive", "paper" (its
        steady (1, 1) cm/s), "line" (of `length_m`) or "turn" (a full one on the spot); `drive` takes its place.
        `duration_s` None never ends (a live board). Raises LinkposeError for a value that cannot be.
        """
        mice = ring(3) if mice is None else mice
        _check(seed, duration_s, rate_hz, len(mice), path, errors, faults, length_m)
        self.seed, self.duration_s, self.rate_hz, self.mice, self.errors = seed, duration_s, rate_hz, mice, errors
        self.path = path
        self.accel_range_g, self.gyro_range_deg_s, self.faults = accel_range_g, gyro_range_deg_s, faults
        self._mouse_errors = mouse_errors or LEVELS[errors]
        self._ticks_per_reading = math.ceil(round(_POLL_S * rate_hz, 9))
        self._drive = drive or _drive(path, seed, duration_s, length_m)
        self._track = DrivenPath(self._drive)
        self._imu_errors = imu.ImuErrors.draw(
            errors, np.random.default_rng([seed, _ERRORS]), accel_range_g, gyro_range_deg_s
        )
        self._place = np.array([(mouse.x_m, mouse.y_m) for mouse in mice])
        off = np.random.default_rng([seed, _MOUNTING]).standard_normal((MAX_MICE, 2))[: len(mice)]
        self.true_counts_per_m = np.array([m.counts_per_m for m in mice]) * (1 + self._mouse_errors.scale * off[:, 0])
        self.true_angle_deg = np.array([m.angle_deg for m in mice]) + self._mouse_errors.angle_deg * off[:, 1]
        self._phase = np.random.default_rng([seed, _PHASE]).uniform(0, 1, (MAX_MICE, 2))[: len(mice)]
        self._noise_ways = [np.zeros((len(mice), 2))]  # what the noise has added up to at the start of each block

    @property
    def rig(self) -> Rig:
        """The rig file that belongs to the run."""
        return Rig(mouse=self.mice)

    @property
    def hello_mice(self) -> tuple[HelloMouse, ...]:
        """The mice as HELLO reports them."""
        return tuple(
            HelloMouse(DeviceState.OK, 0x00, 0x60, min(255, round(mouse.counts_per_m / 1000)), 200, 0)
            for mouse in self.mice
        )

    @property
    def count(self) -> int | None:
        """How many samples the run has, None when it never ends."""
        return None if self.duration_s is None else round(self.duration_s * self.rate_hz)

    def at(self, time_s: Floats) -> PlanarTruth:
        """The truth at any instants (N,), s."""
        time_s = np.atleast_1d(np.asarray(time_s, dtype=np.float64))
        return PlanarTruth(time_s, *self._track.pose(time_s).T, *self._drive.twist(time_s).T)

    def truth(self) -> PlanarTruth:
        """The truth at every sample. Only of a run that ends."""
        if self.count is None:
            raise LinkposeError("a run without an end has no whole truth: give it a duration")
        return self.at(np.arange(self.count) / self.rate_hz)

    # ---- mice ----

    def counts(self, time_s: Floats) -> Integers:
        """Counts dx, dy of every mouse since the start, (N, M, 2), at any instants (N,), in the mice's own axes."""
        way = self._seen(np.maximum(time_s, 0.0))
        angle = np.radians(self.true_angle_deg)
        c, s = np.cos(angle), np.sin(angle)
        own = np.stack([c * way[..., 0] + s * way[..., 1], c * way[..., 1] - s * way[..., 0]], axis=-1)
        return np.floor(own * self.true_counts_per_m[:, None] + self._phase).astype(np.int64)

    def plugged(self, time_s: Floats) -> NDArray[np.bool_]:
        """Whether each mouse is there, (N, M)."""
        there = np.ones((len(time_s), len(self.mice)), np.bool_)
        for fault in self.faults:
            if fault.kind == "unplug":
                there[:, fault.mouse - 1] &= (time_s < fault.start_s) | (time_s >= fault.end_s)
        return there

    def _seen(self, time_s: Floats) -> Floats:
        """The way (N, M, 2) that the mice have seen in the robot's axes, m."""
        way = self._way(time_s)
        for fault in self.faults:
            i, hidden = fault.mouse - 1, 1 - SEEN[fault.kind]
            during = self._way(np.clip(time_s, fault.start_s, fault.end_s))[:, i]
            way[:, i] -= hidden * (during - self._way(np.array([fault.start_s]))[:, i])
        return way

    def _way(self, time_s: Floats) -> Floats:
        """The same without faults: (6), (7) integrated, and the noise."""
        q = self._drive.way(time_s)
        x = q[:, None, 0] - q[:, None, 2] * self._place[:, 1]
        y = q[:, None, 1] + q[:, None, 2] * self._place[:, 0]
        return np.stack([x, y], axis=-1) + self._noise_way(time_s)

    def _noise_way(self, time_s: Floats) -> Floats:
        """What the noise adds to the way, (N, M, 2): its velocity is constant over NOISE_S."""
        draw = time_s / NOISE_S
        blocks = np.floor(draw / _BLOCK + 1e-9).astype(np.int64)
        out = np.empty((len(time_s), len(self.mice), 2))
        for block in np.unique(blocks):
            while len(self._noise_ways) <= block:
                self._noise_ways.append(self._noise_ways[-1] + self._noise_steps(len(self._noise_ways) - 1)[-1])
            steps = self._noise_steps(int(block))
            at = draw[blocks == block] - block * _BLOCK
            whole = np.clip(np.floor(at + 1e-9).astype(np.int64), 0, _BLOCK - 1)
            part = (at - whole)[:, None, None]
            out[blocks == block] = self._noise_ways[block] + (1 - part) * steps[whole] + part * steps[whole + 1]
        return out

    def _noise_steps(self, block: int) -> Floats:
        """The noise's way within a block of draws, (_BLOCK + 1, M, 2)."""
        errors, mice = self._mouse_errors, len(self.mice)
        middle: Floats = (block * _BLOCK + np.arange(_BLOCK, dtype=np.float64) + 0.5) * NOISE_S
        v = self._drive.twist(middle)
        vx, vy = v[:, None, 0] - v[:, None, 2] * self._place[:, 1], v[:, None, 1] + v[:, None, 2] * self._place[:, 0]
        speed = np.hypot(vx, vy)[:, :, None]
        rng = np.random.default_rng([self.seed, _SCATTER, block])
        velocity = errors.scatter * speed * rng.standard_normal((_BLOCK, MAX_MICE, 2))[:, :mice]
        velocity += errors.uniform_m_s * rng.uniform(-1, 1, (_BLOCK, MAX_MICE, 2))[:, :mice]
        common = np.random.default_rng([self.seed, _FLOOR, block]).standard_normal((_BLOCK, 1, 2))
        velocity += errors.floor * np.hypot(v[:, 0], v[:, 1])[:, None, None] * common
        return np.concatenate([np.zeros((1, mice, 2)), np.cumsum(velocity * NOISE_S, axis=0)])

    # ---- samples ----

    def imu_counts(self, time_s: Floats, first: int) -> NDArray[np.int16]:
        """Raw accel xyz, temperature, gyro xyz (N, 7) as in the MPU-6050's burst, at any instants (N,).

        `first` is the number of the first of these readings since the start: it names their noise.
        """
        noise = imu.white((self.seed, _IMU_NOISE), first, len(time_s), 7)
        twist, change = self._drive.twist(time_s), self._drive.acceleration(time_s)
        force = np.column_stack(
            [
                change[:, 0] - twist[:, 2] * twist[:, 1],
                change[:, 1] + twist[:, 2] * twist[:, 0],
                np.full(len(time_s), STANDARD_GRAVITY),
            ]
        )
        errors = self._imu_errors
        accel = force @ errors.accel_matrix.T + errors.accel_bias_m_s2 + errors.accel_noise_m_s2 * noise[:, :3]
        rate = np.outer(twist[:, 2], errors.gyro_matrix[:, 2]) + errors.gyro_bias_rad_s
        rate = rate + errors.gyro_noise_rad_s * noise[:, 4:]
        return np.column_stack(
            [
                imu.accel_counts(accel, self.accel_range_g),
                imu.temperature_counts(np.full(len(time_s), _TEMPERATURE_DEGC)),
                imu.gyro_counts(rate, self.gyro_range_deg_s),
            ]
        )

    def block(self, first: int, count: int) -> list[Sample]:
        """The SAMPLEs of ticks first … first + count − 1. The counts of the first tick of all are 0."""
        ticks = np.arange(first - 1, first + count)
        time_s = np.maximum(ticks, 0) / self.rate_hz
        since_read = ticks % self._ticks_per_reading
        moved = np.diff(self.counts((ticks - since_read) / self.rate_hz), axis=0)
        there = self.plugged(time_s[1:])
        if np.abs(moved).max(initial=0) > 32767:
            raise LinkposeError("a mouse moves by more counts in a sample than the wire holds; lower counts_per_m")
        flags = int(SampleFlags.IMU_VALID) + there @ (int(SampleFlags.MOUSE1_VALID) << np.arange(len(self.mice)))
        flags = flags + np.where(since_read[1:], int(SampleFlags.MICE_STALE), 0)
        counts = self.imu_counts(time_s[1:], first).tolist()
        stamps = np.rint(time_s[1:] * 1e6).astype(np.int64).tolist()
        own = map(tuple, np.where(there[:, :, None], moved, 0).reshape(count, -1).tolist())
        return [
            sample(tick & 0xFFFF, t_us & 0xFFFFFFFF, bits, (ax, ay, az, temp, gx, gy, gz), mice=mice)
            for tick, t_us, (ax, ay, az, temp, gx, gy, gz), bits, mice in zip(
                ticks[1:].tolist(), stamps, counts, flags.tolist(), own, strict=True
            )
        ]

    def samples(self) -> Iterator[Sample]:
        """All SAMPLEs one by one, in bounded memory; without end when the run has none."""
        first = 0
        while self.count is None or first < self.count:
            count = _BLOCK if self.count is None else min(_BLOCK, self.count - first)
            yield from self.block(first, count)
            first += count

    def measurements(self) -> Measurements:
        """The whole run as a recording of it would be read. Only of a run that ends."""
        if self.count is None:
            raise LinkposeError("a run without an end has no whole recording: give it a duration")
        no_baro = Barometer(DeviceFamily.NONE, (0,) * 12, 0)
        ranges = (self.accel_range_g, self.gyro_range_deg_s)
        converter = Converter(BoardSettings(round(self.rate_hz), *ranges, 0, 0, no_baro, len(self.mice)))
        samples = list(self.samples())
        raw = RawSamples.of(samples, converter.mouse_ports)
        flags = np.array([sample.flags for sample in samples], dtype=np.int64)
        return converter.convert(raw, np.arange(len(samples)) / self.rate_hz, flags)


def _drive(path: str, seed: int, duration_s: float | None, length_m: float) -> Drive:
    if path == "paper":
        return Steady(PAPER_TWIST)
    if path == "drive":
        return Manoeuvres((seed, _DRIVE))
    if duration_s is None:
        raise LinkposeError(f"the path {path!r} needs a duration")
    return Move((length_m, 0.0, 0.0) if path == "line" else (0.0, 0.0, 2 * math.pi), duration_s)


def _check(
    seed: int, duration_s: float | None, rate_hz: float, mice: int, path: str, errors: str, faults: tuple[Fault, ...],
    length_m: float,
) -> None:  # fmt: skip
    if seed < 0:
        raise LinkposeError(f"the seed is {seed}: take a whole number from 0 up")
    if not 50 <= rate_hz <= 500:
        raise LinkposeError(f"the board samples at 50 to 500 Hz, not at {rate_hz:g} Hz")
    if not 1 <= mice <= MAX_MICE:
        raise LinkposeError(f"{mice} mice cannot be: the board serves 1 to {MAX_MICE}")
    if path not in PATHS:
        raise LinkposeError(f"there is no path called {path!r}: take {', '.join(PATHS)}")
    if errors not in LEVELS:
        raise LinkposeError(f"there are no errors called {errors!r}: take {', '.join(LEVELS)}")
    shortest = 2 * STILL_S + 1 if path in ("line", "turn") else 1.0
    if duration_s is not None and not shortest <= duration_s < math.inf:
        raise LinkposeError(f"a duration of {duration_s} s is none for this path: take {shortest:g} s or more")
    if not 0.01 <= length_m <= 100:
        raise LinkposeError(f"a line of {length_m:g} m cannot be: take 0.01 to 100 m")
    for fault in faults:
        if not 1 <= fault.mouse <= mice:
            raise LinkposeError(f"there is no mouse {fault.mouse} for a fault to befall: there are {mice}")
