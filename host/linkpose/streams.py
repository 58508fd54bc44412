"""Sends live estimates to other programs: JSON or Open Sound Control (OSC) over UDP, the Lab Streaming Layer (LSL),
and Foxglove's WebSocket protocol.

Sending never waits. A datagram that the system does not accept at once is dropped and counted; LSL and Foxglove send
from threads of their own, and drop the oldest messages for a receiver that is slow. An absent receiver costs nothing.
"""

from __future__ import annotations

import json
import math
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol
from urllib.parse import urlsplit

from linkpose.convert import libraries
from linkpose.errors import InvalidValue
from linkpose.quantities import split, std_column

_CLOCK_READINGS = 20  # of which the fastest takes about 1 µs; one alone may be interrupted for milliseconds
FORMS = "udp://HOST:PORT, osc://HOST:PORT, ws://HOST:PORT or lsl:NAME"


class Output(Protocol):
    """A receiver of estimates."""

    name: str
    dropped: int  # estimates that the system did not accept

    def send(self, row: Mapping[str, float | None], host_s: float) -> None:
        """Sends the estimates of one sample: column -> value, None where there is none. Never waits.

        `host_s` is the time of the sample on the host's clock (time.perf_counter, s).
        """

    def close(self) -> None:
        """Ends the output."""


def open_output(target: str, columns: Sequence[str]) -> Output:
    """The output that `target` names in one of FORMS, for these columns of an estimate.

    Raises InvalidValue for another form, an unknown host or a port in use, and MissingLibrary where its library
    is not installed.
    """
    if target.startswith("lsl:") and len(target) > len("lsl:"):
        return LslOutput(target.removeprefix("lsl:"), columns)
    kinds: dict[str, type[JsonOutput] | type[OscOutput] | type[FoxgloveOutput]] = {
        "udp": JsonOutput, "osc": OscOutput, "ws": FoxgloveOutput,
    }  # fmt: skip
    try:
        parts = urlsplit(target)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if not host or not port or parts.scheme not in kinds or parts.path.strip("/"):
        raise InvalidValue("to", f"is {target!r}; it must be {FORMS}")
    return kinds[parts.scheme](target, host, port, columns)


class _UdpOutput:
    """Datagrams to one address."""

    def __init__(self, target: str, host: str, port: int, columns: Sequence[str]) -> None:
        self.name, self.dropped = target, 0
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise InvalidValue("to", f"names the host {host!r}, which is unknown ({error.strerror})") from error
        self._address: tuple[Any, ...] = address
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)

    def _send(self, data: bytes) -> None:
        try:
            self._socket.sendto(data, self._address)
        except OSError:  # the buffer is full, the network is down, or an earlier datagram was refused
            self.dropped += 1

    def close(self) -> None:
        self._socket.close()


class JsonOutput(_UdpOutput):
    """One JSON object per sample, as `estimate --json` prints: PlotJuggler's UDP server reads it."""

    def send(self, row: Mapping[str, float | None], host_s: float) -> None:
        self._send(json.dumps(dict(row)).encode())


class OscOutput(_UdpOutput):
    """One OSC bundle per sample: /linkpose/COLUMN with value, σ (NaN where the filter has none) and time_s."""

    def __init__(self, target: str, host: str, port: int, columns: Sequence[str]) -> None:
        self._bundles = libraries.load("pythonosc.osc_bundle_builder", target, "live")
        self._messages = libraries.load("pythonosc.osc_message_builder", target, "live")
        super().__init__(target, host, port, columns)
        parts = {name: split(name) for name in columns}
        self._columns = [(name, std_column(name)) for name, part in parts.items() if part and not part.is_std]

    def send(self, row: Mapping[str, float | None], host_s: float) -> None:
        bundle = self._bundles.OscBundleBuilder(self._bundles.IMMEDIATELY)
        for name, std in self._columns:
            value, sigma = row.get(name), row.get(std) if std else None
            if value is not None:
                message = self._messages.OscMessageBuilder(f"/linkpose/{name}")
                message.add_arg(value, "f")
                message.add_arg(math.nan if sigma is None else sigma, "f")
                message.add_arg(row.get("time_s") or 0.0, "d")
                bundle.add_content(message.build())
        self._send(bundle.build().dgram)


class LslOutput:
    """An LSL stream of type "Pose" with one channel per column; missing values are NaN.

    Each sample is stamped with its time on LSL's clock: the board's clock as it is fitted to the host's, and the host's
    clock as LSL counts it. `time_s` is a channel. liblsl sends from a thread of its own.
    """

    def __init__(self, name: str, columns: Sequence[str]) -> None:
        lsl: Any = libraries.load("pylsl", f"lsl:{name}", "live")
        self.name, self.dropped = f"lsl:{name}", 0
        self._columns = list(columns)
        info = lsl.StreamInfo(name, "Pose", len(columns), lsl.IRREGULAR_RATE, lsl.cf_double64, f"linkpose-{name}")
        channels = info.desc().append_child("channels")
        for column in columns:
            part = split(column)
            channel = channels.append_child("channel").append_child_value("label", column)
            channel.append_child_value("unit", part.quantity.unit if part else "s")
        self._outlet: Any = lsl.StreamOutlet(info)
        self._offset_s = _offset_s(lsl.local_clock)

    def send(self, row: Mapping[str, float | None], host_s: float) -> None:
        values = (row.get(column) for column in self._columns)
        self._outlet.push_sample([math.nan if value is None else value for value in values], host_s + self._offset_s)

    def close(self) -> None:
        self._outlet = None


class FoxgloveOutput:
    """A server for Foxglove: the topic /linkpose/values with one JSON object per sample, missing values left out.

    Messages are stamped with the time of their sample since 1970. The server's threads are the library's own.
    """

    def __init__(self, target: str, host: str, port: int, columns: Sequence[str]) -> None:
        foxglove: Any = libraries.load("foxglove", target, "live")
        self.name, self.dropped = target, 0
        self._context: Any = foxglove.Context()
        try:
            self._server: Any = foxglove.start_server(name="linkpose", host=host, port=port, context=self._context)
        except Exception as error:  # of the library's own types
            raise InvalidValue("to", f"names {target}, where no server can be started: {error}") from error
        schema = {"type": "object", "properties": {column: {"type": "number"} for column in columns}}
        self._channel: Any = foxglove.Channel("/linkpose/values", schema=schema, context=self._context)
        self._offset_s = _offset_s(time.time)

    def send(self, row: Mapping[str, float | None], host_s: float) -> None:
        values = {name: value for name, value in row.items() if value is not None}
        self._channel.log(values, log_time=round(1e9 * (host_s + self._offset_s)))

    def close(self) -> None:
        self._server.stop()
        self._channel.close()


def _offset_s(clock: Callable[[], float]) -> float:
    """What to add to the host's clock (time.perf_counter, s) to get `clock`, from the fastest of several readings."""
    best = (math.inf, 0.0)
    for _ in range(_CLOCK_READINGS):
        before = time.perf_counter()
        value = clock()
        after = time.perf_counter()
        best = min(best, (after - before, value - (before + after) / 2))
    return best[1]
