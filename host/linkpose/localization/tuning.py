"""Estimates the noises of a log's sensors and motion from the log itself, by maximum likelihood.

The likelihood is that of the innovations of an extended Kalman filter (Mehra, "On the identification of variances and
adaptive Kalman filtering", IEEE Transactions on Automatic Control 15 (1970), pages 175-184), with Student's t instead
of the normal distribution, since ranges have outliers. Errors of one beacon that persist from one sighting to the next
are no independent measurements. For ranges, the likelihood compares white errors with white and drifting ones (states
of the filter). For landmarks and streams, the correlation time of the errors is estimated from the autocorrelation of
the innovations.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from linkpose.localization.events import NAMED, Event, Log
from linkpose.localization.gate import chi_square_quantile
from linkpose.localization.kalman import CONSTANT_VELOCITY, SUBMERSIBLE
from linkpose.localization.likelihood import Rows, run_filter
from linkpose.localization.linalg import Floats
from linkpose.localization.localizer import Localizer
from linkpose.localization.models import motion_jacobians
from linkpose.localization.settings import Pose, Settings
from linkpose.localization.steps import Gaussian
from linkpose.localization.sum_filter import outlier_density
from linkpose.localization.tables import Beacons
from linkpose.localization.vehicle import (
    CONTROLS,
    control_holds,
    drifts_of,
    first_control,
    kinds_of,
    noise_root,
    vehicle_of,
)

# Fewer measurements do not determine four noises, or drifts beside them; more than MOST add time, not accuracy. Of a
# longer log of ranges, the first DENSE show how errors change from one to the next, and the rest, evenly spread, how
# long they persist.
FEWEST, FEWEST_FOR_DRIFT, MOST, DENSE = 100, 200, 1200, 400
# Readings of depth and attitude nearer than this (s) to the last one take no part in the search: with sensors of 50 and
# 100 Hz, it takes a fifth of the time then, and finds the same noises.
APART_S = 0.1
MEAN_S = 0.2  # over which controls are averaged: a robot that turns by 1 rad/s goes 0.5 % less far on the chord
GATE = 0.999  # of the filter whose innovations count
# Factors of the search, and the standard deviation (ln) of the prior of each noise around its default.
FACTORS, PRIOR_LN = (3.0, 1.7, 1.25), 3.0
SWEEPS = 4
# Lags (s) at whose intervals the autocorrelation is estimated, the fewest pairs of each, and the correlation below
# which errors count as independent (three standard deviations of 200 pairs are 0.2).
LAGS_S = np.array([0.0, 0.15, 0.35, 0.75, 1.5, 3.0, 6.0, 12.0, 24.0])
FEWEST_PAIRS, CORRELATED = 50, 0.15
MOST_STEPS = 200  # sightings of one beacon between the two of a pair
# Drifting errors are assumed where they make the log more likely by e^DRIFT_LEAD (-410, -149 and -18 in three public
# logs with such errors, -1.5 in one without). They persist for at least SHORTEST_DRIFT usual intervals between two
# sightings of a beacon, as errors of a shorter time are white, and at most for LONGEST_DRIFT of the log, as an error
# that persists longer is not distinguished from a constant. Twice LONGEST_DRIFT: σ of slow errors grows by 1.4.
DRIFT_LEAD, SHORTEST_DRIFT, LONGEST_DRIFT = 10.0, 2.0, 0.5
# The search begins at the best of a grid: factors on σ of the white part and of the drift, and shares (of the
# logarithm) between the shortest and the longest time of the drift.
GRID_WHITE, GRID_DRIFT, GRID_TIME = (0.4, 0.8), (0.5, 1.0, 2.0, 4.0), (0.15, 0.4, 0.6, 0.85)
# Noises that trade against each other beside a drift: the search also moves along these pairs, with these powers of a
# factor. Among the noises of landmarks, whose errors are no white noise, it found worse paths with them.
PAIRS = (
    {"range": -1.0, "growth": 1.0}, {"speed": 1.0, "turn": -1.0}, {"range": -1.0, "drift": 1.0},
    {"drift": 1.0, "drift_time": 2.0}, {"drift": -1.0, "speed": 1.0},
)  # fmt: skip
# One of two starts is taken where it makes the log more likely by e^SIDE_LEAD; with less, the user states it.
SIDE_LEAD = 20.0
MOST_DRIFTING = 16  # beacons: each adds a state, and the time of a step grows with their square
TUNABLE = (
    "range", "growth", "bearing", "speed", "turn", "velocity", "yaw", "acceleration", "error_time", "drift", "current",
    "sound",
)  # fmt: skip
PASSES = 3
# Standard deviation of a sea current on each axis (m/s), at the start; twice it widens the first minute.
CURRENT_STD_M_S = 0.3
# Lower bounds of the odometry's noises (m/s and rad/s of one sample): wheels slip now and then, which Student's t
# ignores as outliers. In the public log Plaza 1, whose turn rates are those of the truth, 0.01 takes the errors within
# 2σ of the smoothed path from 89 to 94 %.
LEAST_SPEED_M_S, LEAST_TURN_RAD_S = 0.01, 0.01
# Lower bound of an acoustic range's drift under water, as a share of the usual range: the speed of sound varies between
# 1450 and 1540 m/s with temperature and salt. A drift that hides in the path for a whole log looks smaller than it is;
# one that persists for less than SEEN_DRIFT of the log changes often enough to be seen. In the public log GOATS 14 it
# persists for 0.4 of it, in simulated dives for 0.01.
LEAST_ACOUSTIC, SEEN_DRIFT = 0.01, 0.1
# Ranges within FIX_S (s) to so many beacons are a fix. Where a step between two has FREE_STEPS times the noise of a
# range or more, the motion adds a tenth of the information or less, and its σ is multiplied by FREE_STEPS: the scale
# error that it implies falls to a ninth, from 0.15 in a simulated circle.
FIX_S, FEWEST_OF_FIX, FREE_STEPS = 0.5, 3, 3.0
NORMAL_MEDIAN = 0.6745  # of the absolute value of a standard normal variable


def warm_up() -> None:
    """Compiles the likelihood, or loads it compiled."""
    log: Log = [Event(0.0, "pose", (0.0, 0.0, 0.0)), Event(0.1, "range", (1.0,), "1")]
    settings = Settings(drift_std_m=0.1)
    start = Localizer(log, "ekf", settings, None, {"1": (1.0, 0.0, 0.0)})
    rows, events = _arrays(log, start, None)
    _run(rows, events, settings, start)


def tune(log: Log, settings: Settings, beacons: Beacons, free: tuple[str, ...]) -> Settings:
    """The settings with the noises `free` (of TUNABLE) estimated from the log; unchanged where the log has fewer than
    FEWEST ranges and bearings, or where no noise that was tried makes the filter work.
    """
    if sum(event.kind in NAMED for event in log) < FEWEST:
        return settings
    if "drift" in free and _may_drift(log):
        return _tune_ranges(log, settings, beacons, free)
    names = [name for name in free if name in _present(log)]
    tuned = replace(settings, error_time_s=settings.error_time_s or 0.0)
    for _ in range(PASSES):
        found, cost = _search(thinned(log, tuned.error_time_s or 0.0), settings, beacons, dict.fromkeys(names, 0.0))
        if math.isfinite(cost):
            tuned = replace(_applied(settings, found), error_time_s=tuned.error_time_s)
        tuned, error_time = _as_large_as_innovations(log, tuned, beacons, names)
        if "error_time" not in free or error_time <= 1.3 * (tuned.error_time_s or 0.0):
            break
        tuned = replace(tuned, error_time_s=error_time)
    return _with_slip(tuned, free)


def likelier_start(
    log: Log, settings: Settings, beacons: Beacons, free: tuple[str, ...], starts: Sequence[Pose]
) -> Pose | None:
    """The one of several starts that makes the log clearly more likely than each other one, or None."""
    part, names = thinned(log, 0.0), _noises_of_ranges(log, free)
    costs = [_search(part, replace(settings, start=start), beacons, dict.fromkeys(names, 0.0))[1] for start in starts]
    best = int(np.argmin(costs))
    return starts[best] if min(np.delete(costs, best), default=math.inf) > costs[best] + SIDE_LEAD else None


def _tune_ranges(log: Log, settings: Settings, beacons: Beacons, free: tuple[str, ...]) -> Settings:
    """As `tune`, for ranges whose errors may drift."""
    white = replace(settings, error_time_s=settings.error_time_s or 0.0)
    spread, is_diving = spread_out(_apart(log)), vehicle_of(kinds_of(log)) is SUBMERSIBLE
    names = _noises_of_ranges(log, free)
    found, cost = _search(spread, white, beacons, dict.fromkeys(names, 0.0))
    if not math.isfinite(cost):
        return white
    for further in ("current", "sound"):
        if further in free and is_diving:
            water = _with_water(white, further)
            other, other_cost = _search(spread, water, beacons, dict.fromkeys(names, 0.0))
            if other_cost < cost - DRIFT_LEAD:
                white, found, cost = water, other, other_cost
    tuned = _applied(white, found)
    bounds = _drift_times(log)
    if bounds[0] < bounds[1]:
        lowest = cost - DRIFT_LEAD
        usual_s, first = math.sqrt(bounds[0] * bounds[1]), {**found, "drift": 0.0, "drift_time": 0.0}
        each = replace(white, drift_std_m=tuned.ranges.std_m, drift_time_s=usual_s)
        for drifting in (each, replace(each, drift_is_shared=True)):
            drift, drift_cost = _search(spread, drifting, beacons, first, bounds, stop_above=cost)
            if drift_cost < lowest:
                tuned, lowest = _applied(drifting, drift), drift_cost
        hides = tuned.drift_time_s > SEEN_DRIFT * (log[-1].time_s - log[0].time_s)
        if tuned.drift_std_m and hides and is_diving:
            usual = float(np.median([e.values[0] for e in log if isinstance(e, Event) and e.kind == "range"]))
            tuned = replace(tuned, drift_std_m=max(tuned.drift_std_m, LEAST_ACOUSTIC * usual))
    tuned = _with_slip(_as_large_as_innovations(log, tuned, beacons, names)[0], free)
    return _with_free_steps(log, tuned) if "acceleration" in names else tuned


def _noises_of_ranges(log: Log, free: tuple[str, ...]) -> list[str]:
    """Those of `free` that a log with ranges has; those of the ranges in any case."""
    return [name for name in free if name in _present(log) | {"range", "growth"}]


def _with_water(settings: Settings, constant: str) -> Settings:
    """The settings with one more constant of the water to estimate: its current, or the speed of sound."""
    if constant == "current":
        return replace(settings, current_std_m_s=CURRENT_STD_M_S)
    return replace(settings, estimate=(*settings.estimate, "scale"))


def _with_slip(settings: Settings, free: tuple[str, ...]) -> Settings:
    """The settings with the free noises of the odometry at their lower bounds or above."""
    speed = max(settings.speed_std_m_s, LEAST_SPEED_M_S if "speed" in free else 0.0)
    turn = max(settings.turn_std_rad_s, LEAST_TURN_RAD_S if "turn" in free else 0.0)
    return replace(settings, speed_std_m_s=speed, turn_std_rad_s=turn)


def _with_free_steps(log: Log, settings: Settings) -> Settings:
    """The settings with a wider motion where each fix of a tag without odometry determines its place by itself.

    The steps between slow fixes are known from the fixes alone. A motion as narrow as they are likes them shorter, and
    shortens them by way of the ranges' scale error.
    """
    times: list[float] = []
    beacons: set[str] = set()
    fixes: list[tuple[float, int]] = []
    ranges = [event for event in log if isinstance(event, Event) and event.kind == "range"]
    for event in ranges:
        if times and event.time_s > times[0] + FIX_S:
            fixes.append((times[0], len(times) if len(beacons) >= FEWEST_OF_FIX else 0))
            times, beacons = [], set()
        times.append(event.time_s)
        beacons.add(event.beacon)
    placed = [time for time, size in fixes if size]
    if len(placed) < 2 or sum(size for _, size in fixes) < 0.5 * len(ranges):
        return settings
    interval = float(np.median(np.diff(placed)))
    by_state, by_noise = np.zeros((4, 4)), np.zeros((4, CONSTANT_VELOCITY.noises))
    motion_jacobians(
        CONSTANT_VELOCITY.model, np.zeros(4), first_control(settings, CONSTANT_VELOCITY), interval, by_state, by_noise
    )
    step = settings.acceleration_std_m_s2 * float(np.linalg.norm(by_noise[0])) / math.sqrt(interval)
    usual = float(np.median([event.values[0] for event in ranges]))
    noise = math.sqrt(settings.ranges.variances(np.array([usual]), usual)[0])
    return _with(settings, "acceleration", FREE_STEPS if step > FREE_STEPS * noise else 1.0)


def _may_drift(log: Log) -> bool:
    """Whether the log has ranges alone, to a number of beacons of which each can have a state."""
    beacons = {event.beacon for event in log if isinstance(event, Event) and event.kind == "range"}
    ranges = sum(event.kind == "range" for event in log)
    return len(beacons) <= MOST_DRIFTING and ranges >= FEWEST_FOR_DRIFT and "bearing_range" not in kinds_of(log)


def _drift_times(log: Log) -> tuple[float, float]:
    """The shortest and the longest time (s) for which an error can be found to drift."""
    times: dict[str, list[float]] = {}
    for event in log:
        if isinstance(event, Event) and event.kind == "range":
            times.setdefault(event.beacon, []).append(event.time_s)
    usual = float(np.median(np.concatenate([np.diff(each) for each in times.values()])))
    return SHORTEST_DRIFT * usual, LONGEST_DRIFT * (log[-1].time_s - log[0].time_s)


def described(settings: Settings, log: Log) -> str:
    """The noises that the log's measurements have, in words."""
    present, ranges = _present(log), settings.ranges
    parts = []
    if "range" in present or settings.drift_std_m:
        parts.append(f"range {ranges.std_m:.3g} m" + (f" + {ranges.growth:.2%}" if ranges.model == "affine" else ""))
    words = (
        ("bearing", settings.bearing_std_rad, "rad"), ("speed", settings.speed_std_m_s, "m/s"),
        ("turn", settings.turn_std_rad_s, "rad/s"), ("velocity", settings.velocity_std_m_s, "m/s"),
        ("acceleration", settings.acceleration_std_m_s2, "m/s²"),
    )  # fmt: skip
    parts += [f"{name} {value:.3g} {unit}" for name, value, unit in words if name in present]
    if settings.current_std_m_s:
        parts.append("a constant current")
    if vehicle_of(kinds_of(log)) is SUBMERSIBLE and "scale" in settings.estimate:
        parts.append("the speed of sound")
    if settings.drift_std_m:
        shared = " in common" if settings.drift_is_shared else ""
        parts.append(f"drift {settings.drift_std_m:.3g} m over {settings.drift_time_s:.2g} s{shared}")
    elif settings.error_time_s:
        parts.append(f"errors persist for {settings.error_time_s:.2g} s")
    return ", ".join(parts)


