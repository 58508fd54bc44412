"""Whether the noises and constants that a log shows are those of sensors, or of wrong units, signs, columns or places.

Maximum likelihood explains anything: ranges in feet become a scale error, exchanged beacons an error that drifts,
odometry with another sign a noise as large as the motion. The path is then wrong, and its σ may be small.
"""

from __future__ import annotations

import numpy as np

from linkpose.localization.events import NAMED, Event, Log
from linkpose.localization.settings import Settings
from linkpose.localization.track import Track

# Error that the odometry accumulates in a second, as a share of its motion in a second (rms): Plaza 1 has 0.03 of speed
# and turn, the slow robot of MRCLAM 7 has 0.9 and 0.2. With a wrong sign, unit or column in its odometry, Plaza 1 has
# more than 0.5 of turn or more than 2 of speed. A robot that hardly turns may err by more than it turns (rad).
_SPEED_SHARE, _TURN_SHARE, _LEAST_RAD = 2.0, 0.5, 0.05
# Scale error of the ranges: Plaza 1 has 0.07, a wrong speed of sound gives 0.05. Feet for metres give more than 0.3.
_LARGEST_SCALE = 0.2
_LARGEST_DRIFT = 0.2  # of the median range; Plaza 1 with wrong units or ids has 0.2 and more, as it is less than 0.01


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
