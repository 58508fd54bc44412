"""Sensor measurements of an underwater vehicle, by the algorithms of the thesis's Tables 2.2 to 2.9, each a function.

A command moves the vehicle; Doppler log (DVL), attitude sensor (AHRS), ranges to four beacons and depth are sampled
each at its own times; the ranges carry Gaussian noise, an error common to all of them, and outliers. The surface is z =
0, Z points up, depth is -z. Velocities are in the vehicle's axes (forward, left, up). Our copy of the thesis lacks the
values of its Tables 3.5 to 3.7; those below are our own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from linkpose.localization.events import Event, Log
from linkpose.localization.linalg import Floats
from linkpose.localization.tables import Beacons, Truth

STEP_S = 0.01  # of the true motion
MOTION_NOISES = (  # standard deviations of the commanded motion's noise
    "vx_std_m_s", "vy_std_m_s", "vz_std_m_s", "roll_rate_std_rad_s", "pitch_rate_std_rad_s", "yaw_rate_std_rad_s",
)  # fmt: skip
# Table 2.4: update rate of measurement.
PERIODS_S = {"dvl": 0.20, "ahrs": 0.01, "range1": 0.10, "range2": 0.10, "range3": 0.10, "range4": 0.10, "depth": 0.02}
SYNCHRONOUS_PERIOD_S = 0.20  # when all sensors are read at once, the slowest one sets the pace
BEACONS: Beacons = {"1": (0.0, 0.0, -1.0), "2": (60.0, 0.0, -18.0), "3": (60.0, 60.0, -1.0), "4": (0.0, 60.0, -18.0)}
START = (15.0, 15.0, -6.0, 0.0, 0.0, 0.0)  # x, y, z m, roll, pitch, yaw rad


@dataclass(frozen=True, slots=True)
class UnderwaterErrors:
    """What is added. Standard deviations, but for the outliers: how many, and the constant that each adds."""

    motion_velocity_m_s: float = 0.05
    motion_rate_rad_s: float = 0.01
    time_jitter: float = 0.05  # of a sensor's period; 0 where the sensors are synchronous
    velocity_m_s: float = 0.03
    attitude_rad: float = 0.01
    range_m: float = 0.20
    depth_m: float = 0.05
    correlation_m: float = 0.15
    correlation_interval_s: float = 1.0
    outliers: int = 60
    outlier_m: float = 5.0


@dataclass(frozen=True, slots=True)
class UnderwaterPath:
    """The true path: time (N,), pose (N, 6) x, y, z m, roll, pitch, yaw rad, twist (N, 6) m/s and rad/s held from each
    instant on.
    """

    time_s: Floats
    pose: Floats
    twist: Floats

    @property
    def truth(self) -> Truth:
        return Truth(self.time_s, self.pose[:, :3], np.unwrap(self.pose[:, 5]))

    def at(self, times_s: Floats) -> Floats:
        """Poses (M, 6) between the instants: the motion model over the rest of the interval, as Tables 2.6 and 2.7 have
        it.
        """
        index = self.index(times_s)
        rest = times_s - self.time_s[index]
        return np.array([motion_model(self.pose[i], self.twist[i], dt) for i, dt in zip(index, rest, strict=True)])

    def index(self, times_s: Floats) -> NDArray[np.intp]:
        """The instant i with t_i ≤ t < t_i+1."""
        return np.clip(np.searchsorted(self.time_s, times_s, side="right") - 1, 0, len(self.time_s) - 1)


@dataclass(frozen=True, slots=True)
class UnderwaterRun:
    """Truth, log, and what went into the ranges: `ranges_m[k]` as measured at `times_s`, beacon by beacon, `outlier`
    where one was added.
    """

    errors: UnderwaterErrors
    synchronous: bool
    motion: UnderwaterPath
    times_s: dict[str, Floats]
    velocity_m_s: Floats
    attitude_rad: Floats
    depth_m: Floats
    ranges_m: dict[str, Floats]
    outlier: dict[str, NDArray[np.bool_]]
    log: Log = field(repr=False)

    @property
    def outliers(self) -> frozenset[tuple[float, str]]:
        """Time and beacon of each outlier, as the log has them."""
        return frozenset(
            (float(t), beacon)
            for k, beacon in enumerate(BEACONS, 1)
            for t in self.times_s[f"range{k}"][self.outlier[beacon]]
        )


def motion_model(pose: Floats, twist: Floats, interval_s: float) -> Floats:
    """Dead reckoning: (x, y, z, roll, pitch, yaw) after an interval of constant body velocity and body rate."""
    roll, pitch, yaw = pose[3:]
    cr, sr, cp, sp, cy, sy = (
        math.cos(roll),
        math.sin(roll),
        math.cos(pitch),
        math.sin(pitch),
        math.cos(yaw),
        math.sin(yaw),
    )
    u, v, w, p, q, r = twist
    ahead, aside = cp * u + sp * (sr * v + cr * w), cr * v - sr * w
    swing = sr * q + cr * r
    change = (
        cy * ahead - sy * aside,
        sy * ahead + cy * aside,
        cp * (sr * v + cr * w) - sp * u,
        p + math.tan(pitch) * swing,
        cr * q - sr * r,
        swing / cp,
    )
    return np.asarray(pose + interval_s * np.array(change))


def command_at(time_s: float) -> Floats:
    """The command: a slow round of about 30 m across, up and down by some metres, rolling and pitching gently."""
    pitch_rate = 0.05 * 0.4 * math.cos(0.4 * time_s)
    roll_rate = 0.08 * 0.7 * math.cos(0.7 * time_s)
    yaw_rate = 0.06 + 0.05 * math.sin(0.11 * time_s)
    return np.array([0.8, 0.1 * math.sin(0.3 * time_s), 0.1 * math.cos(0.05 * time_s), roll_rate, pitch_rate, yaw_rate])


def motion_data(rng: np.random.Generator, errors: UnderwaterErrors, duration_s: float) -> UnderwaterPath:
    """Table 2.2, motion data: for each t, v_t = command_t + ε, ε ~ N(0, σ²); x_t+1 = motion_model(x_t, v_t)."""
    time = STEP_S * np.arange(round(duration_s / STEP_S) + 1, dtype=np.float64)
    spread = np.repeat((errors.motion_velocity_m_s, errors.motion_rate_rad_s), 3)
    twist = np.array([command_at(t) for t in time]) + rng.normal(0.0, spread, (len(time), 6))
    pose = np.empty((len(time), 6))
    pose[0] = START
    for i in range(len(time) - 1):
        pose[i + 1] = motion_model(pose[i], twist[i], STEP_S)
    return UnderwaterPath(time, pose, twist)


def measurement_time(rng: np.random.Generator, period_s: float, jitter: float, duration_s: float) -> Floats:
    """Table 2.3, sensor measurement time: t_j = j Δ + ε, ε ~ N(0, σ_t²), with σ_t = jitter Δ. Synchronous sensors share
    Δ and have no ε.

    An ε of half a period and more, which would put two samples into the wrong order, is cut.
    """
    count = int(duration_s / period_s)
    nominal = period_s * np.arange(1, count)
    return nominal + np.clip(rng.normal(0.0, 1.0, count - 1) * jitter, -0.49, 0.49) * period_s


def velocity_data(rng: np.random.Generator, motion: UnderwaterPath, times_s: Floats, std_m_s: float) -> Floats:
    """Table 2.5, velocity: the true velocity of the interval t_i ≤ t_j < t_i+1 plus ε ~ N(0, σ²), (18)."""
    return np.asarray(motion.twist[motion.index(times_s), :3] + rng.normal(0.0, std_m_s, (len(times_s), 3)))


def range_data(
    rng: np.random.Generator, motion: UnderwaterPath, times_s: Floats, beacon: tuple[float, float, float], std_m: float
) -> Floats:
    """Table 2.6, range: δ = t_j - t_i, x = motion_model(x_i, v_i, δ), r = ‖b - x‖ + ε, ε ~ N(0, σ²), (19)."""
    return true_range(motion, times_s, beacon) + rng.normal(0.0, std_m, len(times_s))


def depth_data(rng: np.random.Generator, motion: UnderwaterPath, times_s: Floats, std_m: float) -> Floats:
    """Table 2.7, depth: δ = t_j - t_i, x = motion_model(x_i, v_i, δ), d = -z + ε, ε ~ N(0, σ²), (20)."""
    return np.asarray(-motion.at(times_s)[:, 2] + rng.normal(0.0, std_m, len(times_s)))


def correlation(rng: np.random.Generator, errors: UnderwaterErrors, duration_s: float) -> Floats:
    """Table 2.8, correlation: c ~ N(0, σ²), redrawn at the start of every interval; element i is added to all ranges of
    interval i.
    """
    return rng.normal(0.0, errors.correlation_m, int(duration_s / errors.correlation_interval_s) + 1)


def outlier_times(rng: np.random.Generator, errors: UnderwaterErrors, sizes: list[int]) -> list[NDArray[np.bool_]]:
    """Table 2.9, outliers: n instants drawn at random out of all the ranges' (`sizes` a beacon); there a constant is
    added.
    """
    drawn = np.zeros(sum(sizes), np.bool_)
    drawn[rng.choice(len(drawn), min(errors.outliers, len(drawn)), replace=False)] = True
    return np.split(drawn, np.cumsum(sizes)[:-1])


def true_range(motion: UnderwaterPath, times_s: Floats, beacon: tuple[float, float, float]) -> Floats:
    """Distances (M,) m from the true poses to a beacon."""
    return np.asarray(np.linalg.norm(motion.at(times_s)[:, :3] - np.array(beacon), axis=1))


def simulate_underwater(
    seed: int, errors: UnderwaterErrors, duration_s: float = 120.0, synchronous: bool = False
) -> UnderwaterRun:
    """One dive, the same for the same seed. A range is Gaussian noise, correlation and outliers together, (21)."""
    rng = np.random.default_rng(seed)
    motion = motion_data(rng, errors, duration_s)
    times = {
        sensor: measurement_time(rng, SYNCHRONOUS_PERIOD_S, 0.0, duration_s)
        if synchronous
        else measurement_time(rng, period, errors.time_jitter, duration_s)
        for sensor, period in PERIODS_S.items()
    }
    velocity = velocity_data(rng, motion, times["dvl"], errors.velocity_m_s)
    attitude = motion.at(times["ahrs"])[:, 3:] + rng.normal(0.0, errors.attitude_rad, (len(times["ahrs"]), 3))
    depth = depth_data(rng, motion, times["depth"], errors.depth_m)
    common = correlation(rng, errors, duration_s)
    clocks = [times[f"range{k}"] for k in range(1, len(BEACONS) + 1)]
    outliers = outlier_times(rng, errors, [len(clock) for clock in clocks])
    ranges, outlier = {}, {}
    for (beacon, place), clock, drawn in zip(BEACONS.items(), clocks, outliers, strict=True):
        ranges[beacon] = range_data(rng, motion, clock, place, errors.range_m)
        ranges[beacon] += common[(clock / errors.correlation_interval_s).astype(int)] + errors.outlier_m * drawn
        outlier[beacon] = drawn
    log = _log(times, velocity, attitude, depth, ranges)
    return UnderwaterRun(errors, synchronous, motion, times, velocity, attitude, depth, ranges, outlier, log)


def _log(times: dict[str, Floats], velocity: Floats, attitude: Floats, depth: Floats, ranges: dict[str, Floats]) -> Log:
    """All measurements in order of time, after the pose at the start."""
    events = [Event(float(t), "velocity", tuple(row)) for t, row in zip(times["dvl"], velocity.tolist(), strict=True)]
    events += [Event(float(t), "attitude", tuple(row)) for t, row in zip(times["ahrs"], attitude.tolist(), strict=True)]
    events += [Event(float(t), "depth", (value,)) for t, value in zip(times["depth"], depth.tolist(), strict=True)]
    for k, (beacon, values) in enumerate(ranges.items(), 1):
        clock = times[f"range{k}"].tolist()
        events += [Event(t, "range", (value,), beacon) for t, value in zip(clock, values.tolist(), strict=True)]
    events.sort(key=lambda event: event.time_s)
    return [Event(0.0, "pose", (START[0], START[1], START[5])), *events]


@dataclass(frozen=True, slots=True)
class Check:
    """A setting of the simulator, the same figure computed back from a run, and the thesis's, where our copy has it."""

    table: str  # of the thesis
    check: str
    asked: float
    measured: float
    thesis: float | None = None


