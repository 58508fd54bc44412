"""Decodes a whole raw capture at once, compiled: the same frames, the same counts of corrupt ones as StreamDecoder."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled
from linkpose.wire.frames import Corrupt, OtherProtocol, StreamDecoder
from linkpose.wire.messages import LAYOUTS, MAX_FRAME, Hello, Message, Sample

_SAMPLE = next(layout for layout in LAYOUTS if layout.cls is Sample)
_HELLO_TYPE = next(layout.type_id for layout in LAYOUTS if layout.cls is Hello)
_NUMPY = {"B": "u1", "b": "i1", "H": "<u2", "h": "<i2", "I": "<u4", "i": "<i4"}
_FIELDS = np.dtype([(name, _NUMPY[code]) for name, code in zip(Sample._fields, _SAMPLE.fields, strict=False)])
_GROUP = np.dtype([(name, _NUMPY[code]) for name, code in zip(("dx", "dy"), _SAMPLE.group, strict=True)])

# One SAMPLE with room for all mice; `mouse_count` says how many it really brought.
SAMPLE_DTYPE = np.dtype([*((name, _FIELDS[name]) for name in _FIELDS.names or ()), ("mice", _GROUP, _SAMPLE.group_max)])


class Capture(NamedTuple):
    """What a capture holds."""

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


_CRC = _crc_table()


@compiled
def _unstuff(data: NDArray[np.uint8], start: int, end: int, out: NDArray[np.uint8]) -> int:
    """COBS-decodes data[start:end] into `out`; its length, or -1 where a code points past the end."""
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
def _decode(
    data: NDArray[np.uint8],
    crc_table: NDArray[np.uint16],
    sample_type: int,
    fixed: int,
    group: int,
    groups: int,
    rows: NDArray[np.uint8],
    mouse_count: NDArray[np.uint8],
    others: NDArray[np.int64],
    longest: int,
) -> tuple[int, int]:
    """Fills `rows` with the bodies of sound SAMPLEs and `others` with (start, end, samples before) of all other frames.

    Anything that is not a sound SAMPLE is left to the StreamDecoder. Returns how many of either there are.
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
        mice = (length - 3 - fixed) // group
        if length >= 3 + fixed and payload[0] == sample_type and (length - 3 - fixed) % group == 0 and mice <= groups:
            crc = 0xFFFF
            for i in range(length - 2):
                crc = ((crc << 8) & 0xFFFF) ^ crc_table[(crc >> 8) ^ payload[i]]
            if crc == payload[length - 2] | (payload[length - 1] << 8):
                rows[sample_count, : length - 3] = payload[1 : length - 2]
                rows[sample_count, length - 3 :] = 0
                mouse_count[sample_count] = mice
                sample_count += 1
                continue
        others[other_count, 0], others[other_count, 1], others[other_count, 2] = begin, at, sample_count
        other_count += 1
    return sample_count, other_count


def decode_capture(data: bytes) -> Capture:
    """All messages from the board in a capture. An incomplete last frame is left out, as a stream would wait for it."""
    raw = np.frombuffer(data, np.uint8)
    frames = data.count(b"\0")
    rows = np.empty((frames, SAMPLE_DTYPE.itemsize), np.uint8)
    mouse_count = np.empty(frames, np.uint8)
    others = np.empty((frames, 3), np.int64)
    sample_count, other_count = _decode(
        raw,
        _CRC,
        _SAMPLE.type_id,
        _FIELDS.itemsize,
        _GROUP.itemsize,
        _SAMPLE.group_max,
        rows,
        mouse_count,
        others,
        MAX_FRAME,
    )
    decoder = StreamDecoder(from_board=True)
    messages = []
    for begin, end, before in others[:other_count].tolist():
        messages += [(before, message) for message in decoder.feed(data[begin : end + 1])]
    samples = rows[:sample_count].view(SAMPLE_DTYPE)[:, 0]
    return Capture(samples, mouse_count[:sample_count], messages, decoder.corrupt)
