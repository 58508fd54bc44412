"""From the board's tick to the estimate that `linkpose estimate --live --json` writes, on the emulated board.

    python tests/bench/latency.py [--json]

The board runs in real time. The tick is the START of the inertial sensor's read on its bus; the end is the arrival of
the estimate's line in another process. The peer is the interval between two samples. The firmware must have been built.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from _report import Row, report
from numpy.typing import NDArray

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests" / "virtual_uno"), str(ROOT / "host")]

from pty_server import PtyServer  # noqa: E402
from rig_signals import RigFeed  # noqa: E402
from wire_link import WATCHED_BUS, burst_starts  # noqa: E402

from linkpose.simulation.link import LinkRun  # noqa: E402
from linkpose.wire.frames import StreamDecoder  # noqa: E402
from linkpose.wire.messages import Sample  # noqa: E402
from virtual_uno import CLOCK_HZ, VirtualUno  # noqa: E402

HEX = ROOT / ".pio" / "build" / "uno_distro" / "firmware.hex"
DURATION_S = 20
COMMAND = [sys.executable, "-m", "linkpose", "estimate", "--live", "--json", "-q", "--j2s", "-0.09,-0.04,1.65"]


def serve_and_listen(folder: Path) -> tuple[list[float], NDArray[Any], float]:
    """Arrival of each estimate (s, monotonic clock), the board's events, and the clock's value at its cycle 0."""
    with VirtualUno(HEX) as uno:
        feed = RigFeed(uno, LinkRun(duration_s=None), stretch_s=2 * DURATION_S)  # none is fed while it is measured
        uno.watch([*WATCHED_BUS, "uart_tx"])
        with PtyServer(uno, folder / "port", on_slice=feed.supply) as server:
            command = [*COMMAND, "--port", str(folder / "port"), "--duration", str(DURATION_S)]
            environment = os.environ | {"PYTHONPATH": str(ROOT / "host")}
            with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as process:
                assert process.stdout is not None
                arrivals = [time.monotonic() for line in process.stdout if b"joint_height_m" in line]
        return arrivals, uno.events(), server.statistics.epoch_monotonic_s


def sample_ticks(events: NDArray[Any]) -> NDArray[np.float64]:
    """Cycle of the tick of each SAMPLE that went over the line, from the bytes on it."""
    starts = burst_starts(events)
    sent = events[events["kind"] == "uart_tx"]
    decoder, ticks, first_byte = StreamDecoder(), [], None
    for cycle, byte in zip(sent["cycle"].tolist(), sent["value"].tolist(), strict=True):
        first_byte = cycle if first_byte is None else first_byte
        if any(isinstance(message, Sample) for message in decoder.feed(bytes([byte & 0xFF]))):
            ticks.append(starts[np.searchsorted(starts, first_byte) - 1])
        if byte & 0xFF == 0:
            first_byte = None
    return np.array(ticks)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        arrivals, events, epoch_s = serve_and_listen(Path(folder))
    ticks = sample_ticks(events)[: len(arrivals)]
    latency_us = 1e6 * (np.array(arrivals) - (epoch_s + ticks / CLOCK_HZ))
    report(
        [
            Row("tick to estimate, median", float(np.median(latency_us)), "100 Hz", 1e4),
            Row("tick to estimate, p99", float(np.quantile(latency_us, 0.99)), "100 Hz", 1e4),
        ]
    )


if __name__ == "__main__":
    main()
