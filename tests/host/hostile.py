"""Every file argument of every command, and nasty things that a user, a program or a stranger may put there."""

from __future__ import annotations

import gzip
import os
import random
import socket
from collections.abc import Callable
from pathlib import Path

from fuzzing import targets

# A command with its file arguments by name; {} is the one under test, {name} a valid file of that kind.
INPUTS = {
    "info RECORDING": "info {}",
    "estimate RECORDING": "estimate {} --filter tilt -o {out}.csv --force",
    "estimate --rig": "estimate {recording} --rig {} --filter tilt -o {out}.csv --force",
    "record --rig": "record {out}.csv --port sim://link?speed=0 --duration 0.1 --rig {} --force",
    **{f"calibrate {kind} RECORDINGS": f"calibrate {kind} {{}} --rig {{out}}.toml"
       for kind in ("imu", "joint", "chain", "mag", "noise")},
    "calibrate mice RECORDINGS": "calibrate mice {} --rig {rig}",
    **{f"calibrate {kind} --rig": f"calibrate {kind} {{recording}} --rig {{}}"
       for kind in ("imu", "joint", "chain", "mag", "noise", "mice")},
    "convert IN": "convert {} -o {out}.tum --force",
    "evaluate ESTIMATE": "evaluate {} {truth}",
    "evaluate REFERENCE": "evaluate {estimate} {}",
    "plot FILES": "plot {} -o {out}.svg --force",
    "plot --map": "plot {robot-truth} --map {} -o {out}.svg --force",
    "plot --beacons": "plot {robot-truth} --beacons {} -o {out}.svg --force",
    "localize LOG": "localize {} --map {map} --filter ekf -o {out}.csv --force",
    "localize --map": "localize {carmen} --map {} --filter ekf -o {out}.csv --force",
    "localize --beacons": "localize {events} --beacons {} -o {out}.csv --force",
    "localize --odometry": "localize {events} --beacons {beacons} --odometry {} -o {out}.csv --force",
    "localize --truth": "localize {events} --beacons {beacons} --truth {} -o {out}.csv --force",
    "simulate link --errors": "simulate link --errors {} -o {out}.csv --truth {out}-t.csv --duration 2 --force",
    "simulate chain --errors": "simulate chain --errors {} -o {out}.csv --truth {out}-t.csv --duration 2 --force",
    "flash --hex": "flash --hex {} --port /dev/null",
}  # fmt: skip
# An existing file is replaced by --force only; a name must be one that can be written.
OUTPUTS = {
    "estimate -o": "estimate {recording} --filter tilt -o {} --force",
    "estimate --record": "estimate --live --port sim://link?speed=0 --duration 0.1 --filter tilt --record {} --force",
    "estimate --raw": "estimate --live --port sim://link?speed=0 --duration 0.1 --filter tilt --raw {} --force",
    "record OUT": "record {} --port sim://link?speed=0 --duration 0.1 --force",
    "record --raw": "record {out}.csv --raw {} --port sim://link?speed=0 --duration 0.1 --force",
    "convert -o": "convert {estimate} -o {} --force",
    "evaluate --plot": "evaluate {estimate} {truth} --plot {} --force",
    "plot -o": "plot {estimate} -o {} --force",
    "localize -o": "localize {events} --beacons {beacons} -o {} --force",
    "localize --plot": "localize {events} --beacons {beacons} --plot {} --force",
    **{f"simulate {kind} {option}": f"simulate {kind} {' '.join(words)} {more} --force"
       for kind, options, more in (
           ("link", ("-o", "--truth"), "--duration 2"),
           ("chain", ("-o", "--truth", "--rig"), "--duration 2"),
           ("mice", ("-o", "--truth"), "--path line"),
           ("indoor", ("-o", "--truth", "--map"), "--duration 2"),
           ("underwater", ("-o", "--truth", "--beacons"), ""))
       for option in options
       for words in [[f"{each} {'{}' if each == option else '{out}' + each.strip('-')}" for each in options]]},
    **{f"reproduce {kind} --plot": f"reproduce {kind} --plot {{}} --force"
       for kind in ("link", "mice", "indoor", "underwater")},
}  # fmt: skip

