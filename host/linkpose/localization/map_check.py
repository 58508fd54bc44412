"""Names what is wrong with a map that the scans of a log do not fit: mirrored, or of another scale."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from linkpose.errors import MapMismatch
from linkpose.localization.events import Log, Scan
from linkpose.localization.grid import GridMap
from linkpose.localization.linalg import Floats
from linkpose.localization.scan_matching import FEWEST_BEAMS, ScanMatcher, beams_of

# Share of the beams along an estimated path that hit a wall, below which the map is checked: 0.95 in a public
# building with its own map, 0.03 to 0.25 with the map or the laser mirrored. A higher share costs needless searches.
LEAST_SHARE = 0.5
SCANS = 4  # of the log that are searched for in the map, evenly spread
CANDIDATES = 15  # poses of each search
# The scans fit a changed map when their mean log-likelihood is higher by LEAD. In that building it is -0.1 for the
# right map and -5 to -10 for the others; in a flat of 8 x 6 m, -0.2 and -3 to -8. Half of it still separates them.
LEAD = 2.0
# A right map explains such a share of the beams, people and furniture aside.
GOOD_SHARE = 0.75


class _Change(NamedTuple):
    """What may be wrong, and the factors on the columns of the beams (`scan_fit`) that make up for it."""

    text: str
    factors: tuple[float, float, float, float, float]


UNCHANGED = (1.0, 1.0, 1.0, 1.0, 1.0)
CHANGES = (
    _Change("mirrored; flip the map's image, or reverse the order of the laser's beams", (1.0, -1.0, 1.0, -1.0, 1.0)),
    _Change("half as large; correct the resolution in its YAML file", (2.0, 2.0, 1.0, 1.0, 2.0)),
    _Change(
        "3.28 times as large, unless the ranges are in feet; correct the resolution in its YAML file",
        (0.3048, 0.3048, 1.0, 1.0, 0.3048),
    ),
    _Change("twice as large; correct the resolution in its YAML file", (0.5, 0.5, 1.0, 1.0, 0.5)),
)


def check_map(log: Log, grid: GridMap, share: float, origin: str) -> str:
    """A sentence on what may be wrong where only a `share` of the beams hit a wall along the path; empty for enough.

    Raises MapMismatch where the scans fit the map much better after one of CHANGES.
    """
    if share >= LEAST_SHARE:
        return ""
    scans = [beams for beams in map(beams_of, _spread(log)) if len(beams) >= FEWEST_BEAMS]
    if not scans:
        return ""
    matcher = ScanMatcher(grid, 0.0)
    best_share, likelihood = _fit(matcher, scans, UNCHANGED)
    found = [(_fit(matcher, scans, change.factors), change) for change in CHANGES]
    (changed_share, changed), change = max(found, key=lambda item: item[0][1])
    if changed > likelihood + LEAD and changed_share >= GOOD_SHARE:
        raise MapMismatch(origin, change.text, best_share, changed_share)
    if best_share < GOOD_SHARE:
        return (
            f"only {share:.0%} of the beams end at a wall of the map, and {best_share:.0%} at the pose that fits best; "
            "check whether the map is of this place"
        )
    return (
        f"single scans fit the map ({best_share:.0%} of the beams), but only {share:.0%} along the path; check the "
        "odometry, and the laser's place and direction on the robot"
    )


def _spread(log: Log) -> list[Scan]:
    """SCANS scans, evenly spread over the log."""
    scans = [event for event in log if isinstance(event, Scan)]
    return [scans[i] for i in sorted(set(np.linspace(0, len(scans) - 1, SCANS).astype(int).tolist()))] if scans else []


def _fit(matcher: ScanMatcher, scans: list[Floats], factors: tuple[float, ...]) -> tuple[float, float]:
    """Mean share of the beams that hit, and mean log-likelihood, of the scans at the best pose of each."""
    fits = []
    for beams in scans:
        changed = beams * np.array(factors)
        poses = matcher.search(changed, CANDIDATES)
        fits.append(matcher.compare(changed, poses[0]) if poses else (0.0, -np.inf))
    share, likelihood = np.mean(fits, axis=0).tolist()
    return share, likelihood
