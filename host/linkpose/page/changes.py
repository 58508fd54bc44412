"""Changes of the page that follow each other fast: poses, texts and charts."""

from __future__ import annotations

import struct
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import viser

Array = NDArray[np.float64] | NDArray[np.float32]
ChartData = dict[str, Any] | list[float | None]  # an array, as `Changes.array` keeps it, or values; None is a gap

_ZSTD_START = b"\x28\xb5\x2f\xfd\xa0"  # magic number; then: one segment, its size in four bytes
_ZSTD_BLOCK = 1 << 17  # bytes of a block, at most
_SIZES = struct.Struct("<QQ")
_BINARY = 0x82  # first byte of a WebSocket frame: the whole of a binary message


class Changes:
    """The changes of one update, sent as one message in viser's format.

    viser's own queue keeps each change for browsers that connect later, and its event loop turns ten times for one
    update, which is most of the CPU that a page takes. `broadcast` bypasses the queue: what it sends is not kept, and
    whoever uses it repeats the whole state when a browser connects. All other messages go through the queue.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        from msgspec.msgpack import Encoder
        from viser.infra._infra import _append_aligned_buffers
        from websockets.protocol import State

        self._socket = server._websock_server
        self._encode, self._append_arrays, self._open = Encoder().encode, _append_aligned_buffers, State.OPEN
        self._messages: list[dict[str, Any]] = []  # in viser's format, without arrays
        self._arrays: list[memoryview] = []  # of the charts
        self._is_visible: dict[str, bool] = {}  # nodes of the scene

    def show(self, node: viser.SceneNodeHandle, is_visible: bool) -> None:
        """Shows or hides a node of the scene, which is visible or not only by this method.

        It goes through viser's queue, which is slow, even to see that nothing has changed.
        """
        if self._is_visible.get(node.name) is not is_visible:
            self._is_visible[node.name] = node.visible = is_visible

    def turn(self, node: viser.SceneNodeHandle, wxyz: Sequence[float]) -> None:
        """Gives a node of the scene this quaternion (4,)."""
        self._add("SetOrientationMessage", {"name": node.name, "wxyz": wxyz})

    def move(self, node: viser.SceneNodeHandle, place_m: Sequence[float]) -> None:
        """Gives a node of the scene this position (3,), m."""
        self._add("SetPositionMessage", {"name": node.name, "position": place_m})

    def scale(self, node: viser.SceneNodeHandle, factors: tuple[float, float, float]) -> None:
        """Scales a node of the scene along its axes."""
        self._add("SceneNodeUpdateMessage", {"name": node.name, "updates": {"scale": factors}})

    def write(self, element: viser.GuiHtmlHandle, text: str) -> None:
        """Gives an element of the panel this content."""
        self._add("GuiUpdateMessage", {"uuid": element._impl.uuid, "updates": {"content": text}})

    def plot(self, chart: viser.GuiUplotHandle, data: Sequence[ChartData]) -> None:
        """Gives a chart its data: arrays, as `array` keeps them, or lists, which may have gaps."""
        self._add("GuiUpdateMessage", {"uuid": chart._impl.uuid, "updates": {"data": data}})

    def array(self, values: Array) -> dict[str, Any]:
        """Keeps an array (N,) for the end of the message, and returns what stands in its place, any number of times."""
        self._arrays.append(np.ascontiguousarray(values).data)
        return {"__binary_index": len(self._arrays) - 1, "dtype": values.dtype.str}

    def _add(self, kind: str, fields: dict[str, Any]) -> None:
        fields["type"], fields["owner"] = kind, ""
        self._messages.append(fields)

    def queue(self) -> None:
        """Puts the changes of the scene into viser's queue, of which viser makes recordings."""
        from viser import _messages

        for fields in self._messages:
            kind = fields.pop("type")
            del fields["owner"]
            self._socket.queue_message(getattr(_messages, kind)(**fields))
        self._messages = []

    def broadcast(self, clients: Collection[int]) -> None:
        """Sends the changes to these clients of the server. Runs on the server's event loop.

        A browser that has not read all of what was sent before gets none of them: it would show old values.
        """
        transports = [
            connection.transport
            for client, connection in self._socket._live_connections.items()
            if client in clients
            and connection.protocol.state is self._open
            and not connection.transport.get_write_buffer_size()
        ]
        if self._messages and transports:
            frame = websocket_frame(self._encoded())
            for transport in transports:
                transport.write(frame)
        self._messages, self._arrays = [], []

    def _encoded(self) -> bytes:
        """As viser's `_message_producer` encodes messages: sizes, the messages in zstd's format, and the arrays.

        Messages of a kilobyte are not worth a compressor. The time of sending is left at 0: from a real one, viser's
        client makes the intervals between messages even, and shows them later for it.
        """
        text = self._encode(
            {
                "messages": self._messages,
                "timestampSec": 0.0,
                "binaryBufferLengths": [array.nbytes for array in self._arrays],
            }
        )
        frame = uncompressed_frame(text)
        parts: list[bytes | memoryview] = [_SIZES.pack(len(text), len(frame)), frame]
        if self._arrays:
            self._append_arrays(parts, self._arrays, 16 + len(frame))
        return b"".join(parts)


def uncompressed_frame(data: bytes) -> bytes:
    """Data (at least one byte) in zstd's format (RFC 8878, section 3.1.1), as blocks that are not compressed."""
    parts = [_ZSTD_START, len(data).to_bytes(4, "little")]
    for at in range(0, len(data), _ZSTD_BLOCK):
        block = data[at : at + _ZSTD_BLOCK]
        is_last = at + _ZSTD_BLOCK >= len(data)
        parts += [(len(block) << 3 | is_last).to_bytes(3, "little"), block]
    return b"".join(parts)


def websocket_frame(message: bytes) -> bytes:
    """A binary message of a server in WebSocket's format (RFC 6455, section 5.2)."""
    size = len(message)
    if size < 126:
        head = bytes((_BINARY, size))
    elif size < 1 << 16:
        head = bytes((_BINARY, 126)) + size.to_bytes(2, "big")
    else:
        head = bytes((_BINARY, 127)) + size.to_bytes(8, "big")
    return head + message