def _as_large_as_innovations(
    log: Log, settings: Settings, beacons: Beacons, names: list[str]
) -> tuple[Settings, float]:
    """Raises the noises of range and bearing to the size of the whole log's innovations, by their medians: Student's t,
    and a part of the log, let them be too small. Returns how long the errors persist (s), too.
    """
    start = Localizer(log, "ekf", settings, None, beacons)
    rows, events = _arrays(log, start, None)
    innovations = _run(rows, events, settings, start)[1]
    size = [np.abs(column[column != 0.0]) for column in innovations.T]
    factors = [float(np.median(column)) / NORMAL_MEDIAN if len(column) else 1.0 for column in size]
    for name, factor in (("range", factors[0]), ("growth", factors[0]), ("bearing", factors[1])):
        if name in names:
            settings = _with(settings, name, max(1.0, factor))
    return settings, correlation_time(events, innovations)


def _present(log: Log) -> set[str]:
    """The noises that the log's measurements and its motion model have."""
    kinds = kinds_of(log)
    control = CONTROLS.get(vehicle_of(kinds).model, "")
    if control == "velocity":
        # The errors of moored beacons' positions and of the speed of sound persist, so that no innovation shows them
        # unless they have states.
        return {"velocity", "yaw"}
    names = {"range", "growth", *(("speed", "turn") if control else ("acceleration",))}
    return names | ({"bearing"} if "bearing_range" in kinds else set())


