"""References from the marker files of motion-capture programs: C3D and TRC.

Three markers on the sensor are used, as `linkpose.evaluation.takes` describes: those whose names end in _O, _X and _Y
(as `linkpose convert` names them), or else the first three that have a name.
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from linkpose.errors import FileFormatError, LinkposeError, MissingLibrary
from linkpose.evaluation.c3dcheck import Damaged, check_sizes
from linkpose.evaluation.takes import reference_of, take_of_markers
from linkpose.inputs import read_bytes
from linkpose.recording.delimited import text_lines, to_utf8
from linkpose.recording.table import Table
from linkpose.sensors.measurements import Floats

_METRES = {"m": 1.0, "meters": 1.0, "dm": 0.1, "cm": 0.01, "centimeters": 0.01, "mm": 0.001, "millimeters": 0.001}
_FARTHEST_M = 1e6
_LARGEST = 1e15  # of a coordinate in any unit; larger ones count as hidden
# Bounds of the process that reads a C3D file, for an empty file and for each byte. An hour of ten markers at 100 Hz
# (60 MB) takes 2 s and 0.2 GB; starting takes up to 3 s on a busy machine. Doubled: a damaged file costs twice.
_LONGEST_S = 8.0
_LONGEST_S_PER_BYTE = 2e-7
_MOST_BYTES = 400_000_000
_MOST_BYTES_PER_BYTE = 10
_LONGEST_REASON = 200
_HEAD_LINES = 5  # of a TRC file, before its frames


def is_c3d(start: bytes) -> bool:
    """Whether a file begins as a C3D file does: the second byte is 0x50 (C3D user guide, header section)."""
    return len(start) > 1 and start[1] == 0x50 and 1 <= start[0] <= 0x20


def is_trc(start: bytes) -> bool:
    """Whether a file begins as a TRC file does."""
    return to_utf8(start).startswith(b"PathFileType")


def read_c3d(path: Path, up: str | None) -> Table:
    """The take in a C3D file. `up` None: the axis that the file states (POINT:Y_SCREEN), or else "z".

    Raises MissingLibrary without ezc3d, and LinkposeError naming the file and what is missing in it.
    """
    try:
        importlib.import_module("ezc3d")
    except ImportError as error:
        raise MissingLibrary("ezc3d", path) from error
    try:
        check_sizes(read_bytes(path))
        positions, names, rate_hz, unit, screen, first = _read_in_child(path)
    except Damaged as error:
        raise FileFormatError(path, f"{path} is damaged or no C3D file: {error}; export the take again") from error
    positions[~(np.abs(positions) < _LARGEST)] = np.nan
    if not 0 < rate_hz < _FARTHEST_M:
        raise FileFormatError(path, f"{path} states a rate of {rate_hz:g} Hz; export the take again")
    time_s = (first + np.arange(len(positions))) / rate_hz
    axis = up or (screen[-1:].lower() if screen[-1:].lower() in ("y", "z") else "z")
    return _reference(path, time_s, names, positions, unit, axis)


# On some damaged files, ezc3d crashes, needs minutes, or takes gigabytes: it has a process of its own with bounds.
_CHILD = """
import json, sys
import ezc3d
import numpy
try:
    import resource
    pages = int(open("/proc/self/statm").read().split()[0])
    limit = pages * resource.getpagesize() + int(sys.argv[3])
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.getrlimit(resource.RLIMIT_AS)[1]))
except (ImportError, OSError):
    pass  # not Linux: the time alone is bounded
