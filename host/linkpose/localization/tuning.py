"""Estimates the noises of a log's sensors and motion from the log itself, by maximum likelihood.

The likelihood is that of the innovations of an extended Kalman filter (Mehra, "On the identification of variances and
adaptive Kalman filtering", IEEE Transactions on Automatic Control 15 (1970), pages 175-184), with Student's t instead
of the normal distribution, since ranges have outliers. Errors of one beacon that persist from one sighting to the next
are no independent measurements: their correlation time is estimated from the autocorrelation of the innovations.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from linkpose.localization.events import NAMED, Event, Log
from linkpose.localization.gate import chi_square_quantile
from linkpose.localization.likelihood import Rows, run_filter
from linkpose.localization.linalg import Floats
from linkpose.localization.localizer import Localizer
from linkpose.localization.settings import Settings
from linkpose.localization.steps import Gaussian
from linkpose.localization.tables import Beacons
from linkpose.localization.vehicle import CONTROLS, control_holds, kinds_of, noise_root, vehicle_of

# Fewer measurements do not determine four noises; more than MOST add time, not accuracy.
FEWEST, MOST = 100, 1200
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
TUNABLE = ("range", "growth", "bearing", "speed", "turn", "velocity", "yaw", "acceleration", "error_time")
PASSES = 3
NORMAL_MEDIAN = 0.6745  # of the absolute value of a standard normal variable


def tune(log: Log, settings: Settings, beacons: Beacons, free: tuple[str, ...]) -> Settings:
    """The settings with the noises `free` (of TUNABLE) estimated from the log; unchanged where the log has fewer than
    FEWEST ranges and bearings, or where no noise that was tried makes the filter work.
    """
    if sum(event.kind in NAMED for event in log) < FEWEST:
        return settings
    names = [name for name in free if name in _present(log)]
    tuned = replace(settings, error_time_s=settings.error_time_s or 0.0)
    for _ in range(PASSES):
        tuned = _most_likely(thinned(log, tuned.error_time_s or 0.0), tuned, settings, beacons, names)
        error_time, factors = _residual_statistics(log, tuned, beacons)
        for name, factor in (("range", factors[0]), ("growth", factors[0]), ("bearing", factors[1])):
            if name in names:
                tuned = _with(tuned, name, max(1.0, factor))
        if "error_time" not in free or error_time <= 1.3 * (tuned.error_time_s or 0.0):
            break
        tuned = replace(tuned, error_time_s=error_time)
    return tuned


def described(settings: Settings, log: Log) -> str:
    """The noises that the log's measurements have, in words."""
    present, ranges = _present(log), settings.ranges
    parts = []
    if "range" in present:
        parts.append(f"range {ranges.std_m:.3g} m" + (f" + {ranges.growth:.2%}" if ranges.model == "affine" else ""))
    words = (
        ("bearing", settings.bearing_std_rad, "rad"), ("speed", settings.speed_std_m_s, "m/s"),
        ("turn", settings.turn_std_rad_s, "rad/s"), ("velocity", settings.velocity_std_m_s, "m/s"),
        ("acceleration", settings.acceleration_std_m_s2, "m/s²"),
    )  # fmt: skip
    parts += [f"{name} {value:.3g} {unit}" for name, value, unit in words if name in present]
    return ", ".join([*parts, f"errors persist for {settings.error_time_s:.2g} s"])


def _residual_statistics(log: Log, settings: Settings, beacons: Beacons) -> tuple[float, tuple[float, float]]:
    """How long errors persist (s), and how much larger than stated the innovations of range and bearing are, by their
    medians: 1.5 means half as large again. Student's t, and a part of the log, let the noises be too small.
    """
    start = Localizer(log, "ekf", settings, None, beacons)
    rows, events = _arrays(log, start, None)
    innovations = _run(rows, events, settings, start)[1]
    size = [np.abs(column[column != 0.0]) for column in innovations.T]
    factors = [float(np.median(column)) / NORMAL_MEDIAN if len(column) else 1.0 for column in size]
    return correlation_time(events, innovations), (factors[0], factors[1])


def _present(log: Log) -> set[str]:
    """The noises that the log's measurements and its motion model have."""
    kinds = kinds_of(log)
    control = CONTROLS.get(vehicle_of(kinds).model, "")
    if control == "velocity":
        # The errors of moored beacons' places and of the speed of sound persist, so that no innovation shows them.
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


def _most_likely(log: Log, first: Settings, default: Settings, beacons: Beacons, names: list[str]) -> Settings:
    """Coordinate search of the noises `names` from `first`; the prior is around `default`."""

    def cost(logs: dict[str, float]) -> float:
        settings = default
        for name, value in logs.items():
            settings = _with(settings, name, math.exp(value))
        prior = 0.5 * sum((value / PRIOR_LN) ** 2 for value in logs.values())
        return prior + _run(rows, events, settings, start)[0]

    prepared, hold_s = merged(log)
    start = Localizer(prepared, "ekf", default, None, beacons)
    rows, events = _arrays(prepared, start, hold_s)
    best = dict.fromkeys(names, 0.0)
    lowest = cost(best)
    for factor in FACTORS:
        step = math.log(factor)
        for _ in range(SWEEPS):
            before = lowest
            for name in names:
                for sign in (1.0, -1.0):
                    while (trial := cost({**best, name: best[name] + sign * step})) < lowest - 0.1:
                        lowest, best = trial, {**best, name: best[name] + sign * step}
            if lowest > before - 1.0:
                break
    if not math.isfinite(lowest):
        return first
    tuned = replace(default, error_time_s=first.error_time_s)
    for name, value in best.items():
        tuned = _with(tuned, name, math.exp(value))
    return tuned


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
    values, tables = np.zeros((len(rows), 3)), np.zeros((len(rows), 3, 6))
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
    cost = run_filter(
        Gaussian(start.filter.state.copy(), start.filter.covariance.copy()),
        start.filter.motion.model,
        noise_root(settings, start.vehicle),
        rows,
        _variances(rows, events, settings),
        np.array([chi_square_quantile(GATE, size) for size in (1, 2, 3)]),
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
