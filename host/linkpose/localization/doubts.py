"""Whether the noises and constants that a log shows are those of sensors, or of wrong units, signs, columns or places.

Maximum likelihood explains anything: ranges in feet become a scale error, exchanged beacons an error that drifts,
odometry with another sign a noise as large as the motion. The path is then wrong, and its σ may be small.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.localization.events import NAMED, Event, Log, Scan
from linkpose.localization.linalg import Floats
from linkpose.localization.self_calibration import RobotErrors
from linkpose.localization.settings import Settings
from linkpose.localization.track import Track
from linkpose.rotations import wrapped

# Error that the odometry accumulates in a second, as a share of its motion in a second (rms): Plaza 1 has 0.03 of speed
# and turn, the slow robot of MRCLAM 7 has 0.9 and 0.2. With a wrong sign, unit or column in its odometry, Plaza 1 has
# more than 0.5 of turn or more than 2 of speed. A robot that hardly turns may err by more than it turns (rad).
_SPEED_SHARE, _TURN_SHARE, _LEAST_RAD = 2.0, 0.5, 0.05
# Scale error of the ranges: Plaza 1 has 0.07, a wrong speed of sound gives 0.05. Feet for metres give more than 0.3.
_LARGEST_SCALE = 0.2
_LARGEST_DRIFT = 0.2  # of the median range; Plaza 1 with wrong units or ids has 0.2 and more, as it is less than 0.01

# The path of the scans is compared with the odometry over steps of at least STEP_S (s), in which a robot moves by more
# than scans err. Clocks may differ by LAGS_S at most; a lag is named from LEAST_LAG_S on (a scan of a 25 Hz scanner),
# where it takes the mean difference of the turns to CLEARER of what it is without.
_STEP_S, _LAGS_S, _LEAST_LAG_S, _CLEARER, _FEWEST_STEPS = 0.2, np.arange(-50, 51) / 100.0, 0.04, 0.75, 30
# The odometry contradicts the scans where its motion is less than _LEAST_FACTOR or more than 1 / _LEAST_FACTOR of
# theirs, and both belong together (correlation beyond _RELATED): wheels slip and floors differ by a few tenths.
_LEAST_FACTOR, _RELATED = 0.6, 0.5
_LEAST_DEG = 5.0  # between motion and heading, which wheels do not have; less may be a laser that was put on by hand
# A scale error of the laser's ranges that is named: data sheets state less than 1 %.
_LEAST_SCALE = 0.01


def doubts(log: Log, settings: Settings, track: Track, free: tuple[str, ...]) -> list[str]:
    """A sentence for each noise, of those that were `free`, and each constant that no sensor has."""
    events = [event for event in log if isinstance(event, Event)]
    driven = [event for event in events if event.kind == "odometry"]
    found = []
    if len(driven) > 1:
        size = np.sqrt(np.mean(np.array([event.values[:2] for event in driven]) ** 2, axis=0))
        root_s = float(np.sqrt(np.median(np.diff([event.time_s for event in driven]))))
        speed, turn = root_s * settings.speed_std_m_s, root_s * settings.turn_std_rad_s  # errors in a second
        if "speed" in free and speed > _SPEED_SHARE * size[0]:
            found.append(_on_odometry("speed", "m", speed, size[0]))
        if "turn" in free and turn > max(_LEAST_RAD, _TURN_SHARE * size[1]):
            found.append(_on_odometry("turn rate", "rad", turn, size[1]))
    scale = dict(zip(track.names, track.state[-1].tolist(), strict=True)).get("range_scale_error", 0.0)
    if abs(scale) > _LARGEST_SCALE:
        found.append(
            f"the ranges come out {1.0 + scale:.2f} times too long: check their unit, the unit of the beacons' places "
            "and that of the odometry"
        )
    usual_m = float(np.median([event.values[0] for event in events if event.kind in NAMED] or [np.inf]))
    if settings.drift_std_m > _LARGEST_DRIFT * usual_m:
        found.append(
            f"the ranges have errors of {settings.drift_std_m:.3g} m that persist, where the median range is "
            f"{usual_m:.3g} m: check the ids and the places of the beacons, and the units"
        )
    return found


def _on_odometry(name: str, unit: str, error: float, size: float) -> str:
    return (
        f"the {name} of the odometry is {size:.2g} {unit}/s (rms) and errs by {error:.2g} {unit} in a second: the "
        "measurements contradict it. Check its unit, its sign, its column and its times, unless the robot was carried"
    )


class _Steps(NamedTuple):
    """The motion between scans whose pose is known, and the odometry's own.

    `ahead`, `left` (m) and `turned` (rad) (n,) are those between the times `time_s` (n + 1,), where `is_whole` (n,): no
    gap, no jump. `way` (m) and `heading` (rad) (m,) are what the odometry has driven and turned until the times
    `odometry_s`.
    """

    time_s: Floats
    ahead: Floats
    left: Floats
    turned: Floats
    is_whole: NDArray[np.bool_]
    odometry_s: Floats
    way: Floats
    heading: Floats

    def differences(self, lag_s: float) -> float:
        """Mean difference (rad) of the turns, where the scans are stamped `lag_s` later than the odometry."""
        turned = np.diff(np.interp(self.time_s - lag_s, self.odometry_s, self.heading))
        return float(np.mean(np.abs(self.turned - turned)[self.is_whole]))


def scan_doubts(log: Log, track: Track) -> list[str]:
    """A sentence on the laser's ranges, and on the clock, the signs and the units of an odometry that the path of the
    scans contradicts.
    """
    found = []
    if abs(track.range_scale - 1.0) > _LEAST_SCALE:
        longer = 1.0 / track.range_scale - 1.0
        found.append(
            f"the laser's ranges are {abs(longer):.1%} {'longer' if longer > 0.0 else 'shorter'} than the distances in "
            "the map and were corrected by as much: check the scanner, and the resolution in the map's YAML file"
        )
    steps = _steps(log, track)
    if steps is None:
        return found
    lag = _lag(steps)
    if lag:
        late, other = ("scans are", "the odometry") if lag > 0.0 else ("odometry is", "the scans")
        found.append(
            f"the {late} stamped about {abs(lag):.2f} s later than {other}: correct those that are wrong (with wrong "
            "times of the scans, the path is off by as much as the robot moves in that time)"
        )
    times = steps.time_s - lag
    found += _on_direction(steps, np.diff(np.interp(times, steps.odometry_s, steps.way)))
    for verb, scans, total in (("drives", steps.ahead, steps.way), ("turns", steps.turned, steps.heading)):
        odometry = np.diff(np.interp(times, steps.odometry_s, total))
        found += _on_scale(verb, scans[steps.is_whole], odometry[steps.is_whole])
    return found


def robot_doubts(errors: RobotErrors | None, applied: Floats) -> list[str]:
    """A sentence for each error of the robot's constants that was `applied` (5,), as in `RobotErrors`, and for a place
    of the laser that was not.
    """
    angle, ahead, left, way, turn = applied.tolist()
    found = []
    if angle:
        side = "left" if angle > 0.0 else "right"
        found.append(
            f"the laser points {abs(np.degrees(angle)):.1f} degrees farther to the {side} than the log states, and was "
            "corrected by as much: wheels do not drive sideways. Check the laser's direction on the robot, and the "
            "beams' start angle"
        )
    if ahead or left:
        found.append(
            f"the laser is {_place(ahead, left)} on the robot than the log states, and was corrected by as "
            "much: the robot turns about another point. Check the laser's place"
        )
    elif errors is not None and (errors.certain[1] or errors.certain[2]):
        found.append(
            f"the laser is {_place(*errors.certain[1:3].tolist())} than the point that the robot turns about, and "
            "the log states no place for it: the path is that of the laser, and σ includes the distance. If the path "
            "of the robot is meant, state the laser's place in the log"
        )
    found += [
        f"the odometry {verb} {1.0 / (1.0 + share):.3f} times as far as the scans, and was corrected by as much: check "
        "the diameter of the wheels and the distance between them"
        for verb, share in (("drives", way), ("turns", turn))
        if share
    ]
    return found


def _place(ahead: float, left: float) -> str:
    """In words, where a length is not 0."""
    parts = [
        f"{abs(length):.2f} m farther {words[length < 0.0]}"
        for length, words in ((ahead, ("ahead", "back")), (left, ("left", "right")))
        if length
    ]
    return " and ".join(parts)


def with_doubtful_robot(track: Track) -> Track:
    """The track, with the errors of the laser's mount that were not corrected, though they are likely, in the
    covariance of the pose. The path is off by all of them where the robot is meant, and by nothing where the laser is.
    """
    if track.robot_errors is None or track.heading_rad is None:
        return track
    angle, ahead, left = track.robot_errors.likely[:3].tolist()
    heading = track.heading_rad[track.known]
    c, s = np.cos(heading), np.sin(heading)
    return _widened(track, np.column_stack((c * ahead - s * left, s * ahead + c * left, np.full(len(c), angle))), 1.0)


def with_doubtful_clock(log: Log, track: Track) -> Track:
    """The track, with the motion during the lag of its scans in the covariance of the pose.

    Either clock may be the right one: the path is off by nothing or by all of that motion, with equal probability.
    """
    steps = _steps(log, track)
    lag = _lag(steps) if steps is not None else 0.0
    if not lag or track.heading_rad is None:
        return track
    known = track.known
    times = track.time_s[known]
    path = np.column_stack((track.position_m[known, :2], np.unwrap(track.heading_rad[known])))
    late = np.column_stack([np.interp(times + lag, times, column) for column in path.T])
    return _widened(track, late - path, 0.5)


def _widened(track: Track, off: Floats, probability: float) -> Track:
    """The track, whose known poses (N) may be off by `off` (N, 3; x m, y m, rad) with this probability."""
    at = [track.names.index(name) for name in ("x_m", "y_m", "heading_rad")]
    whole = np.zeros((len(off), len(track.names)))
    whole[:, at] = off
    covariance = track.covariance.copy()
    covariance[track.known] += probability * whole[:, :, np.newaxis] * whole[:, np.newaxis, :]
    return replace(track, covariance=covariance)


def _steps(log: Log, track: Track) -> _Steps | None:
    """None where the log has too few of them, or another odometry than speed and turn rate."""
    driven = [event for event in log if isinstance(event, Event) and event.kind == "odometry"]
    scanned = {event.time_s for event in log if isinstance(event, Scan)}
    rows = [i for i in np.flatnonzero(track.known).tolist() if track.time_s[i] in scanned]
    if track.heading_rad is None or len(driven) < _FEWEST_STEPS or len(rows) < _FEWEST_STEPS:
        return None
    chosen = rows[:1]
    for row in rows[1:]:
        if track.time_s[row] >= track.time_s[chosen[-1]] + _STEP_S - 1e-6:
            chosen.append(row)
    times, heading = track.time_s[chosen], track.heading_rad[chosen]
    moved, turned = np.diff(track.position_m[chosen, :2], axis=0), wrapped(np.diff(heading))
    middle = heading[:-1] + 0.5 * turned
    ahead = moved[:, 0] * np.cos(middle) + moved[:, 1] * np.sin(middle)
    left = moved[:, 1] * np.cos(middle) - moved[:, 0] * np.sin(middle)
    gaps = np.diff(times)
    is_whole = (gaps < 2.0 * np.median(gaps) + 1e-6) & (np.abs(turned) < 1.0)
    odometry_s = np.array([event.time_s for event in driven])
    rates = np.array([event.values[:2] for event in driven])[:-1] * np.diff(odometry_s)[:, np.newaxis]
    way, angle = np.concatenate((np.zeros((1, 2)), np.cumsum(rates, axis=0))).T
    reach = _LAGS_S[-1]
    is_whole &= (times[:-1] > odometry_s[0] + reach) & (times[1:] < odometry_s[-1] - reach)
    if is_whole.sum() < _FEWEST_STEPS:
        return None
    return _Steps(times, ahead, left, turned, is_whole, odometry_s, way, angle)


def _lag(steps: _Steps) -> float:
    """By how much (s) the scans are stamped later than the odometry; 0 where that is not clear."""
    differences = [steps.differences(lag) for lag in _LAGS_S]
    best = float(_LAGS_S[int(np.argmin(differences))])
    is_clear = min(differences) < _CLEARER * steps.differences(0.0)
    return best if is_clear and abs(best) >= _LEAST_LAG_S else 0.0


def _on_direction(steps: _Steps, driven: Floats) -> list[str]:
    """What is wrong with the direction of a laser whose path leads beside the heading; wheels have `driven` (n,)."""
    whole = steps.is_whole
    ahead, left = float(np.sum((steps.ahead * driven)[whole])), float(np.sum((steps.left * driven)[whole]))
    size = float(np.sqrt(np.sum((steps.ahead**2 + steps.left**2)[whole]) * np.sum(driven[whole] ** 2)))
    angle = np.degrees(np.arctan2(left, ahead))
    if np.hypot(ahead, left) < _RELATED * size or not _LEAST_DEG < abs(angle) < 180.0 - _LEAST_DEG:
        return []
    return [
        f"the robot moves {abs(angle):.0f} degrees to the {'left' if angle > 0.0 else 'right'} of its heading: the "
        "beams' start angle, or the laser's direction on the robot, is wrong by as much"
    ]


def _on_scale(verb: str, scans: Floats, odometry: Floats) -> list[str]:
    """What is wrong with the sign or the unit of an odometry that `verb` by so much in each step, unlike the scans."""
    size = float(np.sqrt(np.sum(scans**2) * np.sum(odometry**2)))
    related = float(np.sum(scans * odometry)) / size if size > 0.0 else 0.0
    if abs(related) < _RELATED:
        return []
    if related < 0.0:
        return [
            f"the odometry {verb} the other way than the scans: check the sign of that column, and the direction "
            "of the laser and the order of its beams"
        ]
    factor = float(np.sum(odometry**2) / np.sum(scans * odometry))
    if _LEAST_FACTOR < factor < 1.0 / _LEAST_FACTOR:
        return []
    return [f"the odometry {verb} {factor:.3g} times as far as the scans: check the unit of that column"]