_ESCAPES = b"\x1b]0;title\x07\x1b[2J\x1b[31m\x9b31m\x00\x08\x7f"
CONTENTS = {
    "empty": b"",
    "zeros": bytes(300_000),
    "noise": random.Random(5).randbytes(50_000),
    "one long line": b"a" * 400_000,
    "digits": b"9" * 100_000,
    "quotes": b'"' * 100_000,
    "open quote": b'time_s,a\n0,"1' + b"\n1,2" * 50_000,
    "brackets": b"[" * 100_000,
    "braces": b'{"a":' * 50_000,
    "tables": b"\n".join(b"[" + b"a." * i + b"a]" for i in range(1, 200)),
    "one dotted key": b"a." * 20_000 + b"a = 1",
    "dashes": b"- " * 20_000,
    "aliases": b"a: &a [x,x,x,x,x,x,x,x,x]\n"
    + b"".join(b"%c: &%c [%s]\n" % (98 + i, 98 + i, b",".join([b"*%c" % (97 + i)] * 9)) for i in range(9)),
    "escapes": _ESCAPES * 50,
    "names of escapes": b"time_s,a" + _ESCAPES.replace(b"\0", b"") + b"\n0,1\n1,2\n",
    "head of brackets": b"# linkpose recording 1\n# " + b"[" * 100_000 + b"\ntime_s,a\n0,1\n",
    "head of digits": b'# linkpose recording 1\n# {"settings": {"sample_rate_hz": ' + b"9" * 5000 + b"}}\ntime_s\n0\n",
    "head of words": b'# linkpose recording 1\n# {"rig": {"joint": {"j2s_m": "' + b"x" * 90_000 + b'"}}}\ntime_s\n0\n',
    "head with escapes": b'# linkpose recording 1\n# {"rig": {"\\u001b[2J": 1}}\ntime_s\n0\n',
    "numbers": b"time_s,a\n0,1e308\n1,-1e308\n1e308,1e-320\n",
    "ten thousand columns": b",".join(b"c%d" % i for i in range(10_000)) + b"\n" + b"1," * 9_999 + b"1\n",
    "UTF-16 alone": b"\xff\xfe",
    "surrogates": b"time_s,\xed\xa0\x80\n0,1\n",
    "packed": gzip.compress(b"time_s,a\n0,1\n"),
    "spreadsheet": b"PK\x03\x04\x14\x00\x06\x00" + bytes(500),
    "Parquet": b"PAR1" + bytes(200) + b"\x10\x00\x00\x00PAR1",
    "picture": b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR\x7f\xff\xff\xff\x7f\xff\xff\xff\x08\x00\x00\x00\x00",
    "C3D": b"\x02\x50\xff\xff" + b"\xff" * 2000,
    "map of a device": b"image: /dev/zero\nresolution: 0.1\norigin: [0, 0, 0]\n",
    "map of itself": b"image: a.csv\nresolution: 0.1\norigin: [0, 0, 0]\n",
    "huge map": b"image: /proc/self/mem\nresolution: 1e-300\norigin: [1e300, -1e300, 1e300]\n",
}


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


def _to(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


KINDS: dict[str, Callable[[Path], object]] = {
    "nothing": lambda path: None,
    "folder": Path.mkdir,
    "silent pipe": os.mkfifo,
    "socket": make_socket,
    "endless device": _to("/dev/zero"),
    "no terminal": _to("/dev/tty"),
    "link to nothing": _to("/nowhere/at/all"),
    "link to itself": lambda path: path.symlink_to(path),
    "file that fails": _to("/proc/self/mem"),
    "name too long": _to("/tmp/" + "n" * 300),
    **{name: lambda path, content=content: path.write_bytes(content) for name, content in CONTENTS.items()},
}
PLACES: dict[str, Callable[[Path], object]] = {
    name: KINDS[name] for name in ("folder", "socket", "link to nothing", "link to itself", "name too long")
} | {"full disk": _to("/dev/full")}


def valid_files(folder: Path) -> dict[str, Path]:
    """A valid file of each kind, by the names in the commands."""
    return {name: target.valid for name, target in targets(folder).items()} | {"out": folder / "out"}


def words(command: str, files: dict[str, Path], at: Path) -> list[str]:
    """The command's words with the names of files."""
    names = {f"{{{name}}}": str(path) for name, path in files.items()} | {"{}": str(at)}
    found = []
    for word in command.split():
        for name, path in names.items():
            word = word.replace(name, path)
        found.append(word)
    return found
