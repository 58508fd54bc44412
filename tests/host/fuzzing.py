"""Every reader and every command with a small valid file, and what they may do with a damaged one."""

from __future__ import annotations

import re
import struct
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from click.testing import CliRunner
from mutated_formats import in_c3d, in_chunks, in_frames, in_parquet, in_records
from mutations import Change
from PIL import Image

from linkpose.cli import group
from linkpose.convert import convert
from linkpose.errors import LONGEST_TEXT, LinkposeError
from linkpose.evaluation.references import read_any, read_for_picture
from linkpose.evaluation.scores import evaluate
from linkpose.flashing.image import MARK, read_image
from linkpose.localization.logs import read_log
from linkpose.localization.maps import load_map
from linkpose.localization.tables import read_beacons, read_truth
from linkpose.recording.reader import RecordingFile, load_recording
from linkpose.recording.summary import summarise
from linkpose.recording.table import read_table
from linkpose.recording.writer import write_recording
from linkpose.sensors.rig import as_rig
from linkpose.simulation import board
from linkpose.simulation.link import LinkRun
from linkpose.wire.frames import encode
from linkpose.wire.messages import PROTOCOL_MAJOR, SCHEMA_CRC


class Target(NamedTuple):
    """A reader: a valid file, and what reads it. The reading may raise LinkposeError, and nothing else."""

    valid: Path
    read: Callable[[Path], object]
    inside: Change | None = None  # as in `mutate`


def targets(folder: Path) -> dict[str, Target]:
    """All readers, with their valid files in `folder`."""
    run = LinkRun(duration_s=3.0)
    files = _Files(folder, run)
    estimate, truth = files.estimate(), files.truth()
    recording = files.recording()
    parquet = folder / "run.parquet"
    convert(recording, parquet)
    c3d, trc = folder / "take.c3d", folder / "take.trc"
    convert(estimate, c3d, "joint-inertial")
    convert(estimate, trc, "joint-inertial")
    reference = read_table(truth)
    return {
        "recording": Target(recording, _survey),
        "raw": Target(files.raw(), _survey, in_frames),
        "parquet": Target(parquet, _survey, in_parquet),
        "estimate": Target(estimate, lambda path: evaluate(read_any(path), reference)),
        "truth": Target(truth, lambda path: evaluate(read_table(estimate), read_any(path))),
        "picture": Target(estimate, read_for_picture),
        "motive": Target(files.motive(), read_any),
        "c3d": Target(c3d, read_any, in_c3d),
        "trc": Target(trc, read_any),
        "rig": Target(files.text("rig.toml", _RIG), as_rig),
        "map": Target(files.map(), load_map),
        "map-image": Target(files.map().with_suffix(".png"), lambda path: files.load_map_with(path), in_chunks),
        "carmen": Target(files.text("scans.log", _CARMEN), read_log),
        "beacons": Target(files.text("beacons.csv", _BEACONS), read_beacons),
        "events": Target(files.text("events.csv", _EVENTS), read_log),
        "robot-truth": Target(files.text("robot.csv", _ROBOT), read_truth),
        "hex": Target(files.hex(), read_image, in_records),
    }


def commands(folder: Path) -> dict[str, Target]:
    """Whole commands on a damaged file."""
    files = _Files(folder, LinkRun(duration_s=3.0))
    estimate, recording = str(files.estimate()), files.recording()
    truth, grid = str(files.truth()), str(files.map())
    out, beacons = str(folder / "out"), str(files.text("beacons.csv", _BEACONS))
    return {
        "estimate": Target(recording, _command("estimate", "{}", "--filter", "tilt", "-o", f"{out}.csv", "--force")),
        "info": Target(recording, _command("info", "{}", "--json")),
        "evaluate": Target(Path(estimate), _command("evaluate", "{}", truth)),
        "plot": Target(Path(estimate), _command("plot", "{}", "-o", f"{out}.svg", "--force")),
        "convert": Target(Path(estimate), _command("convert", "{}", "-o", f"{out}.trc", "--force")),
        "localize": Target(
            files.text("scans.log", _CARMEN),
            _command("localize", "{}", "--map", grid, "--filter", "ekf", "-o", f"{out}.csv", "--force"),
        ),
        "localize-beacons": Target(
            files.text("events.csv", _EVENTS),
            _command("localize", "{}", "--beacons", beacons, "-o", f"{out}.csv", "--force"),
        ),
    }


