"""`linkpose flash` up to the bootloader: which images it refuses, which port it takes, and what each failure says.

The upload itself is tested with avrdude and the emulated board, in tests/virtual_uno/test_bootloader.py.
"""

from __future__ import annotations

import errno
import os
import shutil
import sys
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import serial
from serial.tools import list_ports_common

from linkpose.device import ports
from linkpose.flashing import build as build_module
from linkpose.flashing.image import MARK, PREBUILT, read_image
from linkpose.flashing.upload import Stage, Upload, find_avrdude
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
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Puts a shell script of this name in the place of all programs on PATH."""
    monkeypatch.setenv("PATH", str(tmp_path))

    def put(name: str, script: str) -> None:
        (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / name).chmod(0o755)

    return put


# ---- images ----


def test_the_prebuilt_image_is_this_version() -> None:
    image = read_image(PREBUILT)
    assert image.identity.version == VERSION
    assert (image.identity.protocol_major, image.identity.schema_crc) == (PROTOCOL_MAJOR, SCHEMA_CRC)


def test_an_image_is_read_as_it_will_lie_in_the_flash(tmp_path: Path) -> None:
    path = tmp_path / "a.hex"
    start = record(3, 0, bytes(4)) + record(2, 0, b"\x00\x10")  # entry point; segment 0x10: addresses begin at 0x100
    path.write_text(record(0, 0, b"\x01\x02") + start + record(0, 4, IDENTITY) + record(4, 0, bytes(2)) + END)
    image = read_image(path)
    assert image.data == b"\x01\x02" + b"\xff" * 0x102 + IDENTITY
    assert str(image.identity) == "firmware 1.2.3, source revision 12345678"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (record(0, 0, IDENTITY).replace(":1", ":2", 1) + END, "line 1: this is no record"),
        (record(0, 0, IDENTITY)[:-2] + "0\n" + END, "line 1: the checksum is wrong"),
        ("\n" + record(0, 0, IDENTITY)[1:] + END, "line 2: this is no record"),
        (record(0, 0, IDENTITY) + record(6, 0, b"") + END, "line 2: there is no such record of type 6"),
        (record(0, 0, IDENTITY) + record(4, 0, b"\0") + END, "line 2: there is no such record of type 4"),
        (record(0, 0, IDENTITY), "its end record is missing"),
        (record(0, 0, IDENTITY) + END + record(0, 64, b"\1"), "line 3: something follows the end record"),
        (record(0, 0x7DFF, b"\1\2") + END, "line 1: address 0x7dff lies beyond the 32256 bytes"),
        (record(4, 0, b"\0\1") + record(0, 0, b"\1") + END, "line 2: address 0x10000 lies beyond"),
        (record(0, 0, bytes(200)) + END, "is not linkpose's firmware"),
        (record(0, 0, IDENTITY[:-1]) + END, "is not linkpose's firmware"),
        (record(0, 0, IDENTITY.replace(SCHEMA_CRC.to_bytes(4, "little"), bytes(4))) + END, "holds firmware 1.2.3"),
        (record(0, 0, MARK + b"\x09" + IDENTITY[9:]) + END, "does not understand this linkpose"),
        ("", "its end record is missing"),
        ("ünlesbar", "is no Intel HEX file"),
    ],
)
def test_an_image_that_must_not_be_written_is_refused(
    refused: Refused, program: Callable[[str, str], None], tmp_path: Path, port: str, text: str, sentence: str
) -> None:
    program("avrdude", f": > {tmp_path}/avrdude-ran")
    path = tmp_path / "a.hex"
    path.write_text(text)
    said = refused("flash", "--port", port, "--hex", path)
    assert sentence in said
    assert "nothing was written" in said
    assert not (tmp_path / "avrdude-ran").exists()


def test_an_image_that_is_not_there(refused: Refused, tmp_path: Path, port: str) -> None:
    said = refused("flash", "--port", port, "--hex", tmp_path / "none.hex")
    assert "none.hex: No such file" in said


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
        ([list_ports_common.ListPortInfo("/dev/ttyS9")], "no UNO is connected; the ports there are: /dev/ttyS9"),
        ([uno("/dev/ttyACM0"), uno("/dev/ttyACM1")], "2 boards are connected: /dev/ttyACM0 (Arduino Uno),"),
    ],
    ids=["none", "no board", "two boards"],
)
def test_the_board_must_be_the_only_one(
    refused: Refused, monkeypatch: pytest.MonkeyPatch, found: list[object], sentence: str
) -> None:
    monkeypatch.setattr(ports.list_ports, "comports", lambda: found)
    said = refused("flash", "--prebuilt")
    assert sentence in said
    assert "sim://" not in said


def test_a_port_that_cannot_be_opened_is_said_before_anything_is_built(
    refused: Refused, monkeypatch: pytest.MonkeyPatch, port: str
) -> None:
    assert "there is no port /dev/ttyNONE" in refused("flash", "--port", "/dev/ttyNONE")
    assert "sim://link is no board that can be flashed" in refused("flash", "--port", "sim://link")
    with serial.Serial(port, exclusive=True):
        assert "is in use by another program; close it" in refused("flash", "--port", port)
    monkeypatch.setattr(ports, "holder", lambda name: "screen (process 123)")
    assert f"{port} is in use by screen (process 123); close it" in refused("flash", "--port", port)


def test_a_port_without_permission_names_the_group(
    refused: Refused, monkeypatch: pytest.MonkeyPatch, port: str
) -> None:
    def forbid(*_: object, **__: object) -> None:
        raise serial.SerialException(errno.EACCES, "could not open port: Permission denied")

    monkeypatch.setattr(serial, "serial_for_url", forbid)
    monkeypatch.setattr(ports, "_group", lambda name: "dialout")
    assert "sudo usermod -aG dialout $USER" in refused("flash", "--port", port)


# ---- avrdude and PlatformIO ----


def test_without_avrdude_the_package_is_named(
    refused: Refused, program: object, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, port: str
) -> None:
    monkeypatch.setenv("PLATFORMIO_CORE_DIR", str(tmp_path))
    said = refused("flash", "--port", port, "--prebuilt")
    assert "avrdude is not installed; type `sudo apt install avrdude`" in said


def test_platformio_s_own_avrdude_serves_too(program: object, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder = tmp_path / "packages" / "tool-avrdude"
    (folder / "bin").mkdir(parents=True)
    shutil.copy("/bin/true", folder / "bin" / "avrdude")
    (folder / "avrdude.conf").touch()
    monkeypatch.setenv("PLATFORMIO_CORE_DIR", str(tmp_path))
    assert find_avrdude() == [str(folder / "bin" / "avrdude"), "-C", str(folder / "avrdude.conf")]


@pytest.mark.parametrize(
    ("script", "sentence"),
    [
        ("echo 'Platform Manager: Installing atmelavr'; echo 'HTTPClientError: '; exit 1", "linkpose flash --prebuilt"),
        ("echo 'Compiling main.o'; echo 'main.cpp:3:1: error: no such thing'; exit 1", "main.cpp:3:1: error: no such"),
        ("exit 1", "PlatformIO did not build the firmware (no reason)"),
    ],
    ids=["offline", "broken sources", "mute"],
)
def test_a_build_that_fails_says_why(
    refused: Refused, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, port: str, script: str, sentence: str
) -> None:
    interpreter = tmp_path / "python"
    interpreter.write_text(f"#!/bin/sh\n{script}\n")
    interpreter.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(interpreter))
    assert sentence in refused("flash", "--port", port)


def test_without_platformio_or_sources_there_is_the_prebuilt_image(
    refused: Refused, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, port: str
) -> None:
    monkeypatch.setattr(build_module, "_PACKAGE", tmp_path / "lib" / "linkpose")
    assert "the firmware's sources are missing from this installation" in refused("flash", "--port", port)
    monkeypatch.setattr(build_module.importlib.util, "find_spec", lambda name: None)
    said = refused("flash", "--port", port)
    assert "PlatformIO is not installed; type `pip install platformio`" in said
    assert "linkpose flash --prebuilt" in said


# ---- what avrdude says, version by version ----

AVRDUDE_6 = """
avrdude: AVR device initialized and ready to accept instructions

