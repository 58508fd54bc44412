"""Splits the text of a table into cells, as linkpose, spreadsheets, pandas and R write it.

The reader accepts commas, semicolons, tabs or spaces between cells, decimal commas, quotes, UTF-8 and UTF-16 with or
without a byte order mark, all three line ends, empty trailing columns and rows, row names without a header, and comment
lines (`# ...`) which a spreadsheet split into cells, quoted or padded with separators.
"""

from __future__ import annotations

import csv
import itertools
import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from linkpose.errors import FileFormatError, listed
from linkpose.sensors.measurements import Floats

_SEPARATORS = ("\t", ";", ",", " ")  # in order of preference: decimal commas occur beside the first two
_PADDING = ',;\t "'
_MISSING = frozenset({"", "nan", "na", "n/a", "#n/a", "<na>", "null", "none"})
_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d*,\d*(e[+-]?\d+)?\s*", re.IGNORECASE)
# What spreadsheets make of numbers such as 1.5 and 1-5, with names of months in any language, and times of day.
_DATE = re.compile(
    r"\d{1,4}[-./] ?(\d{1,2}|[^\W\d_]{3,12})\.?([-./ ]\d{2,4})?\.?"  # 25.01.2026, 01. Mai, 1-May, 2026-05-01
    r"|[^\W\d_]{3,9}\.?[- ]\d{2,4}"  # May-26
    r"|\d+:\d\d(:\d\d([.,]\d+)?)?"  # 00:00:01,5
)
# A piece of JSON after a comma begins like this only if LibreOffice has removed the quotes of a text as quotes of the
# cell.
_WITHOUT_QUOTES = re.compile(r"(?!(true|false|null)\b)[^\W\d_]", re.IGNORECASE)
_INDEX_NAME = re.compile(r"Unnamed: \d+(_level_\d+)?")  # what pandas names a header cell that is empty
_LONGEST_EXCERPT = 60


@dataclass(frozen=True, slots=True)
class Comment:
    """A comment line without its `#`. `is_intact`: no spreadsheet quoted it or split it into cells."""

    text: str
    line: int
    is_intact: bool

    def as_object(self) -> dict[str, Any] | None:
        """The JSON object in the comment; None where there is none."""
        try:
            content = json.loads(self.text)
        except (ValueError, RecursionError):
            return None
        return content if isinstance(content, dict) else None


@dataclass(slots=True)
class DecimalMark:
    """The first number with a decimal comma and the first with a point in a file; "" where there is none yet."""

    comma: str = ""
    point: str = ""


@dataclass(frozen=True, slots=True)
class Cells:
    """The cells of a table: column names, rows of as many texts, the line number of each row, and the comments."""

    path: Path
    names: list[str]
    rows: list[list[str]]
    lines: list[int]
    head: list[Comment]  # before the names
    tail: list[Comment]  # after the last row
    header_lines: int  # lines up to the names

    def number_columns(self, mark: DecimalMark) -> dict[str, Floats]:
        """The columns as numbers, NaN for a missing one; raises FileFormatError for a cell that is no number.

        `mark` is shared by all parts of a file.
        """
        self._find_decimal_mark(mark)
        return {name: self._numbers(column, mark.comma != "") for column, name in enumerate(self.names)}

    def _numbers(self, column: int, has_decimal_comma: bool) -> Floats:
        values = np.empty(len(self.rows))
        for i, row in enumerate(self.rows):
            text = row[column]
            try:
                if "_" in text:  # Python's own notation of numbers
                    raise ValueError(text)
                values[i] = float(text.replace(",", ".") if has_decimal_comma else text)
            except ValueError:
                if text.strip().lower() not in _MISSING:
                    raise self._no_number(text.strip(), self.lines[i]) from None
                values[i] = np.nan
        return values

    def _no_number(self, cell: str, line: int) -> FileFormatError:
        where = f"{self.path}, line {line}: {cell[:30]!r}"
        if _DATE.fullmatch(cell):
            return FileFormatError(
                self.path,
                f"{where} is a date or a time of day: a spreadsheet has converted a number; "
                "import the table again with English numbers",
                line,
            )
        return FileFormatError(self.path, f"{where} is not a number; correct or remove that row", line)

    def _find_decimal_mark(self, mark: DecimalMark) -> None:
        """Adds to `mark` what these rows show; raises FileFormatError when numbers can be read in two ways."""
        comma = next(((i, cell) for i, row in enumerate(self.rows) for cell in row if "," in cell), None)
        mark.point = mark.point or next((cell.strip() for row in self.rows for cell in row if "." in cell), "")
        if comma is not None:
            mark.comma, line = comma[1].strip(), self.lines[comma[0]]
        else:
            line = self.lines[0]
        if mark.comma and (mark.point or not _DECIMAL_COMMA.fullmatch(mark.comma)):
            both = f"{mark.comma[:30]!r} and {mark.point[:30]!r}" if mark.point else repr(mark.comma[:30])
            raise FileFormatError(
                self.path,
                f"{self.path}, line {line}: {both} can be read in two ways: "
                "save the table with one decimal mark and without separators of thousands",
                line,
            )


