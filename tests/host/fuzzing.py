"""Damaged files for every reader: small valid files, and seeded mutations of them."""

from __future__ import annotations

import gzip
import random
import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from click.testing import CliRunner
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

# What breaks parsers of numbers, of JSON, YAML and TOML, and what breaks programs that trust a number.
TOKENS = [
    b"nan", b"inf", b"-inf", b"-1", b"0", b"1e308", b"-1e308", b"1e400", b"1e-320", b"9" * 400, b"0x10",
    b"1_000", b"1,5", b"", b'"', b"'", b"#", b";", b"\t", b"\n", b"\r", b"\0", b"\xff", b"\xfe\xff", b"\xef\xbb\xbf",
    b"[" * 2000,
    b"{" * 500, b"&a [*a,*a]", b"null", b"true", b"\x1b[31m", b"..", b"/dev/zero", b"%s", b"18446744073709551616",
    b"NaN,", b"99999999999", b"1e9", b"[[[]]]", b"{}", b"[]", b"time_s", b"-0", b"\xed\xa0\x80", b"=1+1",
]  # fmt: skip
LONG = 100_000
HOLDERS = (b",", b"\n", b" ", b":", b"=", b"\t", b"[", b"]")


def mutate(data: bytes, rng: random.Random) -> bytes:
    """One to four changes: bytes, pieces, lines or fields are replaced, removed, doubled, moved or cut."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        rng.choice(_CHANGES)(changed, rng)
    return bytes(changed)


def _flip(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.choice((1, 1, 8))):
        if data:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _insert(data: bytearray, rng: random.Random) -> None:
    at = rng.randint(0, len(data))
    data[at:at] = rng.choice(TOKENS)


def _replace_field(data: bytearray, rng: random.Random) -> None:
    """A whole field, between two of the characters that hold fields."""
    at = rng.randint(0, len(data))
    start = max(data.rfind(holder, 0, at) for holder in HOLDERS) + 1
    ends = [end for holder in HOLDERS if (end := data.find(holder, at)) >= 0]
    data[start : min(ends, default=len(data))] = rng.choice(TOKENS)


def _cut(data: bytearray, rng: random.Random) -> None:
    del data[rng.randint(0, len(data)) :]


def _remove(data: bytearray, rng: random.Random) -> None:
    at = rng.randint(0, len(data))
    del data[at : at + rng.choice((1, 2, 10, 100))]


def _double(data: bytearray, rng: random.Random) -> None:
    at = rng.randint(0, len(data))
    data[at:at] = data[at : at + rng.choice((1, 10, 300))] * rng.choice((1, 3))


def _line(data: bytearray, rng: random.Random) -> None:
    """A line is removed, doubled, or exchanged with another."""
    lines = bytes(data).split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(3)
    if kind == 0:
        del lines[a]
    elif kind == 1:
        lines.insert(b, lines[a])
    else:
        lines[a], lines[b] = lines[b], lines[a]
    data[:] = b"\n".join(lines)


def _columns(data: bytearray, rng: random.Random) -> None:
    """A column is exchanged with another, doubled, removed or made longer in all lines."""
    separator = rng.choice([b",", b",", b" ", b":"])
    a, b, kind = rng.randrange(12), rng.randrange(12), rng.randrange(4)
    lines = bytes(data).split(b"\n")
    for at, line in enumerate(lines):
        cells = line.split(separator)
        if max(a, b) >= len(cells):
            continue
        if kind == 0:
            cells[a], cells[b] = cells[b], cells[a]
        elif kind == 1:
            cells.insert(a, cells[b])
        elif kind == 2:
            del cells[a]
        else:
            cells[a] += cells[b]
        lines[at] = separator.join(cells)
    data[:] = b"\n".join(lines)


def _layout(data: bytearray, rng: random.Random) -> None:
    """The whole file is kept in another form: other line ends, encodings or separators, twice, upside down, zipped."""
    text = bytes(data)
    data[:] = rng.choice(_LAYOUTS)(text, rng)


def _mixed_line_ends(text: bytes, rng: random.Random) -> bytes:
    return b"".join(line + rng.choice([b"\n", b"\r\n", b"\r", b"\n\n", b"\0\n"]) for line in text.split(b"\n"))


def _head_again(text: bytes, rng: random.Random) -> bytes:
    lines = text.split(b"\n")
    at = rng.randint(0, len(lines))
    return b"\n".join(lines[:at] + lines[: rng.choice((1, 3, 6))] + lines[at:])


def _encoded(text: bytes, rng: random.Random) -> bytes:
    codec = rng.choice(["utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-8-sig", "utf-7", "cp500"])
    return text.decode("latin-1").encode(codec)


def _huge(text: bytes, rng: random.Random) -> bytes:
    """A cell of 100 000 characters, or a line or a header of 100 000 cells."""
    at = rng.randint(0, len(text))
    return text[:at] + rng.choice([b"9", b"a", b",", b"1,", b"a,", b" ", b'"', b"[", b"- ", b"a:"]) * LONG + text[at:]


_LAYOUTS: list[Callable[[bytes, random.Random], bytes]] = [
    _mixed_line_ends, _head_again, _encoded, _huge,
    lambda text, rng: text + text,
    lambda text, rng: b"\n".join(reversed(text.split(b"\n"))),
    lambda text, rng: text.replace(b",", rng.choice([b";", b"\t", b" ", b",,", b'","'])),
    lambda text, rng: text.replace(b".", rng.choice([b",", b"", b"e"])),
    lambda text, rng: text.replace(b"\n", rng.choice([b"\r", b"", b",\n", b"\n#"])),
    lambda text, rng: gzip.compress(text, 1),
    lambda text, rng: bytes(len(text)),
]  # fmt: skip

_CHANGES: list[Callable[[bytearray, random.Random], None]] = [
    _flip, _insert, _replace_field, _replace_field, _cut, _remove, _double, _line, _columns, _layout,
]  # fmt: skip


class Target(NamedTuple):
    """A reader: a valid file, and what reads it. The reading may raise LinkposeError, and nothing else."""

    valid: Path
    read: Callable[[Path], object]


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
        "raw": Target(files.raw(), _survey),
        "parquet": Target(parquet, _survey),
        "estimate": Target(estimate, lambda path: evaluate(read_any(path), reference)),
        "truth": Target(truth, lambda path: evaluate(read_table(estimate), read_any(path))),
        "picture": Target(estimate, read_for_picture),
        "motive": Target(files.motive(), read_any),
        "c3d": Target(c3d, read_any),
        "trc": Target(trc, read_any),
        "rig": Target(files.text("rig.toml", _RIG), as_rig),
        "map": Target(files.map(), load_map),
        "map-image": Target(files.map().with_suffix(".png"), lambda path: files.load_map_with(path)),
        "carmen": Target(files.text("scans.log", _CARMEN), read_log),
        "beacons": Target(files.text("beacons.csv", _BEACONS), read_beacons),
        "events": Target(files.text("events.csv", _EVENTS), read_log),
        "robot-truth": Target(files.text("robot.csv", _ROBOT), read_truth),
        "hex": Target(files.hex(), read_image),
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
        return result.exit_code

    return run


def read_mutated(target: Target, data: bytes) -> None:
    """Reads damaged bytes under the name of the valid file's kind. Raises whatever is not a LinkposeError."""
    damaged = target.valid.with_name("damaged" + target.valid.suffix)
    damaged.write_bytes(data)
    try:
        target.read(damaged)
    except LinkposeError as error:
        assert len(str(error)) <= LONGEST_TEXT + 3, str(error)[:300]


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