def self_check(run: UnderwaterRun) -> list[Check]:
    """The statistics of noise and times computed back from the measurements and the true path, as chapter 3.2 does."""
    return [*_time_checks(run), *_motion_checks(run), *_noise_checks(run)]


def _motion_checks(run: UnderwaterRun) -> list[Check]:
    """Table 3.5: how far the true velocities are from the commands."""
    motion, errors = run.motion, run.errors
    noise = motion.twist - np.array([command_at(t) for t in motion.time_s])
    asked = np.repeat((errors.motion_velocity_m_s, errors.motion_rate_rad_s), 3).tolist()
    return [
        Check("3.5", f"motion_{name}", std, float(measured))
        for name, std, measured in zip(MOTION_NOISES, asked, noise.std(axis=0), strict=True)
    ]


def _noise_checks(run: UnderwaterRun) -> list[Check]:
    """Tables 3.6 and 3.7, and the common error and the outliers of Tables 2.8 and 2.9.

    The variance between the intervals gives the common error, and the variance within them the Gaussian noise.
    Both leave out the instants of outliers. An error beyond half an outlier's size counts as one.
    """
    errors, motion = run.errors, run.motion
    spread = np.std(run.velocity_m_s - motion.twist[motion.index(run.times_s["dvl"]), :3])
    turned = run.attitude_rad - motion.at(run.times_s["ahrs"])[:, 3:]
    sunk = run.depth_m + motion.at(run.times_s["depth"])[:, 2]
    off = [
        run.ranges_m[b] - true_range(motion, run.times_s[f"range{k}"], place)
        for k, (b, place) in enumerate(BEACONS.items(), 1)
    ]
    error, clock = np.concatenate(off), np.concatenate([run.times_s[f"range{k}"] for k in range(1, len(off) + 1)])
    drawn = np.concatenate(list(run.outlier.values()))
    within, between = _split_variance(error[~drawn], (clock[~drawn] / errors.correlation_interval_s).astype(int))
    rows = [
        Check("3.6", "velocity_std_m_s", errors.velocity_m_s, float(spread)),
        Check("3.6", "attitude_std_rad", errors.attitude_rad, float(np.std(turned))),
        Check("3.6", "depth_std_m", errors.depth_m, float(np.std(sunk))),
        Check("3.6", "range_std_m", errors.range_m, math.sqrt(within)),
        Check("2.8", "correlation_std_m", errors.correlation_m, math.sqrt(max(between, 0.0))),
        Check("2.9", "outliers", float(errors.outliers), float((np.abs(error) > 0.5 * errors.outlier_m).sum())),
    ]
    if drawn.any():
        rows.append(Check("2.9", "outlier_m", errors.outlier_m, float(np.mean(error[drawn]))))
    return rows


