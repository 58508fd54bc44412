"""MCAP, the container of Foxglove and ROS 2 tools, by `mcap`: messages as JSON."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, BinaryIO

from linkpose import __version__
from linkpose.convert import libraries
from linkpose.convert.motion import Motion
from linkpose.convert.source import Source
from linkpose.errors import LinkposeError

_NUMBER = {"type": "number"}


def write(file: BinaryIO, path: Path, source: Source) -> None:
    """A topic /linkpose/values with all columns, and /linkpose/pose where the table has a motion. World: Z up."""
    writer_module = libraries.load("mcap.writer", path)
    writer = writer_module.Writer(file)
    writer.start(profile="", library=f"linkpose {__version__}")
    values = _channel(writer, "/linkpose/values", "linkpose.Values", _schema(source.names))
    for block in source.blocks():
        for row in zip(*(column.tolist() for column in block.values()), strict=True):
            content = {name: value for name, value in zip(block, row, strict=True) if math.isfinite(value)}
            _add(writer, values, content["time_s"], content)
    if (motion := _motion(source)) is not None:
        _add_poses(writer, motion)
    writer.finish()


def _motion(source: Source) -> Motion | None:
    try:
        return Motion(source, None, "sensor")
    except LinkposeError:  # a recording, or a filter that estimates the height alone
        return None


def _add_poses(writer: Any, motion: Motion) -> None:
    parts = {name: _schema(name_parts) for name, name_parts in (("position", "xyz"), ("orientation", "xyzw"))}
    time = _schema(("sec", "nsec"))
    pose = {"type": "object", "properties": parts}
    schema = {"type": "object", "properties": {"timestamp": time, "frame_id": {"type": "string"}, "pose": pose}}
    channel = _channel(writer, "/linkpose/pose", "foxglove.PoseInFrame", schema)
    rows = (
        row
        for poses in motion.parts()
        for row in zip(poses.time_s.tolist(), poses.position_m.tolist(), poses.quaternion.tolist(), strict=True)
    )
    for t, (x, y, z), (qw, qx, qy, qz) in rows:
        seconds, nanoseconds = divmod(_nanoseconds(t), 1_000_000_000)
        orientation = {"x": qx, "y": qy, "z": qz, "w": qw}
        content = {
            "timestamp": {"sec": seconds, "nsec": nanoseconds},
            "frame_id": "world",
            "pose": {"position": {"x": x, "y": y, "z": z}, "orientation": orientation},
        }
        _add(writer, channel, t, content)


def _schema(names: Any) -> dict[str, Any]:
    return {"type": "object", "properties": dict.fromkeys(names, _NUMBER)}


def _channel(writer: Any, topic: str, name: str, schema: dict[str, Any]) -> int:
    schema_id = writer.register_schema(name=name, encoding="jsonschema", data=json.dumps(schema).encode())
    return int(writer.register_channel(topic=topic, message_encoding="json", schema_id=schema_id))


def _nanoseconds(t: float) -> int:
    return max(0, round(t * 1e9))


def _add(writer: Any, channel: int, t: float, content: dict[str, Any]) -> None:
    stamp = _nanoseconds(t)
    writer.add_message(channel, log_time=stamp, publish_time=stamp, data=json.dumps(content).encode())
