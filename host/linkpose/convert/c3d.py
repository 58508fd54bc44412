"""C3D, the binary format of motion-capture programs, by `ezc3d`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from linkpose.convert import libraries
from linkpose.convert.motion import Motion


def write(path: Path, motion: Motion) -> None:
    """Three markers in mm at equal intervals; the world has Z up. A missing marker has the residual −1."""
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
    file.write(str(path))
