"""A serial port whose time is the emulated board's: what a host does on it does not depend on the machine's speed."""

from __future__ import annotations

from collections.abc import Callable

import serial

from virtual_uno import CLOCK_HZ, VirtualUno

_STEP_S = 0.001


class EmulatedPort:
    """The part of `serial.Serial` that the uploader uses, wired to an emulated board.

    The board runs while the host reads. `on_step` is called before each step of emulated time. A board that is
    `unplugged` raises what pyserial raises.
    """

    def __init__(self, uno: VirtualUno, baud: int, on_step: Callable[[EmulatedPort], None] | None = None) -> None:
        self._uno = uno
        self._on_step = on_step
        self._received = bytearray()
        self._dtr = False
        self.timeout: float | None = None
        self.unplugged = False
        uno.set_line(baud=baud)
        self.dtr = True

    @property
    def dtr(self) -> bool:
        return self._dtr

    @dtr.setter
    def dtr(self, asserted: bool) -> None:
        """The falling edge of DTR resets the board, through a capacitor."""
        self._check()
        if asserted and not self._dtr:
            self._uno.reset()
        self._dtr = asserted

    def _check(self) -> None:
        if self.unplugged:
            raise serial.SerialException("device disconnected")

    def write(self, data: bytes) -> int:
        self._check()
        self._uno.send(data)
        return len(data)

    def read(self, size: int = 1) -> bytes:
        assert self.timeout is not None
        deadline = self._uno.cycle + self.timeout * CLOCK_HZ
        while len(self._received) < size and self._uno.cycle < deadline:
            if self._on_step is not None:
                self._on_step(self)
            self._check()
            self._uno.run_ms(1e3 * _STEP_S)
            self._received += self._uno.take_received()
        data = bytes(self._received[:size])
        del self._received[:size]
        return data

    def close(self) -> None:
        self._received.clear()