def _with(settings: Settings, name: str, factor: float) -> Settings:
    """The settings with one noise multiplied."""
    ranges = settings.ranges
    if name == "range":
        return replace(settings, ranges=replace(ranges, std_m=ranges.std_m * factor))
    if name == "growth":
        return replace(settings, ranges=replace(ranges, growth=ranges.growth * factor))
    field = {
        "bearing": "bearing_std_rad", "speed": "speed_std_m_s", "turn": "turn_std_rad_s",
        "velocity": "velocity_std_m_s", "yaw": "yaw_acceleration_std_rad_s2", "acceleration": "acceleration_std_m_s2",
        "drift": "drift_std_m", "drift_time": "drift_time_s",
    }[name]  # fmt: skip
    return replace(settings, **{field: getattr(settings, field) * factor})


def thinned(log: Log, apart_s: float) -> Log:
    """The log with sightings of each beacon at least `apart_s` apart, up to MOST of them."""
    last: dict[str, float] = {}
    kept: Log = []
    count = 0
    for event in log:
        if isinstance(event, Event) and event.kind in NAMED:
            if event.time_s < last.get(event.beacon, -math.inf) + apart_s:
                continue
            last[event.beacon] = event.time_s
            count += 1
            if count > MOST:
                break
        kept.append(event)
    return kept


