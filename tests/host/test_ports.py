"""Ports: which board is chosen, devices without a port, and text from USB that would act on a terminal."""

from __future__ import annotations

import contextlib
import errno
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from serial.tools import list_ports_common

from linkpose.device import ports
from linkpose.device.connection import Connection
from linkpose.device.ports import CHIPS, UsbIdentity, choose_port, devices_without_port, find_again, find_ports
from linkpose.errors import LinkposeError, printable
from linkpose.wire.messages import Ping


@pytest.fixture
def connect(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Replaces the system's ports by those of these USB ids: (vid, pid), serial number, location."""

    def put(*devices: tuple[str, tuple[int, int], str | None, str | None]) -> None:
        found = []
        for name, (vid, pid), number, location in devices:
            port = list_ports_common.ListPortInfo(name)
            port.vid, port.pid, port.serial_number, port.location = vid, pid, number, location
            found.append(port)
        monkeypatch.setattr(ports.list_ports, "comports", lambda: found)

    return put


UNO, CH340, CH9102, FTDI, CP210X = (
    (0x2341, 0x43),
    (0x1A86, 0x7523),
    (0x1A86, 0x55D4),
    (0x0403, 0x6001),
    (0x10C4, 0xEA60),
)
OTHER = (0x1234, 0x5678)


@pytest.mark.parametrize("chip", [UNO, CH340, CH9102, FTDI, CP210X], ids=lambda chip: CHIPS[chip].name)
def test_the_usb_chips_of_unos_and_copies_are_recognised(connect: Callable[..., None], chip: tuple[int, int]) -> None:
    connect(("COM3", OTHER, None, None), ("COM4", chip, None, None))
    assert choose_port() == "COM4"
    assert [port.is_uno for port in find_ports()] == [False, True]
    assert find_ports()[1].chip == CHIPS[chip].name


def test_an_adapter_does_not_compete_with_an_uno(connect: Callable[..., None]) -> None:
    connect(("COM1", FTDI, None, None), ("COM2", CH340, None, None), ("COM3", CP210X, None, None))
    assert choose_port() == "COM2"
    connect(("COM1", FTDI, None, None), ("COM3", CP210X, None, None))
    with pytest.raises(LinkposeError, match="2 boards are connected: COM1"):
        choose_port()


def test_a_device_is_found_again_by_number_socket_or_kind(connect: Callable[..., None]) -> None:
    numbered, plain = UsbIdentity(*UNO, "N1", "1-1"), UsbIdentity(*CH340, None, "1-2")
    connect(("COM5", UNO, "N2", "1-1"), ("COM6", UNO, "N1", "1-4"), ("COM7", CH340, None, "1-2"))
    assert find_again("COM3", numbered) == "COM6"
    assert find_again("COM3", plain) == "COM7"
    connect(("COM7", CH340, None, "1-3"))
    assert find_again("COM3", plain) == "COM7"
    connect(("COM7", CH340, None, "1-3"), ("COM8", CH340, None, "1-4"))
    assert find_again("COM3", plain) is None  # which of the two is it?
    assert find_again("COM3", numbered) is None
    assert find_again("sim://link", None) == "sim://link"


def usb_device(sysfs: Path, name: str, ids: tuple[int, int], port: str | None) -> None:
    interface = sysfs / name / f"{name}:1.0"
    (interface / port if port else interface).mkdir(parents=True)
    (sysfs / name / "idVendor").write_text(f"{ids[0]:04x}\n")
    (sysfs / name / "idProduct").write_text(f"{ids[1]:04x}\n")


def test_a_board_that_brltty_took_is_named_with_its_cure(
    tmp_path: Path, connect: Callable[..., None], monkeypatch: pytest.MonkeyPatch, linkpose: Callable[..., tuple]
) -> None:
    usb_device(tmp_path, "1-1", CH340, None)
    usb_device(tmp_path, "1-2", CH340, "ttyUSB0")
    usb_device(tmp_path, "1-3", UNO, "tty/ttyACM0")
    usb_device(tmp_path, "1-4", OTHER, None)
    (tmp_path / "1-0:1.0").mkdir()  # an interface of the root hub
    [device] = devices_without_port(tmp_path)
    assert device[:3] == (*CH340, "1-1")
    connect()
    monkeypatch.setattr(ports, "devices_without_port", lambda: iter([device]))
    with pytest.raises(LinkposeError, match=r"1a86:7523 \(CH340\) at 1-1 has no serial port.*sudo apt remove brltty"):
        choose_port()
    assert "sudo apt remove brltty" in linkpose("ports")[2]


def test_a_usb_description_does_not_act_on_the_terminal(
    monkeypatch: pytest.MonkeyPatch, linkpose: Callable[..., tuple]
) -> None:
    port = list_ports_common.ListPortInfo("COM3")
    port.description = "UNO\x1b]0;title\x07\x9b2J\u202e\nCOM4"
    monkeypatch.setattr(ports.list_ports, "comports", lambda: [port])
    shown = "".join(linkpose("ports")[1:])
    assert "UNO\\x1b]0;title\\x07\\x9b2J\\u202e COM4" in shown
    assert not set(shown) & set("\x1b\x07\x9b\u202e")


def vanishing(where: str) -> type:
    """A port whose device is gone when this method is called, as pyserial reports it on POSIX."""
    termios = pytest.importorskip("termios")

    def gone(*_: object) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    def read(*_: object) -> bytes:
        cancelled.wait()
        return b""

    cancelled = threading.Event()
    quiet = {name: lambda *_: None for name in ("write", "reset_input_buffer", "close")}
    cancel = {"cancel_read": lambda _: cancelled.set()}
    return type("Vanishing", (), {"in_waiting": 0, "read": read, **cancel, **quiet, where: gone})


@pytest.mark.parametrize(
    ("where", "sentence"), [("__init__", "there is no port"), ("write", "is gone"), ("reset_input_buffer", None)]
)
def test_a_device_that_goes_while_it_is_opened_is_a_sentence(
    monkeypatch: pytest.MonkeyPatch, where: str, sentence: str | None
) -> None:
    """termios.error is no OSError: the recording ended with an unexpected error."""
    port = vanishing(where)
    monkeypatch.setattr(ports, "_is_no_terminal", lambda name: False)
    monkeypatch.setattr(ports.serial, "serial_for_url", lambda *_, **__: port())
    expected = pytest.raises(LinkposeError, match=sentence) if sentence else contextlib.nullcontext()
    with expected, contextlib.closing(Connection("/dev/ttyX")) as connection:
        connection.send(Ping(1))


def test_printable_keeps_text_and_bounds_it() -> None:
    assert printable("Winkel φ in °\n\tσ") == "Winkel φ in °\n\tσ"
    assert printable("x" * 50, 10) == "x" * 9 + "…"
    assert printable("\x00\r\x7f") == "\\x00\\r\\x7f"
