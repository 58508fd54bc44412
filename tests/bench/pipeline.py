"""What a live sample costs from its bytes to its estimates on disk, one at a time as they come.

    python tests/bench/pipeline.py [--json]

The peer is the time there is: the interval between two samples at 100 Hz. The checks of the sensors' health, which
belong to the live path too, have a row of their own.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
from _report import Row, report

from linkpose.estimation import EstimateWriter, Estimator
from linkpose.live_estimation import LiveEstimator
from linkpose.recording.writer import RecordingWriter, layout_of, metadata
from linkpose.sensors.conversion import BoardSettings, Converter
from linkpose.sensors.devices import found
from linkpose.sensors.health import HealthMonitor, expected_sensors
from linkpose.sensors.timeline import BoardClock, Timeline
from linkpose.simulation import board
from linkpose.simulation.link import LinkRun
from linkpose.wire.frames import StreamDecoder, encode

SAMPLES = 3000


def main() -> None:
    run = LinkRun(duration_s=SAMPLES / 100)
    frames = [encode(sample) for sample in run.samples()]
    hello = board.hello(board.DEFAULTS)
    settings = BoardSettings.of(hello)
    with tempfile.TemporaryDirectory() as folder:
        decoder, timeline, clock = StreamDecoder(), Timeline(100), BoardClock()
        converter, estimator = Converter(settings), Estimator([], run.rig, found(hello))
        estimator.warm_up()
        live, monitor = LiveEstimator(estimator, lambda _: True), HealthMonitor(100, expected_sensors(hello, 0))
        head = metadata(hello, settings, "bench", run.rig, {})
        recording = RecordingWriter(Path(folder, "r.csv"), head, layout_of(settings), force=False)
        estimates = EstimateWriter(Path(folder, "e.csv"), head, estimator.columns, force=False)
        took, checks = [], []
        for frame in frames:
            began, checked_s = time.perf_counter(), 0.0
            for sample in decoder.feed(frame):
                place = timeline.place(sample, clock, 0.0)
                block = converter.convert_placed([sample], [place])
                recording.write_block(block)
                check_began = time.perf_counter()
                checked, _ = monitor.check(block.measurements)
                checked_s = time.perf_counter() - check_began
                rows = live.process(checked).complete
                estimates.write(estimator.text(rows))
            took.append(1e6 * (time.perf_counter() - began - checked_s))
            checks.append(1e6 * checked_s)
    name = f"{len(estimator.filters)} filters"
    report(
        [
            Row(f"live, {name}, median", float(np.median(took)), "100 Hz", 1e4),
            Row(f"live, {name}, p99", float(np.quantile(took, 0.99)), "100 Hz", 1e4),
            Row("health checks, median", float(np.median(checks)), "100 Hz", 1e4),
        ]
    )


if __name__ == "__main__":
    main()
