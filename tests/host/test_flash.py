"""`linkpose flash` up to the bootloader: which images it refuses, which port it takes, and each failure's sentence.

The upload itself is tested with real bootloaders on the emulated board, in tests/virtual_uno/test_bootloader.py.
"""

from __future__ import annotations

import errno
import os
import re
import sys
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import serial
from pty_board import PtyBoard
from serial.tools import list_ports_common

from linkpose.device import ports
from linkpose.device import session as session_module
from linkpose.errors import LinkposeError
from linkpose.flashing import build as build_module
from linkpose.flashing.image import MARK, PREBUILT, Image, read_image
from linkpose.flashing.stk500 import SIGNATURE, Bootloader, NoAnswer
from linkpose.flashing.upload import upload
from linkpose.wire.messages import PROTOCOL_MAJOR, SCHEMA_CRC, VERSION

Refused = Callable[..., str]


def record(kind: int, address: int, payload: bytes) -> str:
    body = bytes([len(payload)]) + address.to_bytes(2, "big") + bytes([kind]) + payload
    return f":{(body + bytes([-sum(body) & 0xFF])).hex().upper()}\n"


END = record(1, 0, b"")
IDENTITY = MARK + bytes([PROTOCOL_MAJOR, 0]) + SCHEMA_CRC.to_bytes(4, "little") + bytes([1, 2, 3]) + b"\x78\x56\x34\x12"


@pytest.fixture
def port() -> Iterator[str]:
    """A port at which nothing answers."""
    master, slave = os.openpty()
    tty.setraw(slave)
    yield os.ttyname(slave)
    os.close(master)
    os.close(slave)


