"""Estimated paths as a table: in memory for a picture, as a CSV of estimates, or row by row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from linkpose import __version__
from linkpose.localization.localizer import Row
from linkpose.localization.track import Track
from linkpose.recording.csvfile import CsvFile
from linkpose.recording.table import Table

_UNITS = ("rad_s", "m_s", "rad", "m")  # of states, the longer ones first


def table_of(tracks: Mapping[str, Track], log: Path) -> Table:
    """The paths by filter, with one time axis, as `write_table` writes them; `log` names the table."""
    first = next(iter(tracks.values()))
    columns = {"time_s": first.time_s}
    for name, track in tracks.items():
        values = [*track.state.T, *track.std.T, *(track.covariance[:, i, j] for i, j in _pairs(track.names))]
        columns |= dict(zip(_columns(name, track.names), values, strict=True))
    rejected = {f"{_prefix(name)}_rejected": track.rejected for name, track in tracks.items()}
    metadata = {"software": __version__, "log": log.name, "filters": list(tracks)}
    return Table(log, "estimate", columns, metadata, {"rows": len(first.time_s), **rejected}, 1)


def write_table(path: Path, table: Table, force: bool) -> None:
    """The estimate CSV: `time_s`, then for each filter its states, their standard deviations, and the covariances of x,
    y and the heading. Raises LinkposeError where the file cannot be made.
    """
    with CsvFile(path, table.kind, table.metadata, list(table.columns), force) as file:
        rows = np.column_stack(list(table.columns.values()))
        line = "%.6f" + ",%.9g" * (rows.shape[1] - 1) + "\n"
        file.write("".join(line % tuple(row) for row in rows.tolist()).replace("nan", ""))
        file.close(table.closing or {})


def header_line(name: str, states: Sequence[str]) -> str:
    """The header of the rows that `row_line` makes."""
    return ",".join(["time_s", *_columns(name, states)])


def row_line(row: Row) -> str:
    """One estimate as a row; empty cells while the pose is not known."""
    std = np.sqrt(np.maximum(np.diagonal(row.covariance), 0.0))
    pairs = (row.covariance[i, j] for i, j in _pairs(row.state))
    values = ",".join(f"{value:.9g}" for value in (*row.state, *std, *pairs))
    return f"{row.time_s:.6f},{values}".replace("nan", "")


def std_name(state: str) -> str:
    """The column of a state's standard deviation. The unit stays last: x_m, x_std_m."""
    unit = next((f"_{unit}" for unit in _UNITS if state.endswith(f"_{unit}")), "")
    return f"{state.removesuffix(unit)}_std{unit}"


def _columns(name: str, states: Sequence[str]) -> list[str]:
    names = [*states, *map(std_name, states), *(f"cov_{states[i]}_{states[j]}" for i, j in _pairs(states))]
    return [f"{_prefix(name)}_{column}" for column in names]


def _prefix(name: str) -> str:
    return name.replace("-", "_")


def _pairs(states: Sequence[object] | np.ndarray[tuple[int], np.dtype[np.float64]]) -> list[tuple[int, int]]:
    """Which covariances are written: of the first three states."""
    return [(i, j) for i in range(2) for j in range(i + 1, min(3, len(states)))]
