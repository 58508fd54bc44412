"""Writes simulated runs: recordings, logs, maps and the truth that `evaluate` reads.

Each function checks all of its files before it writes the first.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from linkpose.errors import LinkposeError
from linkpose.localization.carmen import format_reading
from linkpose.localization.events import HEADER, Event, format_event, write_lines
from linkpose.localization.maps import save_map
from linkpose.outputs import check_outputs
from linkpose.recording.truth import write_truth, write_truth_blocks
from linkpose.recording.writer import write_recording
from linkpose.sensors.measurements import Floats
from linkpose.simulation import board
from linkpose.simulation.chain import ChainRun
from linkpose.simulation.indoor import CELL_M, IndoorRun, office_floor
from linkpose.simulation.link import LinkRun
from linkpose.simulation.mice import MiceRun
from linkpose.simulation.underwater import BEACONS, UnderwaterRun
from linkpose.wire.messages import Configure

MOST_SAMPLES = 10_000_000  # of a simulated run: 27 h at 100 Hz, some 2 GB of CSV
_BLOCK = 50_000  # samples of the truth in memory at once


def check_length(duration_s: float, rate_hz: float) -> None:
    """Raises LinkposeError for a run whose samples do not fit the memory that linkpose allows itself."""
    if duration_s * rate_hz > MOST_SAMPLES:
        longest = MOST_SAMPLES / rate_hz
        raise LinkposeError(
            f"{duration_s:.6g} s at {rate_hz:g} Hz are {duration_s * rate_hz:.3g} samples, and {MOST_SAMPLES:,} is the "
            f"limit: simulate at most {longest:.0f} s, or at a lower rate"
        )


def write_link(run: LinkRun, recording: Path, truth: Path, force: bool) -> None:
    """The recording of a link or a chain, and its truth, whose columns are those of `run.truth_columns`."""
    check_outputs((recording, truth), force)
    write_truth_blocks(truth, _truth_blocks(run), {"device": run.description, "j2s_m": run.j2s_m}, force)
    settings: Configure = board.DEFAULTS._replace(sample_rate_hz=round(run.rate_hz))
    write_recording(
        recording, board.hello(settings, sensors=run.hello_sensors), run.samples(), run.description, run.rig, force
    )


def write_chain(run: ChainRun, recording: Path, truth: Path, rig: Path | None, force: bool) -> None:
    """As `write_link`; `rig` receives the rig file with the mounting of both sensors."""
    check_outputs((recording, truth, *([rig] if rig else [])), force)
    write_link(run, recording, truth, force)
    if rig:
        run.calibrated_rig.save(rig)


def _truth_blocks(run: LinkRun) -> Iterator[Mapping[str, Floats]]:
    """Block by block: a day at 100 Hz would not fit the memory at once."""
    for start in range(0, run.count or 0, _BLOCK):
        yield run.truth_columns(np.arange(start, min(start + _BLOCK, run.count or 0)) / run.rate_hz)


def write_mice(run: MiceRun, resolution: int, recording: Path, truth: Path, force: bool) -> None:
    """The recording of a robot whose mice have `resolution` counts per mm, and its truth."""
    check_outputs((recording, truth), force)
    name = f"sim://mice?seed={run.seed}&mice={len(run.mice)}&path={run.path}&errors={run.errors}"
    write_truth(truth, run.truth().columns(), {"device": name, "rig": run.rig.as_dict()}, force)
    settings = board.DEFAULTS._replace(sample_rate_hz=round(run.rate_hz), mouse_counts_per_mm=resolution)
    hello = board.hello(settings, sensors=run.hello_sensors, mice=run.hello_mice)
    write_recording(recording, hello, run.samples(), name, run.rig, force)


def write_indoor(run: IndoorRun, seed: int, log: Path, truth: Path, map_file: Path, force: bool) -> None:
    """The CARMEN log of a robot with a laser scanner, its truth, and the map with its image."""
    check_outputs((log, truth, map_file, map_file.with_suffix(".pgm")), force)
    columns = {
        "time_s": run.time_s,
        "x_m": run.pose[:, 0],
        "y_m": run.pose[:, 1],
        "heading_rad": run.pose[:, 2],
        "vx_m_s": run.twist[:, 0],
        "wz_rad_s": run.twist[:, 1],
    }
    write_truth(truth, columns, {"simulated": "indoor", "seed": seed}, force)
    save_map(map_file, office_floor(), CELL_M, (0.0, 0.0), force)
    lines = [format_reading(reading) for reading in run.readings]
    write_lines(log, [f"# linkpose simulate indoor --seed {seed}", *lines], force)


def write_underwater(run: UnderwaterRun, seed: int, log: Path, truth: Path, beacons: Path, force: bool) -> None:
    """The log of an underwater vehicle, its truth, and the beacons."""
    check_outputs((log, truth, beacons), force)
    places = [f"{name},{x:g},{y:g},{z:g}" for name, (x, y, z) in BEACONS.items()]
    write_lines(beacons, ["id,x_m,y_m,z_m", *places], force)
    write_truth(truth, _underwater_truth(run), {"simulated": "underwater", "seed": seed}, force)
    rows = [format_event(event) for event in run.log if isinstance(event, Event)]
    write_lines(log, [f"# linkpose simulate underwater --seed {seed}", ",".join(HEADER), *rows], force)


def _underwater_truth(run: UnderwaterRun) -> Mapping[str, Floats]:
    pose = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "heading_rad")
    twist = ("vx_m_s", "vy_m_s", "vz_m_s", "wx_rad_s", "wy_rad_s", "wz_rad_s")
    columns: dict[str, Any] = {"time_s": run.motion.time_s}
    columns |= dict(zip(pose, run.motion.pose.T, strict=True))
    return columns | dict(zip(twist, run.motion.twist.T, strict=True))
