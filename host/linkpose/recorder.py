"""Recording a session: samples become rows in SI units, rows go to the disk, and the end loses nothing."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from linkpose.device.session import Placement, Session
from linkpose.errors import FileChanged, InvalidValue, LinkposeError
from linkpose.outputs import check_unchanged, create
from linkpose.recording.writer import RecordingWriter, closing, layout_of, metadata
from linkpose.sensors.conversion import BoardSettings, Converter
from linkpose.sensors.devices import MOUSE_VALID, slow_mouse_remarks
from linkpose.sensors.health import HealthMonitor, expected_sensors
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig


class Recorder:
    """Converts a session's samples to measurements, and writes them to a recording if one is requested.

    A context manager: leaving it without `close` marks the recording as ended by a failure.
    """

    def __init__(self, session: Session, path: Path | None, rig: Rig, force: bool = False, plain: bool = False) -> None:
        """`path` None: convert only; `plain`: metadata beside the file.

        Raises FileExists (unless `force`) and CannotWrite.
        """
        if path is not None and path.suffix == ".bin":
            raise InvalidValue(str(path), "is not a name for a recording, which is a CSV file: .bin is a raw capture")
        self._session = session
        settings = BoardSettings.of(session.hello)
        mouse_ports = max(settings.mouse_ports, len(rig.mouse))
        self._converter = Converter(settings, mouse_ports)
        self.monitor = HealthMonitor(settings.sample_rate_hz, expected_sensors(session.hello, mouse_ports))
        self.marks: list[float] = []  # instants (s) that the user marked; they go into the closing line
        self._counts_per_m = [mouse.counts_per_m for mouse in rig.mouse]
        self._limits_reported = False
        self._path = path
        self._writer: RecordingWriter | None = None
        if path is not None:
            clock = {"source": "host", "drift_ppm": session.health().drift_ppm}
            head = metadata(session.hello, settings, session.port, rig, clock)
            self._writer = RecordingWriter(path, head, layout_of(settings, mouse_ports), force, plain)

    def convert(self, placements: list[Placement]) -> Measurements:
        """The samples as a block of measurements, with NaN for invalid readings.

        The recording keeps all readings as they came. Its rows are with the operating system when this returns.
        """
        block = self._converter.convert_placed([p.sample for p in placements], [p.place for p in placements])
        if self._writer is not None and placements:
            self._write(self._writer, partial(self._writer.write_block, block))
        checked, changes = self.monitor.check(block.measurements)
        for change in changes:
            self._session.notify(str(change))
        self._count_late_mice(placements)
        self._report_speed_limits()
        return checked

    @property
    def path(self) -> Path | None:
        """The recording, which has another name than at the start if another program took it away or renamed it."""
        return self._path

    def _write(self, writer: RecordingWriter, write: Callable[[], None]) -> None:
        """Writes, into a new file if another program removed or changed the recording."""
        try:
            write()
        except FileChanged as change:
            writer.continue_elsewhere()
            self._path = writer.path
            self._session.notify(f"{change}; the recording goes on in {writer.path}")
            write()

    def _report_speed_limits(self) -> None:
        """Once the board has measured its polls, report mice that the rig's calibration shows to overflow early."""
        status = self._session.status
        if status is None or self._limits_reported:
            return
        self._limits_reported = True
        poll_s = max((mouse.poll_us * 1e-6 for mouse in status.mice), default=0.0)
        for remark in slow_mouse_remarks(self._counts_per_m, self._session.hello.sample_rate_hz, poll_s):
            self._session.notify(remark)

    def _count_late_mice(self, placements: list[Placement]) -> None:
        """Count and report the readings of mice for which the recording has no columns."""
        first = self._converter.mouse_ports
        for port in range(first, max((len(p.sample.mice) // 2 for p in placements), default=0)):
            samples = sum(p.place.flags & MOUSE_VALID[port] != 0 for p in placements)
            if samples and self.monitor.leave_out(f"mouse{port + 1}", samples):
                time_s = next(p.place.time_s for p in placements if p.place.flags & MOUSE_VALID[port])
                self._session.notify(
                    f"{time_s:.2f} s: a mouse was found at port {port + 1}, which had none at the start; its movement "
                    "is left out. Connect all mice before the start, or add a [[mouse]] for each to the rig file"
                )

    def close(self, ended: str) -> None:
        """Writes the closing line; `ended` is "duration", "interrupted" or "failure"."""
        writer, self._writer = self._writer, None
        if writer is not None:
            health = self._session.health()
            status = health.status
            board = {"frames_dropped": status.frames_dropped, "ticks_missed": status.ticks_missed} if status else None
            timeline = self._session.timeline
            with writer:
                more: dict[str, Any] = {"board": board, "sensors": self.monitor.as_dict(), "ended": ended}
                if self.marks:
                    more["marks"] = [round(time_s, 6) for time_s in sorted(self.marks)]
                end = closing(timeline, health.corrupt, health.drift_ppm, **more)
                self._write(writer, partial(writer.close, end))
                self._path = writer.path

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(LinkposeError):  # the failure that led here is on its way to the user
            self.close("failure")


class _RawCapture(io.FileIO):
    """An unbuffered file. Raises FileChanged when another program removes or changes it."""

    def __init__(self, descriptor: int, path: Path) -> None:
        super().__init__(descriptor, "wb")
        self._path = path

    def write(self, data: Any) -> int:
        check_unchanged(self.fileno(), self._path)
        return super().write(data)


@contextlib.contextmanager
def raw_capture(path: Path | None, force: bool = False) -> Iterator[BinaryIO | None]:
    """A new unbuffered file for every received byte, or None without a path.

    Raises FileExists (unless `force`) and CannotWrite, at the end as well: no write follows the last bytes.
    """
    if path is None:
        yield None
        return
    with _RawCapture(create(path, force), path) as file:
        yield file
        check_unchanged(file.fileno(), path)
