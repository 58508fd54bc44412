"""What is converted: a table of any length, read in blocks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from linkpose.convert.poses import Block, has_orientation, poses_of
from linkpose.errors import UnknownFilter
from linkpose.quantities import by_filter, split
from linkpose.recording.ahead import ahead
from linkpose.recording.table import Progress, TableFile
from linkpose.sensors.measurements import Floats


class Source:
    """A table after a first pass over its rows; `blocks` reads them once more.

    `wanted` keeps the columns of one filter, and raises UnknownFilter if it has none. `has_poses` is whether the first
    pass also finds the poses that are estimated, as a Motion needs it. `progress` is called with the share that is done
    of `passes` passes. Raises as TableFile does.
    """

    def __init__(self, file: TableFile, wanted: str | None, has_poses: bool, passes: int, progress: Progress) -> None:
        self._file, self._passes, self._progress = file, passes, progress
        self._passes_done = 0
        self.path, self.kind, self.metadata, self.remarks = file.path, file.kind, file.metadata, list(file.remarks)
        self.names = file.names if wanted is None else _columns_of(file.names, wanted)
        # Prefixes of the filters whose poses are found, in the order of their columns.
        self.oriented = _oriented(self.names) if has_poses else []
        self.rows = 0
        times: list[Floats] = []
        known: dict[str, list[NDArray[np.bool_]]] = {prefix: [] for prefix in self.oriented}
        for block in self.blocks():
            self.rows += len(block[self.names[0]])
            if has_poses and "time_s" in block:
                times.append(block["time_s"].copy())  # a view would hold all columns of the block
                for prefix, rows in known.items():
                    rows.append(poses_of(block, prefix).is_known)
        self.closing = file.closing
        self._time_s = np.concatenate([*times, np.empty(0)])
        self._known = {prefix: np.concatenate([*rows, np.empty(0, np.bool_)]) for prefix, rows in known.items()}

    def times_of(self, prefix: str) -> Floats:
        """The stamps (N,) of the poses that the filter with this prefix has estimated."""
        return np.asarray(self._time_s[self._known[prefix]])

    def require(self, *names: str) -> None:
        """Raises FileFormatError unless the table has all these columns."""
        self._file.require(*names)

    def blocks(self) -> Iterator[Block]:
        """All rows, from the first to the last."""

        def note(share: float) -> None:
            self._progress(min(1.0, (self._passes_done + share) / self._passes))

        for part in ahead(self._file.parts(note)):
            yield {name: part.columns[name] for name in self.names}
        self._passes_done += 1


def _oriented(names: list[str]) -> list[str]:
    """Prefixes of the filters with an orientation."""
    prefixes = dict.fromkeys(part.prefix for name in names if (part := split(name)))
    return [prefix for prefix in prefixes if has_orientation(names, prefix)]


def _columns_of(names: list[str], wanted: str) -> list[str]:
    """time_s and the columns of this filter."""
    prefix = wanted.replace("-", "_")
    own = [name for name in names if (part := split(name)) and part.prefix == prefix]
    if not own:
        raise UnknownFilter(wanted, [name.replace("_", "-") for name in by_filter(names)])
    return ["time_s", *own] if "time_s" in names else own
