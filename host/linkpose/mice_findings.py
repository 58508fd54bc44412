"""What the filters found of the mice and the gyro of a robot, as sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from linkpose.estimation import Estimator

_LONG_S = 5.0  # longer than robots slip or are carried
_GYRO_SCALE = 0.045  # share below which it may be the gyro's scale, as in the planar filters
_SHORTEST_S = 0.2  # of exclusions that are reported: a late packet excludes a mouse for a sample


def mice_findings(estimator: Estimator) -> Iterator[str]:
    """Mice that were left out, jumps of the gyro, misplaced mice, and faults that all mice share, one sentence each."""
    yield from _excluded(estimator)
    jumps = estimator.gyro_jumps
    if jumps:
        times = "" if jumps.times == 1 else f" {jumps.times} times, last"
        yield (
            f"the gyro's bias has jumped{times} by {math.degrees(jumps.last_rad_s):+.1f} °/s, found at "
            f"{jumps.last_time_s:.1f} s: the mice contradicted the gyro, and the heading was corrected by the mice. "
            "Check the mounting and the supply of the sensor"
        )
    for mouse in estimator.moved_mice:
        yield (
            f"mouse {mouse.mouse} is {1e3 * mouse.off_m:.0f} mm from its place in the rig file: the turns show it at "
            f"x_m = {mouse.x_m:.3f}, y_m = {mouse.y_m:.3f}"
        )
    yield from estimator.mice_remarks
    if estimator.mice_scale:
        yield _share_of_turns(*estimator.mice_scale)


def _share_of_turns(factor: float, std: float) -> str:
    """All mice turn by another share than the gyro."""
    if abs(factor - 1.0) < _GYRO_SCALE:
        return (
            f"in turns, gyro and mice differ by {100 * abs(factor - 1):.1f} ± {100 * std:.1f} %: the gyro's scale is "
            "off (its data sheet allows 3 %), the mice slip in turns, or the floor is another one. Turns do not show "
            "which, and σ includes each of them; for another floor, type `linkpose calibrate mice`"
        )
    change = "more" if factor > 1 else "fewer"
    return (
        f"in turns, the mice count {100 * abs(factor - 1):.1f} ± {100 * std:.1f} % {change} per metre than the rig "
        "file states, compared with the gyro: either they slip in turns, or the floor is another one; for that "
        "one, type `linkpose calibrate mice`"
    )


def _excluded(estimator: Estimator) -> Iterator[str]:
    """Which mice were left out, since when, and for how long."""
    excluded = estimator.excluded
    long = sorted(name for name, total_s in excluded.total_s.items() if total_s >= _SHORTEST_S)
    causes = estimator.mouse_causes
    if 0 in causes and len(long) == len(estimator.rig.mouse):  # together: each beside the others means nothing
        causes = {0: causes[0]}
    for name in long:
        still = "; it is still left out" if name in excluded.now else ""
        mouse = int(name.removeprefix("mouse"))
        yield (
            f"mouse {mouse} was left out for {excluded.total_s[name]:.1f} s, first at "
            f"{excluded.first_s[name]:.1f} s{still}: {causes.get(mouse, 'it contradicted the other sensors')}. Check "
            "that it is on the floor, and its place and angle in the rig file"
        )
    mice = len(estimator.rig.mouse)
    if mice and len(long) == mice and min(excluded.total_s.values()) > _LONG_S:
        cause = f" ({causes[0]})" if 0 in causes else ""
        yield (
            f"all mice were left out for long: together they contradict the gyro{cause}. If they were on the floor, "
            "their counts_per_m or angle_deg in the rig file are wrong: type `linkpose calibrate mice`"
        )
