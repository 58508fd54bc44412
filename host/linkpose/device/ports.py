"""Serial ports: the list of them, the choice of the board's, finding it again, and opening it."""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import serial
from serial.tools import list_ports

from linkpose.errors import (
    LinkposeError,
    NoBoardFound,
    NotASerialPort,
    PermissionDenied,
    PortBusy,
    PortError,
    PortNotFound,
    SeveralBoardsFound,
    WrongAddress,
)
from linkpose.wire.messages import BAUD

# What the system raises where a device goes: termios.error, of pyserial's settings and flushes, is no OSError.
PORT_FAILURES: tuple[type[Exception], ...] = (serial.SerialException, OSError)
if sys.platform != "win32":
    import termios

    PORT_FAILURES += (termios.error,)
_NOT_OPENED: tuple[type[Exception], ...] = (*PORT_FAILURES, ValueError)

_MEMORY_DEVICES = 1  # Linux's major device number of null, zero, full, random


class Chip(NamedTuple):
    """A USB chip of UNOs and their copies."""

    name: str
    likelihood: int  # that an UNO is behind it. 2: Arduino's own; 1: mostly on UNO copies; 0: on many other devices too
    driver: str  # Linux kernel module


_ARDUINO = Chip("16U2", 2, "cdc_acm")
CHIPS = {
    (0x2341, 0x0043): _ARDUINO,
    (0x2341, 0x0001): _ARDUINO,
    (0x2341, 0x0243): _ARDUINO,
    (0x2341, 0x006A): _ARDUINO,
    (0x2A03, 0x0043): _ARDUINO,
    (0x1A86, 0x7523): Chip("CH340", 1, "ch341"),
    (0x1A86, 0x55D4): Chip("CH9102", 1, "cdc_acm"),
    (0x1A86, 0x55D3): Chip("CH343", 1, "cdc_acm"),
    (0x0403, 0x6001): Chip("FT232R", 0, "ftdi_sio"),
    (0x0403, 0x6015): Chip("FT231X", 0, "ftdi_sio"),
    (0x10C4, 0xEA60): Chip("CP210x", 0, "cp210x"),
}

READ_TIMEOUT_S = 0.05
WRITE_TIMEOUT_S = 1.0


@dataclass(frozen=True, slots=True)
class PortInfo:
    """A serial port of this machine."""

    port: str
    description: str
    vid: int | None
    pid: int | None
    serial: str | None
    is_uno: bool  # the USB chip is one that UNOs and their copies carry
    busy: bool | None  # None where the system does not report it
    location: str | None = None  # USB bus and socket
    chip: str | None = None  # name of a known USB chip

    @property
    def likelihood(self) -> int:
        """Of an UNO behind the port, as in `Chip`; -1 for other devices."""
        chip = CHIPS.get((self.vid or 0, self.pid or 0))
        return chip.likelihood if chip else -1


def find_ports() -> list[PortInfo]:
    """All serial ports, by name."""
    found = []
    for port in sorted(list_ports.comports(), key=lambda p: p.device):
        chip = CHIPS.get((port.vid or 0, port.pid or 0))
        description = " ".join(port.description.split()) if port.description != "n/a" else ""
        busy = None if _holder_unknowable() else holder(port.device) is not None
        found.append(
            PortInfo(
                port.device,
                description,
                port.vid,
                port.pid,
                port.serial_number,
                chip is not None,
                busy,
                port.location,
                chip.name if chip else None,
            )
        )
    return found


def choose_port(simulated_will_do: bool = True) -> str:
    """The only UNO that is connected.

    Arduino's own USB chips precede those of copies, and these precede general adapters. The environment variable
    LINKPOSE_PORT names another port. Raises NoBoardFound or SeveralBoardsFound, which list the ports, or PortError for
    a board whose USB device has no port.
    """
    if named := os.environ.get("LINKPOSE_PORT"):
        return named
    ports = find_ports()
    best = max((port.likelihood for port in ports), default=-1)
    unos = [port for port in ports if port.likelihood == best >= 0]
    if len(unos) == 1:
        return unos[0].port
    if unos:
        raise SeveralBoardsFound(unos)
    for device in devices_without_port():
        raise PortError(device.location, device.cure)
    raise NoBoardFound(ports, simulated_will_do)


def register_scheme(package: str) -> None:
    """Lets `open_port` open URLs of another scheme: `package` holds a module protocol_SCHEME, as pyserial requires."""
    if package not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(package)


class PortlessDevice(NamedTuple):
    """A USB device with a known chip for which the system made no serial port."""

    vid: int
    pid: int
    location: str

    @property
    def cure(self) -> str:
        """What happened, and what to type."""
        chip = CHIPS[self.vid, self.pid]
        return (
            f"the USB device {self.vid:04x}:{self.pid:04x} ({chip.name}) at {self.location} has no serial port. On "
            "Ubuntu the braille program brltty takes it: type `sudo apt remove brltty`, unplug the board and plug it "
            f"in again. Without brltty, type `sudo modprobe {chip.driver}`"
        )


def devices_without_port(sysfs: Path = Path("/sys/bus/usb/devices")) -> Iterator[PortlessDevice]:
    """USB devices with a known chip but no serial port. Only Linux reports them."""
    for device in sorted(sysfs.glob("*")):
        try:
            vid, pid = (int((device / name).read_text(), 16) for name in ("idVendor", "idProduct"))
        except (OSError, ValueError):
            continue  # an interface or a hub's port
        has_port = any(device.glob("*:*/tty[A-Z]*")) or any(device.glob("*:*/tty/tty*"))
        if (vid, pid) in CHIPS and not has_port:
            yield PortlessDevice(vid, pid, device.name)


