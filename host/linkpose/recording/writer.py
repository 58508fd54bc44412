"""Writes recordings: the one way from samples to a recording's CSV, for a live board and a simulated one."""

from __future__ import annotations

import datetime
import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from linkpose import __version__
from linkpose.recording import columns
from linkpose.recording.csvfile import CsvFile
from linkpose.sensors import devices
from linkpose.sensors.conversion import BoardSettings, Converter
from linkpose.sensors.measurements import Block
from linkpose.sensors.rig import Rig
from linkpose.sensors.timeline import BoardClock, Timeline
from linkpose.wire.frames import Corrupt
from linkpose.wire.messages import Hello, Sample


def metadata(hello: Hello, settings: BoardSettings, device: str, rig: Rig, clock: dict[str, Any]) -> dict[str, Any]:
    """The second line of a recording, from which everything in it can be understood."""
    return {
        "software": f"linkpose {__version__}",
        "start_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds"),
        "device": device,
        "firmware": {
            "version": f"{hello.firmware_major}.{hello.firmware_minor}.{hello.firmware_patch}",
            "source_revision": devices.source_revision(hello),
            "protocol": f"{hello.protocol_major}.{hello.protocol_minor}",
        },
        "settings": settings.as_dict(),
        "sensors": devices.names(hello),
        "devices": [device._asdict() for device in hello.devices],
        "barometer": settings.barometer._asdict(),
        "mice": [mouse._asdict() for mouse in hello.mice],
        "clock": clock,
        "rig": rig.as_dict(),
    }


def closing(timeline: Timeline, corrupt: Corrupt, drift_ppm: float | None, **more: Any) -> dict[str, Any]:
    """The last line of a recording: how it went."""
    duration = timeline.duration_s
    return {
        "samples": timeline.samples,
        "lost": timeline.lost,
        "corrupt": corrupt.as_dict(),
        "gaps": [gap.as_dict() for gap in timeline.gaps[:MOST_GAPS]],
        "gap_count": len(timeline.gaps),
        "duration_s": round(duration, 6),
        "rate_hz": round(timeline.samples / duration, 3) if duration else 0.0,
        "drift_ppm": None if drift_ppm is None else round(drift_ppm, 1),
        **more,
    }


def layout_of(settings: BoardSettings, mouse_ports: int = 0) -> columns.ColumnLayout:
    """Columns of a recording of this board, with room for `mouse_ports` mice or for those found if they are more."""
    return columns.ColumnLayout(max(settings.mouse_ports, mouse_ports), settings.has_imu2, settings.has_mag)


_BATCH = 4096  # samples converted at once; bounds the memory
MOST_GAPS = 1000  # listed in the closing line; the rows mark every one


class RecordingWriter(CsvFile):
    """A recording under way. Raises LinkposeError as `CsvFile` does."""

    def __init__(
        self, path: Path, head: dict[str, Any], layout: columns.ColumnLayout, force: bool, plain: bool = False
    ) -> None:
        super().__init__(path, "recording", head, columns.names(layout), force, plain)
        self._layout = layout

    def write_block(self, block: Block) -> None:
        """Adds samples."""
        self.write(columns.text(block, self._layout))


def write_recording(
    path: Path, hello: Hello, samples: Iterable[Sample], device: str, rig: Rig, force: bool
) -> Timeline:
    """Writes samples that are all there already, in the board's own time; their timeline."""
    settings = BoardSettings.of(hello)
    converter, timeline, clock = Converter(settings), Timeline(settings.sample_rate_hz), BoardClock()
    head = metadata(hello, settings, device, rig, {"source": "board", "drift_ppm": None})
    remaining = iter(samples)
    with RecordingWriter(path, head, layout_of(settings), force) as writer:
        while batch := list(itertools.islice(remaining, _BATCH)):
            places = ((sample, timeline.place(sample, clock, 0.0)) for sample in batch)
            placed = [(sample, place) for sample, place in places if place is not None]
            if placed:
                writer.write_block(converter.convert_placed(*zip(*placed, strict=True)))
        writer.close(closing(timeline, Corrupt(), None))
    return timeline