def _split_variance(values: Floats, group: NDArray[np.int_]) -> tuple[float, float]:
    """Variance within the groups and between them (one-way analysis of variance)."""
    counts = np.bincount(group)
    full = counts > 1
    sums, squares = np.bincount(group, values)[full], np.bincount(group, values**2)[full]
    counts = counts[full]
    within = float(np.sum(squares - sums**2 / counts) / np.sum(counts - 1))
    between = float(np.var(sums / counts, ddof=1) - within * np.mean(1.0 / counts))
    return within, between


def _time_checks(run: UnderwaterRun) -> list[Check]:
    """Table 2.4, update rates, and where the sensors are not synchronous Table 2.3, the jitter of their times."""
    periods = PERIODS_S if not run.synchronous else dict.fromkeys(PERIODS_S, SYNCHRONOUS_PERIOD_S)
    rows = [
        Check("2.4", f"{sensor}_period_s", period, _mean_period(run.times_s[sensor]), PERIODS_S[sensor])
        for sensor, period in periods.items()
    ]
    if not run.synchronous:
        rows += [_jitter_check(run, sensor) for sensor in PERIODS_S]
    return rows


def _mean_period(times_s: Floats) -> float:
    return float((times_s[-1] - times_s[0]) / (len(times_s) - 1))


def _jitter_check(run: UnderwaterRun, sensor: str) -> Check:
    times, period = run.times_s[sensor], PERIODS_S[sensor]
    jitter = times - period * np.arange(1, len(times) + 1)
    return Check("2.3", f"{sensor}_time_std_s", run.errors.time_jitter * period, float(np.std(jitter)))
