"""Writes the truth of a simulated rig: the reference that `evaluate` reads."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from linkpose.recording.csvfile import CsvFile
from linkpose.sensors.measurements import Floats

_DECIMALS = 9


def write_truth(path: Path, columns: Mapping[str, Floats], metadata: Mapping[str, Any], force: bool) -> None:
    """Writes columns of equal length (N,), `time_s` first, names with the unit last.

    Raises LinkposeError where the file cannot be made or written, or exists and `force` is not set.
    """
    rows = np.column_stack(list(columns.values())).tolist()
    line = ",".join([f"%.{_DECIMALS}f"] * len(columns)) + "\n"
    with CsvFile(path, "truth", metadata, list(columns), force) as file:
        file.write("".join(line % tuple(row) for row in rows))
        file.close({"rows": len(rows)})
