"""What an answer of the board, or its absence, means: version, reset cause, and why no session is possible."""

from __future__ import annotations

from linkpose.errors import WrongFirmware
from linkpose.wire.frames import OtherProtocol, StreamDecoder
from linkpose.wire.messages import PROTOCOL_MAJOR, PROTOCOL_MINOR, VERSION, Hello, NakReason, ResetCause


def firmware_version(hello: Hello) -> str:
    """As in the releases, such as 1.2.3."""
    return f"{hello.firmware_major}.{hello.firmware_minor}.{hello.firmware_patch}"


def reset_causes(hello: Hello) -> str:
    """Names of the reset flags that are set, such as "watchdog", or where the firmware hung."""
    if hello.reset_cause & ResetCause.HUNG:
        return f"the firmware hung at program counter {hello.hung_at:#06x}"
    names = [cause.name.lower().replace("_", " ") for cause in ResetCause if hello.reset_cause & cause and cause.name]
    return ", ".join(names) or "cause unknown"


def refusal_reason(code: int) -> str:
    """The reason that a NAK gives."""
    try:
        return NakReason(code).name.lower().replace("_", " ")
    except ValueError:
        return f"reason {code}"


def other_protocol(other: OtherProtocol) -> WrongFirmware:
    """The failure of a board whose protocol has another major version."""
    theirs = f"{other.protocol_major}.{other.protocol_minor}"
    ours = f"{PROTOCOL_MAJOR}.{PROTOCOL_MINOR}"
    if other.protocol_major < PROTOCOL_MAJOR:
        return WrongFirmware(f"the board's firmware is old: it uses protocol {theirs}, this linkpose {ours}", True)
    return WrongFirmware(f"this linkpose is old: it uses protocol {ours}, the board's firmware {theirs}", False)


def other_schema(hello: Hello) -> WrongFirmware:
    """The failure of a board whose messages of the same protocol version have other fields."""
    theirs = firmware_version(hello)
    release = (hello.firmware_major, hello.firmware_minor, hello.firmware_patch)
    if release > tuple(map(int, VERSION.split("."))):
        text = f"this linkpose {VERSION} is older than the board's firmware {theirs}, and their schemas differ"
        return WrongFirmware(text, False)
    text = f"the board's firmware {theirs} and this linkpose {VERSION} have different wire schemas"
    return WrongFirmware(text, True)


def why_no_hello(received: bytes, decoder: StreamDecoder) -> str:
    """What came instead of a HELLO, and what to do about it."""
    corrupt = decoder.corrupt
    if decoder.misfit is not None:
        kind, length = decoder.misfit
        return (
            f"a frame of type {kind:#04x} with {length} bytes arrived intact, which protocol {PROTOCOL_MAJOR} does not "
            "have; the firmware is damaged or not linkpose's"
        )
    if not received:
        return "the board is silent; it may never have had this firmware, or another port is the board's"
    printable = sum(32 <= byte < 127 or byte in b"\r\n\t" for byte in received)
    if printable > 0.8 * len(received):
        text = received[:60].decode("ascii", "replace").strip().replace("\r", "").replace("\n", " / ")
        return f"another firmware answers: {text!r}"
    if 0 in received and corrupt.crc + corrupt.cobs + corrupt.length < 3 and len(received) < 64:
        return "the board answers only in part; check the cable and try again"
    return (
        "only noise was received, and no frame; the device uses another baud rate or is not a linkpose board: check "
        "the port"
    )
