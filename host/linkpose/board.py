"""A connected board as a Python program uses it: `linkpose.open`."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Generator, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from linkpose.device import ports
from linkpose.device.session import Health, Session
from linkpose.errors import NoUsableData
from linkpose.sensors.rig import Joint, Rig, as_rig
from linkpose.wire.messages import Configure, Hello

if TYPE_CHECKING:  # NumPy: commands that only talk to the board start without it
    from linkpose.recorder import Recorder
    from linkpose.sensors.measurements import Measurements

_log = logging.getLogger("linkpose")


def open_session(port: str | None, notify: Callable[[str], None], capture: BinaryIO | None = None) -> Session:
    """Connects to the board at `port`: a device, a pyserial URL or `sim://...`; None: the only UNO connected.

    `notify` receives a line for the user when something happens that is not a failure; `capture`, a binary file,
    receives every byte. Raises PortError, NoBoardFound, SeveralBoardsFound, NoFirmware or WrongFirmware.
    """
    ports.register_scheme("linkpose.simulation")
    return Session(port or ports.choose_port(), notify, capture)


class Board:
    """A connection to a board, or to a simulated one. Use it as a context manager, or call `close`.

    Example:
        with linkpose.open("sim://link") as board:
            for block in board.stream(duration_s=10):
                print(block.time_s[-1], block.accel_m_s2[-1])
    """

    def __init__(
        self,
        port: str | None = None,
        *,
        settings: Mapping[str, int] | None = None,
        rig: Rig | str | PathLike[str] | None = None,
        joint: Joint | None = None,
        record: str | PathLike[str] | None = None,
        raw: str | PathLike[str] | None = None,
        force: bool = False,
        notify: Callable[[str], None] | None = None,
    ) -> None:
        """Connects to the board.

        Args:
            port: device, pyserial URL or `sim://link`, `sim://chain`, `sim://mice`; None: the only UNO connected.
            settings: board settings to change, such as {"sample_rate_hz": 200, "accel_range_g": 16}; the message
                CONFIGURE in protocol/README.md lists them.
            rig: sensor placement and calibration, or the path of a rig.toml; a simulated board has its own.
            joint: J2S with its standard deviation (m), as `linkpose.sensors.rig.Joint`; replaces the rig's.
            record: also write a recording (CSV) to this path.
            raw: also write every received byte to this path.
            force: replace existing files.
            notify: receives a line of text when something happens that is not a failure, such as a pulled cable.
                By default the lines go to the logger "linkpose".

        Raises:
            LinkposeError, as one of PortError, NoBoardFound, SeveralBoardsFound, NoFirmware, WrongFirmware, BoardError
                (the board refuses a setting), FileExists, CannotWrite.
        """
        from linkpose.recorder import Recorder, raw_capture

        self._exit = contextlib.ExitStack()
        with self._exit:
            capture = self._exit.enter_context(raw_capture(Path(raw) if raw else None, force))
            session = self._exit.enter_context(open_session(port, notify or _log.warning, capture))
            if settings:
                session.configure(session.settings._replace(**settings))
            self.session = session
            rig = as_rig(rig, session.rig)
            self.rig = replace(rig, joint=joint) if joint else rig
            session.wait_for_mice(len(self.rig.mouse))
            self._recorder: Recorder = Recorder(session, None, self.rig)
            if record:
                self.record(record, force=force)
            self._exit = self._exit.pop_all()

    @property
    def port(self) -> str:
        """The name of the port."""
        return self.session.port

    @property
    def hello(self) -> Hello:
        """What the board reports of itself: versions, sensors, settings."""
        return self.session.hello

    @property
    def settings(self) -> Configure:
        """The settings in force."""
        return self.session.settings

    @property
    def health(self) -> Health:
        """Counts of samples, losses and corrupt frames so far, clock drift, the board's own counters, and the state and
        counts of each sensor."""
        return replace(self.session.health(), sensors=self._recorder.monitor.as_dict())

    def check_usable(self) -> None:
        """Raises NoUsableData when no inertial sensor and no mouse has given usable data."""
        monitor = self._recorder.monitor
        if not monitor.is_usable:
            raise NoUsableData(monitor.why_unusable)

    def record(self, path: str | PathLike[str], *, force: bool = False, plain: bool = False) -> None:
        """Writes what `stream` yields to a recording (CSV) too; `plain`: without comment lines, metadata beside it.
        Raises FileExists (unless `force`) and CannotWrite."""
        from linkpose.recorder import Recorder

        self._recorder = self._exit.enter_context(Recorder(self.session, Path(path), self.rig, force, plain))

    @property
    def recording(self) -> Path | None:
        """The recording, under another name than at the start if another program took the file away; None: none."""
        return self._recorder.path

    @property
    def started_s(self) -> float:
        """The host's time (time.perf_counter, s) of the first sample; 0 before it."""
        return self.session.timeline.start_s

    def mark(self, time_s: float) -> None:
        """Notes an instant: the closing line of the recording, if there is one, lists it under `marks`."""
        self._recorder.marks.append(time_s)

    def stream(
        self, duration_s: float | None = None, *, yield_idle: bool = False
    ) -> Generator[Measurements, None, None]:
        """Blocks of n ≥ 1 measurements as they arrive, for `duration_s` of the board's time (None: until you stop).

        The loop goes on over resets and pulled cables; gaps are marked in `flags`. With `yield_idle`, an empty block
        is yielded several times a second while nothing arrives, so that the caller can do other work.

        Raises LinkposeError when the stream cannot go on or a file can no longer be written.
        """
        for placements in self.session.stream(duration_s):
            block = self._recorder.convert(placements)
            if len(block) or yield_idle:
                yield block
        self.finish("duration")

    def finish(self, ended: str = "interrupted") -> None:
        """Writes the closing line of the recording, if there is one: "duration", "interrupted" or "failure".

        `stream` does so at the end of its duration, and leaving the context in any other case.
        """
        self._recorder.close(ended)

    def close(self) -> None:
        """Stops the stream, closes the files and frees the port."""
        self._exit.close()

    def __enter__(self) -> Board:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None or issubclass(kind, KeyboardInterrupt):
            self.finish()
        self.close()  # after a failure, the recorder marks the recording so
