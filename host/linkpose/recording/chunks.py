"""Reads text files of any length in pieces of whole lines."""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from linkpose.errors import FileFormatError
from linkpose.recording.delimited import codec_of

# Doubling it doubles the memory of a run (about ten times as much) and saves no time.
CHUNK_BYTES = 8_000_000

# How files of other formats begin.
_FORMATS = (
    (rb"\x89PNG|\xff\xd8\xff|GIF8|BM.{4}\0\0\0\0", "a picture"),
    (rb"%PDF", "a PDF document"),
    (rb"PK\x03\x04|\xd0\xcf\x11\xe0", "a workbook of a spreadsheet or an archive; save its table as CSV"),
    (rb"\x1f\x8b|BZh|\xfd7zXZ|\x28\xb5\x2f\xfd", "a compressed file; unpack it"),
    (rb"MATLAB 5|\x89HDF", "a file of MATLAB or HDF5; save its table as CSV"),
    (rb"[\x02-\x0f]P[\0-\xff]{4}", "a C3D file, which only `evaluate` and `plot` read, as a reference"),
    (rb"\s*\{\s*\"", "JSON"),
)
_FIRST_FRAME_BYTES = 512  # longer than any frame of a raw capture, which a zero byte ends
_BINARY = "binary data; a raw capture has a name in .bin, and `info`, `estimate` and `calibrate` read it"


class Chunk(NamedTuple):
    """Consecutive whole lines of a file, in UTF-8 without a byte order mark."""

    data: bytes
    first_line: int  # its number, from 1
    is_last: bool
    end: int  # bytes of the file up to here


def read_chunks(path: Path, file: BinaryIO) -> Iterator[Chunk]:
    """The file from its start. The last piece may be empty, or end without a line end.

    Raises FileFormatError for a line that is longer than a piece, and for a file of another format.
    """
    file.seek(0)
    raw = file.read(CHUNK_BYTES).removeprefix(b"\xef\xbb\xbf")
    _refuse_other_formats(path, raw)
    to_utf8 = _converter(raw)
    rest, line = b"", 1
    while True:
        following = file.read(CHUNK_BYTES)
        data = rest + to_utf8(raw, not following)
        if not following:
            yield Chunk(data, line, True, file.tell())
            return
        end = _last_line_end(data)
        if not end and len(data) > CHUNK_BYTES:
            raise FileFormatError(path, f"{path}, line {line} is longer than {CHUNK_BYTES} bytes: this is no table")
        rest = data[end:]
        if end:
            yield Chunk(data[:end], line, False, file.tell() - len(following) - len(rest))
            line += data.count(b"\n") or data.count(b"\r")
        raw = following


def _refuse_other_formats(path: Path, data: bytes) -> None:
    """Raises FileFormatError for a file that begins with these bytes as a picture, a workbook or the like does."""
    for beginning, what in _FORMATS:
        if re.match(beginning, data):
            raise FileFormatError(path, f"{path} is no table but {what}")
    if b"\0" in data[:_FIRST_FRAME_BYTES] and codec_of(data) == "utf-8-sig":
        raise FileFormatError(path, f"{path} is no table but {_BINARY}")


def _converter(start: bytes) -> Callable[[bytes, bool], bytes]:
    """Converts consecutive parts of a file that begins with `start` to UTF-8; the second argument marks the last."""
    codec = codec_of(start)
    if codec == "utf-8-sig":
        return lambda data, _: data
    decoder = codecs.getincrementaldecoder(codec)("replace")
    return lambda data, is_last: decoder.decode(data, is_last).encode("utf-8", "replace")


def _last_line_end(data: bytes) -> int:
    """Where the last whole line ends; a carriage return at the end may be half of a line end."""
    return data.rfind(b"\n") + 1 or data.rfind(b"\r", 0, len(data) - 1) + 1
