"""Seeded mutations inside of formats with checksums or offsets: what they carry becomes other, and they hold."""

from __future__ import annotations

import functools
import io
import random
import struct
import zlib
from binascii import crc_hqx
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet
from cobs import cobs
from mutations import CHANGES, VALUES, WORD, any_match, change, cut, double, flip, remove
from PIL import Image


def in_frames(data: bytes, rng: random.Random) -> bytes:
    """Sound frames with other values, of other lengths and types, or in another order."""
    frames = [cobs.decode(frame)[:-2] for frame in data.split(b"\0") if frame]
    for _ in range(rng.choice((1, 1, 2, 10))):
        at = 0 if rng.random() < 0.4 else rng.randrange(len(frames))
        kind = rng.randrange(8)
        if kind < 4:
            frames[at] = _in_words(frames[at], rng)
        elif kind == 4:
            frames[at] = change(frames[at], rng, [flip, remove, double])
        elif kind == 5:
            frames.insert(rng.randint(0, len(frames)), frames[at])
        elif kind == 6 and len(frames) > 1:
            del frames[at : at + rng.choice((1, 1, 30))]
            frames = frames or [b""]
        else:
            column, count = rng.randrange(1, 20), rng.choice((1, 2, 4))
            value = rng.choice([bytes(count), b"\xff" * count, rng.randbytes(count)])
            frames[1:] = [frame[:column] + value + frame[column + count :] for frame in frames[1:]]
    return b"".join(cobs.encode(frame + crc_hqx(frame, 0xFFFF).to_bytes(2, "little")) + b"\0" for frame in frames)


_WORDS = [
    struct.pack(code, value)
    for code, values in (
        ("B", (0, 1, 2, 4, 7, 127, 128, 255)),
        ("<H", (0, 1, 255, 256, 32767, 32768, 65535)),
        ("<I", (0, 1, 65536, 2**31 - 1, 2**31, 2**32 - 1)),
        ("<f", (0, -0.0, 1, -1, 0.5, 1e-38, 1e30, 3.4e38, np.nan, np.inf, -np.inf)),
    )
    for value in values
]


