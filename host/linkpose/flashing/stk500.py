"""STK500 version 1 over a serial port: the protocol of the UNO's bootloaders.

Source: Atmel, AVR061, "STK500 Communication Protocol", 2003. Optiboot and ATmegaBOOT implement a subset of it.
All waiting is reading with a timeout, so that the port alone keeps the time.
"""

from __future__ import annotations

import contextlib
from typing import Protocol

import serial

PAGE_BYTES = 128  # a page of the ATmega328P's flash (data sheet, table 28-12)
SIGNATURE = bytes([0x1E, 0x95, 0x0F])  # of the ATmega328P (data sheet, section 28.3)

RESET_PULSE_S = (
    0.05  # with DTR and RTS released, so that the capacitor at the reset pin recharges (100 nF, 10 kΩ: 1 ms)
)
START_UP_S = 0.1  # the fuses hold the processor for 65 ms after a reset
# Optiboot blinks for 0.4 s before it reads, and gives up 1 s after that. Its UART holds two bytes meanwhile, so that
# GET_SYNC is sent once for each reset: of a second one it would receive a part and start the firmware. Half of this
# value makes the UNO's own Optiboot unreachable; doubling it doubles the time until a silent board is reported.
SYNC_TIMEOUT_S = 0.8
ANSWER_TIMEOUT_S = 2.0  # a page takes 30 ms; the rest is for a computer that is busy

_INSYNC, _OK, _END_OF_COMMAND = 0x14, 0x10, 0x20
_GET_SYNC, _READ_SIGNATURE, _LEAVE = b"0", b"u", b"Q"
_LOAD_ADDRESS, _PROGRAM_PAGE, _READ_PAGE = b"U", b"d", b"t"
_FLASH = b"F"


class SerialPort(Protocol):
    """The part of `serial.Serial` that the protocol uses."""

    timeout: float | None

    def read(self, size: int = 1, /) -> bytes: ...

    def write(self, data: bytes, /) -> int | None: ...

    def close(self) -> None: ...


class NoAnswer(Exception):
    """The bootloader does not answer, or answers something else than the protocol requires."""


class Bootloader:
    """The bootloader behind an open port. Each method raises NoAnswer, and OSError when the port disappears."""

    def __init__(self, port: SerialPort) -> None:
        self._port = port

    def connect(self, patience: int) -> bool:
        """Reset the board and wait `patience` times SYNC_TIMEOUT_S for the bootloader; False when none answers."""
        self._reset()
        self._port.timeout = patience * SYNC_TIMEOUT_S
        self._port.write(_GET_SYNC + bytes([_END_OF_COMMAND]))
        answers = self._is_in_sync()
        self._port.timeout = ANSWER_TIMEOUT_S
        return answers

    def _reset(self) -> None:
        """Pulse DTR and RTS. One of the two is wired to the reset pin through a capacitor.

        A pseudo terminal has neither; opening it resets an emulated board.
        """
        self._set_lines(False)
        self._pause(RESET_PULSE_S)
        self._set_lines(True)
        self._pause(START_UP_S)

    def _set_lines(self, asserted: bool) -> None:
        for line in ("dtr", "rts"):
            with contextlib.suppress(OSError):  # serial.SerialException is an OSError
                setattr(self._port, line, asserted)

    def _pause(self, seconds: float) -> None:
        """Discard what arrives for a time: the firmware's output from before the reset."""
        self._port.timeout = seconds
        self._port.read(1 << 16)

    def _is_in_sync(self) -> bool:
        """Read up to the answer to GET_SYNC; False when it does not come in time."""
        before = b""
        while byte := self._port.read(1):
            if before + byte == bytes([_INSYNC, _OK]):
                return True
            before = byte
        return False

    def signature(self) -> bytes:
        """Return the processor's signature, three bytes."""
        return self._command(_READ_SIGNATURE, 3)

    def write_page(self, address: int, data: bytes) -> None:
        """Write a page at a byte address that is a multiple of PAGE_BYTES."""
        self._load_address(address)
        self._command(_PROGRAM_PAGE + len(data).to_bytes(2, "big") + _FLASH + data, 0)

    def read_page(self, address: int) -> bytes:
        """Read PAGE_BYTES from a byte address."""
        self._load_address(address)
        return self._command(_READ_PAGE + PAGE_BYTES.to_bytes(2, "big") + _FLASH, PAGE_BYTES)

    def leave(self) -> None:
        """Start the firmware. ATmegaBOOT starts it later, by its own timeout."""
        with contextlib.suppress(NoAnswer, serial.SerialException, OSError):
            self._command(_LEAVE, 0)

    def _load_address(self, address: int) -> None:
        self._command(_LOAD_ADDRESS + (address // 2).to_bytes(2, "little"), 0)  # in words

    def _command(self, command: bytes, answer_bytes: int) -> bytes:
        self._port.write(command + bytes([_END_OF_COMMAND]))
        answer = self._port.read(answer_bytes + 2)
        if len(answer) != answer_bytes + 2 or (answer[0], answer[-1]) != (_INSYNC, _OK):
            raise NoAnswer
        return answer[1:-1]
