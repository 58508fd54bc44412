"""Converts estimates and recordings into the formats of other programs.

| ending | read by | content |
|---|---|---|
| `.sto` | OpenSim (OpenSense) | orientation of the sensor, quaternions w, x, y, z, Z up |
| `.mot` | OpenSim | all columns |
| `.trc` | OpenSim, motion-capture programs | three markers on the sensor, mm, Y up |
| `.c3d` | motion-capture programs | three markers on the sensor, mm, Z up |
| `.tum` | evo | positions (m) and quaternions x, y, z, w, Z up |
| `.mcap` | Foxglove, ROS 2 tools | pose (`foxglove.PoseInFrame`) and all columns, as JSON |
| `.parquet` | pandas, polars, linkpose | all columns with the metadata |
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from linkpose.convert import c3d, mcap, parquet, text
from linkpose.convert.motion import Motion
from linkpose.convert.source import Source
from linkpose.errors import InvalidValue
from linkpose.outputs import new_file
from linkpose.recording.table import Progress, TableFile

_OF_MOTION: dict[str, Callable[[BinaryIO, Path, Motion], None]] = {
    ".sto": text.write_sto,
    ".trc": text.write_trc,
    ".c3d": c3d.write,
    ".tum": text.write_tum,
}
_OF_TABLE: dict[str, Callable[[BinaryIO, Path, Source], None]] = {
    ".mot": text.write_mot,
    ".mcap": mcap.write,
    ".parquet": parquet.write,
}
ENDINGS = (*_OF_MOTION, *_OF_TABLE)

# Passes over the source: the first finds what a head states, the last of .mcap writes the poses.
_PASSES = dict.fromkeys(ENDINGS, 2) | {".mcap": 3}
_WITH_TIMES = (".mot", ".mcap")
_WITH_POSES = (*_OF_MOTION, ".mcap")


def convert(
    source: Path,
    output: Path,
    wanted: str | None = None,
    label: str = "sensor_imu",
    force: bool = False,
    progress: Progress = lambda share: None,
) -> list[str]:
    """Writes `source`, a table that linkpose reads, in the format of the ending of `output`; gives remarks.

    `wanted` names the filter; without it, formats of one motion hold the first filter that fits, and formats of columns
    hold all. `label` names the sensor in formats with names. An existing output is kept unless `force`. `progress` is
    called with the share of the work that is done. Raises FileError, MissingLibrary, UnknownFilter, or LinkposeError
    where the source has no motion.
    """
    ending = output.suffix.lower()
    if ending not in ENDINGS:
        raise InvalidValue("output", f"ends in {ending or 'nothing'}; the formats are {', '.join(ENDINGS)}")
    with contextlib.closing(TableFile(source)) as file:
        if ending in _WITH_TIMES:
            file.require("time_s")
        table = Source(file, wanted, ending in _WITH_POSES, _PASSES[ending], progress)
        if ending not in _OF_MOTION:
            with new_file(output, force) as written:
                _OF_TABLE[ending](written, output, table)
            return table.remarks
        motion = Motion(table, wanted, label)
        with new_file(output, force) as written:
            _OF_MOTION[ending](written, output, motion)
        return table.remarks + motion.remarks
