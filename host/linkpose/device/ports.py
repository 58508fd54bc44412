"""Serial ports: which there are, which one is the board, and opening one with a sentence for each way it fails."""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import serial
from serial.tools import list_ports

from linkpose.errors import LinkposeError
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

    Raises LinkposeError, which lists the ports, when no UNO or several are connected.
    """
    if named := os.environ.get("LINKPOSE_PORT"):
        return named
    ports = find_ports()
    unos = [port for port in ports if port.is_uno]
    if len(unos) == 1:
        return unos[0].port
    listed = ", ".join(f"{p.port} ({p.description or 'no description'})" for p in (unos or ports))
    if unos:
        raise LinkposeError(f"{len(unos)} boards are connected: {listed}; choose one with --port")
    if ports:
        raise LinkposeError(f"no UNO is connected; the ports there are: {listed}; connect it or choose with --port")
    hint = ", or try --port sim://link" if simulated_will_do else ""
    raise LinkposeError(f"no serial port is connected; plug the board in{hint}")


def open_port(name: str, baud: int = BAUD) -> serial.Serial:
    """Open a device, a pyserial URL or a simulated board (`sim://...`) at a bit rate.

    Raises LinkposeError with a sentence of its own for a port that is absent, busy or forbidden, and for a file that is
    not a port.
    """
    if "linkpose.simulation" not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append("linkpose.simulation")
    options: dict[str, Any] = {"baudrate": baud, "timeout": READ_TIMEOUT_S, "write_timeout": WRITE_TIMEOUT_S}
    if "://" not in name:
        user = holder(name)
        if user:
            raise LinkposeError(f"{name} is in use by {user}; close it and try again")
        if os.name == "posix":
            options["exclusive"] = True
    try:
        port = serial.serial_for_url(name, **options)
    except (serial.SerialException, OSError, ValueError) as error:
        raise LinkposeError(_why_not(name, error)) from error
    return port


def _why_not(name: str, error: Exception) -> str:
    code = getattr(error, "errno", None)
    text = str(error).lower()
    if code == errno.ENOENT or "filenotfound" in text or "could not find" in text:
        return f"there is no port {name}; `linkpose ports` lists those there are"
    if code in (errno.EACCES, errno.EPERM) or "permissionerror(13" in text or "access is denied" in text:
        if os.name == "nt":
            return f"{name} is in use by another program; close it and try again"
        join = f"sudo usermod -aG {_group(name)} $USER"
        return f"no permission to open {name}; join the group that owns it with `{join}` and log in again"
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        return f"{name} is in use by another program; close it and try again"
    if "no handler" in text or "invalid url" in text:
        return f"{name} is no port that can be opened; name a device such as /dev/ttyACM0 or COM3, or sim://link"
    if code in (errno.ENOTTY, errno.ENODEV, errno.EISDIR) or "could not configure" in text:
        return f"{name} is not a serial port; `linkpose ports` lists those there are"
    return f"cannot open {name}: {error}"


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
