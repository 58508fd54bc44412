"""Frames on the wire: COBS, closed by 0x00, around a type byte, a body and a CRC-16/CCITT-FALSE (little-endian)."""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass
from struct import Struct
from typing import Any, NamedTuple, cast

from cobs import cobs
from cobs.cobs import DecodeError
from cobs.cobs import decode as cobs_decode

from linkpose.wire.messages import LAYOUTS, MAX_FRAME, PROTOCOL_MAJOR, Hello, Layout, Message, Sample

_CRC_START = 0xFFFF
_OVERHEAD = 4  # bytes of a frame beside its body: type, CRC and COBS's
_LONGEST_BODY = MAX_FRAME - _OVERHEAD
_HELLO_TYPE = next(layout.type_id for layout in LAYOUTS if layout.cls is Hello)
_SAMPLE = next(layout for layout in LAYOUTS if layout.cls is Sample)
_SAMPLE_FIELDS = Struct("<" + _SAMPLE.fields)
_SAMPLE_MICE_AT = 1 + _SAMPLE_FIELDS.size  # in the payload
_SAMPLE_CRC_START = crc_hqx(bytes([_SAMPLE.type_id]), _CRC_START)  # what the type byte makes of it
_PREFIX = Struct("<BBI")  # the part of HELLO's body that no version changes


class OtherProtocol(NamedTuple):
    """A HELLO of a protocol whose major number is not ours: all that can be read of it."""

    protocol_major: int
    protocol_minor: int
    schema_crc: int


@dataclass(slots=True)
class Corrupt:
    """Frames that were dropped, by cause."""

    cobs: int = 0  # a COBS code points past the frame's end
    length: int = 0  # shorter or longer than any frame, or than its type's body
    crc: int = 0
    type: int = 0  # unknown to this side

    @property
    def total(self) -> int:
        return self.cobs + self.length + self.crc + self.type

    def as_dict(self) -> dict[str, int]:
        return {"cobs": self.cobs, "length": self.length, "crc": self.crc, "type": self.type}


Unpack = Callable[[bytes], Message | OtherProtocol | None]  # None: the length is wrong after all
UnpackFrom = Callable[[bytes, int], tuple[int, ...]]

# Fills a NamedTuple in a third of the time that its own constructor takes.
_new = cast(Any, tuple.__new__)


def _unpacker(layout: Layout, count: int) -> tuple[int, Unpack]:
    """Body length and decoder of a message whose closing group stands `count` times."""
    whole = Struct("<" + layout.fields + layout.group * count)
    unpack_from, cls, group_cls = whole.unpack_from, layout.cls, layout.group_cls
    fields, width = len(layout.fields), len(layout.group)
    starts = [fields + width * at for at in range(count)]

    def plain(payload: bytes) -> Message:
        message: Message = _new(cls, unpack_from(payload, 1))
        return message

    def grouped(payload: bytes) -> Message:
        values = unpack_from(payload, 1)
        groups = tuple([_new(group_cls, values[at : at + width]) for at in starts])
        message: Message = _new(cls, (*values[:fields], groups))
        return message

    return whole.size, grouped if layout.group else plain


def _hello_or_other(unpack: Unpack | None) -> Unpack:
    """Reads a HELLO of our protocol by `unpack`, and of any other major number what never changes."""

    def read(payload: bytes) -> Message | OtherProtocol | None:
        if payload[1] != PROTOCOL_MAJOR:
            return OtherProtocol(*_PREFIX.unpack_from(payload, 1))
        return unpack(payload) if unpack else None

    return read


def _unpackers(from_board: bool) -> dict[int, Unpack]:
    """Decoder of each message of one side but SAMPLE, by type and body length: type * 256 + length."""
    table: dict[int, Unpack] = {}
    for layout in LAYOUTS:
        if (layout.type_id < 0x80) == from_board and layout is not _SAMPLE:
            for count in range(layout.group_max + 1):
                size, unpack = _unpacker(layout, count)
                table[layout.type_id << 8 | size] = unpack
    if from_board:
        for size in range(_PREFIX.size, MAX_FRAME):
            table[_HELLO_TYPE << 8 | size] = _hello_or_other(table.get(_HELLO_TYPE << 8 | size))
    return table


