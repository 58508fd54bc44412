"""What a log's measurements call for: the motion model, its noise, and the state at the start."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator

import numpy as np

from linkpose.localization.events import Event, Log, Scan
from linkpose.localization.kalman import (
    CONSTANT_VELOCITY,
    HOLONOMIC,
    SUBMERSIBLE,
    UNICYCLE,
    MotionModel,
    covariance_root,
)
from linkpose.localization.linalg import Floats
from linkpose.localization.noise import equicorrelated
from linkpose.localization.settings import CONSTANTS, DRIFT, Pose, Settings
from linkpose.localization.tables import Beacons

DIVING = {"velocity", "depth", "attitude"}  # kinds that only an underwater vehicle's log has
CONTROLS = {UNICYCLE.model: "odometry", HOLONOMIC.model: "twist", SUBMERSIBLE.model: "velocity"}  # the kind that drives
FIRST_S = 5.0  # of ranges from which a tag's first place is fitted; a walk of a few metres at the most
FIT_STEPS = 20
# Beacons near one line give two places if the mirror image is further away than MIRRORED_M (m) and the residual of each
# range grows by less than MIRROR_MISFIT_M (m), the usual error of a radio range. Doubled, more starts are compared.
MIRRORED_M, MIRROR_MISFIT_M = 1.0, 0.5
NEAR_LINE = 0.1  # spread of beacons across their line, in that along it, below which a single range decides no side
# Standard deviations of speed and turn rate of a robot whose log has no odometry (m/s, rad/s): a walk. With twice them,
# a scan may be fitted to the next door.
WALK_M_S, WALK_RAD_S = 1.0, 0.8
FASTEST_M_S = 2.0  # standard deviation of a tag's velocity at the start, on each axis: a walk


def kinds_of(log: Iterable[Event | Scan]) -> set[str]:
    """The kinds of measurement in a log."""
    return {event.kind for event in log}


def vehicle_of(kinds: set[str]) -> MotionModel:
    """The motion model for these kinds of measurement."""
    if kinds & DIVING:
        return SUBMERSIBLE
    if "twist" in kinds:
        return HOLONOMIC
    return UNICYCLE if "odometry" in kinds or "scan" in kinds or "bearing_range" in kinds else CONSTANT_VELOCITY


def never_moves(log: Log) -> bool:
    """Whether the odometry of a log with laser scans is at rest throughout, as without encoders."""
    controls = [event for event in log if isinstance(event, Event) and event.kind in ("odometry", "twist")]
    return "scan" in kinds_of(log) and not any(any(event.values) for event in controls)


def control_holds(log: Log, kind: str) -> dict[int, float]:
    """How long (s) the control at each index of the log holds: until the next; the last as long as usual."""
    at = [i for i, event in enumerate(log) if event.kind == kind]
    times = [log[i].time_s for i in at]
    steps = np.diff(times)
    steps = steps[steps > 0]
    usual = float(np.median(steps)) if len(steps) else 1.0
    return dict(zip(at, _holds(times, usual), strict=True))


def _holds(times: list[float], usual: float) -> Iterator[float]:
    for before, after in itertools.pairwise(times):
        yield after - before if after > before else usual
    if times:
        yield usual


def first_pose(log: Log) -> Event | None:
    """The pose that the log states for its own first instant."""
    first = (event for event in log if isinstance(event, Event) and event.time_s == log[0].time_s)
    return next((event for event in first if event.kind == "pose"), None)


def at_their_height(beacons: Beacons) -> Beacons:
    """The beacons with heights relative to their mean: a tag without a known height is taken to be there."""
    mean = sum(place[2] for place in beacons.values()) / max(len(beacons), 1)
    return {name: (x, y, z - mean) for name, (x, y, z) in beacons.items()}


def places_from_ranges(log: Log, beacons: Beacons) -> list[Pose]:
    """Where a tag may be at the log's start, from the first ranges to at least three beacons; empty where there are
    fewer.

    The ranges of FIRST_S are fitted by Gauss-Newton from each beacon and from their centre; the best fit is the first
    place. Beacons near one line have a second one, its mirror image, where that explains the ranges nearly as well.
    """
    first = _first_ranges(log)
    if len(first) < 3:
        return []
    at = np.array([beacons[name] for name in first])
    ranges = np.array([event.values[0] for event in first.values()])
    cost, place = min((_fitted(at, ranges, start) for start in (at.mean(axis=0), *at)), key=lambda fit: fit[0])
    if not np.isfinite(place).all():
        return []
    centre = at[:, :2].mean(axis=0)
    along = np.linalg.svd(at[:, :2] - centre)[2][0]
    mirrored = 2.0 * (centre + ((place - centre) @ along) * along) - place
    other_cost, other = _fitted(at, ranges, mirrored)
    is_apart = math.dist(place, other) > MIRRORED_M
    explains = other_cost < cost + len(at) * MIRROR_MISFIT_M**2
    return [(float(x), float(y), 0.0) for x, y in ([place, other] if is_apart and explains else [place])]


def _first_ranges(log: Log) -> dict[str, Event]:
    """The first range of FIRST_S to each beacon."""
    first = [e for e in log if isinstance(e, Event) and e.kind == "range" and e.time_s <= log[0].time_s + FIRST_S]
    return {event.beacon: event for event in reversed(first)}


def first_place(log: Log, beacons: Beacons) -> tuple[Pose | None, float]:
    """Where a tag without odometry is at the log's start, and how much (m, 1σ) it may have moved among the ranges that
    say so, or how far the area reaches whose beacons it ranges to. None where neither is known.
    """
    if places := places_from_ranges(log, beacons):
        times = [event.time_s for event in _first_ranges(log).values()]
        return places[0], WALK_M_S * (max(times) - min(times))
    return area_of(log, beacons) or (None, 0.0)


def area_of(log: Log, beacons: Beacons) -> tuple[Pose, float] | None:
    """Where a tag may be that no single fix places: the centre of the beacons that it ranges to, and a standard
    deviation (m) on each axis, as far as they are apart.

    None where they are fewer than three, or near one line: its ranges fit both sides then.
    """
    seen = {event.beacon for event in log if isinstance(event, Event) and event.kind == "range"}
    at = np.array([beacons[name][:2] for name in sorted(seen)])
    if len(at) < 3:
        return None
    centre = at.mean(axis=0)
    spread = np.linalg.svd(at - centre)[1]
    if spread[1] < NEAR_LINE * spread[0]:
        return None
    return (float(centre[0]), float(centre[1]), 0.0), float(np.linalg.norm(np.ptp(at, axis=0)))


def _fitted(beacons: Floats, ranges: Floats, start: Floats) -> tuple[float, Floats]:
    """The sum of squares (m²) and the place (2,) of the least-squares fit of ranges (n,) to beacons (n, 3)."""
    place = np.array([start[0] + 0.1, start[1] - 0.1])
    for _ in range(FIT_STEPS):
        off = place - beacons[:, :2]
        distance = np.maximum(np.linalg.norm(off, axis=1), 1e-6)
        place = place + np.linalg.lstsq(off / distance[:, np.newaxis], ranges - distance, rcond=None)[0]
    return float(np.sum((ranges - distance) ** 2)), place


def start_state(pose: Pose, depth_m: float, settings: Settings, motion: MotionModel) -> tuple[Floats, Floats]:
    """State and standard deviations at the log's start."""
    state, std = np.zeros(len(motion.states)), np.zeros(len(motion.states))
    far, turned = settings.start_std
    prior = {
        "x_m": (pose[0], far),
        "y_m": (pose[1], far),
        "heading_rad": (pose[2], turned),
        "z_m": (-depth_m, max(far, settings.depth_std_m)),
        "wz_rad_s": (0.0, 0.5),
        "x_current_m_s": (0.0, settings.current_std_m_s),
        "y_current_m_s": (0.0, settings.current_std_m_s),
        "x_rate_m_s": (0.0, FASTEST_M_S),
        "y_rate_m_s": (0.0, FASTEST_M_S),
    }
    for i, name in enumerate(motion.states):
        state[i], std[i] = prior[name] if name in prior else (0.0, _nuisance_std(name, settings))
    return state, std


