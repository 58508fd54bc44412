"""Decodes raw captures, compiled. It accepts the same frames as StreamDecoder, with the same counts."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled
from linkpose.wire.frames import Corrupt, OtherProtocol, StreamDecoder, sample_shapes
from linkpose.wire.messages import LAYOUTS, MAX_FRAME, Message, Sample

_SAMPLE = next(layout for layout in LAYOUTS if layout.cls is Sample)
_NUMPY = {"B": "u1", "b": "i1", "H": "<u2", "h": "<i2", "I": "<u4", "i": "<i4"}
_BYTES = {"B": 1, "b": 1, "H": 2, "h": 2, "I": 4, "i": 4}
_MICE = _SAMPLE.groups[-1]
_CODES = _SAMPLE.fields + "".join(group.code for group in _SAMPLE.groups[:-1])
_MOUSE = np.dtype([(name, _NUMPY[code]) for name, code in zip(("dx", "dy"), _MICE.code, strict=True)])

# One SAMPLE with room for all sections and all mice; absent ones are 0.
SAMPLE_DTYPE = np.dtype(
    [
        *((name, _NUMPY[code]) for name, code in zip(Sample._fields[:-1], _CODES, strict=True)),
        ("mice", _MOUSE, _MICE.most),
    ]
)
_HEAD_SIZE = sum(_BYTES[code] for code in _SAMPLE.fields)
_GROUP_SIZES = np.array([sum(_BYTES[code] for code in group.code) for group in _SAMPLE.groups])
_SECTIONS_AT = 1 + sum(_BYTES[code] for code in _SAMPLE.fields[: Sample._fields.index("sections")])


class Capture(NamedTuple):
    """Contents of a capture."""

    samples: NDArray[np.void]  # (N,) of SAMPLE_DTYPE
    mouse_count: NDArray[np.uint8]  # (N,) mice in each
    others: list[tuple[int, Message | OtherProtocol]]  # all other messages, each with the number of samples before it
    corrupt: Corrupt


def _crc_table() -> NDArray[np.uint16]:
    table = np.zeros(256, np.uint16)
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1
        table[byte] = crc & 0xFFFF
    return table


def _counts_table() -> NDArray[np.int64]:
    """Repetitions of each group for every value of `sections`, (256, groups); -1 where a value is impossible."""
    table = np.full((256, len(_SAMPLE.groups)), -1)
    for shape in sample_shapes():
        table[shape.sections] = shape.counts
    return table


_PIECE_BYTES = 1 << 20  # decoded at once; up to 60 times as much memory, for a piece of frames of one byte
_CRC = _crc_table()
_COUNTS = _counts_table()


@compiled
def _unstuff(data: NDArray[np.uint8], start: int, end: int, out: NDArray[np.uint8]) -> int:
    """COBS-decodes data[start:end] into `out`. Returns the length, or -1 if a code points past the end."""
    length = 0
    while start < end:
        code = data[start]
        stop = start + code
        if stop > end:
            return -1
        for i in range(start + 1, stop):
            out[length] = data[i]
            length += 1
        start = stop
        if code < 255 and start < end:
            out[length] = 0
            length += 1
    return length


@compiled
def _body_length(counts: NDArray[np.int64], head: int, group_sizes: NDArray[np.int64]) -> int:
    """Length of the body with these repetitions of the groups, -1 if they are impossible."""
    length = head
    for group in range(len(group_sizes)):
        if counts[group] < 0:
            return -1
        length += counts[group] * group_sizes[group]
    return length


@compiled
def _spread(
    payload: NDArray[np.uint8],
    counts: NDArray[np.int64],
    head: int,
    group_sizes: NDArray[np.int64],
    row: NDArray[np.uint8],
) -> None:
    """Copies a body to a row in which every group has its place."""
    row[:] = 0
    row[:head] = payload[1 : 1 + head]
    source, target = 1 + head, head
    last = len(group_sizes) - 1
    for group in range(len(group_sizes)):
        size = counts[group] * group_sizes[group]
        row[target : target + size] = payload[source : source + size]
        source += size
        target += size if group == last else group_sizes[group]


@compiled
def _decode(
    data: NDArray[np.uint8],
    crc_table: NDArray[np.uint16],
    counts_table: NDArray[np.int64],
    sample_type: int,
    sections_at: int,
    head: int,
    group_sizes: NDArray[np.int64],
    rows: NDArray[np.uint8],
    mouse_count: NDArray[np.uint8],
    others: NDArray[np.int64],
    longest: int,
) -> tuple[int, int]:
    """Fills `rows` with the bodies of sound SAMPLEs and `others` with (start, end, samples before) of all other frames.

    Whatever is not a sound SAMPLE is left to the StreamDecoder. Returns the numbers of rows and of others.
    """
    payload = np.empty(longest, np.uint8)
    sample_count = other_count = 0
    start = 0
    for at in range(len(data)):
        if data[at] != 0:
            continue
        begin, start = start, at + 1
        if begin == at:
            continue
        length = _unstuff(data, begin, at, payload) if at - begin <= longest else 0
        if length >= 3 + head and payload[0] == sample_type:
            counts = counts_table[payload[sections_at]]
            if length == 3 + _body_length(counts, head, group_sizes):
                crc = 0xFFFF
                for i in range(length - 2):
                    crc = ((crc << 8) & 0xFFFF) ^ crc_table[(crc >> 8) ^ payload[i]]
                if crc == payload[length - 2] | (payload[length - 1] << 8):
                    _spread(payload, counts, head, group_sizes, rows[sample_count])
                    mouse_count[sample_count] = counts[len(counts) - 1]
                    sample_count += 1
                    continue
        others[other_count, 0], others[other_count, 1], others[other_count, 2] = begin, at, sample_count
        other_count += 1
    return sample_count, other_count


def read_capture(file: BinaryIO) -> Iterator[Capture]:
    """The messages from the board in a capture, in parts: one part is in memory at a time.

    `others` count the samples from the capture's beginning, and `corrupt` counts all frames so far. An incomplete last
    frame is left out, as a stream would wait for it.
    """
    decoder = StreamDecoder(from_board=True)
    rest, before = b"", 0
    while piece := file.read(_PIECE_BYTES):
        data = rest + piece
        end = data.rfind(b"\0") + 1
        rest = data[end:]
        if len(rest) > _PIECE_BYTES:  # longer than any frame: keep enough of it to detect that
            rest = rest[: 2 * MAX_FRAME]
        if end:
            part = _decode_part(data[:end], before, decoder)
            before += len(part.samples)
            yield part
    if len(rest) > MAX_FRAME:  # no beginning of a frame: a stream has counted it
        decoder.feed(rest)
        yield _decode_part(b"", before, decoder)


def decode_capture(data: bytes) -> Capture:
    """All messages from the board in a capture, as `read_capture` finds them."""
    parts = [*read_capture(io.BytesIO(data)), _decode_part(b"", 0, StreamDecoder())]
    # As bytes: NumPy copies records field by field, which takes as long as decoding them.
    samples = np.concatenate([part.samples.view(np.uint8) for part in parts]).view(SAMPLE_DTYPE)
    return Capture(
        samples,
        np.concatenate([part.mouse_count for part in parts]),
        [message for part in parts for message in part.others],
        parts[0].corrupt,
    )


def _decode_part(data: bytes, before: int, decoder: StreamDecoder) -> Capture:
    """Decodes whole frames, of which the first comes after `before` samples."""
    frames = data.count(b"\0")
    rows = np.empty((frames, SAMPLE_DTYPE.itemsize), np.uint8)
    mouse_count = np.empty(frames, np.uint8)
    others = np.empty((frames, 3), np.int64)
    sample_count, other_count = _decode(
        np.frombuffer(data, np.uint8),
        _CRC,
        _COUNTS,
        _SAMPLE.type_id,
        _SECTIONS_AT,
        _HEAD_SIZE,
        _GROUP_SIZES,
        rows,
        mouse_count,
        others,
        MAX_FRAME,
    )
    messages = []
    for begin, end, at in _adjoining(others[:other_count]):
        messages += [(before + at, message) for message in decoder.feed(data[begin:end])]
    samples = rows[:sample_count].copy().view(SAMPLE_DTYPE)[:, 0]
    return Capture(samples, mouse_count[:sample_count].copy(), messages, decoder.corrupt)


def _adjoining(others: NDArray[np.int64]) -> list[list[int]]:
    """Start, end and number of samples before, of frames without a sample between them."""
    first = np.flatnonzero(np.diff(others[:, 2], prepend=-1))
    last = np.append(first[1:], len(others))[: len(first)] - 1
    found: list[list[int]] = np.column_stack([others[first, 0], others[last, 1] + 1, others[first, 2]]).tolist()
    return found
