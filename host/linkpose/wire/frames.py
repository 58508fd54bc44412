"""Frames on the wire: COBS, ended by 0x00, around a type byte, a body and a CRC-16/CCITT-FALSE (little-endian)."""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from struct import Struct
from typing import Any, NamedTuple, cast

from cobs import cobs
from cobs.cobs import DecodeError
from cobs.cobs import decode as cobs_decode

from linkpose.wire.messages import LAYOUTS, MAX_FRAME, PROTOCOL_MAJOR, Group, Hello, Layout, Message, Sample

_CRC_START = 0xFFFF
_OVERHEAD = 4  # bytes of a frame besides its body: type, CRC and one of COBS
_LONGEST_BODY = MAX_FRAME - _OVERHEAD
_HELLO_TYPE = next(layout.type_id for layout in LAYOUTS if layout.cls is Hello)
_SAMPLE = next(layout for layout in LAYOUTS if layout.cls is Sample)
_SAMPLE_TYPE = _SAMPLE.type_id
_SECTIONS_AT = 1 + Struct("<" + _SAMPLE.fields[: Sample._fields.index("sections")]).size  # in the payload
_SHORTEST_SAMPLE = _OVERHEAD + Struct("<" + _SAMPLE.fields).size
_PREFIX = Struct("<BBI")  # the part of HELLO's body that is the same in every version


class OtherProtocol(NamedTuple):
    """A HELLO with another major number than this program's: all that can be read of it."""

    protocol_major: int
    protocol_minor: int
    schema_crc: int


@dataclass(slots=True)
class Corrupt:
    """Number of dropped frames, by cause."""

    cobs: int = 0  # a COBS code points past the end of the frame
    length: int = 0  # shorter or longer than any frame, or than its type's body
    crc: int = 0
    type: int = 0  # unknown type

    @property
    def total(self) -> int:
        return self.cobs + self.length + self.crc + self.type

    def as_dict(self) -> dict[str, int]:
        return {"cobs": self.cobs, "length": self.length, "crc": self.crc, "type": self.type}


Unpack = Callable[[bytes], Message | OtherProtocol | None]  # None: the length is wrong

# Fills a NamedTuple in a third of the time that its own constructor takes.
_new = cast(Any, tuple.__new__)


def _unpacker(layout: Layout, last: int) -> tuple[int, Unpack]:
    """Body length and decoder of a message whose last group is present `last` times."""
    counts = [group.least for group in layout.groups[:-1]] + [last] * bool(layout.groups)
    groups = list(zip(layout.groups, counts, strict=True))
    whole = Struct("<" + layout.fields + "".join(group.code * count for group, count in groups))
    unpack_from, cls, fields = whole.unpack_from, layout.cls, len(layout.fields)

    def plain(payload: bytes) -> Message:
        message: Message = _new(cls, unpack_from(payload, 1))
        return message

    def grouped(payload: bytes) -> Message:
        values = unpack_from(payload, 1)
        parts, at = list(values[:fields]), fields
        for group, count in groups:
            end = at + count * len(group.code)
            parts.append(_repetitions(group, values[at:end]))
            at = end
        message: Message = _new(cls, parts)
        return message

    return whole.size, grouped if layout.groups else plain


def _repetitions(group: Group, values: tuple[int, ...]) -> tuple[Any, ...]:
    """The values of all repetitions of a group as its field in the message holds them."""
    if group.cls is None:
        return values
    width = len(group.code)
    return tuple([_new(group.cls, values[at : at + width]) for at in range(0, len(values), width)])


def _hello_or_other(unpack: Unpack | None) -> Unpack:
    """Reads a HELLO of this protocol by `unpack`, and only the invariable part of one with another major number."""

    def read(payload: bytes) -> Message | OtherProtocol | None:
        if payload[1] != PROTOCOL_MAJOR:
            return OtherProtocol(*_PREFIX.unpack_from(payload, 1))
        return unpack(payload) if unpack else None

    return read


def _unpackers(from_board: bool) -> dict[int, Unpack]:
    """Decoder of each message of one side except SAMPLE, by type and body length: type * 256 + length."""
    table: dict[int, Unpack] = {}
    for layout in LAYOUTS:
        if (layout.type_id < 0x80) == from_board and layout is not _SAMPLE:
            last = layout.groups[-1] if layout.groups else None
            for count in range(last.least, last.most + 1) if last else (0,):
                size, unpack = _unpacker(layout, count)
                table[layout.type_id << 8 | size] = unpack
    if from_board:
        for size in range(_PREFIX.size, MAX_FRAME):
            table[_HELLO_TYPE << 8 | size] = _hello_or_other(table.get(_HELLO_TYPE << 8 | size))
    return table


