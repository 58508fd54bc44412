"""Reads the tables of linkpose, of spreadsheets, pandas and R, and refuses others with the line and the reason.

Files as linkpose writes them are parsed at once by numpy; all others are split into cells by `delimited`.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from linkpose.errors import CannotRead, FileFormatError, MissingLibrary
from linkpose.recording.csvfile import metadata_path
from linkpose.recording.delimited import Cells, split_cells, to_utf8
from linkpose.sensors.measurements import Floats

PARQUET_KEY = b"linkpose"  # of the metadata in a Parquet file's schema
_PLAIN_HEADER = re.compile(rb"[^\";\t]*[A-Za-z_][^\";\t]*")


@dataclass(frozen=True, slots=True)
class Table:
    """A table: columns by name, each (N,) float64 with NaN for an empty field; metadata of head and closing line."""

    path: Path
    kind: str  # "recording", "estimate", ...; "" for a plain table without linkpose's head
    columns: dict[str, Floats]
    metadata: dict[str, Any]
    closing: dict[str, Any] | None  # None: the file was cut, or never closed
    first_line: int  # line number of the first row
    remarks: tuple[str, ...] = ()  # anomalies, one sentence each

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def require(self, *names: str) -> None:
        """Raises FileFormatError unless the table has all these columns."""
        missing = [name for name in names if name not in self.columns]
        if missing:
            raise FileFormatError(
                self.path, f"{self.path} has no column {', '.join(missing)}; it has {', '.join(self.columns)}"
            )


def read_bytes(path: Path) -> bytes:
    """The file's bytes; raises CannotRead where it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise CannotRead(path, error.strerror) from error


def read_table(path: Path, kind: str | None = None) -> Table:
    """Reads a table with a header of names: linkpose's own, or one that another program has written or saved again.

    `kind` refuses linkpose files of other kinds; a table without linkpose's head is of any kind. An incomplete last
    line of linkpose's own, as a killed program leaves it, is left out. Raises FileFormatError naming the file and the
    line for whatever else is not a number, a row of another length, or a time that runs backwards.
    """
    data = read_bytes(path)
    if data.startswith(b"PAR1"):
        table = _read_parquet(path)
    else:
        data = to_utf8(data)
        table = _read_own(path, data) or _read_other(path, data)
    if not table.kind:
        table = _with_metadata_beside(table)
    if kind is not None and table.kind not in ("", kind):
        raise FileFormatError(path, f"{path} is a linkpose {table.kind}, not a {kind}")
    if "time_s" in table.columns:
        check_times(path, table.columns["time_s"], table.first_line)
    return table


def _with_metadata_beside(table: Table) -> Table:
    """The table with the kind and the metadata that NAME.meta.json beside NAME.csv holds, if it is there."""
    beside = metadata_path(table.path)
    if not beside.is_file():
        return table
    content = _json(beside, read_bytes(beside).decode("utf-8", "replace"), 1)
    metadata, closing = content.get("metadata"), content.get("closing")
    if not isinstance(metadata, dict) or not isinstance(content.get("kind"), str):
        raise FileFormatError(beside, f"{beside} has no kind or no metadata; write it again, or remove it")
    return replace(
        table, kind=content["kind"], metadata=metadata, closing=closing if isinstance(closing, dict) else None
    )


def _read_own(path: Path, data: bytes) -> Table | None:
    """A table exactly as linkpose writes it, fast; None for any other."""
    lines_before, offset, comments = _head_lines(data)
    if any(comment.endswith((",", ";")) for comment in comments):  # padded by a spreadsheet
        return None
    found = _kind(path, comments)
    header_end = data.find(b"\n", offset)
    header = data[offset:header_end] if header_end >= 0 else b""
    names = [name.strip() for name in header.decode("utf-8", "replace").split(",")]
    if not _PLAIN_HEADER.fullmatch(header) or len(set(names)) < len(names) or "" in names:
        return None
    if not found and not data.endswith(b"\n"):  # typed by hand, not cut by a kill
        data += b"\n"
    body, closing = _closing(data[header_end + 1 :])
    values = _numbers(body, len(names))
    if values is None:
        return None
    columns = {name: np.ascontiguousarray(values[:, i]) for i, name in enumerate(names)}
    metadata = _json(path, comments[1], 2) if found and len(comments) > 1 else {}
    return Table(path, found, columns, metadata, closing, lines_before + 2)


