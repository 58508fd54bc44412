"""Firmware images in Intel HEX: one that is damaged or not linkpose's is refused before a board is touched."""

from __future__ import annotations

import binascii
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from linkpose.errors import LinkposeError
from linkpose.inputs import read_bytes
from linkpose.wire.messages import PROTOCOL_MAJOR, SCHEMA_CRC, VERSION

PREBUILT = Path(__file__).with_name("firmware.hex")
APPLICATION_BYTES = 32_256  # of the flash; the UNO's bootloader occupies the last 512 of 32768
MARK = b"linkpose"  # precedes the identity; firmware/src/Link.cpp puts both into the image

_IDENTITY = struct.Struct("<BBIBBBI")
_DATA, _END, _EXTENDED_SEGMENT, _START_SEGMENT, _EXTENDED_LINEAR, _START_LINEAR = range(6)
_PAYLOAD_BYTES = {_END: 0, _EXTENDED_SEGMENT: 2, _START_SEGMENT: 4, _EXTENDED_LINEAR: 2, _START_LINEAR: 4}

# __do_copy_data of libgcc (libgcc/config/avr/lib1funcs.S) copies the initial values of variables, the last bytes of
# the image, into RAM: ldi r17; ldi r26; ldi r27; ldi r30; ldi r31; rjmp; lpm; st; cpi r26; cpc; brne.
_COPY_DATA = re.compile(
    rb"([\x10-\x1f][\xe0-\xef])([\xa0-\xaf][\xe0-\xef])([\xb0-\xbf][\xe0-\xef])([\xe0-\xef][\xe0-\xef])"
    rb"([\xf0-\xff][\xe0-\xef])\x02\xc0\x05\x90\x0d\x92([\xa0-\xaf][\x30-\x3f])\xb1\x07\xd9\xf7",
    re.DOTALL,
)
_COPY_AGAIN = "nothing was written. Copy the file again"


class Identity(NamedTuple):
    """Version of the firmware in an image: the first fields of the HELLO that the firmware sends."""

    protocol_major: int
    protocol_minor: int
    schema_crc: int
    firmware_major: int
    firmware_minor: int
    firmware_patch: int
    source_revision: int

    @property
    def version(self) -> str:
        return f"{self.firmware_major}.{self.firmware_minor}.{self.firmware_patch}"

    def __str__(self) -> str:
        return f"firmware {self.version}, source revision {self.source_revision:08x}"


@dataclass(frozen=True, slots=True)
class Image:
    """A firmware that may be written to the board."""

    path: Path
    data: bytes  # from address 0, without holes
    identity: Identity


def read_image(path: Path) -> Image:
    """Read a .hex file.

    Raises LinkposeError for a file that is absent, damaged (a wrong checksum, contradicting or missing lines, no end
    record), too large for the UNO, or not the firmware of this linkpose.
    """
    try:
        text = read_bytes(path, "the firmware").decode("ascii")
    except UnicodeDecodeError as error:
        raise LinkposeError(f"{path} is not an Intel HEX file; nothing was written") from error
    data = _parse(path, text)
    identity = _identify(path, data)
    _check_length(path, data)
    return Image(path, data, identity)


@dataclass(slots=True)
class _Flash:
    """Bytes by address, and which of them a record has set."""

    data: bytearray = field(default_factory=lambda: bytearray(APPLICATION_BYTES))
    is_set: bytearray = field(default_factory=lambda: bytearray(APPLICATION_BYTES))

    def contradicts(self, address: int, payload: bytes) -> int | None:
        """The first address at which an earlier record set another value."""
        for at, value in enumerate(payload, address):
            if self.is_set[at] and self.data[at] != value:
                return at
        return None

    def put(self, address: int, payload: bytes) -> None:
        end = address + len(payload)
        self.data[address:end] = payload
        self.is_set[address:end] = b"\x01" * len(payload)


