"""Reads estimates and references of any kind of file."""

from __future__ import annotations

from pathlib import Path

from linkpose.evaluation.markers import is_c3d, is_trc, read_c3d, read_trc
from linkpose.evaluation.motive import is_motive, read_motive
from linkpose.inputs import open_binary
from linkpose.recording.table import Progress, Table, read_table
from linkpose.recording.thinned import read_thinned


def read_any(path: Path, up: str | None = None) -> Table:
    """A take (C3D, TRC, Motive's CSV), or any other table, with the errors of their readers.

    `up` is the axis of the room that points upwards, "y" or "z"; None: as the format has it.
    """
    return read_take(path, up) or read_table(path)


def read_for_picture(path: Path, up: str | None = None, progress: Progress | None = None) -> Table:
    """As `read_any`; of a long table, the rows that a picture shows."""
    return read_take(path, up) or read_thinned(path, progress)


def read_take(path: Path, up: str | None) -> Table | None:
    """The take (C3D, TRC, Motive's CSV) in a file; None for any other file."""
    with open_binary(path) as file:
        start = file.read(64)
    if is_c3d(start):
        return read_c3d(path, up)
    if is_trc(start):
        return read_trc(path, up)
    return read_motive(path, up or "y") if is_motive(start) else None