def _survey(path: Path) -> None:
    summarise(RecordingFile(path))
    load_recording(path)


def _command(*words: str) -> Callable[[Path], int]:
    """A command on a file; its exit status. Raises as the command does."""

    def run(path: Path) -> int:
        result = CliRunner().invoke(group, [word.format(path) if word == "{}" else word for word in words])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        check(result.exit_code, result.stderr)
        return result.exit_code

    return run


_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
_LONGEST = 4_000  # characters of all messages of a command


def check(status: int, err: str) -> None:
    """Asserts that a command ended in a result or in a sentence."""
    assert status in (0, 1, 2) and "Traceback" not in err and "please report" not in err, err
    assert not _CONTROL.search(err), repr(err)
    assert len(err) < _LONGEST, err[:300]
    if status:
        assert err.strip(), f"status {status} without a sentence"


READ = "read"


def read_mutated(target: Target, data: bytes) -> str:
    """Reads damaged bytes under the name of the valid file's kind. Raises whatever is not a LinkposeError.

    Returns READ, or the line of linkpose that refused the file.
    """
    damaged = target.valid.with_name("damaged" + target.valid.suffix)
    damaged.write_bytes(data)
    try:
        status = target.read(damaged)
    except LinkposeError as error:
        assert len(str(error)) <= LONGEST_TEXT + 3, str(error)[:300]
        *_, (frame, line) = traceback.walk_tb(error.__traceback__)
        return f"{Path(frame.f_code.co_filename).name}:{line}"
    return f"status {status}" if isinstance(status, int) and status else READ


_RIG = """[joint]
j2s_m = [-0.09, -0.04, 1.65]
j2s_std_m = 0.001
[imu]
gyro_bias_rad_s = [0.01, 0.0, 0.0]
delay_s = 0.004
[[mouse]]
x_m = 0.1
y_m = 0.0
angle_deg = 28.0
counts_per_m = 8000
"""


def _to_wall(x_m: float, angle_deg: int) -> str:
    """The range from (x, 1) to the wall of `_Files.map`, whose inside reaches from -0.5 to 6.5 and from -0.5 to 4.5."""
    along, across = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    walls = [(6.5 - x_m) / max(along, 1e-9), (3.5 if across > 0 else 1.5) / max(abs(across), 1e-9)]
    return f"{min(walls):.2f}"


def _scan(x_m: float, time_s: int) -> str:
    """A line of 37 ranges, 5° apart, and one of odometry half a second later."""
    ranges = " ".join(_to_wall(x_m, angle) for angle in range(-90, 91, 5))
    pose = f"{x_m:.2f} 1.0 0.0"
    return (
        f"FLASER 37 {ranges} {pose} {pose} {time_s}.0 host {time_s}.0\n"
        f"ODOM {pose} 0.1 0.0 0.0 {time_s}.5 host {time_s}.5\n"
    )


_CARMEN = "PARAM robot_length 0.5 0 host 0\n" + "".join(_scan(0.1 * i, i) for i in range(1, 8))
_BEACONS = "id,x_m,y_m\n1,0.0,0.0\n0xDD05,5.0,0.0\nA1,0.0,5.0\n"
_EVENTS = "time_s,kind,a,b,c\n0,pose,1.0,1.0,0.0\n" + "".join(
    f"{0.1 * i:.1f},odometry,0.1,0.0,\n{0.1 * i:.1f},range,1,{1.4 + 0.01 * i:.3f},\n" for i in range(1, 12)
)
_ROBOT = "time_s,x_m,y_m,heading_rad\n" + "".join(f"{0.1 * i:.1f},{i},0,0.1\n" for i in range(12))


