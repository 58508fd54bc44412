"""What a user names as a file may be a pipe, a device, a folder, a socket, or nothing."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from hostile import make_socket

from linkpose import inputs
from linkpose.convert import convert
from linkpose.errors import CannotRead, FileError, FileExists
from linkpose.evaluation.references import read_any
from linkpose.evaluation.scores import evaluate
from linkpose.flashing.image import read_image
from linkpose.localization.logs import read_log
from linkpose.localization.maps import load_map
from linkpose.localization.tables import read_beacons, read_truth
from linkpose.outputs import STDOUT, create, write_all
from linkpose.recording.reader import RecordingFile
from linkpose.recording.table import read_table
from linkpose.sensors.rig import Rig

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes are Unix's")

READERS: dict[str, Callable[[Path], object]] = {
    "recording": RecordingFile,
    "table": read_table,
    "reference": read_any,
    "rig": Rig.load,
    "map": load_map,
    "log": read_log,
    "beacons": read_beacons,
    "truth": read_truth,
    "hex": read_image,
    "convert": lambda path: convert(path, path.with_name("out.trc")),
}


NASTY: dict[str, tuple[Callable[[Path], object], str]] = {
    "silent pipe": (os.mkfifo, "it is a pipe, and no program writes into it"),
    "endless device": (lambda path: path.symlink_to("/dev/zero"), "it is a device, not a file"),
    "folder": (Path.mkdir, "Is a directory"),
    "socket": (make_socket, "No such device or address"),
    "loop of links": (lambda path: path.symlink_to(path), "Too many levels of symbolic links"),
    "nothing": (lambda path: None, "No such file or directory"),
}


@pytest.mark.parametrize("kind", NASTY)
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_file_is_refused_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str, kind: str
) -> None:
    monkeypatch.setattr(inputs, "PIPE_WAIT_S", 0.0)
    make, reason = NASTY[kind]
    make(path := tmp_path / "a.csv")
    with pytest.raises(CannotRead) as raised:
        READERS[reader](path)
    assert reason in str(raised.value)


def pipe_with(path: Path, content: bytes) -> threading.Thread:
    """A named pipe into which a thread writes."""
    os.mkfifo(path)
    writer = threading.Thread(target=path.write_bytes, args=(content,), daemon=True)
    writer.start()
    return writer


def test_a_pipe_is_read_like_a_file(tmp_path: Path) -> None:
    names = "time_s,height_m,roll_deg,pitch_deg"
    rows = "".join(f"{t / 10},{t % 7},{t % 5},{t % 3}\n" for t in range(60))
    truth = tmp_path / "truth.csv"
    writer = pipe_with(truth, f"{names}\n{rows}".encode())
    (tmp_path / "e.csv").write_text(names.replace(",", ",tilt_").replace("tilt_time", "time") + "\n" + rows)
    scores = evaluate(read_table(tmp_path / "e.csv"), read_any(truth))
    writer.join()
    assert scores


def test_a_pipe_that_gives_more_than_memory_allows_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inputs, "MOST_BYTES", 1000)
    pipe_with(tmp_path / "a.csv", bytes(5000))
    with pytest.raises(CannotRead, match="a pipe with more than"):
        read_table(tmp_path / "a.csv")
    (tmp_path / "rig.toml").write_bytes(bytes(5000))
    with pytest.raises(CannotRead, match="it is larger than"):
        Rig.load(tmp_path / "rig.toml")


def test_an_output_may_be_a_link_to_a_file_that_does_not_exist_yet(tmp_path: Path) -> None:
    link, target = tmp_path / "link.csv", tmp_path / "target.csv"
    link.symlink_to(target)
    with pytest.raises(FileExists):
        create(link, force=False)
    os.close(create(link, force=True))
    assert link.is_symlink() and target.exists()


def test_the_standard_output_has_its_name_in_messages() -> None:
    full = os.open("/dev/full", os.O_WRONLY)
    try:
        with pytest.raises(FileError, match="cannot write to the standard output any more: No space left"):
            write_all(full, STDOUT, b"0\n")
    finally:
        os.close(full)