def _in_words(data: bytes, rng: random.Random) -> bytes:
    """One to four numbers of 1, 2 or 4 bytes become others; the length stays."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        word = rng.choice(_WORDS)
        if len(changed) >= len(word):
            at = rng.randint(0, len(changed) - len(word))
            changed[at : at + len(word)] = word
    return bytes(changed)


_C3D_HEAD = 2_048  # bytes of header and parameters, in which a change has more consequences than in a coordinate


def in_c3d(data: bytes, rng: random.Random) -> bytes:
    """Numbers and letters of header, parameters and coordinates become others; all offsets stay as they are."""
    at = rng.choice((0, 0, 0, _C3D_HEAD))
    part = data[at : at + _C3D_HEAD] if rng.random() < 0.8 else data[at:]
    if rng.random() < 0.7 or not (found := any_match(WORD, bytearray(part), rng)):
        new = _in_words(part, rng)
    else:
        name = bytearray(found.group())
        rng.shuffle(name)
        new = part[: found.start()] + name + part[found.end() :]
    return data[:at] + new + data[at + len(part) :]


def in_records(data: bytes, rng: random.Random) -> bytes:
    """Records of an Intel HEX file with other lengths, addresses, types and bytes, and checksums that hold."""
    records = [bytearray.fromhex(line[1:-2].decode()) for line in data.split()]
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(records))
        kind = rng.randrange(6)
        if kind == 0:
            del records[at : at + rng.choice((1, 1, 5))]
        elif kind == 1:
            records.insert(rng.randint(0, len(records)), records[at][:])
        elif kind == 2:
            records[at] = bytearray([0, 0, 0, rng.randrange(8)]) + rng.choice([b"", b"\0\0", rng.randbytes(4)])
            records[at][0] = len(records[at]) - 4
        elif kind == 3:
            records[at][1:3] = rng.choice([b"\0\0", b"\xff\xff", b"\x7e\0", records[0][1:3], rng.randbytes(2)])
        elif kind == 4:
            records[at][4:] = records[at][4 : 4 + rng.randrange(17)]
            records[at][0] = len(records[at]) - 4
        else:
            records[at][4:] = _in_words(bytes(records[at][4:]), rng)
        records = records or [bytearray(4)]
    return b"".join(b":%s\n" % (r + bytes([-sum(r) & 255])).hex().upper().encode() for r in records)


def in_chunks(data: bytes, rng: random.Random) -> bytes:
    """Chunks of a PNG with other content, and checksums that hold: sizes, depth, colours, and the packed pixels."""
    chunks, at = [], 8
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += size + 12
    kind = rng.randrange(5)
    at = rng.randrange(len(chunks))
    if kind == 0:
        chunks.insert(
            at, rng.choice([chunks[at], (b"PLTE", rng.randbytes(9)), (b"tRNS", b"\0\1"), (b"acTL", bytes(8))])
        )
    elif kind == 1:
        name = next(at for at, chunk in enumerate(chunks) if chunk[0] == b"IDAT")
        pixels = change(zlib.decompress(chunks[name][1]), rng, [flip, remove, double, cut])
        chunks[name] = b"IDAT", zlib.compress(pixels)
    elif kind == 2:
        head = bytearray(chunks[0][1])
        field = rng.randrange(6)
        if field < 2:
            head[4 * field : 4 * field + 4] = rng.choice((0, 1, 3, 40, 4000, 30_000, 2**31 - 1)).to_bytes(4, "big")
        else:
            head[6 + field] = rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
        chunks[0] = b"IHDR", bytes(head)
    elif kind == 3:
        chunks[at] = chunks[at][0], change(chunks[at][1], rng, [flip, remove, double, cut])
    else:
        return _picture(rng)
    packed = [len(body).to_bytes(4, "big") + name + body + zlib.crc32(name + body).to_bytes(4, "big")
              for name, body in chunks]  # fmt: skip
    return data[:8] + b"".join(packed)


def _picture(rng: random.Random) -> bytes:
    """A sound picture of another size, with other colours, or of another format."""
    mode = rng.choice(["1", "L", "P", "RGB", "RGBA", "LA", "I", "I;16", "F", "CMYK"])
    size = rng.choice([1, 2, 12, 300]), rng.choice([1, 2, 16, 300])
    kind = rng.choice(["PNG", "PNG", "TIFF", "PPM", "BMP", "GIF"])
    picture = Image.new("L", size, rng.randrange(256))
    try:
        picture = picture.convert(mode)
        picture.save(out := io.BytesIO(), kind)
    except (OSError, ValueError, KeyError):  # no such conversion, or no such colours in this format
        Image.new("L", size).save(out := io.BytesIO(), "PNG")
    return out.getvalue()


def in_parquet(data: bytes, rng: random.Random) -> bytes:
    """A sound Parquet file with other values, types, names, order and metadata."""
    table = _parquet(data)
    columns = dict(zip(table.column_names, table.columns, strict=True))
    metadata = dict(table.schema.metadata or {})
    for _ in range(rng.choice((1, 1, 2, 4))):
        name = rng.choice(list(columns))
        kind = rng.randrange(8)
        if kind < 2:
            values = columns[name].to_pylist()
            first = rng.randrange(len(values) or 1)
            count = rng.choice((1, 1, len(values)))
            values[first : first + count] = [_other_value(value, rng) for value in values[first : first + count]]
            columns[name] = _column(values)
        elif kind == 2:
            columns[name] = rng.choice([_strings, _booleans, _lists, _nulls, _dictionary, _times])(columns[name])
        elif kind == 3:
            columns[rng.choice([name[:-1], name + "_", "x", "", "time_s", "\x1b[2J"])] = columns.pop(name)
        elif kind == 4 and len(columns) > 1:
            del columns[name]
        elif kind == 5:
            columns = dict(rng.sample(list(columns.items()), len(columns)))
        elif metadata:
            key = rng.choice(list(metadata))
            metadata[key] = change(metadata[key], rng, rng.choice([VALUES, CHANGES]))
    length = min(map(len, columns.values()))
    changed = pyarrow.table({name: column[:length] for name, column in columns.items()})
    row_order = np.random.default_rng(rng.randrange(2**32)).permutation(length)
    kind = rng.randrange(8)
    changed = changed.take(row_order) if kind == 0 else changed[: length // 2] if kind == 1 else changed
    pyarrow.parquet.write_table(
        changed.replace_schema_metadata(metadata), out := io.BytesIO(), rng.choice((7, 1000)), compression="none"
    )
    return out.getvalue()


@functools.lru_cache(1)
def _parquet(data: bytes) -> pyarrow.Table:
    return pyarrow.parquet.read_table(io.BytesIO(data))


def _other_value(value: Any, rng: random.Random) -> Any:
    number = float(value) if isinstance(value, (int, float)) else 0.0
    return rng.choice([np.nan, np.inf, -np.inf, None, 0.0, -number, 1000 * number, 2 * number, 1e308, 1e-320, 2.0**63])


def _column(values: list[Any]) -> pyarrow.Array:
    numbers = [float(value) if isinstance(value, (int, float)) else None for value in values]
    return pyarrow.array(numbers, pyarrow.float64())


def _strings(column: pyarrow.ChunkedArray) -> pyarrow.Array:
    return pyarrow.array([str(value) for value in column.to_pylist()])


def _booleans(column: pyarrow.ChunkedArray) -> pyarrow.Array:
    return pyarrow.array([bool(value) for value in column.to_pylist()])


def _lists(column: pyarrow.ChunkedArray) -> pyarrow.Array:
    return pyarrow.array([[value, value] for value in column.to_pylist()])


def _nulls(column: pyarrow.ChunkedArray) -> pyarrow.Array:
    return pyarrow.nulls(len(column))


def _dictionary(column: pyarrow.ChunkedArray) -> pyarrow.Array:
    return _strings(column).dictionary_encode()


def _times(column: pyarrow.ChunkedArray) -> pyarrow.Array:
    return pyarrow.array(range(len(column)), pyarrow.timestamp("us"))
