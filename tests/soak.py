"""Soaks: what takes minutes or gigabytes, each with a bound.

    python tests/soak.py [--seed S] [NAME ...]

Without NAME, all run: day, frames, kills, reconnects, disk, wraps, suspended. Figures are printed; a bound that is
missed is an AssertionError, and the status is 1. The day's files (4 GB) are written to the folder in $TMPDIR.
"""

from __future__ import annotations

import argparse
import itertools
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent / "host"), str(Path(__file__).parents[1] / "host")]

import numpy as np  # noqa: E402
from pty_board import PtyBoard  # noqa: E402
from serial.tools import list_ports_common  # noqa: E402
from test_wire import corrupted_stream  # noqa: E402

from linkpose.device import ports  # noqa: E402
from linkpose.device.session import Session  # noqa: E402
from linkpose.recorder import Recorder  # noqa: E402
from linkpose.recording.reader import load_recording  # noqa: E402
from linkpose.recording.table import read_table  # noqa: E402
from linkpose.sensors.conversion import GAP_BEFORE  # noqa: E402
from linkpose.sensors.rig import Rig  # noqa: E402
from linkpose.simulation import board as simulated  # noqa: E402
from linkpose.simulation.link import LinkRun  # noqa: E402
from linkpose.wire.frames import StreamDecoder, encode  # noqa: E402

CLI = [sys.executable, "-m", "linkpose"]
MOST_MB = 600
KILLS, RECONNECTS = 50, 40


def run(*words: object) -> tuple[float, float, float]:
    """Elapsed time (s), processor time (s) and peak memory (MB) of a command with its processes."""
    began, before = time.monotonic(), os.times()
    process = subprocess.Popen([*CLI, *map(str, words)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    peaks: list[float] = []
    sampler = threading.Thread(target=_watch, args=(process, peaks), daemon=True)
    sampler.start()
    _, err = process.communicate()
    assert process.returncode == 0, err.decode()
    sampler.join()
    after = os.times()
    used = sum(after[i] - before[i] for i in (2, 3))
    return time.monotonic() - began, used, max(peaks)


def _watch(process: subprocess.Popen[bytes], peaks: list[float]) -> None:
    """Proportional set size (MB) of a process and its children together, ten times a second."""
    while process.poll() is None:
        total = 0
        for pid in [process.pid, *_children(process.pid)]:
            try:
                total += int(Path(f"/proc/{pid}/smaps_rollup").read_text().split("Pss:")[1].split()[0]) * 1024
            except (OSError, IndexError):  # it has ended
                continue
        peaks.append(total / 1e6)
        time.sleep(0.1)


def _children(pid: int) -> list[int]:
    found = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            found += [int(word) for word in task.read_text().split()]
        except OSError:
            continue
    return found


def day(folder: Path, rng: random.Random) -> None:
    """24 h at 100 Hz through the commands that read files."""
    recording, truth, estimate = folder / "day.csv", folder / "truth.csv", folder / "estimate.csv"
    _write_day(recording, truth)
    missed = []
    for words in (
        ("info", recording),
        ("estimate", recording, "-o", estimate, "-q"),
        ("evaluate", estimate, truth),
        ("plot", estimate, "-o", folder / "day.png", "-q"),
        ("convert", recording, "-o", folder / "day.parquet", "-q"),
        ("convert", estimate, "-o", folder / "estimate.parquet", "-q"),
        ("convert", estimate, "-o", folder / "estimate.sto", "--filter", "joint-inertial", "-q"),
    ):
        took_s, used_s, peak_mb = run(*words)
        name = f"{words[0]} {Path(str(words[1])).name}" + (f" to {Path(str(words[3])).name}" if len(words) > 3 else "")
        print(f"day: {name}: {took_s:.0f} s, processor {used_s:.0f} s, {peak_mb:.0f} MB", flush=True)
        missed += [name] if peak_mb > MOST_MB else []
    assert not missed, f"more than {MOST_MB} MB: {missed}"


def _write_day(recording: Path, truth: Path) -> None:
    """An hour of a simulated link, 24 times behind each other."""
    hour = recording.with_name("hour.csv")
    words = ("simulate", "link", "--duration", "3600", "-o", hour, "-q")
    run(*words, "--truth", truth.with_name("hour-truth.csv"))
    for source, target in ((hour, recording), (truth.with_name("hour-truth.csv"), truth)):
        lines = source.read_text().splitlines(keepends=True)
        comments = [line for line in lines if line.startswith("#")]
        body = [line for line in lines if not line.startswith("#")]
        names, rows = body[0], [line.split(",", 1) for line in body[1:]]
        with target.open("w") as file:
            file.writelines([*comments[:2], names])
            for number in range(24):
                file.writelines(f"{float(cell) + 3600 * number:.6f},{rest}" for cell, rest in rows)


def frames(folder: Path, rng: random.Random) -> None:
    """200 MB of damaged frames: no exception, and strangers within what CRC-16 lets through."""
    run_ = LinkRun(duration_s=250.0)
    sent = list(run_.samples())
    encoded, known = [encode(sample) for sample in sent], set(sent)
    decoder, total, accepted, strangers = StreamDecoder(), 0, 0, 0
    while total < 200e6:
        stream = corrupted_stream(rng, encoded)
        total += len(stream)
        for at in range(0, len(stream), 4096):
            got = decoder.feed(stream[at : at + 4096])
            accepted += len(got)
            strangers += sum(message not in known for message in got)
    corrupt = decoder.corrupt.total
    print(f"frames: {total / 1e6:.0f} MB, {accepted} accepted, {corrupt} corrupt, {strangers} strangers", flush=True)
    assert strangers <= 3 * corrupt / 65536 + 5


def kills(folder: Path, rng: random.Random) -> None:
    """kill -9 at random moments; the age of the last write is that of the file."""
    worst_s = 0.0
    for number in range(KILLS):
        path = folder / f"{number}.csv"
        process = subprocess.Popen([*CLI, "record", path, "--port", "sim://link", "-q"], stderr=subprocess.DEVNULL)
        while not (path.exists() and path.stat().st_size > 3000):
            assert process.poll() is None
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 1.5))
        held = path.read_bytes().count(b"\n")
        before = time.time()
        process.kill()
        process.wait()
        table = read_table(path, "recording")
        assert table.closing is None and len(table) >= held - 3
        worst_s = max(worst_s, before - path.stat().st_mtime)
        path.unlink()
    print(f"kills: {KILLS}, all readable, at most {worst_s:.3f} s between the last write and the signal", flush=True)
    assert worst_s < 1.0


