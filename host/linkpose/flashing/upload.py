"""Uploading through the UNO's bootloader, and the state of the board when the upload fails."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum

from linkpose.device.ports import PORT_FAILURES, open_port
from linkpose.errors import LinkposeError
from linkpose.flashing.image import APPLICATION_BYTES, Image
from linkpose.flashing.stk500 import PAGE_BYTES, SIGNATURE, Bootloader, NoAnswer, SerialPort

# Bit rate of a bootloader -> bytes of flash in front of it. Optiboot (UNO, Nano since 2018) occupies the last 512
# bytes, ATmegaBOOT (Nano before 2018) the last 2 KiB.
BOOTLOADERS = {115_200: APPLICATION_BYTES, 57_600: 0x7800}
ROUNDS = 2  # over the bit rates, the later one with more patience: 5.4 s until a silent board is reported
ATTEMPTS = 2  # at the whole upload: a computer that stalls for a second makes a bootloader give up

AGAIN = "run `linkpose flash` again"
INCOMPLETE = "The bootloader is intact but the firmware is incomplete"


class Stage(Enum):
    """Stages of an upload."""

    CONNECTING = "connecting"
    WRITING = "writing"
    VERIFYING = "verifying"


@dataclass(slots=True)
class Progress:
    """How far an upload has come."""

    stage: Stage = Stage.CONNECTING
    percent: int = 0  # of the stage


Report = Callable[[Progress], None]
OpenPort = Callable[[str, int], SerialPort]


def upload(image: Image, port: str, report: Report, open_port: OpenPort = open_port) -> None:
    """Write an image through the bootloader and verify it by reading it back.

    `report` receives the progress page by page. `open_port` opens a port by name and bit rate, and resets the board if
    the port has no DTR line. Raises LinkposeError with the state of the board.
    """
    for attempt in range(1, ATTEMPTS + 1):
        progress = Progress()
        try:
            with _connected(port, open_port) as (loader, baud):
                _check_board(loader, image, port, baud)
                _transfer(loader, image, progress, report)
            return
        except NoAnswer as error:
            if attempt == ATTEMPTS:
                raise LinkposeError(_why_broken_off(progress, f"The board at {port} stopped answering")) from error
        except PORT_FAILURES as error:
            raise LinkposeError(_why_broken_off(progress, f"{port} disappeared")) from error
        except KeyboardInterrupt:
            raise LinkposeError(_why_broken_off(progress, "The upload was interrupted")) from None


@contextlib.contextmanager
def _connected(name: str, open_port: OpenPort) -> Iterator[tuple[Bootloader, int]]:
    """The bootloader and its bit rate. Raises LinkposeError when none answers."""
    for patience, baud in itertools.product(range(1, ROUNDS + 1), BOOTLOADERS):
        port = open_port(name, baud)
        try:
            loader = Bootloader(port)
            if loader.connect(patience):
                yield loader, baud
                return
        finally:
            with contextlib.suppress(*PORT_FAILURES):
                port.close()
    raise LinkposeError(
        f"No UNO bootloader answers at {name}; nothing was written. It is another board or another port, or the board "
        "has no bootloader. See `linkpose ports` and pass the UNO's port with --port"
    )


def _check_board(loader: Bootloader, image: Image, port: str, baud: int) -> None:
    """Raise LinkposeError unless the processor is an ATmega328P and the image fits in front of the bootloader."""
    signature = loader.signature()
    if signature != SIGNATURE:
        raise LinkposeError(
            f"The board at {port} is no UNO: its processor has the signature 0x{signature.hex().upper()}, an "
            f"ATmega328P has 0x{SIGNATURE.hex().upper()}. Nothing was written. Pass the UNO's port with --port"
        )
    if len(image.data) > BOOTLOADERS[baud]:
        raise LinkposeError(
            f"{image.path} has {len(image.data)} bytes, and the board at {port} has {BOOTLOADERS[baud]} bytes in front "
            "of its bootloader. Nothing was written. Use a smaller firmware, or a board with Optiboot"
        )


def _transfer(loader: Bootloader, image: Image, progress: Progress, report: Report) -> None:
    """Write all pages, then compare all pages. Raises LinkposeError at the first difference."""
    addresses = range(0, len(image.data), PAGE_BYTES)
    progress.stage = Stage.WRITING
    for number, address in enumerate(addresses):
        progress.percent = 100 * number // len(addresses)
        report(progress)
        loader.write_page(address, image.data[address : address + PAGE_BYTES].ljust(PAGE_BYTES, b"\xff"))
    progress.stage = Stage.VERIFYING
    for number, address in enumerate(addresses):
        progress.percent = 100 * number // len(addresses)
        report(progress)
        expected = image.data[address : address + PAGE_BYTES]
        _compare(address, expected, loader.read_page(address))
    loader.leave()


def _compare(address: int, expected: bytes, found: bytes) -> None:
    for at, (written, read) in enumerate(zip(expected, found, strict=False), address):
        if written != read:
            raise LinkposeError(
                f"Verification failed: address {at:#06x} contains {read:#04x}, and {written:#04x} was written. The "
                f"bootloader is intact but the firmware is wrong. First {AGAIN}; if it fails again, replace the board"
            )


def _why_broken_off(progress: Progress, cause: str) -> str:
    if progress.stage is Stage.CONNECTING:
        return f"{cause} before anything was written. Check the cable and {AGAIN}"
    where = f"{cause} at {progress.percent} % of {progress.stage.value}"
    return f"{where}. {INCOMPLETE}. Check the cable and {AGAIN}"
