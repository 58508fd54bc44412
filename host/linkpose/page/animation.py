"""An estimate as one HTML file that plays the motion in 3-D in any browser, without linkpose and without a network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from linkpose.errors import CannotWrite
from linkpose.page.drawing import Drawing
from linkpose.page.history import Replay
from linkpose.page.page import LOOPBACK, free_port, serve
from linkpose.sensors.measurements import Floats
from linkpose.sensors.rig import Rig

if TYPE_CHECKING:
    from linkpose.page.scene import Surroundings

FRAME_INTERVAL_S = 0.05  # motion looks smooth at 20 Hz
MOST_FRAMES = 2400  # two minutes at 20 Hz, about 1 MB; a longer recording gets fewer frames per second


def save_animation(
    path: Path, columns: Sequence[str], values: Floats, rig: Rig, surroundings: Surroundings | None
) -> None:
    """Writes the estimates (N ≥ 1, columns) as an animation in real time; the first column is the time (s).

    viser records the scene's messages while a server runs on the loopback address. Raises CannotWrite.
    """
    server = serve(LOOPBACK, free_port(LOOPBACK), is_named=False)
    try:
        drawing, replay = Drawing(server, columns, rig, surroundings), Replay(values)
        start, end = replay.span_s
        frames = int(np.clip(round((end - start) / FRAME_INTERVAL_S), 1, MOST_FRAMES)) + 1
        recorded = server.get_scene_serializer()
        for time_s in np.linspace(start, end, frames):
            replay.seek(float(time_s))
            newest = replay.newest
            row = drawing.read(newest)
            name = drawing.best(row)
            if name is not None:
                drawing.draw(newest, row, name, replay)
            recorded.insert_sleep((end - start) / frames)
        text = recorded.as_html()
    finally:
        server.stop()
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CannotWrite(path, error.strerror or str(error)) from error