def _nuisance_std(name: str, settings: Settings) -> float:
    """Standard deviation at the start of a state that is no motion: a constant of the ranges, or their drift."""
    if name.startswith(DRIFT):
        return settings.drift_std_m
    return next(std for stem, _, std in CONSTANTS.values() if name.startswith(stem))


def drifts_of(settings: Settings, motion: MotionModel) -> Floats | None:
    """Rates (1/s) and variances (n, 2) of the states that drift; None where none does."""
    if settings.drift_std_m == 0.0:
        return None
    is_drift = np.array([name.startswith(DRIFT) for name in motion.states])
    return np.outer(is_drift, (1.0 / settings.drift_time_s, settings.drift_std_m**2))


def first_control(settings: Settings, vehicle: MotionModel) -> Floats:
    """The control (c,) before the log states one: no motion; for a tag without odometry, its velocity's time (s)."""
    control = np.zeros(vehicle.controls)
    if vehicle is CONSTANT_VELOCITY:
        control[0] = settings.velocity_time_s
    return control


def noise_root(settings: Settings, vehicle: MotionModel) -> Floats:
    """The lower Cholesky factor of Q, (16): off-diagonal between the errors of speed and turn rate, or of a velocity's
    axes.
    """
    speed, turn, velocity = settings.speed_std_m_s, settings.turn_std_rad_s, settings.velocity_std_m_s
    if vehicle is CONSTANT_VELOCITY:
        return settings.acceleration_std_m_s2 * np.eye(vehicle.noises)
    std = {UNICYCLE: (speed, turn), HOLONOMIC: (speed, speed, turn), SUBMERSIBLE: (velocity, velocity, velocity)}[
        vehicle
    ]
    q = np.zeros((vehicle.noises, vehicle.noises))
    q[: len(std), : len(std)] = equicorrelated(np.array(std), settings.motion_correlation)
    if vehicle is SUBMERSIBLE:
        q[3, 3] = settings.yaw_acceleration_std_rad_s2**2
    return covariance_root(q, "Q, the covariance of the motion's noises,")
