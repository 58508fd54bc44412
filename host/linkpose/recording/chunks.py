"""Reads text files of any length in pieces of whole lines."""

from __future__ import annotations

import codecs
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from linkpose.errors import FileFormatError
from linkpose.recording.delimited import codec_of

# Twice of it doubles the memory of a run (about ten times as much) and saves no time.
CHUNK_BYTES = 8_000_000


class Chunk(NamedTuple):
    """Consecutive whole lines of a file, in UTF-8 without a byte order mark."""

    data: bytes
    first_line: int  # its number, from 1
    is_last: bool
    end: int  # bytes of the file up to here


def read_chunks(path: Path, file: BinaryIO) -> Iterator[Chunk]:
    """The file from its start. The last piece may be empty, or end without a line end.

    Raises FileFormatError for a line that is longer than a piece.
    """
    file.seek(0)
    raw = file.read(CHUNK_BYTES).removeprefix(b"\xef\xbb\xbf")
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