def _parse(path: Path, text: str) -> bytes:
    """The bytes of an Intel HEX file, from address 0."""
    flash = _Flash()
    base, ended = 0, False
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        if ended:
            raise _damaged(path, number, "a line follows the end record")
        kind, address, payload = _record(path, number, line.strip())
        if kind == _DATA:
            _place(path, number, flash, base + address, payload)
        elif kind == _EXTENDED_SEGMENT:
            base = int.from_bytes(payload, "big") << 4
        elif kind == _EXTENDED_LINEAR:
            base = int.from_bytes(payload, "big") << 16
        ended = kind == _END
    if not ended:
        raise LinkposeError(f"{path} is cut off: the end record is missing; {_COPY_AGAIN}")
    end = flash.is_set.rfind(1) + 1
    hole = flash.is_set.find(0, 0, end)
    if hole >= 0:
        last = flash.is_set.find(1, hole) - 1
        raise _missing(path, hole, last)
    return bytes(flash.data[:end])


def _record(path: Path, number: int, line: str) -> tuple[int, int, bytes]:
    """Type, address and payload of a line."""
    try:
        record = binascii.unhexlify(line[1:])
    except (ValueError, binascii.Error):
        record = b""
    if line[0] != ":" or len(record) < 5 or len(record) != record[0] + 5:
        raise _damaged(path, number, "this is not a record")
    if sum(record) & 0xFF:
        raise _damaged(path, number, "the checksum is wrong")
    kind, payload = record[3], record[4:-1]
    if kind != _DATA and _PAYLOAD_BYTES.get(kind) != len(payload):
        raise _damaged(path, number, f"there is no such record of type {kind}")
    return kind, int.from_bytes(record[1:3], "big"), payload


def _place(path: Path, number: int, flash: _Flash, address: int, payload: bytes) -> None:
    if address + len(payload) > APPLICATION_BYTES:
        raise LinkposeError(
            f"{path}, line {number}: address {address:#x} lies beyond the {APPLICATION_BYTES} bytes that an UNO has "
            "for a program. The file is for another board; nothing was written"
        )
    at = flash.contradicts(address, payload)
    if at is not None:
        raise _damaged(path, number, f"it contradicts an earlier line at address {at:#x}")
    flash.put(address, payload)


def _damaged(path: Path, number: int, what: str) -> LinkposeError:
    return LinkposeError(f"{path} is damaged, line {number}: {what}; {_COPY_AGAIN}")


def _missing(path: Path, first: int, last: int) -> LinkposeError:
    what = f"addresses {first:#x} to {last:#x} are missing" if first < last else f"address {first:#x} is missing"
    return LinkposeError(f"{path} is damaged: {what}; {_COPY_AGAIN}")


def _identify(path: Path, data: bytes) -> Identity:
    at = data.find(MARK)
    if at < 0 or len(data) < at + len(MARK) + _IDENTITY.size:
        raise LinkposeError(f"{path} is not linkpose's firmware; nothing was written. `linkpose flash` builds it")
    identity = Identity(*_IDENTITY.unpack_from(data, at + len(MARK)))
    if (identity.protocol_major, identity.schema_crc) != (PROTOCOL_MAJOR, SCHEMA_CRC):
        raise LinkposeError(
            f"{path} contains firmware {identity.version}, which does not match this linkpose {VERSION}; nothing was "
            "written. `linkpose flash` builds the matching one"
        )
    return identity


def _check_length(path: Path, data: bytes) -> None:
    """Raise LinkposeError when the end of the image is missing. A program without initial values has no such check."""
    found = _COPY_DATA.search(data)
    if found is None:
        return
    end_high, start_low, start_high, load_low, load_high, end_low = map(_immediate, found.groups())
    length = 256 * load_high + load_low + (256 * end_high + end_low) - (256 * start_high + start_low)
    if len(data) < length:
        raise LinkposeError(
            f"{path} is damaged: addresses {len(data):#x} to {length - 1:#x} are missing; {_COPY_AGAIN}"
        )


def _immediate(instruction: bytes) -> int:
    """The constant in an instruction such as `ldi` or `cpi`: the low half of each byte."""
    return instruction[0] & 0x0F | instruction[1] << 4 & 0xF0