def codec_of(data: bytes) -> str:
    """The encoding of a file that begins with these bytes, as far as they show it."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    for nul_at, codec in ((1, "utf-16-le"), (0, "utf-16-be")):
        if data[nul_at : nul_at + 4 : 2] == b"\0\0":
            return codec
    return "utf-8-sig"


def to_utf8(data: bytes) -> bytes:
    """The same text in UTF-8 without a byte order mark."""
    codec = codec_of(data)
    if codec != "utf-8-sig":
        return data.decode(codec, "replace").encode("utf-8", "replace")
    return data.removeprefix(b"\xef\xbb\xbf")


def text_lines(data: bytes) -> list[str]:
    """The lines of a text in UTF-8, or else in the encoding of Windows; the last one ends without a line end."""
    try:
        text = data.decode()
    except UnicodeDecodeError:
        text = data.decode("cp1252", "replace")
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def split_cells(path: Path, data: bytes, before: Sequence[str] = (), first_line: int = 1) -> Cells:
    """Splits `data`, in UTF-8, into cells. Raises FileFormatError naming the line where rows and names do not match.

    For a later part of a file, `before` holds the lines up to the names, and `first_line` is the number of the part's
    first line. An unterminated last line of a file which linkpose wrote is left out: a killed program leaves one.
    """
    lines = text_lines(data)
    first = before[0] if before else lines[0]
    if first.startswith("# linkpose ") and first[-1] not in _PADDING:
        lines.pop()
    all_lines = itertools.chain(enumerate(before, 1), enumerate(lines, first_line))
    numbered = [(i, line) for i, line in all_lines if line.strip(_PADDING)]
    if numbered and numbered[0][1].lower().startswith("sep="):  # Excel's own first line
        del numbered[0]
    table = [(i, line) for i, line in numbered if not _is_comment(line)]
    if not table:
        raise FileFormatError(path, f"{path} ends before its first row; it holds no data")
    if path.suffix.lower() in _SETTINGS or _TOML_TABLE.fullmatch(table[0][1].strip()):
        raise FileFormatError(path, f"{path} holds settings, no table: it is a rig file, or describes a map")
    separator = _separator(table[0][1])
    comments = [_comment(i, line, separator) for i, line in numbered if _is_comment(line)]
    numbers, rows = _parse(path, table, separator)
    inner = _separator(rows[0][0]) if rows[0] else separator
    if inner in "".join(rows[0][:1]) and not any(cell.strip() for row in rows for cell in row[1:]):
        separator = inner  # a spreadsheet kept each line as one quoted cell, and may have padded it
        numbers, rows = _parse(path, [(i, row[0]) for i, row in zip(numbers, rows, strict=True) if row], separator)
    names, body = _match(path, rows, numbers, separator)
    head = [comment for comment in comments if comment.line < numbers[0]]
    tail = [comment for comment in comments if comment.line > numbers[-1]]
    return Cells(path, names, body, numbers[1:], head, tail, numbers[0])


def has_rows(lines: Sequence[str]) -> bool:
    """Whether any of these lines, which come after the names, is a row."""
    return any(line.strip(_PADDING) and not _is_comment(line) for line in lines)


def last_comment(lines: Sequence[str], before: Sequence[str]) -> dict[str, Any] | None:
    """The JSON object in the last of these comment lines; the names are in the last line of `before`."""
    comments = [line for line in lines if _is_comment(line)]
    return _comment(0, comments[-1], _separator(before[-1])).as_object() if comments else None


_SETTINGS = (".toml", ".yaml", ".yml")
_TOML_TABLE = re.compile(r"\[\[?[\w.-]+\]?\](\s*#.*)?")


def _is_comment(line: str) -> bool:
    return line.lstrip(' "').startswith("#")


def _comment(number: int, line: str, separator: str) -> Comment:
    """A comment line, put together again where a spreadsheet split it at its commas."""
    if line.startswith("#"):
        text = line[1:].strip(_PADDING if number == 1 else ",;\t ")
        return Comment(text, number, line[1:].strip() == text)
    cells = next(csv.reader([line], delimiter=separator))
    while cells and not cells[-1].strip():
        cells.pop()
    cells = [cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells]
    cells = [cell.lower() if cell.strip() in ("TRUE", "FALSE") else cell for cell in cells]
    as_is = Comment(",".join(cells).lstrip()[1:].strip(), number, False)
    if as_is.as_object() is None and cells[1:]:
        quoted = [f'"{cell}"' if _WITHOUT_QUOTES.match(cell) else cell for cell in cells[1:]]
        repaired = Comment(",".join([cells[0], *quoted]).lstrip()[1:].strip(), number, False)
        if repaired.as_object() is not None:
            return repaired
    return as_is


def _separator(line: str) -> str:
    """The separator outside quotes; a comma where there is none."""
    bare = re.sub(r'"[^"]*"', "x", line).strip(" ")
    return next((separator for separator in _SEPARATORS if separator in bare), ",")


def _parse(path: Path, table: list[tuple[int, str]], separator: str) -> tuple[list[int], list[list[str]]]:
    """Line numbers and cells of the rows."""
    reader = csv.reader((line for _, line in table), delimiter=separator, skipinitialspace=separator == " ")
    numbers, rows = [], []
    before = 0
    try:
        for row in reader:
            if reader.line_num - before > 1:
                raise csv.Error("a quote is not closed")
            numbers.append(table[before][0])
            rows.append(row)
            before = reader.line_num
    except csv.Error as error:
        line = table[min(before, len(table) - 1)][0]
        raise FileFormatError(path, f"{path}, line {line}: {error}; correct or remove that row", line) from error
    return numbers, rows


def _match(path: Path, rows: list[list[str]], numbers: list[int], separator: str) -> tuple[list[str], list[list[str]]]:
    """Names and rows of one width, without row names and empty columns."""
    names, body = [name.strip() for name in rows[0]], rows[1:]
    if not body:
        _check_names(path, names, numbers[0])
        raise FileFormatError(path, f"{path} has a header but no row")
    if names and all(len(row) == len(names) + 1 for row in body) and any(row[-1].strip() for row in body):
        if separator == "," or len({row[0] for row in body}) < len(body):
            raise _width_error(path, numbers[1], len(body[0]), len(names))
        names = ["", *names]  # R's write.table gives no name to its row names
    width = len(names)
    for number, row in zip(numbers[1:], body, strict=True):
        if len(row) < width or any(cell.strip() for cell in row[width:]):
            raise _width_error(path, number, len(row), width)
    keep = [i for i, name in enumerate(names) if name or any(row[i].strip() for row in body)]
    if keep and keep[0] == 0 and width > 1 and (not names[0] or _INDEX_NAME.fullmatch(names[0])):
        del keep[0]
    if keep != list(range(width)) or any(len(row) > width for row in body):
        body = [[row[i] for i in keep] for row in body]
    names = [names[i] for i in keep]
    _check_names(path, names, numbers[0])
    return names, body


def _width_error(path: Path, line: int, found: int, expected: int) -> FileFormatError:
    hint = ""
    if found >= 2 * expected - 1 > 1:
        hint = " (numbers with decimal commas need semicolons or tabs between them)"
    return FileFormatError(
        path,
        f"{path}, line {line}: {found} fields where the header has {expected}{hint}; "
        "the file was cut or edited: remove that row",
        line,
    )


def _check_names(path: Path, names: list[str], line: int) -> None:
    twice = {name for name, times in Counter(names).items() if times > 1 and name}
    if twice:
        raise FileFormatError(path, f"{path}, line {line}: column {listed(sorted(twice))} stands twice", line)
    if not names or "" in names or all(_is_number(name) for name in names):
        shown = ",".join(names)[:_LONGEST_EXCERPT]
        raise FileFormatError(path, f"{path}, line {line}: expected the names of the columns, found {shown!r}", line)


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True