def _read_other(path: Path, data: bytes) -> Table:
    """A table as other programs write it."""
    cells = split_cells(path, data)
    found = _kind(path, [comment.text for comment in cells.head])
    metadata, remarks = _metadata(cells) if found else ({}, ())
    closing = cells.tail[-1].as_object() if cells.tail else None
    return Table(path, found, cells.number_columns(), metadata, closing, cells.lines[0], remarks)


def _read_parquet(path: Path) -> Table:
    """A Parquet file of linkpose, or of any program, with columns of numbers."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MissingLibrary("pyarrow", path) from error
    try:
        found = pyarrow.parquet.read_table(path)
        columns = {
            name: column.cast(pyarrow.float64()).to_numpy().astype(np.float64)
            for name, column in zip(found.column_names, found.columns, strict=True)
            if not name.startswith("__index_level_")
        }
    except (pyarrow.ArrowException, OSError) as error:
        raise FileFormatError(path, f"{path} is no Parquet table of numbers: {error}") from error
    if not columns or not found.num_rows:
        raise FileFormatError(path, f"{path} has no row; nothing was recorded")
    own = (found.schema.metadata or {}).get(PARQUET_KEY)
    content = _json(path, own.decode("utf-8", "replace"), 1) if own else {}
    metadata, closing = (
        part if isinstance(part := content.get(name), dict) else None for name in ("metadata", "closing")
    )
    return Table(path, str(content.get("kind", "")), columns, metadata or {}, closing, 1)


def _metadata(cells: Cells) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The metadata in the second comment line, and a remark where a spreadsheet damaged it."""
    comment = cells.head[1] if len(cells.head) > 1 else None
    content = comment.as_object() if comment else {}
    if comment is None or content is not None:
        return content or {}, ()
    if comment.is_intact:
        return _json(cells.path, comment.text, comment.line), ()
    return {}, (
        f"{cells.path}, line {comment.line}: a spreadsheet damaged the metadata; the settings and the rig in it are "
        "not used",
    )


def check_times(path: Path, time_s: Floats, first_line: int) -> None:
    """Raises FileFormatError at the first stamp that is missing or earlier than the one before it."""
    bad = np.flatnonzero(~(np.diff(time_s, prepend=-np.inf) >= 0))
    if len(bad):
        row = int(bad[0])
        what = "is missing" if np.isnan(time_s[row]) else f"runs backwards ({time_s[row]:.6f} s)"
        raise FileFormatError(
            path, f"{path}, line {first_line + row}: time_s {what}; remove the rows before or after it"
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
        except ValueError:
            closing = None
        return body[:start], closing if isinstance(closing, dict) else None
    return body, None


def _json(path: Path, text: str, line: int) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except ValueError as error:
        raise FileFormatError(path, f"{path}, line {line}: the metadata is not JSON: {error}", line) from error
    if not isinstance(content, dict):
        raise FileFormatError(path, f"{path}, line {line}: the metadata is not a JSON object")
    return content


def _numbers(body: bytes, width: int) -> Floats | None:
    """The rows as an (N, width) array; None unless each row consists of `width` numbers or empty fields."""
    if b"\r" in body:
        body = body.replace(b"\r\n", b"\n")
    raw = np.frombuffer(body, np.uint8)
    ends = np.flatnonzero(raw == ord("\n"))
    commas = np.flatnonzero(raw == ord(","))
    per_row = np.diff(np.searchsorted(commas, ends), prepend=0) + 1
    if not len(ends) or (per_row != width).any():
        return None
    values = _parse(body, width * len(ends))
    return None if values is None else values.reshape(len(ends), width)


def _parse(body: bytes, count: int) -> Floats | None:
    """All fields as numbers, an empty one as NaN; None when something is not a number."""
    flat = body.replace(b"\n", b",")
    if b",," in flat or flat.startswith(b","):
        flat = b"," + flat
        while b",," in flat:
            flat = flat.replace(b",,", b",nan,")
        flat = flat[1:]
    try:
        values = np.fromstring(flat[:-1].decode("ascii"), dtype=np.float64, sep=",")
    except (ValueError, UnicodeDecodeError):
        return None
    return values if len(values) == count else None