class SampleShape(NamedTuple):
    """Which groups a SAMPLE with one value of `sections` carries."""

    sections: int
    counts: tuple[int, ...]  # repetitions of each group
    code: str  # struct format of the whole body


def sample_shapes() -> Iterator[SampleShape]:
    """Every shape that a SAMPLE can have."""
    for counts in product(*(range(group.least, group.most + 1) for group in _SAMPLE.groups)):
        sections = sum(count * (group.mask & -group.mask) for group, count in zip(_SAMPLE.groups, counts, strict=True))
        groups = "".join(group.code * count for group, count in zip(_SAMPLE.groups, counts, strict=True))
        yield SampleShape(sections, counts, _SAMPLE.fields + groups)


def _sample_unpacker(shape: SampleShape) -> tuple[int, Unpack]:
    """Frame length and decoder of SAMPLEs of one shape. The fields of absent sections are 0.

    The values of a body become a message by at most two insertions of zeros: four sections leave no more gaps.
    """
    unpack_from = Struct("<" + shape.code).unpack_from
    cuts: list[int] = []  # where in the values zeros are missing
    fills: list[tuple[int, ...]] = []  # the zeros
    at = len(_SAMPLE.fields)
    for group, count in zip(_SAMPLE.groups[:-1], shape.counts, strict=False):
        if count:
            at += len(group.code)
        elif cuts and cuts[-1] == at:
            fills[-1] += (0,) * len(group.code)
        else:
            cuts.append(at)
            fills.append((0,) * len(group.code))
    end = at
    (cut1, cut2), (fill1, fill2) = [*cuts, end, end][:2], [*fills, (), ()][:2]

    def usual(payload: bytes) -> Message:  # without the last sections
        values = unpack_from(payload, 1)
        message: Message = _new(Sample, (*values[:end], *fill1, values[end:]))
        return message

    def sparse(payload: bytes) -> Message:
        values = unpack_from(payload, 1)
        parts = (*values[:cut1], *fill1, *values[cut1:cut2], *fill2, *values[cut2:end], values[end:])
        message: Message = _new(Sample, parts)
        return message

    return _OVERHEAD + Struct("<" + shape.code).size, usual if cut1 == end else sparse


_UNPACK = {from_board: _unpackers(from_board) for from_board in (True, False)}
_UNPACK_SAMPLE: dict[int, Unpack] = {}  # by frame length and sections: length * 256 + sections
for _shape in sample_shapes():
    _length, _unpack = _sample_unpacker(_shape)
    _UNPACK_SAMPLE[_length << 8 | _shape.sections] = _unpack
_PACK = {layout.cls: layout for layout in LAYOUTS}


def encode(message: Message) -> bytes:
    """The frame of a message, including its final 0x00.

    A SAMPLE carries the sections that its field `sections` names. Raises struct.error for a value that its type cannot
    hold, and ValueError for a number of mice that differs from `sections`.
    """
    layout = _PACK[type(message)]
    values, code = _sample_values(message) if isinstance(message, Sample) else _values(layout, message)
    payload = bytes([layout.type_id]) + Struct("<" + code).pack(*values)
    return bytes(cobs.encode(payload + crc_hqx(payload, _CRC_START).to_bytes(2, "little"))) + b"\0"


