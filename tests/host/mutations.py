"""Seeded mutations of a file: of its bytes, its head, all but its head, and its numbers and words."""

from __future__ import annotations

import gzip
import random
import re
from collections.abc import Callable, Sequence

# What breaks parsers of numbers, of JSON, YAML and TOML, and what breaks programs that trust a number.
TOKENS = [
    b"nan", b"inf", b"-inf", b"-1", b"0", b"1e308", b"-1e308", b"1e400", b"1e-320", b"9" * 400, b"0x10",
    b"1_000", b"1,5", b"", b'"', b"'", b"#", b";", b"\t", b"\n", b"\r", b"\0", b"\xff", b"\xfe\xff", b"\xef\xbb\xbf",
    b"[" * 2000,
    b"{" * 500, b"&a [*a,*a]", b"null", b"true", b"\x1b[31m", b"..", b"/dev/zero", b"%s", b"18446744073709551616",
    b"NaN,", b"99999999999", b"1e9", b"[[[]]]", b"{}", b"[]", b"time_s", b"-0", b"\xed\xa0\x80", b"=1+1",
]  # fmt: skip
# What a field of numbers may hold in place of one.
NUMBERS = [
    b"nan", b"inf", b"-inf", b"-1", b"0", b"-0", b"1", b"2", b"255", b"256", b"65536", b"4294967296", b"1e308",
    b"-1e308", b"1e200", b"1e-320", b"1e15", b"-1e9", b"1e400", b"9" * 400, b"18446744073709551616", b"0.5", b"1e-9",
    b"360", b"",
]  # fmt: skip
NUMBER = re.compile(rb"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?(?![\w.])")
WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9]*")
LONG = 100_000
HEAD_LINES = 6  # at most, of the files below: format, settings, units, names of columns
HEAD_BYTES = 512  # at most, of a file without lines
HOLDERS = (b",", b"\n", b" ", b":", b"=", b"\t", b"[", b"]")


Change = Callable[[bytes, random.Random], bytes]
Step = Callable[[bytearray, random.Random], None]


def mutate(data: bytes, rng: random.Random, inside: Change | None = None) -> bytes:
    """A damaged file: its bytes, its head alone, all but its head, or what its format carries.

    `inside` changes what a binary format or a checksum wraps, and wraps it again; without it, numbers and words of a
    text are replaced by others. Without such changes, most damaged files are refused at their first step.
    """
    kind = rng.randrange(4)
    if kind == 0:
        return change(data, rng, CHANGES)
    if kind == 1:
        at = _end_of_head(data, rng)
        head, body = data[:at], data[at:]
        return change(head, rng, CHANGES) + body if rng.random() < 0.5 else head + change(body, rng, CHANGES)
    return inside(data, rng) if inside else change(data, rng, VALUES)


def change(data: bytes, rng: random.Random, changes: Sequence[Step]) -> bytes:
    """One to four changes."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        rng.choice(changes)(changed, rng)
    return bytes(changed)


def _end_of_head(data: bytes, rng: random.Random) -> int:
    at = 0
    for _ in range(rng.randint(1, HEAD_LINES)):
        at = data.find(b"\n", at) + 1
        if not 0 < at < len(data):
            return rng.randint(0, min(HEAD_BYTES, len(data)))
    return at


def _number(data: bytearray, rng: random.Random) -> None:
    """A number becomes another one."""
    if found := any_match(NUMBER, data, rng):
        data[found.start() : found.end()] = _other_number(found.group(), rng)


def _other_number(number: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.5:
        return rng.choice(NUMBERS)
    value = float(number)
    value = value * rng.choice((-1, 0.001, 0.5, 1.001, 2, 1000, 1e6)) + rng.choice((0, 0, 1e-6, 1, -1))
    return b"%d" % value if b"." not in number and abs(value) < 1e18 else b"%.9g" % value


def _numbers_of_column(data: bytearray, rng: random.Random) -> None:
    """The same number in all lines from one on, or a row's number at another place, or all of a column scaled."""
    separator = rng.choice([b",", b",", b" ", b"\t"])
    column, kind, token = rng.randrange(12), rng.randrange(3), rng.choice(NUMBERS)
    factor = rng.choice((-1, 0, 0.001, 0.5, 2, 10, 1000, 57.29577951))
    lines = bytes(data).split(b"\n")
    rows = [at for at, line in enumerate(lines) if line.count(separator) >= column]
    rows = [at for at in rows if NUMBER.fullmatch(lines[at].split(separator)[column])]
    if not rows:
        return
    cells = [lines[at].split(separator)[column] for at in rows]
    first = rng.randrange(len(rows)) if rng.random() < 0.5 else 0
    if kind == 0:
        cells[first:] = [token] * (len(rows) - first)
    elif kind == 1:
        rng.shuffle(cells)
    else:
        cells[first:] = [b"%.9g" % (factor * float(cell)) for cell in cells[first:]]
    for at, cell in zip(rows, cells, strict=True):
        parts = lines[at].split(separator)
        parts[column] = cell
        lines[at] = separator.join(parts)
    data[:] = b"\n".join(lines)


def _word(data: bytearray, rng: random.Random) -> None:
    """A word becomes another one of the same file, or a wrong one."""
    found = any_match(WORD, data, rng)
    other = any_match(WORD, data, rng)
    if found and other:
        new = rng.choice([other.group(), other.group(), b"x", found.group()[:-1], found.group().upper(), b"\xc3\xa4"])
        data[found.start() : found.end()] = new


