"""Odometry from an estimate of the mice or planar filters, in place of a log's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.localization.events import Event, Log
from linkpose.recording.table import read_table

# Best first: the planar filters take the turn rate from the gyro, calibrate the mice and leave out faulty ones.
FILTERS = ("planar_ekf", "planar_ukf", "mice")
QUANTITIES = ("vx_m_s", "vy_m_s", "wz_rad_s")


def with_mice_odometry(log: Log, path: Path) -> Log:
    """The log with the velocities of an estimate CSV instead of its odometry; both have one clock.

    The velocities are those of the first of FILTERS that the file holds. Rows without a velocity are left out. Raises
    LinkposeError when the file has no such columns or none of its rows lies in the log's time.
    """
    table = read_table(path)
    found = [name for name in FILTERS if f"{name}_{QUANTITIES[0]}" in table.columns]
    columns = [f"{(found or ['mice'])[0]}_{quantity}" for quantity in QUANTITIES]
    table.require("time_s", *columns)
    rows = np.column_stack([table.columns[name] for name in ("time_s", *columns)])
    inside = np.isfinite(rows).all(axis=1) & (rows[:, 0] >= log[0].time_s) & (rows[:, 0] <= log[-1].time_s)
    if not inside.any():
        raise LinkposeError(
            f"{path} has no velocity between {log[0].time_s:.6g} and {log[-1].time_s:.6g} s, the log's times; "
            "record the mice and the log on one clock"
        )
    events = [Event(row[0], "twist", (row[1], row[2], row[3])) for row in rows[inside].tolist()]
    kept = [event for event in log if not (isinstance(event, Event) and event.kind == "odometry")]
    return sorted([*kept, *events], key=lambda event: event.time_s)
