"""Tables as text: what linkpose, spreadsheets, pandas and R write, in blocks of rows."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from linkpose.errors import FileFormatError
from linkpose.inputs import open_binary
from linkpose.recording.chunks import Chunk, read_chunks
from linkpose.recording.delimited import Cells, DecimalMark, has_rows, last_comment, split_cells, text_lines
from linkpose.recording.numbers import parse_rows
from linkpose.sensors.measurements import Floats

_OF_OTHERS = re.compile(rb"[\";\t]")  # in a header that another program wrote
_LETTER = re.compile(rb"[A-Za-z_]")


class Part(NamedTuple):
    """Consecutive rows of a table."""

    columns: dict[str, Floats]  # (N,) each
    first_line: int  # line number of the first row

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))


class TextTable:
    """A text file of rows and columns. Attributes: kind, names, metadata, remarks; closing after a pass over the rows.

    Raises FileFormatError naming the file and the line for what is no table of numbers.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = open_binary(path)
        self.kind = ""
        self.names: list[str] = []
        self.metadata: dict[str, Any] = {}
        self.closing: dict[str, Any] | None = None
        self.remarks: tuple[str, ...] = ()
        self._before: list[str] = []  # the lines up to the names
        self._mark = DecimalMark()
        first = next(read_chunks(path, self._file))
        found = self._first_of_linkpose(first) or self._first_of_others(first)
        self._first, self._is_one_part = found, first.is_last

    def parts(self, progress: Callable[[float], None] | None = None) -> Iterator[Part]:
        """The rows from the first to the last. `progress` is called with the share that was read."""
        size = self._size()
        chunks = read_chunks(self._path, self._file)
        end = next(chunks).end if not self._is_one_part else size
        if progress is not None:
            progress(end / size)
        yield self._first
        if self._is_one_part:
            return
        self._mark.comma = self._mark.point = ""
        for chunk in chunks:
            if progress is not None:
                progress(min(1.0, chunk.end / size))
            part = self._part_of_linkpose(chunk) or self._part_of_others(chunk)
            if part is not None:
                yield part

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def _size(self) -> int:
        return max(1, self._file.seek(0, 2))

    # ---- linkpose's own ----

    def _first_of_linkpose(self, chunk: Chunk) -> Part | None:
        """The head and the first rows exactly as linkpose writes them; None for any other table."""
        data = chunk.data
        lines_before, offset, comments = _head_lines(data)
        if any(comment.endswith((",", ";")) for comment in comments):  # padded by a spreadsheet
            return None
        self.kind = _kind(self._path, comments)
        header_end = data.find(b"\n", offset)
        header = data[offset:header_end] if header_end >= 0 else b""
        names = [name.strip() for name in header.decode("utf-8", "replace").split(",")]
        if _OF_OTHERS.search(header) or not _LETTER.search(header) or len(set(names)) < len(names) or "" in names:
            return None
        self.names, self._before = names, text_lines(data[:header_end])
        part = self._part_of_linkpose(Chunk(data[header_end + 1 :], lines_before + 2, chunk.is_last, chunk.end))
        if part is None:
            return None
        self.metadata = metadata_of(self._path, comments[1], 2) if self.kind and len(comments) > 1 else {}
        return part

    def _part_of_linkpose(self, chunk: Chunk) -> Part | None:
        body = chunk.data
        if chunk.is_last:
            if not self.kind and not body.endswith(b"\n"):  # typed by hand, not cut by a kill
                body += b"\n"
            body, self.closing = _closing(body)
        values = parse_rows(body, len(self.names))
        return None if values is None else Part(dict(zip(self.names, values, strict=True)), chunk.first_line)

    # ---- all others ----

    def _first_of_others(self, chunk: Chunk) -> Part:
        """The head and the first rows as other programs write them."""
        cells = split_cells(self._path, chunk.data)
        self.kind = _kind(self._path, [comment.text for comment in cells.head])
        self.metadata, self.remarks = _metadata(cells) if self.kind else ({}, ())
        self.names, self._before = cells.names, text_lines(chunk.data)[: cells.header_lines]
        return self._part_of(cells)

    def _part_of_others(self, chunk: Chunk) -> Part | None:
        lines = text_lines(chunk.data)
        if not has_rows(lines):
            self.closing = last_comment(lines, self._before) or self.closing
            return None
        cells = split_cells(self._path, chunk.data, self._before, chunk.first_line)
        return self._part_of(cells)

    def _part_of(self, cells: Cells) -> Part:
        self.closing = cells.tail[-1].as_object() if cells.tail else None
        return Part(cells.number_columns(self._mark), cells.lines[0])


def _metadata(cells: Cells) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The metadata in the second comment line, and a remark where a spreadsheet damaged it."""
    comment = cells.head[1] if len(cells.head) > 1 else None
    content = comment.as_object() if comment else {}
    if comment is None or content is not None:
        return content or {}, ()
    if comment.is_intact:
        return metadata_of(cells.path, comment.text, comment.line), ()
    return {}, (
        f"{cells.path}, line {comment.line}: a spreadsheet damaged the metadata; the settings and the rig in it are "
        "not used",
    )


def _head_lines(data: bytes) -> tuple[int, int, list[str]]:
    """Number of leading comment lines, where they end, and their texts."""
    offset, comments = 0, []
    while data.startswith(b"#", offset):
        end = data.find(b"\n", offset)
        end = len(data) if end < 0 else end
        comments.append(data[offset + 1 : end].decode("utf-8", "replace").strip())
        offset = end + 1
    return len(comments), offset, comments


def _kind(path: Path, comments: list[str]) -> str:
    """The kind of file in the first line. Raises FileFormatError for another version of the format."""
    words = comments[0].split() if comments else []
    if len(words) != 3 or words[0] != "linkpose":
        return ""
    if words[2] != "1":
        raise FileFormatError(
            path,
            f"{path} is a linkpose {words[1]} of version {words[2][:20]}, and this program reads version 1: "
            "read it with the linkpose that wrote it, or a newer one",
        )
    return words[1]


def _closing(body: bytes) -> tuple[bytes, dict[str, Any] | None]:
    """Rows, without blank lines at the end, the closing line and an incomplete one; the closing line's content."""
    body = body[: body.rfind(b"\n") + 1]
    rows = body.rstrip()
    body = body[: body.find(b"\n", len(rows)) + 1] if rows else b""
    start = body.rfind(b"\n", 0, len(body) - 1) + 1
    if body.startswith(b"#", start):
        try:
            closing = json.loads(body[start + 1 :])
        except (ValueError, RecursionError):
            closing = None
        return body[:start], closing if isinstance(closing, dict) else None
    return body, None


def metadata_of(path: Path, text: str, line: int) -> dict[str, Any]:
    """The JSON object in `text`; raises FileFormatError for anything else."""
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(path, f"{path}, line {line}: the metadata is not JSON: {error}", line) from error
    if not isinstance(content, dict):
        raise FileFormatError(path, f"{path}, line {line}: the metadata is not a JSON object")
    return content