class UsbIdentity(NamedTuple):
    """What stays the same when a device returns under another port name."""

    vid: int
    pid: int
    serial: str | None
    location: str | None


def usb_identity(name: str) -> UsbIdentity | None:
    """The USB device behind a port; None for other ports."""
    device = os.path.realpath(name)
    for port in list_ports.comports():
        if device in (port.device, os.path.realpath(port.device)) and port.vid is not None and port.pid is not None:
            return UsbIdentity(port.vid, port.pid, port.serial_number, port.location)
    return None


def find_again(name: str, identity: UsbIdentity | None) -> str | None:
    """The present name of the port that was called `name`; None while its device is absent.

    A device with a USB serial number is found by it. One without (CH340) is found in its USB socket, or as the only
    device of its kind.
    """
    if identity is None:
        return name
    alike = [port for port in list_ports.comports() if (port.vid, port.pid) == identity[:2]]
    if identity.serial:
        same = [port.device for port in alike if port.serial_number == identity.serial]
    else:
        same = [port.device for port in alike if port.location and port.location == identity.location]
        same = same or [port.device for port in alike if len(alike) == 1]
    if any(os.path.realpath(name) == os.path.realpath(device) for device in same):
        return name
    return same[0] if same else None


def is_network(name: str) -> bool:
    """Whether a serial server is behind the name: nothing locks its port, and another program may take it away."""
    return name.lower().startswith(("socket://", "rfc2217://"))


def counts_waiting_bytes(port: serial.SerialBase) -> bool:
    """Whether `port.in_waiting` is the number of bytes that have arrived; for pyserial's sockets it is 1 at most."""
    return type(port).__module__ != "serial.urlhandler.protocol_socket"


def open_port(name: str, baud: int = BAUD) -> serial.Serial:
    """Opens a device, a pyserial URL, or a URL of a registered scheme, at a bit rate.

    Raises PortNotFound, PortBusy, PermissionDenied, NotASerialPort or another PortError.
    """
    options: dict[str, Any] = {"baudrate": baud, "timeout": READ_TIMEOUT_S, "write_timeout": WRITE_TIMEOUT_S}
    if "://" not in name:
        if _is_no_terminal(name):
            raise NotASerialPort(name)
        user = holder(name)
        if user:
            raise PortBusy(name, user)
        if os.name == "posix":
            options["exclusive"] = True
    elif is_network(name) and not _is_address(name):
        raise WrongAddress(name, f"{name} is no address of a serial server; type socket://HOST:PORT")
    try:
        port = serial.serial_for_url(name, **options)
    except _NOT_OPENED as error:
        raise _why_not(name, error) from error
    return port


def _is_address(url: str) -> bool:
    """Whether a URL has a host and the number of a TCP port."""
    try:
        parts = urlsplit(url)
        return bool(parts.hostname and parts.port)
    except ValueError:  # a number above 65535, a bracket too many
        return False


def _is_no_terminal(name: str) -> bool:
    """Whether the name belongs to a file, a folder, or one of Linux's memory devices such as /dev/null."""
    try:
        status = Path(name).stat()
    except OSError:  # no such file, or a name such as COM3
        return False
    is_memory = sys.platform == "linux" and os.major(status.st_rdev) == _MEMORY_DEVICES
    return not stat.S_ISCHR(status.st_mode) or is_memory


def _why_not(name: str, error: Exception) -> PortError:
    """The PortError for an exception that the system or pyserial raised while opening a port."""
    code = getattr(error, "errno", None) or next((part for part in error.args if isinstance(part, int)), None)
    text = str(error).lower()
    if code in (errno.ENOENT, errno.ENXIO, errno.EIO) or "filenotfound" in text or "could not find" in text:
        return PortNotFound(name)
    if code in (errno.EACCES, errno.EPERM) or "permissionerror(13" in text or "access is denied" in text:
        return PortBusy(name) if os.name == "nt" else PermissionDenied(name, _group(name))
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        return PortBusy(name)
    if "no handler" in text or "invalid url" in text:
        return WrongAddress(name, f"{name} is not a port; name a device such as /dev/ttyACM0 or COM3, or sim://link")
    if code in (errno.ENOTTY, errno.ENODEV, errno.EISDIR) or "could not configure" in text:
        return NotASerialPort(name)
    if isinstance(error.__cause__, LinkposeError):  # of a simulated board
        return WrongAddress(name, f"cannot open {name}: {error}")
    reason = getattr(error.__context__, "strerror", None) or error  # pyserial's own text names the port twice
    return PortError(name, f"cannot open {name}: {reason}")


def _group(name: str) -> str:
    """The group whose members may open the port: dialout on Debian, uucp on Arch."""
    try:
        return Path(name).group()
    except (OSError, KeyError, NotImplementedError):
        return "dialout"


def _holder_unknowable() -> bool:
    return not Path("/proc/self/fd").is_dir()


def holder(name: str) -> str | None:
    """The program that has the device open, as "name (process id)"; None if it cannot be determined.

    Only Linux reports it, and only for processes that this user may inspect. Opening the port instead would reset the
    board.
    """
    if _holder_unknowable():
        return None
    device = os.path.realpath(name)
    if device.startswith("/dev/pts/"):  # a pseudo terminal is always held, by the program at its other end
        return None
    for process in Path("/proc").glob("[0-9]*"):
        if process.name == str(os.getpid()):
            continue
        try:
            if any(entry.readlink() == Path(device) for entry in (process / "fd").iterdir()):
                return f"{(process / 'comm').read_text().strip()} (process {process.name})"
        except OSError:
            continue
    return None
