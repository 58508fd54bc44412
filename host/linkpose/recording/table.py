"""Reads the CSV files of linkpose, and refuses others with the line and the reason."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from linkpose.errors import CannotRead, FileFormatError
from linkpose.sensors.measurements import Floats


@dataclass(frozen=True, slots=True)
class Table:
    """A CSV file: columns by name, each (N,) float64 with NaN for an empty field; metadata of head and closing line."""

    path: Path
    kind: str  # "recording", "estimate", ...; "" for a plain CSV without linkpose's head
    columns: dict[str, Floats]
    metadata: dict[str, Any]
    closing: dict[str, Any] | None  # None: the file was cut, or never closed
    first_line: int  # line number of the first row
    remarks: tuple[str, ...] = ()  # what the reader should know

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
    """Reads a linkpose CSV (of one kind, when `kind` names it) or a plain CSV with a header of names.

    An incomplete last line of linkpose's own, as a killed program leaves it, is left out. Raises FileFormatError naming
    the file and the line for whatever else is not a number, a row of another length, or a time that runs backwards.
    """
    data = read_bytes(path).removeprefix(b"\xef\xbb\xbf")  # as spreadsheets save
    lines_before, offset, comments = _head_lines(data)
    found = _kind(path, comments)
    if kind is not None and found != kind:
        raise FileFormatError(
            path, f"{path} is no linkpose {kind}: its first line is {_excerpt(data)!r}, not '# linkpose {kind} 1'"
        )
    header_end = data.find(b"\n", offset)
    if header_end < 0:
        raise FileFormatError(path, f"{path} ends before its first row; it holds no data")
    names = [name.strip() for name in data[offset:header_end].decode("utf-8", "replace").strip().split(",")]
    _check_names(path, names, lines_before + 1)
    if not found and not data.endswith(b"\n"):  # typed by hand, not cut by a kill
        data += b"\n"
    body, closing = _closing(data[header_end + 1 :])
    values = _numbers(path, body, len(names), lines_before + 2)
    columns = {name: np.ascontiguousarray(values[:, i]) for i, name in enumerate(names)}
    if "time_s" in columns:
        check_times(path, columns["time_s"], lines_before + 2)
    metadata = _json(path, comments[1], 2) if found and len(comments) > 1 else {}
    return Table(path, found, columns, metadata, closing, lines_before + 2)


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
    """What the first line says that the file is; raises FileFormatError for another version of the format."""
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


def _excerpt(data: bytes) -> str:
    return data.split(b"\n", 1)[0][:40].decode("utf-8", "replace").strip()


def _check_names(path: Path, names: list[str], line: int) -> None:
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise FileFormatError(path, f"{path}, line {line}: column {', '.join(sorted(twice))} stands twice")
    if "" in names or all(_is_number(name) for name in names):
        raise FileFormatError(
            path, f"{path}, line {line}: expected the names of the columns, found {','.join(names)[:60]!r}"
        )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


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


def _numbers(path: Path, body: bytes, width: int, first_line: int) -> Floats:
    """The rows as an (N, width) array."""
    if b"\r" in body:
        body = body.replace(b"\r\n", b"\n")
    if not body:
        raise FileFormatError(path, f"{path} has a header but no row; nothing was recorded")
    raw = np.frombuffer(body, np.uint8)
    ends = np.flatnonzero(raw == ord("\n"))
    commas = np.flatnonzero(raw == ord(","))
    per_row = np.diff(np.searchsorted(commas, ends), prepend=0) + 1
    wrong = np.flatnonzero(per_row != width)
    if len(wrong):
        row = int(wrong[0])
        raise FileFormatError(
            path,
            f"{path}, line {first_line + row}: {per_row[row]} fields where the header has {width}; "
            "the file was cut or edited: remove that row",
        )
    values = _parse(body, width * len(ends))
    if values is None:
        raise _first_word_error(path, body, first_line)
    return values.reshape(len(ends), width)


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


def _first_word_error(path: Path, body: bytes, first_line: int) -> FileFormatError:
    """The error that names the first field that is not a number."""
    for number, line in enumerate(body.decode("utf-8", "replace").split("\n"), first_line):
        for text in line.split(","):
            if text.strip() and not _is_number(text):
                word = text.strip()[:30]
                text = f"{path}, line {number}: {word!r} is not a number; correct or remove that row"
                return FileFormatError(path, text, number)
    return FileFormatError(path, f"{path}: a field is not a number")
