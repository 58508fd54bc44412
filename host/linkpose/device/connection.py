"""An open port: a thread that reads and stamps what arrives, a decoder, and sending."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import BinaryIO

from linkpose.device.ports import PORT_FAILURES, counts_waiting_bytes, is_network, open_port
from linkpose.errors import LinkposeError
from linkpose.sensors.rig import Rig
from linkpose.wire.frames import OtherProtocol, StreamDecoder, encode
from linkpose.wire.messages import Message

READ_SIZE = 4096


class Disconnected(LinkposeError):
    """The port is gone: the cable was unplugged, or the program behind the port has ended."""

    def __init__(self, port: str, reason: Exception) -> None:
        check = "close other programs that use it, and check the network" if is_network(port) else "check the cable"
        super().__init__(f"{port} is gone ({reason}); {check} and try again")
        self.reason = reason


@dataclass(slots=True)
class Arrival:
    """Messages that arrived together, and when (s, the clock of the connection)."""

    time_s: float
    messages: list[Message | OtherProtocol]
    data: bytes = field(repr=False)


class Connection:
    """A port read continuously by a thread, so that no data are lost while the program is busy.

    The clock is `time.perf_counter` (`time.monotonic` steps by 15.6 ms on Windows before Python 3.13), or the port's
    own if a simulated port provides one. `capture` receives every byte unchanged.
    """

    def __init__(self, port: str, capture: BinaryIO | None = None) -> None:
        self.decoder = StreamDecoder(from_board=True)
        self._name = port
        self._port = open_port(port)
        self._counts_waiting_bytes = counts_waiting_bytes(self._port)
        self._capture = capture
        self.now: Callable[[], float] = getattr(self._port, "clock", time.perf_counter)
        self.rig: Rig | None = getattr(self._port, "rig", None)
        self._arrived: queue.SimpleQueue[tuple[float, bytes] | Exception] = queue.SimpleQueue()
        self._closing = False
        with contextlib.suppress(*PORT_FAILURES):
            self._port.reset_input_buffer()
        self._thread = threading.Thread(target=self._read, name="linkpose-read", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        port, arrived, now = self._port, self._arrived, self.now
        try:
            while not self._closing:
                data = port.read(1)
                if data:
                    data += self._waiting_bytes()
                    arrived.put((now(), data))
        except Exception as error:  # whatever a driver raises when its device goes, the reader cannot go on
            arrived.put(error)

    def _waiting_bytes(self) -> bytes:
        """What else has arrived. Where the port does not count it, each pair of bytes would take a turn."""
        port = self._port
        if self._counts_waiting_bytes:
            return bytes(port.read(min(port.in_waiting, READ_SIZE)))
        timeout, port.timeout = port.timeout, 0
        data = bytes(port.read(READ_SIZE))
        port.timeout = timeout
        return data

    def send(self, message: Message) -> float:
        """Sends a message and returns the time just before (s). Raises Disconnected."""
        sent = self.now()
        try:
            self._port.write(encode(message))
        except PORT_FAILURES as error:
            raise Disconnected(self._name, error) from error
        return sent

    def receive(self, timeout_s: float) -> Arrival | None:
        """The next arrival; None if there is none within `timeout_s`. Raises Disconnected."""
        try:
            item = self._arrived.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if isinstance(item, Exception):
            self._arrived.put(item)  # a later call raises it again
            raise Disconnected(self._name, item) from item
        time_s, data = item
        if self._capture is not None:
            try:
                self._capture.write(data)
            except OSError as error:
                raise LinkposeError(f"cannot write the raw capture any more: {error.strerror}") from error
        return Arrival(time_s, self.decoder.feed(data), data)

    def close(self) -> None:
        """Closes the port. Errors are ignored because the port may be gone already."""
        self._closing = True
        with contextlib.suppress(Exception):
            self._port.cancel_read()
        self._thread.join(timeout=1.0)
        with contextlib.suppress(Exception):
            self._port.close()