class _Usb:
    """The system's list of ports with one board."""

    def __init__(self, board: PtyBoard) -> None:
        self._board = board

    def __call__(self) -> list[list_ports_common.ListPortInfo]:
        if not self._board.path.exists():
            return []
        port = list_ports_common.ListPortInfo(str(self._board.path))
        port.vid, port.pid, port.serial_number = 0x2341, 0x0043, "75735"
        return [port]


def reconnects(folder: Path, rng: random.Random) -> None:
    """The cable is pulled and put back under another name each time: every gap is marked, the recording goes on."""
    out, said = folder / "r.csv", []
    with PtyBoard(folder / "ttyACM0") as board:
        ports.list_ports.comports = _Usb(board)
        with Session(str(board.path), said.append) as session, Recorder(session, out, Rig()) as recorder:
            pulled, wanted = 0, 20
            for placements in session.stream():
                recorder.convert(placements)
                timeline = session.timeline
                if pulled == RECONNECTS and timeline.samples >= wanted:
                    break
                if pulled == len(timeline.gaps) and timeline.samples >= wanted:
                    board.pull()
                    pulled += 1
                    threading.Timer(rng.uniform(0, 0.5), board.plug, [folder / f"ttyACM{pulled}"]).start()
                    wanted = timeline.samples + rng.randrange(20, 60)
            recorder.close("interrupted")
    table = read_table(out, "recording")
    marked = np.count_nonzero(table.columns["flags"].astype(int) & GAP_BEFORE)
    back = sum("the board is back at" in line for line in said)
    print(f"reconnects: {pulled} pulls, {back} found again, {marked} gaps marked, {len(table)} rows", flush=True)
    assert table.closing and marked == table.closing["gap_count"] == back == RECONNECTS


