"""Live estimates, received by the libraries of their protocols."""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest

from linkpose.errors import InvalidValue, MissingLibrary
from linkpose.streams import open_output

HOST = Path(__file__).parents[2] / "host"
COLUMNS = ["time_s", "tilt_height_m", "tilt_height_std_m", "tilt_roll_deg"]
ROW = {"time_s": 0.25, "tilt_height_m": 1.5, "tilt_height_std_m": 0.125, "tilt_roll_deg": -20.5}


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 21)
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(20)
        yield receiver


def test_every_live_estimate_arrives_with_its_sigma(receiver):
    """One second at 100 Hz, through the command line; a second receiver that does not exist costs nothing."""
    to = ["--to", f"udp://127.0.0.1:{receiver.getsockname()[1]}", "--to", "udp://127.0.0.1:9"]
    run = ["estimate", "--live", "--port", "sim://link?test=1", "--duration", "1", "--filter", "tilt", "--json", *to]
    done = subprocess.run([sys.executable, "-m", "linkpose", *run], capture_output=True, text=True, cwd=HOST)
    assert done.returncode == 0, done.stderr
    printed = [row for row in map(json.loads, done.stdout.splitlines()) if "tilt_height_m" in row]
    received = [json.loads(receiver.recv(65536)) for _ in printed]
    assert len(printed) >= 100 and received == printed
    assert all(row["tilt_height_std_m"] > 0 for row in received)


def test_osc_messages_hold_value_sigma_and_time(receiver):
    osc_bundle = importlib.import_module("pythonosc.osc_bundle")
    output = open_output(f"osc://127.0.0.1:{receiver.getsockname()[1]}", COLUMNS)
    output.send(ROW | {"tilt_roll_deg": None}, 0.0)
    output.send(ROW, 0.0)
    first, second = (osc_bundle.OscBundle(receiver.recv(65536)) for _ in range(2))
    output.close()
    assert [message.address for message in first] == ["/linkpose/tilt_height_m"]
    found = {message.address: message.params for message in second}
    assert found["/linkpose/tilt_height_m"] == [1.5, 0.125, 0.25]
    value, sigma, time_s = found["/linkpose/tilt_roll_deg"]
    assert (value, time_s) == (-20.5, 0.25) and math.isnan(sigma)


def test_lsl_samples_hold_all_columns():
    lsl = importlib.import_module("pylsl")
    output = open_output("lsl:linkpose-test", COLUMNS)
    found = lsl.resolve_byprop("name", "linkpose-test", timeout=10)
    inlet = lsl.StreamInlet(found[0])
    inlet.open_stream(timeout=10)
    labels, channel = [], inlet.info().desc().child("channels").child("channel")
    while not channel.empty():
        labels.append(channel.child_value("label"))
        channel = channel.next_sibling("channel")
    measured = lsl.local_clock() - 0.25  # a quarter of a second ago, on both clocks
    output.send(ROW | {"tilt_roll_deg": None}, time.perf_counter() - 0.25)
    sample, stamp = inlet.pull_sample(timeout=10)
    assert labels == COLUMNS
    assert sample[:3] == [0.25, 1.5, 0.125] and math.isnan(sample[3])
    assert stamp == pytest.approx(measured, abs=1e-3)
    inlet.close_stream()
    output.close()


def test_a_receiver_that_does_not_read_costs_nothing(receiver):
    """Far more datagrams than its buffer holds: each call returns, and nothing is raised."""
    output = open_output(f"udp://127.0.0.1:{receiver.getsockname()[1]}", COLUMNS)
    for _ in range(30_000):
        output.send(ROW, 0.0)
    output.close()
    assert json.loads(receiver.recv(65536)) == ROW


class FoxgloveClient:
    """A receiver of Foxglove's WebSocket protocol (foxglove.sdk.v1), by the library `websockets`."""

    def __init__(self, port: int) -> None:
        client = importlib.import_module("websockets.sync.client")
        self.socket = client.connect(
            f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], open_timeout=20, close_timeout=0.2
        )

    def subscribe(self, topic: str) -> dict:
        """The advertised channel of a topic, after the subscription to it."""
        while True:
            message = json.loads(self.socket.recv(timeout=20))
            for channel in message.get("channels", []):
                if channel["topic"] == topic:
                    subscription = {"id": 7, "channelId": channel["id"]}
                    self.socket.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))
                    return channel

    def receive(self, timeout_s: float) -> tuple[int, dict]:
        """Time stamp (ns) and content of the next message."""
        while True:
            data = self.socket.recv(timeout=timeout_s)
            if isinstance(data, bytes) and data[0] == 1:  # MESSAGE_DATA
                subscription, stamp = struct.unpack("<IQ", data[1:13])
                assert subscription == 7
                return stamp, json.loads(data[13:])


def free_port() -> int:
    with socket.socket() as receiver:
        receiver.bind(("127.0.0.1", 0))
        return int(receiver.getsockname()[1])


def test_foxglove_receives_values_with_their_time():
    """A second client that never reads costs nothing: each call returns, and the first goes on receiving."""
    port = free_port()
    output = open_output(f"ws://127.0.0.1:{port}", COLUMNS)
    client, deaf = FoxgloveClient(port), FoxgloveClient(port)
    channel = client.subscribe("/linkpose/values")
    deaf.subscribe("/linkpose/values")
    assert channel["encoding"] == "json" and set(json.loads(channel["schema"])["properties"]) == set(COLUMNS)
    received = None
    while received is None:  # the subscription takes effect at some time
        since_1970, since_start = time.time_ns(), time.perf_counter()
        output.send(ROW | {"tilt_roll_deg": None}, since_start - 0.25)
        with contextlib.suppress(TimeoutError):
            received = client.receive(0.2)
    stamp, content = received
    assert (
        content == {k: v for k, v in ROW.items() if k != "tilt_roll_deg"}
        and abs(stamp - since_1970 + 250_000_000) < 5e9
    )
    for _ in range(20_000):
        output.send(ROW, time.perf_counter())
    while client.receive(20)[1] != ROW:
        pass
    output.close()
    for each in (client, deaf):
        each.socket.close()


def test_a_port_in_use_is_named():
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        with pytest.raises(InvalidValue, match="where no server can be started"):
            open_output(f"ws://127.0.0.1:{busy.getsockname()[1]}", COLUMNS)


@pytest.mark.parametrize("target", ["udp://127.0.0.1", "tcp://127.0.0.1:1", "lsl:", "udp://a:99999", "udp://:1", "x"])
def test_other_targets_are_refused(target):
    with pytest.raises(InvalidValue, match="it must be udp://HOST:PORT"):
        open_output(target, COLUMNS)


def test_a_missing_library_is_named(monkeypatch):
    for module, target in (
        ("pylsl", "lsl:name"),
        ("pythonosc.osc_bundle_builder", "osc://127.0.0.1:9"),
        ("foxglove", "ws://127.0.0.1:9"),
    ):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(MissingLibrary, match=r'pip install "linkpose\[live\]"'):
            open_output(target, COLUMNS)
