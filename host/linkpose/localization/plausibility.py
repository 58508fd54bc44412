"""Recognises units that are wrong by a thousand, or degrees for radians, by the size of the values in a log."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.localization.events import NAMED, Event, Log
from linkpose.localization.headings import check_headings
from linkpose.localization.tables import Beacons

# The median range in units of the beacons' largest distance from each other, beyond which it cannot be metres: a robot
# among or near its beacons has 0.1 to 3; a log in centimetres has 10 to 300, one in millimetres 100 to 3000.
MILLIMETRES, CENTIMETRES = 100.0, 20.0
MILLISECONDS_S = 10.0  # the median step of a log whose times are whole numbers, or of odometry, which holds for a step
SPEEDS = ("odometry", "twist")
# The fastest twentieth of the changes between fixes 10 s apart: 0.1 m/s for a robot of 0.2 m/s. Milliseconds taken
# for seconds: noise of 0.1 m at 100 Hz is 0.03 m/s, a walk 0.001 m/s. Ranges that change by less than STANDING_M (m)
# are those of a sensor at rest, whose place is right in either unit; no one fixes it once in RARE_FIX_S (s).
SLOWEST_M_S, STANDING_M, RARE_FIX_S = 0.05, 1.0, 60.0
FASTEST_TURN_RAD_S = 10.0  # 95 % of a robot's turn rates are below


def check_units(log: Log, beacons: Beacons, origin: str) -> None:
    """Raises LinkposeError that names the unit and the cure."""
    events = [event for event in log if isinstance(event, Event)]
    _check_ranges(events, beacons, origin)
    _check_times(log, origin)
    poses = [event.values for event in events if event.kind == "pose"]
    if poses:
        check_headings(np.array(poses), Path(origin), "the poses")
    _check_angles(events, origin)


def _check_ranges(events: list[Event], beacons: Beacons, origin: str) -> None:
    ranges = [event.values[0] for event in events if event.kind in NAMED]
    places = np.array(list(beacons.values()))
    if len(ranges) < 3 or len(places) < 2:
        return
    extent = float(np.linalg.norm(places.max(axis=0) - places.min(axis=0)))
    ratio = float(np.median(ranges)) / extent if extent > 0.0 else 0.0
    for limit, unit, factor in ((MILLIMETRES, "millimetres", 1000), (CENTIMETRES, "centimetres", 100)):
        if ratio > limit:
            raise LinkposeError(
                f"{origin}: the ranges look like {unit} (median {np.median(ranges):.4g} among beacons "
                f"{extent:.3g} m apart); divide them by {factor} to give metres"
            )


def _check_times(log: Log, origin: str) -> None:
    times = np.unique([event.time_s for event in log])
    speeds = np.unique([event.time_s for event in log if isinstance(event, Event) and event.kind in SPEEDS])
    judged = [speeds, *([times] if (times == np.floor(times)).all() else [])]
    step = max(float(np.median(np.diff(each))) if len(each) >= 20 else 0.0 for each in judged)
    if step >= MILLISECONDS_S and not _moves_between(log, step):
        raise LinkposeError(
            f"{origin}: the times look like milliseconds ({step:g} apart); divide them by 1000 to give seconds"
        )


def _moves_between(log: Log, step: float) -> bool:
    """Whether the ranges, or the places, of a log change as between fixes `step` seconds apart: at a speed that needs
    no thousandfold, or not at all.
    """
    series: dict[str, list[tuple[float, float]]] = {}
    for event in log:
        if isinstance(event, Event) and event.kind in (*NAMED, "pose"):
            series.setdefault(event.beacon, []).append((event.time_s, event.values[0]))
    rows = [np.array(each) for each in series.values() if len(each) > 2]
    if not rows:
        return False
    steps = np.concatenate([np.diff(each, axis=0) for each in rows])
    speeds = np.abs(steps[:, 1]) / np.maximum(steps[:, 0], 1e-9)
    spread = max(float(np.ptp(np.percentile(each[:, 1], (5, 95)))) for each in rows)
    return float(np.percentile(speeds, 95)) > SLOWEST_M_S or (spread < STANDING_M and step < RARE_FIX_S)


def _check_angles(events: Iterable[Event], origin: str) -> None:
    rates = []
    for event in events:
        angle = {"bearing_range": 1, "pose": 2}.get(event.kind)
        if angle is not None and abs(event.values[angle]) > 2.0 * math.pi:
            what = "bearing" if event.kind == "bearing_range" else "heading"
            raise LinkposeError(
                f"{origin} line {event.line}: the {what} {event.values[angle]:g} looks like degrees; "
                "multiply angles by 0.0174533 to give radians"
            )
        if event.kind == "attitude" and max(map(abs, event.values[:2])) > math.pi:
            raise LinkposeError(
                f"{origin} line {event.line}: roll and pitch look like degrees; "
                "multiply angles by 0.0174533 to give radians"
            )
        if event.kind in ("odometry", "twist"):
            rates.append(abs(event.values[-1]))
    if len(rates) >= 20 and float(np.percentile(rates, 95)) > FASTEST_TURN_RAD_S:
        raise LinkposeError(
            f"{origin}: the turn rates look like degrees per second (5 % are above {FASTEST_TURN_RAD_S:g}); "
            "multiply them by 0.0174533 to give rad/s"
        )