def disk(folder: Path, rng: random.Random) -> None:
    """A disk that fills up under the recording, the raw capture, the estimates, stderr and stdout."""
    small = folder / "small"
    small.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", small], check=True)
    try:
        for words in (
            ["record", small / "a.csv"],
            ["record", folder / "b.csv", "--raw", small / "b.bin"],
            ["estimate", "--live", "-o", small / "c.csv", "--filter", "tilt"],
        ):
            port = ["--port", "sim://link?speed=0", "--duration", "200", "--force"]
            done = subprocess.run([*CLI, *words, *port], capture_output=True, text=True)
            last = done.stderr.strip().splitlines()[-1]
            print(f"disk: {words[0]}: {last}", flush=True)
            assert done.returncode == 1 and "No space left" in last and "Traceback" not in done.stderr
            written = small / Path(words[-1] if words[0] == "record" else words[3]).name
            if written.suffix == ".csv":
                data = written.read_bytes()
                assert data.endswith(b"\n") and b"\0" not in data and len(read_table(written)) > 100
            else:
                assert len(load_recording(written).measurements) > 100
            written.unlink()
    finally:
        subprocess.run(["umount", small], check=True)


def wraps(folder: Path, rng: random.Random) -> None:
    """Three hours of a board: seq wraps 16 times, t_us twice."""
    hello, one = simulated.hello(simulated.DEFAULTS), list(LinkRun(duration_s=30.0).samples())
    count = 3 * 3600 * 100
    with (folder / "r.bin").open("wb") as file:
        file.write(encode(hello))
        for number in range(count):
            sample = one[number % len(one)]
            file.write(encode(sample._replace(seq=number % 65536, t_us=(4_000_000_000 + 10_000 * number) % 2**32)))
    recording = load_recording(folder / "r.bin")
    steps = np.diff(recording.measurements.time_s)
    print(f"wraps: {len(recording.measurements)} rows, steps {steps.min():.6f} to {steps.max():.6f} s", flush=True)
    assert len(steps) == count - 1 and steps.min() > 0.00999 and steps.max() < 0.01001
    assert not np.any(recording.measurements.flags & GAP_BEFORE)


def suspended(folder: Path, rng: random.Random) -> None:
    """A host that stands still for 10 s, five times: in step again, gaps are marked, and nothing else is reported.

    The terminal's buffer holds some of the samples, so that not each of the stops leaves a gap.
    """
    out = folder / "r.csv"
    with PtyBoard(folder / "ttyACM0") as board:
        command = [*CLI, "record", out, "--port", board.path]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        for number in itertools.count():
            size = out.stat().st_size if out.exists() else 0
            while not out.exists() or out.stat().st_size < size + 20_000:
                assert process.poll() is None, process.stderr and process.stderr.read()
                time.sleep(0.05)
            if number == 5:
                break
            process.send_signal(signal.SIGSTOP)
            time.sleep(10)
            process.send_signal(signal.SIGCONT)
        process.send_signal(signal.SIGTERM)  # a background job ignores SIGINT
        _, err = process.communicate(timeout=30)
    table = read_table(out, "recording")
    closing = table.closing or {}
    steps = np.diff(table.columns["time_s"])
    print(
        f"suspended: {closing.get('gap_count')} gaps, {closing.get('lost')} lost, {closing.get('corrupt')}", flush=True
    )
    assert closing["gap_count"] > 0 and closing["lost"] > 0 and closing["corrupt"] == 0
    assert "no sample for" not in err and steps.min() > 0 and process.returncode == 0


SOAKS: dict[str, Callable[[Path, random.Random], None]] = {
    each.__name__: each for each in (day, frames, kills, reconnects, disk, wraps, suspended)
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("names", nargs="*", choices=[*SOAKS, []])
    chosen = parser.parse_args()
    missed = 0
    for name in chosen.names or SOAKS:
        with tempfile.TemporaryDirectory() as folder:
            try:
                SOAKS[name](Path(folder), random.Random(f"{name} {chosen.seed}"))
            except (AssertionError, subprocess.SubprocessError) as error:
                missed += 1
                print(f"{name}: missed: {error}", flush=True)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