Reading | ################################################## | 100% 0.00s

avrdude: Device signature = 0x1e950f (probably m328p)
avrdude: writing flash (13348 bytes):

Writing | #########################"""


@pytest.mark.parametrize(
    ("said", "stage", "percent"),
    [
        ("", Stage.CONNECTING, 0),
        (AVRDUDE_6[:150], Stage.CONNECTING, 0),
        (AVRDUDE_6, Stage.WRITING, 50),
        (AVRDUDE_6 + "#" * 25 + " | 100% 2.00s\n\nReading | ##", Stage.VERIFYING, 4),
    ],
)
def test_how_far_an_upload_has_come(port: str, said: str, stage: Stage, percent: int) -> None:
    upload = Upload(port)
    assert upload.hear(said)
    assert (upload.stage, upload.percent) == (stage, percent)


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        ('avrdude: ser_open(): can\'t open device "{port}": Permission denied', "sudo usermod -aG dialout"),
        ('avrdude: ser_open(): can\'t open device "{port}": Device or resource busy', "{port} cannot be opened"),
        ("avrdude: stk500_recv(): programmer is not responding", "no UNO bootloader answers at {port}"),
        ("avrdude: stk500_getsync() attempt 10 of 10: not in sync: resp=0x4c", "no UNO bootloader answers at {port}"),
        ("avrdude: Expected signature for ATmega328P is 1E 95 0F", "the board at {port} is no UNO"),
        ("Tool Manager: Installing tool-avrdude\nHTTPClientError:", "linkpose flash --prebuilt"),
        ("avrdude error: cannot read the moon", "(avrdude error: cannot read the moon)"),
        (AVRDUDE_6, "the board stopped answering at 50 % of writing: the board's bootloader is intact"),
        (AVRDUDE_6 + " |\nReading | #\navrdude: verification error, first mismatch at byte 0", "verification failed"),
    ],
)
def test_what_each_complaint_means(port: str, said: str, sentence: str) -> None:
    upload = Upload(port)
    upload.hear(said.format(port=port))
    assert sentence.format(port=port) in upload.why_failed()


def test_a_board_that_falls_silent_while_it_is_written_is_given_up(port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("linkpose.flashing.upload.time.monotonic", lambda: now[0])
    upload = Upload(port)
    assert upload.hear(AVRDUDE_6)
    now[0] += 5.0
    assert upload.hear("")
    now[0] += 5.0
    assert not upload.hear("")
