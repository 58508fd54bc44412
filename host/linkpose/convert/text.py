"""The text formats of OpenSim and the trajectories of the TUM benchmark."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

import numpy as np

from linkpose.convert.motion import Motion
from linkpose.convert.source import Source
from linkpose.sensors.measurements import Floats


def write_sto(file: BinaryIO, _path: Path, motion: Motion) -> None:
    """OpenSense's orientations: one column of quaternions w,x,y,z, which turn the sensor's axes into a world with Z up.

    OpenSim's own world has Y up: pass `sensor_to_opensim_rotations` = (-π/2, 0, 0) to its tools.
    """
    head = [f"DataRate={motion.rate_hz:.6f}", "DataType=Quaternion", "version=3", "OpenSimVersion=4.5", "endheader"]
    rows = (
        f"{t:.6f}\t" + ",".join(f"{part:.9f}" for part in quaternion)
        for poses in motion.parts()
        for t, quaternion in zip(poses.time_s.tolist(), poses.quaternion.tolist(), strict=True)
    )
    _write(file, [*head, f"time\t{motion.label}"], rows)


def write_mot(file: BinaryIO, path: Path, source: Source) -> None:
    """OpenSim's motion file: all columns; angles as their names state."""
    names = [name for name in source.names if name != "time_s"]
    angles = "yes" if any(name.endswith("_deg") for name in names) else "no"
    head = [path.stem, "version=1", f"nRows={source.rows}", f"nColumns={len(names) + 1}", f"inDegrees={angles}"]
    rows = (
        "\t".join(f"{value:.9g}" for value in row)
        for block in source.blocks()
        for row in np.column_stack([block[name] for name in ("time_s", *names)]).tolist()
    )
    _write(file, [*head, "endheader", "\t".join(["time", *names])], rows)


def write_trc(file: BinaryIO, path: Path, motion: Motion) -> None:
    """Three markers in mm at equal intervals, in OpenSim's world with Y up. An empty field is a missing marker."""
    rate, names, count = motion.rate_hz, motion.marker_names, motion.frames()
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate:g}\t{rate:g}\t{count}\t{len(names)}\tmm\t{rate:g}\t1\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{i}" for i in range(1, len(names) + 1) for axis in "XYZ"),
        "",
    ]
    y_up = (1000 * markers[:, :, [0, 2, 1]] * [1, 1, -1] for markers in motion.markers())
    # Each row ends with a tab: OpenSim drops a last field that is empty.
    rows = (
        f"{i + 1}\t{motion.start_s + i / rate:.6f}\t" + "\t".join(_cells(row)) + "\t"
        for i, row in enumerate(row for block in y_up for row in block.reshape(-1, 9))
    )
    _write(file, head, rows)


def write_tum(file: BinaryIO, _path: Path, motion: Motion) -> None:
    """Time (s), position (m) and quaternion x, y, z, w of each pose; the world has Z up."""
    values = (
        np.column_stack([poses.time_s, poses.position_m, poses.quaternion[:, [1, 2, 3, 0]]]) for poses in motion.parts()
    )
    _write(file, [], (" ".join(f"{value:.9f}" for value in row) for block in values for row in block.tolist()))


def _cells(row: Floats) -> list[str]:
    return ["" if value != value else f"{value:.4f}" for value in row.tolist()]


def _write(file: BinaryIO, head: list[str], rows: Iterable[str]) -> None:
    file.writelines(f"{line}\n".encode(errors="backslashreplace") for line in head)  # a file's name may be no UTF-8
    file.writelines(f"{row}\n".encode() for row in rows)