def _apart(log: Log) -> Log:
    """The log with depths and attitudes at least APART_S apart."""
    last: dict[str, float] = {}
    kept: Log = []
    for event in log:
        if event.kind in ("depth", "attitude"):
            if event.time_s < last.get(event.kind, -math.inf) + APART_S:
                continue
            last[event.kind] = event.time_s
        kept.append(event)
    return kept


def spread_out(log: Log) -> Log:
    """The log with MOST ranges: the first DENSE, and of the rest every n-th instant with all its ranges."""
    times = [event.time_s for event in log if event.kind == "range"]
    if len(times) <= MOST:
        return log
    rest = sorted({time for time in times if time > times[DENSE]})
    stride = math.ceil((len(times) - DENSE) / (MOST - DENSE))
    kept = set(rest[::stride])
    return [event for event in log if event.kind != "range" or event.time_s <= times[DENSE] or event.time_s in kept]


def _search(
    log: Log,
    default: Settings,
    beacons: Beacons,
    first: dict[str, float],
    drift_times_s: tuple[float, float] = (0.0, math.inf),
    stop_above: float = math.inf,
) -> tuple[dict[str, float], float]:
    """The most likely factors (ln) on the noises of `default`, by a search from `first`, and their cost.

    The prior is around `default`. A search that is not below `stop_above` after its widest steps ends there.
    """

    def cost(logs: dict[str, float]) -> float:
        settings = _applied(default, logs)
        if not drift_times_s[0] <= settings.drift_time_s <= drift_times_s[1]:
            return math.inf
        prior = 0.5 * sum((value / PRIOR_LN) ** 2 for value in logs.values())
        return prior + _run(rows, events, settings, start)[0]

    prepared, hold_s = merged(log)
    start = Localizer(prepared, "ekf", default, None, beacons)
    rows, events = _arrays(prepared, start, hold_s)
    starts = [first]
    if "drift" in first:
        shortest, longest = np.log(np.array(drift_times_s) / default.drift_time_s)
        for white, drift, share in itertools.product(GRID_WHITE, GRID_DRIFT, GRID_TIME):
            at = {"drift": math.log(drift), "drift_time": float(shortest + share * (longest - shortest))}
            starts.append(_moved({**first, **at}, {"range": 1.0} if "range" in first else {}, math.log(white)))
    lowest, best = min(((cost(each), each) for each in starts), key=lambda pair: pair[0])
    directions = [{name: 1.0} for name in first]
    if "drift" in first:
        directions += [pair for pair in PAIRS if first.keys() >= pair.keys()]
    for factor in FACTORS:
        step = math.log(factor)
        for _ in range(SWEEPS):
            before = lowest
            for direction, sign in itertools.product(directions, (1.0, -1.0)):
                while (trial := cost(moved := _moved(best, direction, sign * step))) < lowest - 0.1:
                    lowest, best = trial, moved
            if lowest > before - 1.0:
                break
        if lowest > stop_above:
            break
    return best, lowest