def _values(layout: Layout, message: Message) -> tuple[list[int], str]:
    """All numbers of a message in the order of the wire, and their struct format."""
    fields = len(layout.fields)
    content = cast("tuple[Any, ...]", message)
    values, code = list(content[:fields]), layout.fields
    for group, repetitions in zip(layout.groups, content[fields:], strict=True):
        flat = repetitions if group.cls is None else [value for each in repetitions for value in each]
        values += flat
        code += group.code * (len(flat) // len(group.code))
    return values, code


def _sample_values(sample: Sample) -> tuple[list[int], str]:
    """As `_values`, with only the sections that the sample declares."""
    at = len(_SAMPLE.fields)
    content = cast("tuple[Any, ...]", sample)
    values, code = list(content[:at]), _SAMPLE.fields
    for group in _SAMPLE.groups[:-1]:
        if sample.sections & group.mask:
            values += content[at : at + len(group.code)]
            code += group.code
        at += len(group.code)
    mice = _SAMPLE.groups[-1]
    count = len(sample.mice) // len(mice.code)
    if (sample.sections & mice.mask) // (mice.mask & -mice.mask) != count:
        raise ValueError(f"sections {sample.sections:#x} do not declare {count} mice")
    return values + list(sample.mice), code + mice.code * count


def sample(
    seq: int,
    t_us: int,
    flags: int,
    imu: tuple[int, ...] = (),
    imu2: tuple[int, ...] = (),
    baro: tuple[int, ...] = (),
    mag: tuple[int, ...] = (),
    mice: tuple[int, ...] = (),
) -> Sample:
    """A SAMPLE with the sections whose values are given; the others are absent.

    imu, imu2: accel x y z, temperature, gyro x y z; baro: ut, up, count; mag: x y z, count; mice: dx, dy of each.
    """
    values: list[Any] = [seq, t_us, flags, 0]
    sections = 0
    for group, given in zip(_SAMPLE.groups, (imu, baro, imu2, mag), strict=False):
        values += given or (0,) * len(group.code)
        sections |= group.mask * bool(given)
    counted = _SAMPLE.groups[-1]
    sections |= len(mice) // len(counted.code) * (counted.mask & -counted.mask)
    values[3] = sections
    message: Sample = _new(Sample, (*values, mice))
    return message


class StreamDecoder:
    """Turns bytes, in pieces of any size, into messages.

    Whatever is not a frame is dropped and counted in `corrupt` by cause; the decoder is in step again at the next 0x00.
    Memory is bounded for any input.

    `from_board` selects which side's messages are decoded; messages of the other side count as unknown types.
    """

    def __init__(self, from_board: bool = True) -> None:
        self.corrupt = Corrupt()
        self.misfit: tuple[int, int] | None = None  # type and body length of the last sound frame that is no message
        self._unpack = _UNPACK[from_board]
        self._unpack_sample: dict[int, Unpack] = _UNPACK_SAMPLE if from_board else {}
        self._types = {layout.type_id for layout in LAYOUTS if (layout.type_id < 0x80) == from_board}
        self._rest = b""
        self._overlong = False  # the present frame is too long: skip to its end

    def feed(self, data: bytes) -> list[Message | OtherProtocol]:
        """Messages completed by `data`, in order."""
        pieces = (self._rest + data).split(b"\0")
        rest = pieces.pop()
        messages: list[Message | OtherProtocol] = []
        if self._overlong and pieces:  # its end has arrived
            self._overlong = False
            pieces[0] = b""
        sample_of, append, sections_at = self._unpack_sample.get, messages.append, _SECTIONS_AT
        for piece in pieces:
            if not piece:  # nothing between two 0x00 is an idle line, not a frame
                continue
            try:
                payload = cobs_decode(piece)
            except DecodeError:
                if len(piece) > MAX_FRAME:  # as when it arrives in pieces
                    self.corrupt.length += 1
                else:
                    self.corrupt.cobs += 1
                continue
            # Nearly all frames are SAMPLEs, so they are tried first.
            if len(piece) >= _SHORTEST_SAMPLE and payload[0] == _SAMPLE_TYPE:
                unpack = sample_of(len(piece) << 8 | payload[sections_at])
                if unpack and crc_hqx(payload[:-2], 0xFFFF) == payload[-2] | payload[-1] << 8:
                    append(unpack(payload))  # type: ignore[arg-type]  # never None: the length is in the key
                    continue
            if (message := self._decode(payload)) is not None:
                append(message)
        if len(rest) > MAX_FRAME:
            if not self._overlong:
                self._overlong = True
                self.corrupt.length += 1
            rest = b""
        self._rest = rest
        return messages

    def _decode(self, payload: bytes) -> Message | OtherProtocol | None:
        """Any message that is not a sound SAMPLE; None, counted, if it is not a message."""
        length = len(payload) - 3
        message = None
        is_sound = length >= 0 and crc_hqx(payload[:-2], _CRC_START) == payload[-2] | payload[-1] << 8
        if length < 0 or length > _LONGEST_BODY:
            self.corrupt.length += 1
        elif not is_sound:
            self.corrupt.crc += 1
        elif (unpack := self._unpack.get(payload[0] << 8 | length)) is None:
            self._refuse(payload)
        elif (message := unpack(payload)) is None:
            self.corrupt.length += 1
        if is_sound and message is None:
            self.misfit = payload[0], length
        return message

    def _refuse(self, payload: bytes) -> None:
        """Counts a sound frame of unknown type or of a length that its type does not have."""
        if payload[0] in self._types:
            self.corrupt.length += 1
        else:
            self.corrupt.type += 1
