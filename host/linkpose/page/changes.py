"""Changes of the page that follow each other fast: poses, texts and charts."""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from linkpose.sensors.measurements import Floats

if TYPE_CHECKING:
    import viser

Nullable = Floats | list[float | None]  # values of a chart; None is a gap

# Bytes that wait for a browser, from which on it gets no further change until it has read them: some four updates with
# charts. Ten times as many would show a slow browser what was measured seconds ago.
_MOST_WAITING = 200_000


class Changes:
    """The changes of one update, sent as one message in viser's format.

    viser's own queue keeps each change for browsers that connect later, and its event loop turns ten times for one
    update, which is most of the CPU that a page takes. `broadcast` bypasses the queue: what it sends is not kept, and
    whoever uses it repeats the whole state when a browser connects. All other messages go through the queue.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        from zstandard import ZstdCompressor

        self._socket = server._websock_server
        self._compressor = ZstdCompressor(level=1)
        self._messages: list[tuple[str, dict[str, Any]]] = []  # viser's kind of message, and its fields
        self._arrays: list[memoryview] = []  # of the charts

    def turn(self, node: viser.SceneNodeHandle, wxyz: Floats) -> None:
        """Gives a node of the scene this quaternion (4,)."""
        self._messages.append(("SetOrientationMessage", {"name": node.name, "wxyz": tuple(wxyz.tolist())}))

    def move(self, node: viser.SceneNodeHandle, place_m: Floats) -> None:
        """Gives a node of the scene this position (3,), m."""
        self._messages.append(("SetPositionMessage", {"name": node.name, "position": tuple(place_m.tolist())}))

    def scale(self, node: viser.SceneNodeHandle, factors: tuple[float, float, float]) -> None:
        """Scales a node of the scene along its axes."""
        self._messages.append(("SceneNodeUpdateMessage", {"name": node.name, "updates": {"scale": factors}}))

    def write(self, element: viser.GuiHtmlHandle, text: str) -> None:
        """Gives an element of the panel this content."""
        self._messages.append(("GuiUpdateMessage", {"uuid": element._impl.uuid, "updates": {"content": text}}))

    def plot(self, chart: viser.GuiUplotHandle, data: Sequence[Nullable]) -> None:
        """Gives a chart its data: arrays travel as binary, lists, which may have gaps, as text."""
        parts = [self._placeholder(values) if isinstance(values, np.ndarray) else values for values in data]
        self._messages.append(("GuiUpdateMessage", {"uuid": chart._impl.uuid, "updates": {"data": parts}}))

    def _placeholder(self, values: Floats) -> dict[str, Any]:
        """Keeps an array for the end of the message, and returns what viser has in its place."""
        self._arrays.append(np.ascontiguousarray(values).data)
        return {"__binary_index": len(self._arrays) - 1, "dtype": values.dtype.str}

    def queue(self) -> None:
        """Puts the changes of the scene into viser's queue, of which viser makes recordings."""
        from viser import _messages

        for kind, fields in self._messages:
            self._socket.queue_message(getattr(_messages, kind)(**fields))
        self._messages = []

    def broadcast(self, clients: Collection[int]) -> None:
        """Sends the changes to these clients of the server. Runs on the server's event loop."""
        from websockets.asyncio.server import broadcast

        connections = [
            connection
            for client, connection in self._socket._live_connections.items()
            if client in clients and connection.transport.get_write_buffer_size() < _MOST_WAITING
        ]
        if self._messages and connections:
            broadcast(connections, self._encoded())
        self._messages, self._arrays = [], []

    def _encoded(self) -> bytes:
        """As viser's `_message_producer` encodes messages: sizes, the compressed messages, and the arrays."""
        from msgspec.msgpack import encode
        from viser.infra._infra import _append_aligned_buffers

        text = encode({
            "messages": [{"type": kind, "owner": "", **fields} for kind, fields in self._messages],
            "timestampSec": time.perf_counter(),
            "binaryBufferLengths": [array.nbytes for array in self._arrays],
        })  # fmt: skip
        compressed = self._compressor.compress(text)
        parts: list[bytes | memoryview] = [len(size).to_bytes(8, "little") for size in (text, compressed)]
        parts.append(compressed)
        _append_aligned_buffers(parts, self._arrays, 16 + len(compressed))
        return b"".join(parts)
