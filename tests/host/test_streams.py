"""Standard streams that are closed, full or without a reader: messages are dropped, lost results are one sentence."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import child
import pytest
from fuzzing import check
from hostile import valid_files, words

from linkpose.recording.table import read_table

CLI = [sys.executable, "-m", "linkpose"]
RECORD = ["record", "r.csv", "--port", "sim://link?speed=20", "--duration", "1"]


def run(folder: Path, *arguments: str, shell: str = "") -> subprocess.CompletedProcess[str]:
    """The command with the shell's redirections behind it."""
    script = " ".join(f"'{word}'" for word in [*CLI, *arguments])
    return subprocess.run(
        ["sh", "-c", f"{script} {shell}"], cwd=folder, env=dict(os.environ), capture_output=True, text=True, timeout=60
    )


@pytest.mark.parametrize("shell", ["2>&-", "2>/dev/full"], ids=["closed", "full"])
def test_a_message_that_cannot_be_shown_does_not_end_the_recording(tmp_path: Path, shell: str) -> None:
    done = run(tmp_path, *RECORD, shell=shell)
    assert done.returncode == 0
    closing = read_table(tmp_path / "r.csv", "recording").closing
    assert closing is not None
    assert (closing["samples"], closing["ended"]) == (100, "duration")


def test_a_reader_of_the_messages_that_goes_away_does_not_end_the_recording(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([*CLI, *RECORD], cwd=tmp_path, stderr=writer, timeout=60)
    os.close(writer)
    assert done.returncode == 0
    assert len(read_table(tmp_path / "r.csv", "recording")) == 100


@pytest.mark.parametrize("arguments", [["--help"], [*RECORD, "--json"]], ids=["help", "summary"])
@pytest.mark.parametrize(
    ("shell", "reason"),
    [(">/dev/full", "No space left on device"), (">&-", "stdout is closed")],
    ids=["full", "closed"],
)
def test_results_that_cannot_be_written_are_one_sentence(
    tmp_path: Path, arguments: list[str], shell: str, reason: str
) -> None:
    done = run(tmp_path, *arguments, shell=shell)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(f"linkpose: cannot write the output: {reason}")
    assert "report it" not in done.stderr


@pytest.mark.parametrize("shell", [">/dev/full", ">&-"], ids=["full", "closed"])
def test_a_picture_that_cannot_be_written_is_one_sentence(tmp_path: Path, shell: str) -> None:
    (tmp_path / "e.csv").write_text("time_s,tilt_height_m\n0,1\n1,2\n")
    done = run(tmp_path, "plot", "e.csv", "-o", "-", shell=shell)
    assert done.returncode == 1
    reason = "the standard output: No space left" if "full" in shell else "the output: stdout is closed"
    assert done.stderr.splitlines()[-1].startswith(f"linkpose: cannot write {reason}")


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="Windows has no SIGHUP")
@pytest.mark.parametrize("ignored", [False, True], ids=["terminal closed", "nohup"])
def test_sighup_ends_a_recording_with_its_closing_line_unless_it_is_ignored(tmp_path: Path, ignored: bool) -> None:
    command = [*CLI, "record", "r.csv", "--port", "sim://link"]
    handler = signal.SIG_IGN if ignored else signal.SIG_DFL
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, handler),
    )
    path = tmp_path / "r.csv"
    while not (path.exists() and path.read_bytes().count(b"\n") > 20):
        assert process.poll() is None
    process.send_signal(signal.SIGHUP)
    if ignored:
        lines = path.read_bytes().count(b"\n")
        while path.read_bytes().count(b"\n") < lines + 20:
            assert process.poll() is None
        process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=60) == 0
    closing = read_table(path, "recording").closing
    assert closing is not None and closing["ended"] == "interrupted"


# ---- every command, with each fault of a standard stream and each signal ----

SIM = "sim://link?speed=0"
# A command, and where its results go: "out" is the standard output, also beside files.
COMMANDS = {
    "estimate --help": "out",
    "ports": "out",
    f"info --port {SIM} --json": "out",
    "info {recording}": "out",
    f"record out.csv --port {SIM} --duration 0.2 --force": "file",
    f"record - --port {SIM} --duration 0.2": "out",
    "estimate {recording} --filter tilt": "out",
    "estimate {recording} --filter tilt -o out.csv --force": "file",
    f"estimate --live --port {SIM} --duration 0.2 --filter tilt --json": "out",
    "convert {estimate} -o out.tum --force": "out",
    "evaluate {estimate} {truth}": "out",
    "plot {estimate} -o -": "out",
    "localize {events} --beacons {beacons} -o out.csv --force": "out",
    "calibrate imu {rests} --rig out.toml": "out",
    "calibrate joint {swing} --rig out.toml --json": "out",
    "simulate link --duration 2 -o out.csv --truth truth.csv --force": "file",
    "simulate chain --duration 2 -o out.csv --truth truth.csv --force": "file",
    "reproduce mice --seeds 1 --json": "out",
}
FAULTS = ("closed", "full", "gone")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    found = valid_files(tmp_path_factory.mktemp("valid"))
    folder = found["recording"].parent
    for name, kind in (("rests", ["--rests", "--duration", 24]), ("swing", ["--test", 2, "--duration", 20])):
        found[name] = folder / f"{name}.csv"
        made = child.run(folder, ["simulate", "link", *kind, "-o", found[name], "--truth", f"{name}-truth.csv"])
        assert made.status == 0, made
    return found


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_with_faulty_standard_streams(tmp_path: Path, files: dict[str, Path], command: str) -> None:
    """Each fault of stdout is at every third command; stderr and stdin never change what a command does."""
    typed = words(command, files, tmp_path)
    fault = FAULTS[list(COMMANDS).index(command) % len(FAULTS)]
    without_messages = child.run(tmp_path, typed, {0: "closed", 2: fault})
    assert without_messages.status == 0
    assert bool(without_messages.out) == (COMMANDS[command] == "out")
    without_results = child.run(tmp_path, typed, {1: fault})
    check(without_results.status, without_results.err)
    if COMMANDS[command] == "file":
        assert without_results.status == 0
    else:
        assert without_results.status == 1
        assert re.search("cannot write|has gone", without_results.err.splitlines()[-1])


# Where a signal arrives: at the first file that is read, and at the first that is written.
PLACES = ("linkpose.inputs._File", "linkpose.outputs._target")
ENDS = {signal.SIGINT: {130}, signal.SIGTERM: {-signal.SIGTERM, 0, 130}, signal.SIGHUP: {-signal.SIGHUP, 0, 130}}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_signal_ends_every_command_without_a_traceback(tmp_path: Path, files: dict[str, Path], command: str) -> None:
    typed = words(command, files, tmp_path)
    at = list(COMMANDS).index(command)
    number = list(ENDS)[at % len(ENDS)]
    done = child.run(tmp_path, typed, signalled=(PLACES[at % 2], number))
    assert done.status in ENDS[number] | {0}, done
    assert "Traceback" not in done.err and "report it" not in done.err
    assert not list(tmp_path.glob(".out*")), "a temporary file is left"