class _Files:
    """Writes small valid files."""

    def __init__(self, folder: Path, run: LinkRun) -> None:
        self._folder, self._run = folder, run

    def text(self, name: str, content: str) -> Path:
        path = self._folder / name
        path.write_text(content)
        return path

    def recording(self) -> Path:
        path = self._folder / "run.csv"
        samples = [s for s in self._run.samples() if s.seq < 120]
        write_recording(path, board.hello(board.DEFAULTS), samples, "sim", self._run.rig, force=True)
        return path

    def raw(self) -> Path:
        path = self._folder / "run.bin"
        frames = [encode(s) for s in self._run.samples()][:80]
        path.write_bytes(encode(board.hello(board.DEFAULTS)) + b"".join(frames))
        return path

    def _rows(self, prefix: str, count: int) -> str:
        t = np.arange(count) / 40
        tilt = np.stack([0.4 * np.sin(2 * t), 0.3 * np.cos(3 * t)])
        height = 1.65 * np.sqrt(1 - (tilt**2).sum(axis=0))
        names = [
            "time_s",
            *(f"{prefix}{name}" for name in ("height_m", "roll_deg", "pitch_deg", "yaw_deg", "x_m", "y_m")),
        ]
        table = np.column_stack([t, height, *np.degrees(tilt), 0 * t, 1.65 * tilt[1], -1.65 * tilt[0]])
        return ",".join(names) + "\n" + "".join(",".join(f"{v:.6f}" for v in row) + "\n" for row in table.tolist())

    def estimate(self) -> Path:
        head = '# linkpose estimate 1\n# {"filters": ["joint-inertial"], "rig": {}}\n'
        return self.text("est.csv", head + self._rows("joint_inertial_", 120) + '# {"rows": 120}\n')

    def truth(self) -> Path:
        return self.text("truth.csv", self._rows("", 120))

    def motive(self) -> Path:
        head = ["Format Version,1.23,Length Units,Meters", "", ",Type" + ",Marker" * 9]
        head += [",Name" + "".join(f",P:{i}" * 3 for i in range(3)), "," + ",Position" * 9]
        rows = ["Frame,Time (Seconds)" + ",X,Y,Z" * 3]
        for i in range(60):
            a, b = 0.3 * np.sin(0.1 * i), 0.2 * np.cos(0.17 * i)
            place = np.array([a, np.sqrt(1 - a * a - b * b), b])
            cells = np.concatenate([place, place + np.array([0.1, 0, 0]), place + np.array([0, 0, 0.1])])
            rows.append(f"{i},{i / 50:.4f}," + ",".join(f"{value:.5f}" for value in cells))
        return self.text("take.csv", "\n".join(head + rows) + "\n")

    def map(self) -> Path:
        cells = np.full((12, 16), 254, np.uint8)
        cells[0] = cells[-1] = 0
        cells[:, 0] = cells[:, -1] = 0
        Image.fromarray(cells).save(self._folder / "map.png")
        return self.text("map.yaml", "image: map.png\nresolution: 0.5\norigin: [-1.0, -1.0, 0.0]\nnegate: 0\n")

    def load_map_with(self, image: Path) -> None:
        load_map(self.text("damaged-map.yaml", f"image: {image.name}\nresolution: 0.5\norigin: [-1.0, -1.0, 0.0]\n"))

    def hex(self) -> Path:
        """An image of 512 bytes with the mark and the version by which linkpose knows its firmware."""
        version = struct.pack("<BBIBBBI", PROTOCOL_MAJOR, 0, SCHEMA_CRC, 1, 0, 0, 7)
        content = bytes(100) + MARK + version
        content += bytes(range(256)) * 2
        lines = []
        for at in range(0, 512, 16):
            body = bytes([16, at >> 8, at & 255, 0]) + content[at : at + 16]
            lines.append(":" + (body + bytes([-sum(body) & 255])).hex().upper())
        return self.text("firmware.hex", "\n".join([*lines, ":00000001FF"]) + "\n")