def any_match(pattern: re.Pattern[bytes], data: bytearray, rng: random.Random) -> re.Match[bytes] | None:
    text = bytes(data)
    return pattern.search(text, rng.randint(0, len(text))) or pattern.search(text)


def _rows(data: bytearray, rng: random.Random) -> None:
    """Rows are left out, doubled, or in another order."""
    lines = bytes(data).split(b"\n")
    first = rng.randrange(len(lines))
    last = rng.randint(first, len(lines))
    part = lines[first:last]
    kind = rng.randrange(4)
    if kind == 0:
        part = []
    elif kind == 1:
        part = part * 2
    elif kind == 2:
        part.reverse()
    else:
        rng.shuffle(part)
    data[:] = b"\n".join(lines[:first] + part + lines[last:])


def flip(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.choice((1, 1, 8))):
        if data:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _insert(data: bytearray, rng: random.Random) -> None:
    at = rng.randint(0, len(data))
    data[at:at] = rng.choice(TOKENS)


def _replace_field(data: bytearray, rng: random.Random) -> None:
    """A whole field, between two of the characters that hold fields."""
    at = rng.randint(0, len(data))
    start = max(data.rfind(holder, 0, at) for holder in HOLDERS) + 1
    ends = [end for holder in HOLDERS if (end := data.find(holder, at)) >= 0]
    data[start : min(ends, default=len(data))] = rng.choice(TOKENS)


def cut(data: bytearray, rng: random.Random) -> None:
    del data[rng.randint(0, len(data)) :]


def remove(data: bytearray, rng: random.Random) -> None:
    at = rng.randint(0, len(data))
    del data[at : at + rng.choice((1, 2, 10, 100))]


def double(data: bytearray, rng: random.Random) -> None:
    at = rng.randint(0, len(data))
    data[at:at] = data[at : at + rng.choice((1, 10, 300))] * rng.choice((1, 3))


def _line(data: bytearray, rng: random.Random) -> None:
    """A line is removed, doubled, or exchanged with another."""
    lines = bytes(data).split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(3)
    if kind == 0:
        del lines[a]
    elif kind == 1:
        lines.insert(b, lines[a])
    else:
        lines[a], lines[b] = lines[b], lines[a]
    data[:] = b"\n".join(lines)


def _columns(data: bytearray, rng: random.Random) -> None:
    """A column is exchanged with another, doubled, removed or made longer in all lines."""
    separator = rng.choice([b",", b",", b" ", b":"])
    a, b, kind = rng.randrange(12), rng.randrange(12), rng.randrange(4)
    lines = bytes(data).split(b"\n")
    for at, line in enumerate(lines):
        cells = line.split(separator)
        if max(a, b) >= len(cells):
            continue
        if kind == 0:
            cells[a], cells[b] = cells[b], cells[a]
        elif kind == 1:
            cells.insert(a, cells[b])
        elif kind == 2:
            del cells[a]
        else:
            cells[a] += cells[b]
        lines[at] = separator.join(cells)
    data[:] = b"\n".join(lines)


def _layout(data: bytearray, rng: random.Random) -> None:
    """The whole file is kept in another form: other line ends, encodings or separators, twice, upside down, zipped."""
    text = bytes(data)
    data[:] = rng.choice(_LAYOUTS)(text, rng)


def _mixed_line_ends(text: bytes, rng: random.Random) -> bytes:
    return b"".join(line + rng.choice([b"\n", b"\r\n", b"\r", b"\n\n", b"\0\n"]) for line in text.split(b"\n"))


def _head_again(text: bytes, rng: random.Random) -> bytes:
    lines = text.split(b"\n")
    at = rng.randint(0, len(lines))
    return b"\n".join(lines[:at] + lines[: rng.choice((1, 3, 6))] + lines[at:])


def _encoded(text: bytes, rng: random.Random) -> bytes:
    codec = rng.choice(["utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-8-sig", "utf-7", "cp500"])
    return text.decode("latin-1").encode(codec)


def _huge(text: bytes, rng: random.Random) -> bytes:
    """A cell of 100 000 characters, or a line or a header of 100 000 cells."""
    at = rng.randint(0, len(text))
    return text[:at] + rng.choice([b"9", b"a", b",", b"1,", b"a,", b" ", b'"', b"[", b"- ", b"a:"]) * LONG + text[at:]


_LAYOUTS: list[Change] = [
    _mixed_line_ends, _head_again, _encoded, _huge,
    lambda text, rng: text + text,
    lambda text, rng: b"\n".join(reversed(text.split(b"\n"))),
    lambda text, rng: text.replace(b",", rng.choice([b";", b"\t", b" ", b",,", b'","'])),
    lambda text, rng: text.replace(b".", rng.choice([b",", b"", b"e"])),
    lambda text, rng: text.replace(b"\n", rng.choice([b"\r", b"", b",\n", b"\n#"])),
    lambda text, rng: gzip.compress(text, 1),
    lambda text, rng: bytes(len(text)),
]  # fmt: skip

CHANGES: list[Step] = [
    flip, _insert, _replace_field, _replace_field, cut, remove, double, _line, _columns, _layout,
]  # fmt: skip


VALUES: list[Step] = [_number, _number, _number, _numbers_of_column, _numbers_of_column, _word, _rows]