def _moved(logs: dict[str, float], direction: dict[str, float], step: float) -> dict[str, float]:
    """Factors (ln) after a step along a direction."""
    return {**logs, **{name: logs[name] + step * power for name, power in direction.items()}}


def _applied(settings: Settings, logs: dict[str, float]) -> Settings:
    """The settings with factors (ln) on their noises."""
    for name, value in logs.items():
        settings = _with(settings, name, math.exp(value))
    return settings


def merged(log: Log) -> tuple[Log, float | None]:
    """The log with mean controls over at most MEAN_S between two measurements, and how long each of the original ones
    held (s); the log itself where it has no odometry.
    """
    kind = CONTROLS.get(vehicle_of(kinds_of(log)).model, "")
    if kind not in ("odometry", "twist"):
        return log, None
    controls = [event for event in log if isinstance(event, Event) and event.kind == kind]
    others = [event for event in log if event.kind != kind]
    holds = np.array(list(control_holds(log, kind).values()))
    times = np.array([event.time_s for event in controls])
    ends = np.append(times, times[-1] + holds[-1])
    values = np.array([event.values for event in controls])
    way = np.vstack((np.zeros(values.shape[1]), np.cumsum(values * np.diff(ends)[:, np.newaxis], axis=0)))
    at = np.unique(np.concatenate(([event.time_s for event in others], np.arange(times[0], ends[-1], MEAN_S))))
    travelled = np.column_stack([np.interp(at, ends, column) for column in way.T])
    means = np.diff(travelled, axis=0) / np.diff(at)[:, np.newaxis]
    mean_controls: Log = [
        Event(float(time), kind, tuple(mean)) for time, mean in zip(at[:-1], means.tolist(), strict=True)
    ]
    return sorted([*others, *mean_controls], key=lambda event: event.time_s), float(np.median(holds))


