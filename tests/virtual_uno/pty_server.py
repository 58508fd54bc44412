"""The emulated board behind a pseudo-terminal: what a host program opens in place of /dev/ttyACM0."""

from __future__ import annotations

import errno
import fcntl
import os
import queue
import select
import struct
import threading
import time
import tty
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from virtual_uno import CLOCK_HZ, Faults, VirtualUno

_TCGETS2 = 0x802C542A  # Linux: terminal settings with any bit rate
_TERMIOS2 = struct.Struct("<4I20x2I")
_SLICE_S = 0.002
_FLAT_OUT_SLICE_S = 0.01
_LONGEST_RUN_S = 0.05  # so that commands and bytes from the host get through when the emulation lags


_LONGEST_STEP_S = 0.01


class PatientClock:
    """The wall clock without the time that the machine kept from this process: a step at most from look to look.

    A machine that is suspended, or busy with something else, makes the board slow with it. By the wall clock, the board
    would send all at once afterwards, faster than a host can read. For hosts that go by the board's time.
    """

    def __init__(self) -> None:
        self._time_s, self._looked_s = 0.0, time.monotonic()

    def __call__(self) -> float:
        now_s = time.monotonic()
        self._time_s += min(now_s - self._looked_s, _LONGEST_STEP_S)
        self._looked_s = now_s
        return self._time_s


@dataclass
class PtyStatistics:
    """How the serving went."""

    epoch_monotonic_s: float = 0.0  # time.monotonic() at the board's cycle 0, when paced
    board_s: float = 0.0
    wall_s: float = 0.0
    max_late_s: float = 0.0  # bytes reached the host at most so long after the board had sent them
    opens: int = 0
    bytes_to_host: int = 0
    bytes_to_board: int = 0
    bytes_dropped: int = 0  # nobody had the port open, or did not read it