@pytest.fixture
def uploaded(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The images whose upload began; none is carried out."""
    images: list[Path] = []

    def note(image: Image, *_: object) -> None:
        images.append(image.path)
        raise LinkposeError("the test ends here")

    monkeypatch.setattr("linkpose.flashing.upload.upload", note)
    return images


@pytest.fixture
def platformio(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[str], None]:
    """Puts a shell script in the place of PlatformIO."""

    def put(script: str) -> None:
        interpreter = tmp_path / "python"
        interpreter.write_text(f"#!/bin/sh\n{script}\n")
        interpreter.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(interpreter))

    return put


# ---- images ----


def test_the_prebuilt_image_is_this_version() -> None:
    image = read_image(PREBUILT)
    assert image.identity.version == VERSION
    assert (image.identity.protocol_major, image.identity.schema_crc) == (PROTOCOL_MAJOR, SCHEMA_CRC)


def test_an_image_is_read_as_it_will_lie_in_the_flash(tmp_path: Path) -> None:
    path = tmp_path / "a.hex"
    start = record(3, 0, bytes(4)) + record(2, 0, b"\x00\x01")  # entry point; segment 1: addresses begin at 0x10
    same = record(0, 0, bytes(14))  # once more, with the same values
    path.write_text(record(0, 0, bytes(18)) + start + record(0, 2, IDENTITY) + record(4, 0, bytes(2)) + same + END)
    image = read_image(path)
    assert image.data == bytes(18) + IDENTITY
    assert str(image.identity) == "firmware 1.2.3, source revision 12345678"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (record(0, 0, IDENTITY).replace(":1", ":2", 1) + END, "line 1: this is not a record"),
        (record(0, 0, IDENTITY)[:-2] + "0\n" + END, "line 1: the checksum is wrong"),
        ("\n" + record(0, 0, IDENTITY)[1:] + END, "line 2: this is not a record"),
        (record(0, 0, IDENTITY) + record(6, 0, b"") + END, "line 2: there is no such record of type 6"),
        (record(0, 0, IDENTITY) + record(4, 0, b"\0") + END, "line 2: there is no such record of type 4"),
        (record(0, 0, IDENTITY), "the end record is missing"),
        (record(0, 0, IDENTITY) + END + record(0, 64, b"\1"), "line 3: a line follows the end record"),
        (record(0, 0x7DFF, b"\1\2") + END, "line 1: address 0x7dff lies beyond the 32256 bytes"),
        (record(4, 0, b"\0\1") + record(0, 0, b"\1") + END, "line 2: address 0x10000 lies beyond"),
        (record(0, 0, IDENTITY) + record(0, 4, b"\0") + END, "line 2: it contradicts an earlier line at address 0x4"),
        (record(0, 0, IDENTITY) + record(0, 0x40, b"\0") + END, "addresses 0x15 to 0x3f are missing"),
        (record(0, 1, IDENTITY) + END, "address 0x0 is missing"),
        (record(0, 0, bytes(200)) + END, "is not linkpose's firmware"),
        (record(0, 0, IDENTITY[:-1]) + END, "is not linkpose's firmware"),
        (record(0, 0, IDENTITY.replace(SCHEMA_CRC.to_bytes(4, "little"), bytes(4))) + END, "contains firmware 1.2.3"),
        (record(0, 0, MARK + b"\x09" + IDENTITY[9:]) + END, "does not match this linkpose"),
        ("", "the end record is missing"),
        ("ünlesbar", "is not an Intel HEX file"),
    ],
)
def test_an_image_that_must_not_be_written_is_refused(
    refused: Refused, uploaded: list[Path], tmp_path: Path, port: str, text: str, sentence: str
) -> None:
    path = tmp_path / "a.hex"
    path.write_text(text)
    output = refused("flash", "--port", port, "--hex", path)
    assert sentence in output
    assert "nothing was written" in output
    assert not uploaded


@pytest.mark.parametrize("line", [0, 5, -3, -2])
def test_a_line_missing_from_the_firmware_is_noticed(
    refused: Refused, uploaded: list[Path], tmp_path: Path, port: str, line: int
) -> None:
    lines = PREBUILT.read_text().splitlines(keepends=True)
    del lines[line]
    path = tmp_path / "a.hex"
    path.write_text("".join(lines))
    assert re.search(
        r"addresses 0x\w+ to 0x\w+ are missing; nothing was written", refused("flash", "--port", port, "--hex", path)
    )
    assert not uploaded


def test_an_image_that_is_not_there(refused: Refused, tmp_path: Path, port: str) -> None:
    output = refused("flash", "--port", port, "--hex", tmp_path / "none.hex")
    assert "none.hex: No such file" in output


def test_one_image_at_a_time(refused: Refused) -> None:
    assert "choose one of --prebuilt and --hex" in refused("flash", "--prebuilt", "--hex", "a.hex")


# ---- ports ----


def uno(device: str) -> list_ports_common.ListPortInfo:
    port = list_ports_common.ListPortInfo(device)
    port.vid, port.pid, port.description = 0x2341, 0x0043, "Arduino Uno"
    return port


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        ([], "no serial port is connected; plug the board in"),
        ([list_ports_common.ListPortInfo("/dev/ttyS9")], "no UNO is connected; the ports are: /dev/ttyS9"),
        ([uno("/dev/ttyACM0"), uno("/dev/ttyACM1")], "2 boards are connected: /dev/ttyACM0 (Arduino Uno),"),
    ],
    ids=["none", "no board", "two boards"],
)
def test_the_board_must_be_the_only_one(
    refused: Refused, monkeypatch: pytest.MonkeyPatch, found: list[object], sentence: str
) -> None:
    monkeypatch.setattr(ports.list_ports, "comports", lambda: found)
    output = refused("flash", "--prebuilt")
    assert sentence in output
    assert "sim://" not in output


def test_a_port_that_cannot_be_opened_is_said_before_anything_is_built(
    refused: Refused, monkeypatch: pytest.MonkeyPatch, port: str
) -> None:
    assert "there is no port /dev/ttyNONE" in refused("flash", "--port", "/dev/ttyNONE")
    assert "sim://link is not a board that can be flashed" in refused("flash", "--port", "sim://link")
    with monkeypatch.context() as patch:
        patch.setenv("LINKPOSE_PORT", "sim://mice")
        assert "sim://mice is not a board that can be flashed" in refused("flash", "--prebuilt")
    with serial.Serial(port, exclusive=True):
        assert "is in use by another program. Close it" in refused("flash", "--port", port)
    monkeypatch.setattr(ports, "holder", lambda name: "screen (process 123)")
    assert f"{port} is in use by screen (process 123). Close it" in refused("flash", "--port", port)


def test_a_port_without_permission_names_the_group(
    refused: Refused, monkeypatch: pytest.MonkeyPatch, port: str
) -> None:
    def forbid(*_: object, **__: object) -> None:
        raise serial.SerialException(errno.EACCES, "could not open port: Permission denied")

    monkeypatch.setattr(serial, "serial_for_url", forbid)
    monkeypatch.setattr(ports, "_group", lambda name: "dialout")
    assert "sudo usermod -aG dialout $USER" in refused("flash", "--port", port)


# ---- PlatformIO ----


@pytest.mark.parametrize(
    ("script", "sentence"),
    [
        ("echo 'Compiling main.o'; echo 'main.cpp:3:1: error: no such thing'; exit 1", "main.cpp:3:1: error: no such"),
        ("exit 1", "PlatformIO did not build the firmware (no reason)"),
    ],
    ids=["broken sources", "mute"],
)
def test_sources_that_do_not_compile_are_an_error(
    refused: Refused,
    platformio: Callable[[str], None],
    uploaded: list[Path],
    port: str,
    script: str,
    sentence: str,
) -> None:
    platformio(script)
    assert sentence in refused("flash", "--port", port)
    assert not uploaded


def test_without_the_toolchain_the_prebuilt_image_is_uploaded(
    linkpose: Callable[..., tuple[int, str, str]],
    platformio: Callable[[str], None],
    uploaded: list[Path],
    port: str,
) -> None:
    platformio("echo 'Platform Manager: Installing atmelavr'; echo 'HTTPClientError: '; exit 1")
    _, _, shown = linkpose("flash", "--port", port)
    assert "PlatformIO cannot download its toolchain" in shown
    assert "uploading the prebuilt firmware instead" in shown
    assert uploaded == [PREBUILT]


def test_without_platformio_or_sources_the_prebuilt_image_is_uploaded(
    linkpose: Callable[..., tuple[int, str, str]],
    monkeypatch: pytest.MonkeyPatch,
    uploaded: list[Path],
    tmp_path: Path,
    port: str,
) -> None:
    monkeypatch.setattr(build_module, "_PACKAGE", tmp_path / "lib" / "linkpose")
    assert (
        "the firmware's sources are missing from this installation; uploading" in linkpose("flash", "--port", port)[2]
    )
    monkeypatch.setattr(build_module.importlib.util, "find_spec", lambda name: None)
    assert "PlatformIO is not installed" in linkpose("flash", "--port", port)[2]
    assert uploaded == [PREBUILT, PREBUILT]


# ---- the upload's words on the line; real bootloaders answer in tests/virtual_uno/test_bootloader.py ----


class ScriptedPort:
    """A port that gives these answers, one for each write, and records what was written."""

    def __init__(self, *answers: bytes) -> None:
        self.timeout: float | None = None
        self.written: list[bytes] = []
        self._answers = list(answers)
        self._pending = b""

    def write(self, data: bytes) -> int:
        self.written.append(data)
        self._pending += self._answers.pop(0) if self._answers else b""
        return len(data)

    def read(self, size: int = 1) -> bytes:
        data, self._pending = self._pending[:size], self._pending[size:]
        return data

    def close(self) -> None:
        """Nothing to let go."""


def test_the_words_are_those_of_stk500() -> None:
    ok = b"\x14\x10"
    port = ScriptedPort(b"noise" + ok, b"\x14\x1e\x95\x0f\x10", ok, ok, ok, b"\x14" + bytes(128) + b"\x10", ok)
    loader = Bootloader(port)
    assert loader.connect(1)
    assert loader.signature() == SIGNATURE
    loader.write_page(0x1080, bytes(range(128)))
    assert loader.read_page(0) == bytes(128)
    loader.leave()
    page = b"d\x00\x80F" + bytes(range(128)) + b" "
    assert port.written == [b"0 ", b"u ", b"U\x40\x08 ", page, b"U\0\0 ", b"t\0\x80F ", b"Q "]


@pytest.mark.parametrize("answer", [b"", b"\x14", b"\x10\x1e\x95\x0f\x14", b"\x14\x1e\x95\x0f\x11"])
def test_an_answer_that_is_cut_off_or_wrong_is_none(answer: bytes) -> None:
    with pytest.raises(NoAnswer):
        Bootloader(ScriptedPort(answer)).signature()


def test_both_bit_rates_are_tried(port: str) -> None:
    rates: list[int] = []

    def open_silent(_: str, baud: int) -> ScriptedPort:
        rates.append(baud)
        return ScriptedPort()

    with pytest.raises(LinkposeError, match="No UNO bootloader answers"):
        upload(read_image(PREBUILT), port, lambda _: None, open_silent)
    assert rates == [115_200, 57_600, 115_200, 57_600]


@pytest.mark.parametrize(
    ("answers", "sentence"),
    [
        (True, "reports source revision .*, but .* was written. Check that .* is the board that was flashed"),
        (False, "The firmware was written and verified, but the handshake failed: .*the board is silent"),
    ],
    ids=["another firmware", "silence"],
)
def test_what_answers_after_the_upload_is_checked(
    refused: Refused, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, answers: bool, sentence: str
) -> None:
    """A simulated board, whose firmware is not the one that was written, or a port at which nothing answers."""
    monkeypatch.setattr(session_module, "HANDSHAKE_TIMEOUT_S", 0.4)
    monkeypatch.setattr("linkpose.flashing.upload.upload", lambda *_: None)
    with PtyBoard(tmp_path / "port", spoil=lambda data: data if answers else b""):
        assert re.search(sentence, refused("flash", "--prebuilt", "--port", tmp_path / "port"))
