"""An estimate as one HTML file that plays the motion in 3-D in any browser, without linkpose and without a network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from linkpose import plotting
from linkpose.localization.surroundings import Surroundings
from linkpose.outputs import new_file
from linkpose.page.changes import Changes
from linkpose.page.client import titled
from linkpose.page.drawing import Drawing
from linkpose.page.history import Replay
from linkpose.page.page import LOOPBACK, free_port, serve
from linkpose.page.tables import rig_of, rows_of
from linkpose.recording.table import Table
from linkpose.sensors.measurements import Floats
from linkpose.sensors.rig import Rig

ENDING = ".html"
FORMATS = (*plotting.FORMATS, ENDING)  # of pictures of estimates
FRAME_INTERVAL_S = 0.05  # motion looks smooth at 20 Hz
MOST_FRAMES = 2400  # two minutes at 20 Hz, about 1 MB; a longer recording gets fewer frames per second
_SLOW_INTERVAL = 5  # frames between two of σ and of the path, which is larger than a pose


def save_picture(
    path: Path, tables: Sequence[Table], wanted: Sequence[str], surroundings: Surroundings, force: bool
) -> list[str]:
    """Draws tables as `plotting.plot_tables` does, or as an animation where the name ends in .html.

    Returns remarks for the user. Raises FileError, and LinkposeError where there is nothing to draw.
    """
    if path.suffix.lower() == ENDING:
        save_animation(path, tables, wanted, surroundings, force)
        return []
    figure, remarks = plotting.plot_tables(tables, wanted, surroundings)
    plotting.save(figure, path, force)
    return remarks


def save_animation(
    path: Path, tables: Sequence[Table], wanted: Sequence[str], surroundings: Surroundings, force: bool
) -> None:
    """Writes the first estimate, with the reference if there is one, as an animation in real time.

    `wanted` names filters; without any, all are shown. Raises FileError, and LinkposeError without an estimate.
    """
    plotting.check_output(path, force, FORMATS)
    columns, values = rows_of(tables, wanted)
    text = _recorded(columns, values, rig_of(tables), surroundings)
    with new_file(path, force) as file:
        file.write(text.encode())


def _recorded(columns: Sequence[str], values: Floats, rig: Rig, surroundings: Surroundings) -> str:
    """HTML that plays rows (N ≥ 1, columns). viser records the scene while a server runs on the loopback address."""
    server = serve(LOOPBACK, free_port(LOOPBACK), is_named=False)
    try:
        changes, replay = Changes(server), Replay(values)
        drawing = Drawing(server, changes, columns, rig, surroundings, values)
        start, end = replay.span_s
        frames = int(np.clip(round((end - start) / FRAME_INTERVAL_S), 1, MOST_FRAMES)) + 1
        recorded = server.get_scene_serializer()
        for at, time_s in enumerate(np.linspace(start, end, frames)):
            replay.seek(float(time_s))
            newest = replay.newest.tolist()
            name = drawing.best(newest)
            if name is not None:
                row = drawing.draw(newest, name)
                if at % _SLOW_INTERVAL == 0:
                    drawing.draw_slow(row, name, replay)
                changes.queue()
            recorded.insert_sleep((end - start) / frames)
        return titled(recorded.as_html())
    finally:
        server.stop()
