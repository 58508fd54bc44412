"""A recording as a raw capture, the bytes that the board sent: its samples become measurements."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import FileFormatError
from linkpose.inputs import open_binary
from linkpose.recording.table import Progress
from linkpose.sensors.conversion import (
    COUNT_FIELDS,
    GAP_BEFORE,
    TIME_DECIMALS,
    BoardSettings,
    Converter,
    RawSamples,
)
from linkpose.sensors.devices import impossible
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.rig import Rig
from linkpose.sensors.timeline import OFF_TICKS, WINDOW_TICKS, is_foreign, is_step, off_ticks
from linkpose.wire.frames import OtherProtocol
from linkpose.wire.messages import PROTOCOL_MAJOR, Hello

if TYPE_CHECKING:
    from linkpose.wire.capture import Capture

_T_WRAP = 1 << 32
_SEQ_WRAP = 1 << 16


class CaptureSource:
    """A recording as the bytes that came from the board."""

    closing: dict[str, Any] | None = None
    rig: Rig | None = None

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = open_binary(path)
        self._size = max(1, self._file.seek(0, 2))
        self._restarts: list[int] = []  # samples before each
        self._mouse_ports = self._samples = self._corrupt = self._lost = self._gaps = self._jumps = 0
        self.settings = self._find_settings()
        self.rate_hz = self.stated_rate_hz = float(self.settings.sample_rate_hz)
        self.metadata: dict[str, Any] = {
            "device": str(path),
            "settings": self.settings.as_dict(),
            "devices": [{"family": family} for family in self.settings.imu_families],
        }
        self.listed_sensors: list[str] = []
        others = ["imu2"] * self.settings.has_imu2 + ["baro"] + ["mag"] * self.settings.has_mag
        self.sensors = ["imu", *others, *(f"mouse{port}" for port in range(1, self._mouse_ports + 1))]

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def blocks(self, progress: Progress | None) -> Iterator[Measurements]:
        """All samples in SI units."""
        converter = Converter(self.settings, self._mouse_ports)
        clock = _CaptureClock(self._restarts, self.rate_hz)
        for capture in self._parts(progress):
            if len(capture.samples):
                new, time_s, gap_before = clock.place(capture.samples)
                flags = (capture.samples["flags"][new].astype(np.int64) & ~GAP_BEFORE) | gap_before
                if len(flags):
                    yield converter.convert(_raw_samples(capture, self._mouse_ports, new), time_s, flags)
        self._lost, self._gaps, self._jumps = clock.lost, clock.gaps, clock.jumps

    def remarks(self) -> list[str]:
        """On the capture, after a pass over all blocks."""
        found = [f"{self._path}: times are the board's own, because a raw capture holds no other clock"]
        if self._corrupt:
            found.append(f"{self._path}: {self._corrupt} corrupt frames left out")
        if self._gaps:
            found.append(f"{self._path}: {self._lost} samples lost in {self._gaps} gaps")
        if self._jumps:
            found.append(
                f"{self._path}: the board's clock jumped {self._jumps} times; its count of ticks gives the times there"
            )
        return found

    def _parts(self, progress: Progress | None) -> Iterator[Capture]:
        from linkpose.wire.capture import read_capture

        self._file.seek(0)
        for capture in read_capture(self._file):
            if progress is not None:
                progress(self._file.tell() / self._size)
            yield capture

    def _find_settings(self) -> BoardSettings:
        """Reads all messages but the samples; the settings in force. Raises FileFormatError where there are none."""
        found: Hello | None = None
        other: OtherProtocol | None = None
        for capture in self._parts(None):
            for before, message in capture.others:
                if isinstance(message, Hello):
                    found = self._hello(message, before, found)
                elif isinstance(message, OtherProtocol):
                    other = other or message
            self._samples += len(capture.samples)
            self._mouse_ports = max(self._mouse_ports, int(capture.mouse_count.max(initial=0)))
            self._corrupt = capture.corrupt.total
        self._restarts = sorted({before for before in self._restarts if before < self._samples})
        self._check_complete(found, other)
        assert found is not None
        return BoardSettings.of(found)

    def _hello(self, hello: Hello, before: int, found: Hello | None) -> Hello:
        """The HELLO whose settings are in force: the last before the first sample, or else the first."""
        if wrong := impossible(hello):
            raise FileFormatError(
                self._path, f"{self._path}: its HELLO states {wrong}, which is impossible; the capture is damaged"
            )
        if before and not hello.streaming and before not in self._restarts[-1:]:
            self._restarts.append(before)
        return hello if found is None or before == 0 else found

    def _check_complete(self, hello: Hello | None, other: OtherProtocol | None) -> None:
        if hello is None and other is not None:
            raise FileFormatError(
                self._path,
                f"{self._path} was captured with protocol {other.protocol_major}.{other.protocol_minor}, and this "
                f"linkpose reads protocol {PROTOCOL_MAJOR}: read it with the linkpose that captured it, or use the CSV "
                "recording",
            )
        if hello is None:
            raise FileFormatError(self._path, f"{self._path} holds no HELLO of a board; it is not a raw capture")
        if not self._samples:
            raise FileFormatError(self._path, f"{self._path} holds no sample; the board was never started")


class _CaptureClock:
    """Board time from 0 over its wraps.

    The duration of a restart is unknown. The next sample is placed one interval later and flagged.
    """

    def __init__(self, restarts: list[int], rate_hz: float) -> None:
        """`restarts`: number of samples before each restart."""
        self._restarts = np.array(restarts, dtype=np.int64)
        self._period_us = round(1e6 / rate_hz)
        self._placed = self._elapsed_us = 0
        self._foreign_to = 0  # the sample before which those of another stream end
        self._last: tuple[int, int] | None = None  # t_us and seq
        self.gaps = self.lost = self.jumps = 0

    def place(self, raw: NDArray[np.void]) -> tuple[NDArray[np.bool_], Floats, NDArray[np.int64]]:
        """Which of the next samples (N,) are new; times (M,) of these, s, and the flag of those after a gap."""
        inside = (self._restarts >= self._placed) & (self._restarts < self._placed + len(raw))
        restarts = self._restarts[inside] - self._placed
        t_us, seq = raw["t_us"].astype(np.int64), raw["seq"].astype(np.int64)
        new = self._are_new(t_us, seq, restarts)
        restarts = self._drop_foreign(new, t_us, seq, restarts)
        self._placed += len(raw)
        restarts = (np.cumsum(new) - 1)[restarts]
        t_us, seq = t_us[new], seq[new]
        if not len(seq):
            return new, np.empty(0), np.empty(0, np.int64)
        step_us, ticks = self._steps(t_us, seq)
        jumped = (ticks > 0) & (ticks <= WINDOW_TICKS)
        jumped &= np.abs(off_ticks(step_us, ticks, self._period_us)) > OFF_TICKS * self._period_us
        jumped[0] &= self._last is not None
        step_us[jumped] = ticks[jumped] * self._period_us
        self.jumps += int(np.count_nonzero(jumped))
        step_us[restarts], ticks[restarts] = self._period_us, 1
        elapsed_us = self._elapsed_us + np.cumsum(step_us)
        marked = ticks > 1
        self.gaps += int(np.count_nonzero(marked))
        self.lost += int(np.sum(ticks[marked] - 1))
        marked[restarts] = True
        self._elapsed_us, self._last = int(elapsed_us[-1]), (int(t_us[-1]), int(seq[-1]))
        return new, np.round(elapsed_us * 1e-6, TIME_DECIMALS), np.where(marked, GAP_BEFORE, 0)

    def _steps(self, t_us: NDArray[np.int64], seq: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Steps of the board's clock (µs) and ticks from sample to sample, forward over their wraps."""
        before = self._last or (int(t_us[0]), -1)
        return np.diff(t_us, prepend=before[0]) % _T_WRAP, np.diff(seq, prepend=before[1]) % _SEQ_WRAP

    def _are_new(
        self, t_us: NDArray[np.int64], seq: NDArray[np.int64], restarts: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """Which samples did not come before, as `sensors.timeline.Timeline` finds live."""
        before = self._last or (int(t_us[0]), int(seq[0]) - 1)
        back = -np.diff(seq, prepend=before[1]) % _SEQ_WRAP
        is_back = (back <= WINDOW_TICKS) & is_step(np.diff(t_us, prepend=before[0]), -back, self._period_us)
        is_back[restarts] = False
        if not is_back.any():  # as almost always
            return np.ones(len(seq), np.bool_)
        count = np.cumsum(np.where(is_back, -back, _SEQ_WRAP - back))
        return np.asarray(count > np.maximum.accumulate(np.concatenate([[0], count[:-1]])))

    def _drop_foreign(
        self, new: NDArray[np.bool_], t_us: NDArray[np.int64], seq: NDArray[np.int64], restarts: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Takes from `new` the samples of a stream that this program had not started, as the session does live.

        They go up to the HELLO by which the session began again. Without one, they are a restart of their own. Returns
        all restarts.
        """
        new[: max(0, self._foreign_to - self._placed)] = False
        while True:
            kept = np.flatnonzero(new)
            if not len(kept):
                return restarts
            foreign = is_foreign(*self._steps(t_us[kept], seq[kept]), self._period_us)
            foreign[0] &= self._last is not None
            foreign &= ~np.isin(kept, restarts)
            if not foreign.any():  # as almost always
                return restarts
            first = int(kept[foreign.argmax()])
            later = self._restarts[self._restarts > self._placed + first]
            if len(later):
                self._foreign_to = int(later[0])
                new[first : self._foreign_to - self._placed] = False
            else:
                restarts = np.union1d(restarts, [first])


def _raw_samples(capture: Capture, ports: int, new: NDArray[np.bool_]) -> RawSamples:
    """The capture's samples that are `new` (N,), with these mouse ports."""
    raw = capture.samples[new]
    mice = np.stack([raw["mice"]["dx"], raw["mice"]["dy"]], axis=2)[:, :ports]
    return RawSamples(
        np.stack([raw[name].astype(np.int64) for name in COUNT_FIELDS], axis=1),
        mice.astype(np.int64),
        capture.mouse_count[new].astype(np.int64),
    )
