"""Firmware images in Intel HEX: read, and refused before a board is touched when broken or not linkpose's."""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from linkpose.errors import LinkposeError
from linkpose.wire.messages import PROTOCOL_MAJOR, SCHEMA_CRC, VERSION

PREBUILT = Path(__file__).with_name("firmware.hex")
APPLICATION_BYTES = 32_256  # of the flash; the bootloader has the last 512
MARK = b"linkpose"  # stands before the identity; firmware/src/Link.cpp puts both into the image

_IDENTITY = struct.Struct("<BBIBBBI")
_DATA, _END, _EXTENDED_SEGMENT, _START_SEGMENT, _EXTENDED_LINEAR, _START_LINEAR = range(6)
_PAYLOAD_BYTES = {_END: 0, _EXTENDED_SEGMENT: 2, _START_SEGMENT: 4, _EXTENDED_LINEAR: 2, _START_LINEAR: 4}


class Identity(NamedTuple):
    """Which firmware an image holds: the first fields of the HELLO that it will send."""

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
    data: bytes  # from address 0, 0xFF where the file says nothing
    identity: Identity


def read_image(path: Path) -> Image:
    """Reads a .hex. Raises LinkposeError for one that is absent, damaged, too large or not this linkpose's firmware."""
    try:
        text = path.read_text(encoding="ascii")
    except OSError as error:
        raise LinkposeError(f"cannot read the firmware {path}: {error.strerror}; nothing was written") from error
    except UnicodeDecodeError as error:
        raise LinkposeError(f"{path} is no Intel HEX file; nothing was written") from error
    data = _parse(path, text)
    return Image(path, data, _identify(path, data))


def _parse(path: Path, text: str) -> bytes:
    """The bytes of an Intel HEX file, from address 0."""
    data = bytearray()
    base, ended = 0, False
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        if ended:
            raise _damaged(path, number, "something follows the end record")
        kind, address, payload = _record(path, number, line.strip())
        if kind == _DATA:
            _place(path, number, data, base + address, payload)
        elif kind == _EXTENDED_SEGMENT:
            base = int.from_bytes(payload, "big") << 4
        elif kind == _EXTENDED_LINEAR:
            base = int.from_bytes(payload, "big") << 16
        ended = kind == _END
    if not ended:
        raise LinkposeError(f"{path} is cut off: its end record is missing; nothing was written, copy the file again")
    return bytes(data)


def _record(path: Path, number: int, line: str) -> tuple[int, int, bytes]:
    """Type, address and payload of a line."""
    try:
        record = binascii.unhexlify(line[1:])
    except (ValueError, binascii.Error):
        record = b""
    if line[0] != ":" or len(record) < 5 or len(record) != record[0] + 5:
        raise _damaged(path, number, "this is no record")
    if sum(record) & 0xFF:
        raise _damaged(path, number, "the checksum is wrong")
    kind, payload = record[3], record[4:-1]
    if kind != _DATA and _PAYLOAD_BYTES.get(kind) != len(payload):
        raise _damaged(path, number, f"there is no such record of type {kind}")
    return kind, int.from_bytes(record[1:3], "big"), payload


def _place(path: Path, number: int, data: bytearray, address: int, payload: bytes) -> None:
    end = address + len(payload)
    if end > APPLICATION_BYTES:
        raise LinkposeError(
            f"{path}, line {number}: address {address:#x} lies beyond the {APPLICATION_BYTES} bytes that an UNO has "
            "for a program; this file is for another board, nothing was written"
        )
    data.extend(b"\xff" * (end - len(data)))
    data[address:end] = payload


def _damaged(path: Path, number: int, what: str) -> LinkposeError:
    return LinkposeError(f"{path} is damaged, line {number}: {what}; nothing was written, copy the file again")


def _identify(path: Path, data: bytes) -> Identity:
    at = data.find(MARK)
    if at < 0 or len(data) < at + len(MARK) + _IDENTITY.size:
        raise LinkposeError(f"{path} is not linkpose's firmware; nothing was written, `linkpose flash` builds it")
    identity = Identity(*_IDENTITY.unpack_from(data, at + len(MARK)))
    if (identity.protocol_major, identity.schema_crc) != (PROTOCOL_MAJOR, SCHEMA_CRC):
        raise LinkposeError(
            f"{path} holds firmware {identity.version}, which does not understand this linkpose {VERSION}; nothing was "
            "written, `linkpose flash` builds the right one"
        )
    return identity