file = ezc3d.c3d(sys.argv[1])
points = file["parameters"]["POINT"]
facts = [
    [str(name) for name in points["LABELS"]["value"]],
    float(points["RATE"]["value"][0]),
    str(points.get("UNITS", {}).get("value", ["mm"])[0]),
    str(points.get("Y_SCREEN", {}).get("value", [""])[0]),
    int(file["header"]["points"]["first_frame"]),
]
positions = numpy.array(file["data"]["points"], dtype=numpy.float64)[:3].transpose(2, 1, 0)
numpy.savez(sys.argv[2], positions=positions, facts=json.dumps(facts))
"""


def _read_in_child(path: Path) -> tuple[Floats, list[str], float, str, str, int]:
    """Positions (N, markers, 3), names, rate (Hz), unit, vertical axis of the screen, and number of the first frame.

    Raises Damaged where ezc3d cannot read the file within the bounds.
    """
    size = path.stat().st_size
    most_bytes = _MOST_BYTES + _MOST_BYTES_PER_BYTE * size
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "take.npz")
        child = [sys.executable, "-c", _CHILD, str(path.resolve()), str(out), str(most_bytes)]
        longest_s = _LONGEST_S + _LONGEST_S_PER_BYTE * size
        try:
            done = subprocess.run(child, capture_output=True, text=True, errors="replace", timeout=longest_s)
        except subprocess.TimeoutExpired:
            raise Damaged(f"ezc3d does not finish within {longest_s:.0f} s") from None
        if done.returncode:
            last = (done.stderr.strip().splitlines() or [""])[-1]
            if "MemoryError" in last or "bad_alloc" in last:
                last = f"ezc3d needs more than {most_bytes / 1e6:.0f} MB for it"
            raise Damaged(last[:_LONGEST_REASON] if last and done.returncode > 0 else "ezc3d has crashed")
        with np.load(out) as found:
            return found["positions"], *json.loads(str(found["facts"]))


def read_trc(path: Path, up: str | None) -> Table:
    """The take in a TRC file; `up` None: "y", as OpenSim has it. An empty field is a hidden marker.

    Raises LinkposeError naming the file and what is missing in it.
    """
    lines = text_lines(to_utf8(read_bytes(path)))
    head = [line.split("\t") for line in lines[:_HEAD_LINES]]
    facts = dict(zip(head[1], head[2], strict=False)) if len(head) == _HEAD_LINES else {}
    names = [name.strip() for name in head[3][2::3]] if facts else []
    while names and not names[-1]:
        names.pop()
    if not names:
        raise FileFormatError(path, f"{path} has no marker names in line 4: export the take as TRC again")
    rows = [(number, line) for number, line in enumerate(lines, 1) if number > _HEAD_LINES and line.strip()]
    if not rows:
        raise FileFormatError(path, f"{path} has no frame: export the take with its frames")
    values = np.array([_trc_row(path, line, number, 3 * len(names)) for number, line in rows])
    positions = values[:, 1:].reshape(len(values), len(names), 3)
    return _reference(path, values[:, 0], names, positions, facts.get("Units", "mm").strip(), up or "y", rows[0][0])


def _trc_row(path: Path, line: str, number: int, width: int) -> Floats:
    """Time and coordinates of a frame, NaN where a field is empty."""
    cells = line.split("\t")[1 : 2 + width]
    try:
        found = [float(cell.replace(",", ".")) if cell.strip() else np.nan for cell in cells]
        found = [value if abs(value) < _LARGEST else np.nan for value in found]
    except ValueError:
        raise FileFormatError(
            path, f"{path}, line {number}: a field is not a number; export the take again", number
        ) from None
    return np.array(found + [np.nan] * (1 + width - len(found)))


def _reference(
    path: Path, time_s: Floats, names: Sequence[str], positions: Floats, unit: str, up: str, first_line: int = 1
) -> Table:
    """The reference from markers (N, markers, 3) of these names, in `unit`."""
    if unit.lower() not in _METRES:
        raise FileFormatError(path, f"{path}: unknown unit {unit[:20]!r} of length; export in m or mm")
    chosen = _choose(names)
    if len(chosen) < 3 or positions.shape[1] < max(chosen) + 1:
        raise LinkposeError(
            f"{path} has {len(chosen)} named markers; three are needed: at the sensor, along its x axis, and on the "
            "side of its y axis"
        )
    markers = _METRES[unit.lower()] * positions[:, chosen]
    if (np.abs(markers[np.isfinite(markers)]) > _FARTHEST_M).any():
        raise FileFormatError(path, f"{path} holds positions that no camera system gives; export the take again")
    left = [name for at, name in enumerate(names) if at not in chosen and name]
    remarks = [f"{path}: the markers are {', '.join(names[at] for at in chosen)}"]
    remarks += [f"{path}: markers left out: {', '.join(left[:10])}"] if left else []
    return reference_of(path, take_of_markers(path, time_s, markers, remarks, first_line), up)


def _choose(names: Sequence[str]) -> list[int]:
    """The numbers of the three markers on the sensor."""
    ends = [next((at for at, name in enumerate(names) if name.endswith(end)), None) for end in ("_O", "_X", "_Y")]
    if all(at is not None for at in ends):
        return [at for at in ends if at is not None]
    return [at for at, name in enumerate(names) if name and not name.startswith("*")][:3]
