"""Writes the truth of a simulated rig: the reference that `evaluate` reads."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from linkpose.recording.csvfile import CsvFile
from linkpose.sensors.measurements import Floats

_DECIMALS = 9
_BLOCK = 50_000  # rows that are text at once


def write_truth(path: Path, columns: Mapping[str, Floats], metadata: Mapping[str, Any], force: bool) -> None:
    """Writes columns of equal length (N,), `time_s` first, names with the unit last.

    Raises LinkposeError where the file cannot be made or written, or exists and `force` is not set.
    """
    write_truth_blocks(path, _blocks(columns), metadata, force)


def write_truth_blocks(
    path: Path, blocks: Iterable[Mapping[str, Floats]], metadata: Mapping[str, Any], force: bool
) -> None:
    """The same from consecutive blocks of rows, one in memory at a time; at least one, all with the same columns."""
    rest = iter(blocks)
    first = next(rest)
    line = ",".join([f"%.{_DECIMALS}f"] * len(first)) + "\n"
    rows = 0
    with CsvFile(path, "truth", metadata, list(first), force) as file:
        for block in itertools.chain([first], rest):
            table = np.column_stack(list(block.values())).tolist()
            file.write("".join(line % tuple(row) for row in table))
            rows += len(table)
        file.close({"rows": rows})


def _blocks(columns: Mapping[str, Floats]) -> Iterator[Mapping[str, Floats]]:
    count = len(next(iter(columns.values())))
    for start in range(0, max(count, 1), _BLOCK):
        yield {name: column[start : start + _BLOCK] for name, column in columns.items()}
