"""A board at a pseudo terminal that can be pulled, reset, silenced and made to talk nonsense."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from linkpose.simulation.board import SimulatedBoard
from linkpose.simulation.link import LinkRun
from linkpose.wire.messages import Configure


def link_run(settings: Configure) -> LinkRun:
    return LinkRun(
        1,
        0,
        None,
        settings.sample_rate_hz,
        accel_range_g=settings.accel_range_g,
        gyro_range_deg_s=settings.gyro_range_deg_s,
        oversampling=settings.baro_oversampling,
    )


class Board(Protocol):
    """A board by the bytes on its line. Times are microseconds since power-on."""

    def advance(self, now_us: int) -> bytes:
        """What it sends by itself up to `now_us`."""

    def receive(self, data: bytes, now_us: int) -> bytes:
        """Its answers to bytes that arrive at `now_us`."""


def simulated_link() -> Board:
    return SimulatedBoard(link_run)


class PtyBoard:
    """Serves a board at the symlink `path`. `spoil` may change what the board sends; `chatter` is sent all the time."""

    def __init__(
        self,
        path: Path,
        spoil: Callable[[bytes], bytes] = lambda data: data,
        chatter: bytes = b"",
        make: Callable[[], Board] = simulated_link,
    ) -> None:
        self.path, self._make = path, make
        self.spoil = spoil
        self.chatter = chatter
        self.received = threading.Event()  # the host has sent something
        self.streams = threading.Event()  # the board has sent samples
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> PtyBoard:
        self.plug()
        return self

    def __exit__(self, *_: object) -> None:
        self.pull()

    def plug(self, path: Path | None = None) -> None:
        """Switches a fresh board on and puts it at the path, or at another one from now on."""
        self.path = path or self.path
        self.received.clear()
        self._master, self._slave = os.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._unsent = b""
        self._board, self._began = self._make(), time.perf_counter()
        self.path.symlink_to(os.ttyname(self._slave))
        self._stop.clear()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def pull(self) -> None:
        """The cable is pulled: the terminal vanishes, the board loses its power."""
        if self._thread is None:
            return
        self._stop.set()
        self._thread.join()
        self._thread = None
        self.path.unlink()
        os.close(self._slave)
        os.close(self._master)

    def reset(self, says_hello: bool = True) -> None:
        """The board restarts at the same port, and sends HELLO unless that gets lost."""
        from linkpose.simulation import board as simulated
        from linkpose.wire.frames import encode

        self._board, self._began = self._make(), time.perf_counter()
        if says_hello:
            self._send(encode(simulated.hello(simulated.DEFAULTS)))

    def _serve(self) -> None:
        while not self._stop.is_set():
            received = b""
            if select.select([self._master], [], [], 0.004)[0]:
                with contextlib.suppress(OSError):
                    received = os.read(self._master, 4096)
                self.received.set()
            now_us = int((time.perf_counter() - self._began) * 1e6)
            streamed = self._board.advance(now_us)
            sent = streamed + self._board.receive(received, now_us)
            self._send(self.spoil(sent) if sent else b"")
            if streamed:
                self.streams.set()
            self._send(self.chatter)

    def _send(self, data: bytes) -> None:
        """Sends data, or drops them whole while a host that does not read leaves earlier ones unsent."""
        data = self._unsent or data
        with contextlib.suppress(BlockingIOError):
            self._unsent = data[os.write(self._master, data) :] if data else b""
