"""Reads a localization log of either format, as any program saves it."""

from __future__ import annotations

from pathlib import Path

from linkpose.inputs import open_binary
from linkpose.localization.carmen import is_carmen, read_carmen
from linkpose.localization.events import LogFile, read_events
from linkpose.recording.delimited import text_lines, to_utf8


def read_log(path: Path) -> LogFile:
    """Reads a CARMEN log or a CSV log, in UTF-8, UTF-16 or the encoding of Windows, from a file or a pipe.

    Raises LinkposeError with file, line and cure for what cannot be read.
    """
    with open_binary(path, "the log") as file:
        lines = text_lines(to_utf8(file.read()))  # the last one ends without a line end
    return read_carmen(path, lines) if is_carmen(lines) else read_events(path, lines)