class PtyServer:
    """Serves one board at a symbolic link; everything happens inside `run` or in the thread of `start`.

    A host that opens the port resets the board, as DTR does on an UNO (opens are seen every 2 ms). The host's bit rate
    is what it has set on its side: another one than the board's gives garbage, as on a wire.
    """

    def __init__(
        self, uno: VirtualUno, link: Path, *, paced: bool = True, clock_ppm: float = 0.0, reset_on_open: bool = True,
        on_slice: Callable[[], None] | None = None, on_open: Callable[[], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        """`paced`: by the wall clock, never early; otherwise as fast as the host reads. `clock_ppm`: how much faster
        than the wall clock the board's own runs (an UNO's resonator: up to 5000 either way). `on_slice` is called
        before every piece of emulated time, `on_open` when a host has opened the port (after the reset). `clock` (s)
        takes the place of the wall clock."""
        self.uno, self.link = uno, link
        self.statistics = PtyStatistics()
        self.to_host = self.to_board = Faults()
        self.waits_for_host = not paced  # rather than losing what the host does not read in time
        self._paced, self._reset_on_open = paced, reset_on_open
        self._clock_rate = 1 + clock_ppm * 1e-6  # seconds of the board a second
        self._on_slice, self._on_open = on_slice, on_open
        self._clock = clock
        self._actions: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure: BaseException | None = None
        self._master: int | None = None
        self._opened = False
        self._baud: int | None = None
        self.put_cable_back()

    # --- the cable ---

    def pull_cable(self) -> None:
        """The port vanishes under whoever has it open. The board goes on (it has its own supply)."""
        if self._master is not None:
            self.link.unlink(missing_ok=True)
            os.close(self._master)
            self._master = None

    def put_cable_back(self, link: Path | None = None) -> None:
        """The port is there again, at the same link or at another one from now on."""
        if self._master is not None:
            return
        self.link = link or self.link
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(slave))
        os.close(slave)  # from now on the master sees whether somebody has the port open
        self._opened = False

    # --- serving ---

    def start(self) -> PtyServer:
        """Serves in a thread until `stop`."""
        self._thread = threading.Thread(target=self._run_thread, daemon=True)
        self._thread.start()
        return self

    def end(self) -> None:
        """Has `run` return after its present slice."""
        self._stop.set()

    def stop(self) -> PtyStatistics:
        """Ends the thread and takes the port away. Raises what went wrong in the thread."""
        self.end()
        if self._thread is not None:
            self._thread.join()
        self.pull_cable()
        if self._failure is not None:
            raise self._failure
        return self.statistics

    @property
    def host_present(self) -> bool:
        """Whether a host has the port open."""
        return self._opened

    def __enter__(self) -> PtyServer:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def call(self, action: Callable[[], None]) -> None:
        """Has the serving thread do something with the board or the cable before its next slice of time."""
        self._actions.put(action)

    def _run_thread(self) -> None:
        try:
            self.run(None)
        except BaseException as error:  # handed to whoever calls stop()
            self._failure = error

    def run(self, duration_s: float | None) -> PtyStatistics:
        """Serves for a duration of the board's time (None: until `end` or `stop`)."""
        begin_wall, begin_board = self._clock(), self.uno.time_s
        self.statistics.epoch_monotonic_s = begin_wall - begin_board
        while not self._stop.is_set() and (duration_s is None or self.uno.time_s - begin_board < duration_s):
            while not self._actions.empty():
                self._actions.get()()
            if self._on_slice is not None:
                self._on_slice()
            self._meet_host()
            self._advance(begin_wall, begin_board)
            self._exchange()
            self.statistics.board_s = self.uno.time_s - begin_board
            self.statistics.wall_s = self._clock() - begin_wall
            if self._paced:
                late = self.statistics.wall_s - self.statistics.board_s / self._clock_rate
                self.statistics.max_late_s = max(self.statistics.max_late_s, late)
                time.sleep(max(0.0, _SLICE_S - late))
        return self.statistics

    def _advance(self, begin_wall: float, begin_board: float) -> None:
        """Runs the board up to the wall clock, so that no byte reaches the host before its time.

        Flat out, time stands still while nobody has the port open.
        """
        ahead = _FLAT_OUT_SLICE_S
        if not self._paced and not self._opened:
            time.sleep(_SLICE_S)
            return
        if self._paced:
            ahead = (self._clock() - begin_wall) * self._clock_rate - (self.uno.time_s - begin_board)
        if ahead > 0:
            self.uno.run_cycles(round(min(ahead, _LONGEST_RUN_S) * CLOCK_HZ))

    def _meet_host(self) -> None:
        """Notices a host that opened or closed the port, or set another bit rate."""
        if self._master is None:
            return
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        hung_up = any(events & select.POLLHUP for _, events in poll.poll(0))
        if hung_up == self._opened:
            self._opened = not hung_up
            if self._opened:
                self.statistics.opens += 1
                if self._reset_on_open:
                    self.uno.reset()
                if self._on_open is not None:
                    self._on_open()
        baud = self._host_baud() if self._opened else None
        if baud != self._baud:
            self._baud = baud
            self.apply_line()

    def apply_line(self) -> None:
        """Puts `to_host` and `to_board` into force."""
        self.uno.set_line(baud=self._baud, to_host=self.to_host, to_board=self.to_board)

    def _host_baud(self) -> int | None:
        assert self._master is not None
        try:
            settings = fcntl.ioctl(self._master, _TCGETS2, bytes(_TERMIOS2.size))
        except OSError:  # another system than Linux: the host's rate is not known
            return None
        speed: int = _TERMIOS2.unpack(settings)[-1]
        return speed or None

    def _exchange(self) -> None:
        data = self.uno.take_received()
        if self._master is None or not self._opened:
            self.statistics.bytes_dropped += len(data)
            return
        self._write(data)
        try:
            sent = os.read(self._master, 4096)
        except BlockingIOError:
            return
        except OSError as error:
            if error.errno != errno.EIO:  # EIO: the host has just closed the port
                raise
            return
        self.statistics.bytes_to_board += len(sent)
        self.uno.send(sent)

    def _write(self, data: bytes) -> None:
        """To the host; a board in real time cannot wait for a host that does not read, and what has no room is lost."""
        assert self._master is not None
        while data:
            try:
                count = os.write(self._master, data)
            except BlockingIOError:
                if not self.waits_for_host or self._stop.is_set():
                    self.statistics.bytes_dropped += len(data)
                    return
                select.select([], [self._master], [], 0.1)
                continue
            self.statistics.bytes_to_host += count
            data = data[count:]
