"""C3D, the binary format of motion-capture programs, by `ezc3d`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import BinaryIO

import numpy as np

from linkpose.convert import libraries
from linkpose.convert.motion import Motion


def write(output: BinaryIO, path: Path, motion: Motion) -> None:
    """Three markers in mm at equal intervals; the world has Z up. A missing marker has the residual −1.

    ezc3d writes to a file name only; the file is created in a private folder, which no other user can write.
    """
    ezc3d = libraries.load("ezc3d", path)
    markers = np.concatenate(list(motion.markers()))
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [motion.rate_hz]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["LABELS"]["value"] = tuple(motion.marker_names)
    file.add_parameter("POINT", "X_SCREEN", "+X")
    file.add_parameter("POINT", "Y_SCREEN", "+Z")
    points = np.ones((4, 3, len(markers)))
    points[:3] = 1000 * markers.transpose(2, 1, 0)
    file["data"]["points"] = points
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "motion.c3d"
        file.write(str(written))
        output.write(written.read_bytes())
