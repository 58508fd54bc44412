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

from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from linkpose.convert import c3d, mcap, parquet, text
from linkpose.convert.motion import Motion, motion_of, only_filter
from linkpose.errors import InvalidValue
from linkpose.outputs import new_file
from linkpose.recording.table import Table, read_table

_OF_MOTION: dict[str, Callable[[BinaryIO, Path, Motion], None]] = {
    ".sto": text.write_sto,
    ".trc": text.write_trc,
    ".c3d": c3d.write,
    ".tum": text.write_tum,
}
_OF_TABLE: dict[str, Callable[[BinaryIO, Path, Table], None]] = {
    ".mot": text.write_mot,
    ".mcap": mcap.write,
    ".parquet": parquet.write,
}
ENDINGS = (*_OF_MOTION, *_OF_TABLE)


def convert(
    source: Path, output: Path, wanted: str | None = None, label: str = "sensor_imu", force: bool = False
) -> list[str]:
    """Writes `source`, a table that linkpose reads, in the format of the ending of `output`; gives remarks.

    `wanted` names the filter; without it, formats of one motion hold the first filter that fits, and formats of columns
    hold all. `label` names the sensor in formats with names. An existing output is kept unless `force`. Raises
    FileError, MissingLibrary, UnknownFilter, or LinkposeError where the source has no motion.
    """
    ending = output.suffix.lower()
    if ending not in ENDINGS:
        raise InvalidValue("output", f"ends in {ending or 'nothing'}; the formats are {', '.join(ENDINGS)}")
    table = read_table(source)
    remarks = list(table.remarks)
    if ending in _OF_MOTION:
        motion = motion_of(table, wanted, label)
        remarks += motion.remarks
        with new_file(output, force) as file:
            _OF_MOTION[ending](file, output, motion)
    else:
        part = only_filter(table, wanted) if wanted else table
        with new_file(output, force) as file:
            _OF_TABLE[ending](file, output, part)
    return remarks