def _arrays(log: Log, start: Localizer, hold_s: float | None) -> tuple[Rows, list[Event]]:
    """A log as arrays, and the event of each row; `start` is a localizer that has not processed anything."""
    holds = control_holds(log, start.control_kind)
    motion, rows = start.filter.motion, []
    for i, event in enumerate(log):
        if not isinstance(event, Event):
            continue
        measurement = None if event is start.prior else start.sensors.measurement([event])
        rows.append((event, start.control.copy(), start.hold.copy(), measurement))
        start.steer(event, hold_s if i in holds and hold_s is not None else holds.get(i))
    times = np.array([event.time_s for event, *_ in rows])
    values, tables = np.zeros((len(rows), 3)), np.zeros((len(rows), 3, 7))
    angles = np.zeros((len(rows), len(motion.states) + 3), np.bool_)
    angles[:, : len(motion.states)] = motion.is_angle
    model, size = np.zeros(len(rows), np.int64), np.zeros(len(rows), np.int64)
    for i, (_, _, _, measurement) in enumerate(rows):
        if measurement is not None:
            m = size[i] = len(measurement.values)
            model[i], values[i, :m] = measurement.model, measurement.values
            tables[i, : len(measurement.parameters), : measurement.parameters.shape[1]] = measurement.parameters
            angles[i, len(motion.states) : len(motion.states) + len(measurement.angles)] = measurement.angles
    events = [event for event, *_ in rows]
    named = np.isin([event.kind for event in events], NAMED)
    arrays = Rows(
        intervals_s=np.diff(times, prepend=times[0]),
        controls=np.array([control for _, control, _, _ in rows]),
        holds_s=np.array([hold for _, _, hold, _ in rows]),
        models=model,
        sizes=size,
        values=values,
        parameters=tables,
        is_angle=angles,
        is_direct=~named,
        counts=named | np.array([event.kind == "attitude" for event in events]),
    )
    return arrays, events


