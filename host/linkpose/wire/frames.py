"""Frames on the wire: COBS, closed by 0x00, around a type byte, a body and a CRC-16/CCITT-FALSE (little-endian)."""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass
from struct import Struct
from typing import Any, NamedTuple, cast

from cobs import cobs

from linkpose.wire.messages import LAYOUTS, MAX_FRAME, PROTOCOL_MAJOR, Hello, Layout, Message

_CRC_START = 0xFFFF
_HELLO_TYPE = next(layout.type_id for layout in LAYOUTS if layout.cls is Hello)
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


Unpack = Callable[[bytes], Message]


def _unpacker(layout: Layout, count: int) -> tuple[int, Unpack]:
    """Body length and decoder of a message whose closing group stands `count` times."""
    whole = Struct("<" + layout.fields + layout.group * count)
    fields, width, cls = len(layout.fields), len(layout.group), cast(Any, layout.cls)
    group_cls = cast(Any, layout.group_cls)

    def plain(payload: bytes) -> Message:
        return cast(Message, cls(*whole.unpack_from(payload, 1)))

    def grouped(payload: bytes) -> Message:
        values = whole.unpack_from(payload, 1)
        ends = range(fields + width, fields + width * count + 1, width)
        return cast(Message, cls(*values[:fields], tuple([group_cls(*values[end - width : end]) for end in ends])))

    return whole.size, grouped if count else plain


def _unpackers() -> dict[int, Unpack]:
    """Decoder of each message by type and body length: type * 256 + length."""
    table = {}
    for layout in LAYOUTS:
        for count in range(layout.group_max + 1):
            size, unpack = _unpacker(layout, count)
            table[layout.type_id << 8 | size] = unpack
    return table


_UNPACK = _unpackers()
_TYPES = frozenset(layout.type_id for layout in LAYOUTS)
_PACK = {layout.cls: layout for layout in LAYOUTS}


def encode(message: Message) -> bytes:
    """The frame of a message, its closing 0x00 included. Raises struct.error for a value that its type cannot hold."""
    layout = _PACK[type(message)]
    values: list[int] = list(cast("tuple[int, ...]", message))
    code = layout.fields
    if layout.group:
        groups = cast("tuple[tuple[int, ...], ...]", values.pop())
        code += layout.group * len(groups)
        values += [value for group in groups for value in group]
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
        self._from_board = from_board
        self._rest = b""
        self._overlong = False  # the frame under way is longer than any: wait for its end

    def feed(self, data: bytes) -> list[Message | OtherProtocol]:
        """Messages completed by `data`, in order."""
        pieces = (self._rest + data).split(b"\0")
        rest = pieces.pop()
        messages = []
        for piece in pieces:
            if self._overlong:
                self._overlong = False
            elif piece:  # nothing between two 0x00 is an idle line, not a frame
                message = self._decode(piece)
                if message is not None:
                    messages.append(message)
        if len(rest) > MAX_FRAME:
            if not self._overlong:
                self._overlong = True
                self.corrupt.length += 1
            rest = b""
        self._rest = rest
        return messages

    def _decode(self, piece: bytes) -> Message | OtherProtocol | None:
        if len(piece) > MAX_FRAME:
            self.corrupt.length += 1
            return None
        try:
            payload = cobs.decode(piece)
        except cobs.DecodeError:
            self.corrupt.cobs += 1
            return None
        if len(payload) < 3:
            self.corrupt.length += 1
            return None
        if crc_hqx(payload[:-2], _CRC_START) != payload[-2] | payload[-1] << 8:
            self.corrupt.crc += 1
            return None
        kind = payload[0]
        unpack = _UNPACK.get(kind << 8 | len(payload) - 3)
        if unpack is not None and (kind < 0x80) == self._from_board:
            if kind == _HELLO_TYPE and payload[1] != PROTOCOL_MAJOR:
                return OtherProtocol(*_PREFIX.unpack_from(payload, 1))
            return unpack(payload)
        return self._refuse(payload)

    def _refuse(self, payload: bytes) -> OtherProtocol | None:
        """A sound frame that is none of ours: another protocol's HELLO, a wrong length or an unknown type."""
        kind = payload[0]
        if (kind < 0x80) != self._from_board or kind not in _TYPES:
            self.corrupt.type += 1
        elif kind == _HELLO_TYPE and len(payload) - 3 >= _PREFIX.size and payload[1] != PROTOCOL_MAJOR:
            return OtherProtocol(*_PREFIX.unpack_from(payload, 1))
        else:
            self.corrupt.length += 1
        return None