def _sample_mice() -> dict[int, UnpackFrom]:
    """Decoder of the counts of the mice in a SAMPLE, by the length of its frame."""
    mice = [Struct("<" + _SAMPLE.group * count) for count in range(_SAMPLE.group_max + 1)]
    return {_OVERHEAD + _SAMPLE_FIELDS.size + each.size: each.unpack_from for each in mice}


_UNPACK = {from_board: _unpackers(from_board) for from_board in (True, False)}
_SAMPLE_MICE = _sample_mice()
_PACK = {layout.cls: layout for layout in LAYOUTS}


def encode(message: Message) -> bytes:
    """The frame of a message, its closing 0x00 included. Raises struct.error for a value that its type cannot hold."""
    layout = _PACK[type(message)]
    values: list[int] = list(cast("tuple[int, ...]", message))
    code = layout.fields
    if layout.group:
        groups = cast("tuple[Any, ...]", values.pop())
        flat = [value for group in groups for value in group] if layout.group_cls else groups
        code += layout.group * (len(flat) // len(layout.group))
        values += flat
    payload = bytes([layout.type_id]) + Struct("<" + code).pack(*values)
    return bytes(cobs.encode(payload + crc_hqx(payload, _CRC_START).to_bytes(2, "little"))) + b"\0"


class StreamDecoder:
    """Turns bytes, in pieces of any size, into messages.

    What is no frame is counted in `corrupt` by cause and dropped; the decoder is in step again at the next 0x00.
    Memory is bounded whatever arrives.

    `from_board` chooses which side's messages are known; the other side's are counted as of unknown type.
    """

    def __init__(self, from_board: bool = True) -> None:
        self.corrupt = Corrupt()
        self._unpack = _UNPACK[from_board]
        self._sample_mice = _SAMPLE_MICE if from_board else {}
        self._types = {layout.type_id for layout in LAYOUTS if (layout.type_id < 0x80) == from_board}
        self._rest = b""
        self._overlong = False  # the frame under way is longer than any: wait for its end

    def feed(self, data: bytes) -> list[Message | OtherProtocol]:
        """Messages completed by `data`, in order."""
        pieces = (self._rest + data).split(b"\0")
        rest = pieces.pop()
        messages: list[Message | OtherProtocol] = []
        if self._overlong and pieces:  # its end has come
            self._overlong = False
            pieces[0] = b""
        mice_of = self._sample_mice.get
        for piece in pieces:
            if not piece:  # nothing between two 0x00 is an idle line, not a frame
                continue
            try:
                payload = cobs_decode(piece)
            except DecodeError:
                self.corrupt.cobs += 1
                continue
            # Nearly all frames are SAMPLEs. Their CRC is begun behind the type byte: of another type it is never right.
            unpack_mice = mice_of(len(piece))
            if unpack_mice and crc_hqx(payload[1:-2], _SAMPLE_CRC_START) == payload[-2] | payload[-1] << 8:
                mice = (unpack_mice(payload, _SAMPLE_MICE_AT),)
                messages.append(_new(Sample, _SAMPLE_FIELDS.unpack_from(payload, 1) + mice))
            elif (message := self._decode(payload)) is not None:
                messages.append(message)
        if len(rest) > MAX_FRAME:
            if not self._overlong:
                self._overlong = True
                self.corrupt.length += 1
            rest = b""
        self._rest = rest
        return messages

    def _decode(self, payload: bytes) -> Message | OtherProtocol | None:
        """What is no sound SAMPLE; None where it is nothing at all, and is counted."""
        length = len(payload) - 3
        message = None
        if length < 0 or length > _LONGEST_BODY:
            self.corrupt.length += 1
        elif crc_hqx(payload[:-2], _CRC_START) != payload[-2] | payload[-1] << 8:
            self.corrupt.crc += 1
        elif (unpack := self._unpack.get(payload[0] << 8 | length)) is None:
            self._refuse(payload)
        elif (message := unpack(payload)) is None:
            self.corrupt.length += 1
        return message

    def _refuse(self, payload: bytes) -> None:
        """Counts a sound frame that is none of ours: of unknown type or another length."""
        if payload[0] in self._types:
            self.corrupt.length += 1
        else:
            self.corrupt.type += 1