def _run(rows: Rows, events: list[Event], settings: Settings, start: Localizer) -> tuple[float, Floats]:
    """−ln likelihood, and the normalised innovations (N, 2) of ranges and bearings; `start` is only read."""
    innovations = np.zeros((len(events), 2))
    covariance, drifts = start.filter.covariance.copy(), drifts_of(settings, start.filter.motion)
    if drifts is not None:
        at = np.flatnonzero(drifts[:, 1])
        covariance[at, at] = drifts[at, 1]
    if start.vehicle is CONSTANT_VELOCITY:
        rows = rows._replace(controls=np.tile(first_control(settings, start.vehicle), (len(events), 1)))
    cost = run_filter(
        Gaussian(start.filter.state.copy(), covariance),
        start.filter.motion.model,
        noise_root(settings, start.vehicle),
        rows,
        _variances(rows, events, settings),
        np.zeros((len(start.filter.state), 2)) if drifts is None else drifts,
        np.array([chi_square_quantile(GATE, size) for size in (1, 2, 3)]),
        outlier_density(start.sensors.beacons),
        start.filter.grid,
        innovations,
    )
    innovations[rows.is_direct] = 0.0
    return cost, innovations


def _variances(rows: Rows, events: list[Event], settings: Settings) -> Floats:
    """The diagonal (N, 3) of each row's R with these noises."""
    variances, kinds = np.zeros((len(events), 3)), np.array([event.kind for event in events])
    named = ~rows.is_direct
    variances[named, 0] = settings.ranges.variances(rows.values[named, 0], float(np.mean(rows.values[named, 0])))
    variances[named, 1] = settings.bearing_std_rad**2
    variances[kinds == "depth", 0] = settings.depth_std_m**2
    variances[kinds == "attitude", 0] = settings.attitude_std_rad**2
    far, turned = settings.start_std
    variances[kinds == "pose"] = (far**2, far**2, turned**2)
    return variances


def correlation_time(events: list[Event], innovations: Floats) -> float:
    """T = 2 ∫ ρ dτ (s) of the errors of single beacons: so long apart, sightings count as independent.

    `innovations` (N, 2) are normalised, and 0 where there is none. 0 for errors that are independent from one sighting
    to the next; the largest of the rows, range and bearing.
    """
    by_beacon: dict[str, list[int]] = {}
    for i, event in enumerate(events):
        if event.kind in NAMED:
            by_beacon.setdefault(event.beacon, []).append(i)
    times = np.array([event.time_s for event in events])
    series = [(times[at], innovations[at]) for at in map(np.array, by_beacon.values())]
    return max((_time_of([(t, values[:, row]) for t, values in series]) for row in (0, 1)), default=0.0)


def _time_of(series: list[tuple[Floats, Floats]]) -> float:
    sums, counts, squares, number = np.zeros(len(LAGS_S) - 1), np.zeros(len(LAGS_S) - 1), 0.0, 0
    for times, raw in series:
        values = np.clip(raw / max(float(np.median(np.abs(raw))), 1e-12), -4.0, 4.0)
        squares, number = squares + float(values @ values), number + len(values)
        for step in range(1, min(len(values), MOST_STEPS)):
            lag = times[step:] - times[:-step]
            at = np.searchsorted(LAGS_S, lag, side="right") - 1
            inside = at < len(LAGS_S) - 1
            np.add.at(sums, at[inside], (values[step:] * values[:-step])[inside])
            np.add.at(counts, at[inside], 1.0)
    total = 0.0
    for i in range(len(LAGS_S) - 1):
        if counts[i] < FEWEST_PAIRS:
            if total > 0.0:
                break
            continue
        correlation = float(sums[i] / counts[i] / max(squares / max(number, 1), 1e-12))
        if correlation < CORRELATED:
            break
        total += 2.0 * correlation * float(LAGS_S[i + 1] - (LAGS_S[i] if total else 0.0))
    return total
