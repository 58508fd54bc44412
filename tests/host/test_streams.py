"""Standard streams that are closed, full or without a reader: messages are dropped, lost results are one sentence."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

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
