"""The motion of the sensor, or of the robot, that a filter has estimated."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from linkpose.convert.poses import Poses, not_estimated, poses_of
from linkpose.convert.source import Source
from linkpose.errors import LinkposeError
from linkpose.sensors.measurements import Floats

_LONGEST_STEPS = 2.5  # of the grid: longer gaps stay empty. One lost sample is interpolated; doubled, four are
_MOST_EMPTY = 100  # frames for each pose; a clock that jumped would fill the memory with empty frames


class Motion:
    """The poses of one filter: of the only one in `source`, or of the first that has at least two.

    Raises LinkposeError where there are none. `who` names the filter, if the user has.
    """

    def __init__(self, source: Source, who: str | None, label: str) -> None:
        source.require("time_s")
        if not source.oriented:
            kind = f"the filter {who}" if who else "it"
            raise LinkposeError(
                f"{source.path}: {kind} has no orientation (roll_deg and pitch_deg, heading_rad, or qw to qz); "
                "a recording must be estimated before it has one"
            )
        candidates = ((prefix, source.times_of(prefix)) for prefix in source.oriented)
        prefix, known = next((found for found in candidates if len(found[1]) >= 2), (source.oriented[0], np.empty(0)))
        name, is_only = prefix.replace("_", "-") or str(source.path), len(source.oriented) == 1
        if not len(known):
            raise LinkposeError(f"{source.path} has no two poses of {name if is_only else 'any filter'}")
        self._source, self._prefix, self.label = source, prefix, label
        self.start_s = float(known[0])  # of the first pose, and of the first frame
        self._last_s, self._count = float(known[-1]), len(known)
        steps = np.diff(known)
        steps = steps[steps > 0]
        self.rate_hz = float(np.round(1 / np.median(steps), 3)) if len(steps) else 1.0  # the usual one
        self.remarks = [f"{source.path}: the motion is the one of the filter {name}"] if not is_only else []
        self.remarks += [f"{name} does not estimate {missing}" for missing in not_estimated(source.names, prefix)]
        if self._count < source.rows:
            self.remarks.append(f"{source.path}: {source.rows - self._count} rows without an estimate left out")

    def parts(self) -> Iterator[Poses]:
        """The poses that are estimated, in blocks."""
        for block in self._source.blocks():
            poses = poses_of(block, self._prefix)
            known = poses[poses.is_known]
            if len(known):
                yield known

    @property
    def marker_names(self) -> list[str]:
        """The names of the three markers."""
        return [f"{self.label}_{end}" for end in ("O", "X", "Y")]

    def frames(self) -> int:
        """Frames at the motion's rate. Raises LinkposeError where nearly all of them would be empty."""
        count = round((self._last_s - self.start_s) * self.rate_hz) + 1
        if count > _MOST_EMPTY * self._count:
            raise LinkposeError(
                f"{self.label}: {count} frames at {self.rate_hz:g} Hz would hold {self._count} poses only: "
                "cut the file at its longest gap"
            )
        return count

    def markers(self) -> Iterator[Floats]:
        """Markers (M, 3, 3) of all frames, in blocks: interpolated, NaN in gaps."""
        count, done, left = self.frames(), 0, self._count
        before: Poses | None = None
        for part in self.parts():
            left -= len(part)
            poses = part if before is None else before.then(part)
            reached = math.floor((float(poses.time_s[-1]) - self.start_s) * self.rate_hz) + 1
            end = min(reached, count) if left else count
            yield self._interpolated(poses, self.start_s + np.arange(done, end) / self.rate_hz)
            before, done = poses[-1:], max(done, end)

    def _interpolated(self, poses: Poses, time_s: Floats) -> Floats:
        """Markers (M, 3, 3) at these times."""
        known, rate = poses.time_s, self.rate_hz
        flat = poses.markers().reshape(-1, 9)
        values = np.column_stack([np.interp(time_s, known, column) for column in flat.T])
        if len(known) > 1:
            after = np.clip(np.searchsorted(known, time_s), 1, len(known) - 1)
            gap = known[after] - known[after - 1]
            exact = np.abs(known[after] - time_s) * rate < 0.5
            exact |= np.abs(known[after - 1] - time_s) * rate < 0.5
            values[(gap * rate > _LONGEST_STEPS) & ~exact] = np.nan
        return values.reshape(-1, 3, 3)
