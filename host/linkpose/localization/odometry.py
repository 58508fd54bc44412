"""Odometry from the estimate of the mice filter, in place of a log's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.localization.events import Event, Log
from linkpose.recording.table import read_table

COLUMNS = ("mice_vx_m_s", "mice_vy_m_s", "mice_wz_rad_s")


def with_mice_odometry(log: Log, path: Path) -> Log:
    """The log with the velocities of an estimate CSV instead of its odometry; both have one clock.

    Rows without a velocity are left out. Raises LinkposeError when the file has no such columns or none of its rows
    lies in the log's time.
    """
    table = read_table(path)
    table.require("time_s", *COLUMNS)
    rows = np.column_stack([table.columns[name] for name in ("time_s", *COLUMNS)])
    inside = np.isfinite(rows).all(axis=1) & (rows[:, 0] >= log[0].time_s) & (rows[:, 0] <= log[-1].time_s)
    if not inside.any():
        raise LinkposeError(
            f"{path} has no velocity between {log[0].time_s:.6g} and {log[-1].time_s:.6g} s, the log's times; "
            "record the mice and the log on one clock"
        )
    events = [Event(row[0], "twist", (row[1], row[2], row[3])) for row in rows[inside].tolist()]
    kept = [event for event in log if not (isinstance(event, Event) and event.kind == "odometry")]
    return sorted([*kept, *events], key=lambda event: event.time_s)
