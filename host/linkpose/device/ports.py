"""Serial ports: which there are, which one is the board, and opening one with a sentence for each way it fails."""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import serial
from serial.tools import list_ports

from linkpose.errors import (
    NoBoardFound,
    NotASerialPort,
    PermissionDenied,
    PortBusy,
    PortError,
    PortNotFound,
    SeveralBoardsFound,
)
from linkpose.wire.messages import BAUD

# USB ids of the UNO: Arduino's own, and the CH340 that nearly all its copies carry.
UNO_IDS = frozenset(
    {
        (0x2341, 0x0043),
        (0x2341, 0x0001),
        (0x2341, 0x0243),
        (0x2341, 0x006A),
        (0x2A03, 0x0043),
        (0x1A86, 0x7523),
    }
)

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
    is_uno: bool
    busy: bool | None  # None where this system does not tell


def find_ports() -> list[PortInfo]:
    """All serial ports, by name."""
    found = []
    for port in sorted(list_ports.comports(), key=lambda p: p.device):
        is_uno = (port.vid, port.pid) in UNO_IDS
        description = port.description if port.description != "n/a" else ""
        busy = None if _holder_unknowable() else holder(port.device) is not None
        found.append(PortInfo(port.device, description, port.vid, port.pid, port.serial_number, is_uno, busy))
    return found


def choose_port(simulated_will_do: bool = True) -> str:
    """The port that the environment variable LINKPOSE_PORT names, otherwise the only UNO connected.

    Raises NoBoardFound or SeveralBoardsFound, which list the ports.
    """
    if named := os.environ.get("LINKPOSE_PORT"):
        return named
    ports = find_ports()
    unos = [port for port in ports if port.is_uno]
    if len(unos) == 1:
        return unos[0].port
    raise SeveralBoardsFound(unos) if unos else NoBoardFound(ports, simulated_will_do)


def register_scheme(package: str) -> None:
    """Lets `open_port` open URLs of another scheme: `package` holds a module protocol_SCHEME, as pyserial asks."""
    if package not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(package)


def open_port(name: str, baud: int = BAUD) -> serial.Serial:
    """Opens a device, a pyserial URL, or a URL of a registered scheme, at a bit rate.

    Raises PortNotFound, PortBusy, PermissionDenied, NotASerialPort or another PortError.
    """
    options: dict[str, Any] = {"baudrate": baud, "timeout": READ_TIMEOUT_S, "write_timeout": WRITE_TIMEOUT_S}
    if "://" not in name:
        user = holder(name)
        if user:
            raise PortBusy(name, user)
        if os.name == "posix":
            options["exclusive"] = True
    try:
        port = serial.serial_for_url(name, **options)
    except (serial.SerialException, OSError, ValueError) as error:
        raise _why_not(name, error) from error
    return port


def _why_not(name: str, error: Exception) -> PortError:
    """The error that says why a port cannot be opened, from what the system or pyserial raised."""
    code = getattr(error, "errno", None)
    text = str(error).lower()
    if code == errno.ENOENT or "filenotfound" in text or "could not find" in text:
        return PortNotFound(name)
    if code in (errno.EACCES, errno.EPERM) or "permissionerror(13" in text or "access is denied" in text:
        return PortBusy(name) if os.name == "nt" else PermissionDenied(name, _group(name))
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        return PortBusy(name)
    if "no handler" in text or "invalid url" in text:
        return PortError(
            name, f"{name} is no port that can be opened; name a device such as /dev/ttyACM0 or COM3, or sim://link"
        )
    if code in (errno.ENOTTY, errno.ENODEV, errno.EISDIR) or "could not configure" in text:
        return NotASerialPort(name)
    return PortError(name, f"cannot open {name}: {error}")


def _group(name: str) -> str:
    """The group that may use the port: dialout on Debian, uucp on Arch."""
    try:
        return Path(name).group()
    except (OSError, KeyError, NotImplementedError):
        return "dialout"


def _holder_unknowable() -> bool:
    return not Path("/proc/self/fd").is_dir()


def holder(name: str) -> str | None:
    """The program that has the device open, as "name (process id)"; None when none is known to.

    Only Linux tells, and only of the processes that this user may look into. Opening the port to find out would reset
    the board.
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
