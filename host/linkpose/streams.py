"""Sends live estimates to other programs: JSON or Open Sound Control (OSC) over UDP, or the Lab Streaming Layer (LSL).

Sending never waits. A datagram that the system does not accept at once is dropped and counted; a receiver that is slow
or absent costs nothing.
"""

from __future__ import annotations

import json
import math
import socket
from collections.abc import Mapping, Sequence
from typing import Any, Protocol
from urllib.parse import urlsplit

from linkpose.convert import libraries
from linkpose.errors import InvalidValue
from linkpose.quantities import split, std_column

FORMS = "udp://HOST:PORT, osc://HOST:PORT or lsl:NAME"


class Output(Protocol):
    """A receiver of estimates."""

    name: str
    dropped: int  # estimates that the system did not accept

    def send(self, row: Mapping[str, float | None]) -> None:
        """Sends the estimates of one sample: column -> value, None where there is none. Never waits."""

    def close(self) -> None:
        """Ends the output."""


def open_output(target: str, columns: Sequence[str]) -> Output:
    """The output that `target` names: udp://HOST:PORT, osc://HOST:PORT or lsl:NAME, for these columns of an estimate.

    Raises InvalidValue for another form or an unknown host, and MissingLibrary without python-osc or pylsl.
    """
    if target.startswith("lsl:") and len(target) > len("lsl:"):
        return LslOutput(target.removeprefix("lsl:"), columns)
    kinds: dict[str, type[JsonOutput] | type[OscOutput]] = {"udp": JsonOutput, "osc": OscOutput}
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

    def send(self, row: Mapping[str, float | None]) -> None:
        self._send(json.dumps(dict(row)).encode())


class OscOutput(_UdpOutput):
    """One OSC bundle per sample: /linkpose/COLUMN with value, σ (NaN where the filter has none) and time_s."""

    def __init__(self, target: str, host: str, port: int, columns: Sequence[str]) -> None:
        self._bundles = libraries.load("pythonosc.osc_bundle_builder", target, "live")
        self._messages = libraries.load("pythonosc.osc_message_builder", target, "live")
        super().__init__(target, host, port, columns)
        parts = {name: split(name) for name in columns}
        self._columns = [(name, std_column(name)) for name, part in parts.items() if part and not part.is_std]

    def send(self, row: Mapping[str, float | None]) -> None:
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

    Samples are stamped on LSL's clock when they are sent; `time_s` is a channel. liblsl sends from a thread of its own.
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

    def send(self, row: Mapping[str, float | None]) -> None:
        values = (row.get(column) for column in self._columns)
        self._outlet.push_sample([math.nan if value is None else value for value in values])

    def close(self) -> None:
        self._outlet = None
