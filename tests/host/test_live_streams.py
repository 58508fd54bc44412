"""Live estimates, received by the libraries of their protocols."""

from __future__ import annotations

import importlib
import json
import math
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from linkpose.errors import InvalidValue, MissingLibrary
from linkpose.streams import open_output

HOST = Path(__file__).parents[2] / "host"
COLUMNS = ["time_s", "tilt_height_m", "tilt_height_std_m", "tilt_roll_deg"]
ROW = {"time_s": 0.25, "tilt_height_m": 1.5, "tilt_height_std_m": 0.125, "tilt_roll_deg": -20.5}


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 21)
        listening.bind(("127.0.0.1", 0))
        listening.settimeout(20)
        yield listening


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
    output.send(ROW | {"tilt_roll_deg": None})
    output.send(ROW)
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
    output.send(ROW | {"tilt_roll_deg": None})
    sample, stamp = inlet.pull_sample(timeout=10)
    assert labels == COLUMNS
    assert sample[:3] == [0.25, 1.5, 0.125] and math.isnan(sample[3]) and stamp <= lsl.local_clock()
    inlet.close_stream()
    output.close()


def test_a_receiver_that_does_not_read_costs_nothing(receiver):
    """Far more datagrams than its buffer holds: each call returns, and nothing is raised."""
    output = open_output(f"udp://127.0.0.1:{receiver.getsockname()[1]}", COLUMNS)
    for _ in range(30_000):
        output.send(ROW)
    output.close()
    assert json.loads(receiver.recv(65536)) == ROW


@pytest.mark.parametrize("target", ["udp://127.0.0.1", "tcp://127.0.0.1:1", "lsl:", "udp://a:99999", "udp://:1", "x"])
def test_other_targets_are_refused(target):
    with pytest.raises(InvalidValue, match="it must be udp://HOST:PORT"):
        open_output(target, COLUMNS)


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pylsl", None)
    with pytest.raises(MissingLibrary, match=r'pip install "linkpose\[live\]"'):
        open_output("lsl:name", COLUMNS)
