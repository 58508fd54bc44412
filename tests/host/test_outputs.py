"""Outputs of every kind in hostile places: planted links, disks, modes, files that are exchanged, failing systems."""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from linkpose import outputs
from linkpose.cli import options
from linkpose.errors import CannotWrite, FileChanged, FileError, FileExists
from linkpose.outputs import create, new_file, replace_file
from linkpose.recording.csvfile import CsvFile
from linkpose.sensors.rig import Rig

STRANGER = 54321


def with_owner(path: Path, entry: os.stat_result, owner: int) -> SimpleNamespace:
    return SimpleNamespace(st_uid=owner, st_mode=entry.st_mode, st_dev=entry.st_dev, st_ino=entry.st_ino)


def fill(path: Path) -> None:
    with new_file(path, force=True) as file:
        file.write(b"new")


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """A link that a stranger has put into a folder that all can write, and the file of this user behind it."""
    (folder := tmp_path / "tmp").mkdir()
    folder.chmod(0o1777)
    target = tmp_path / "precious.csv"
    target.write_text("precious")
    link = folder / "e.csv"
    link.symlink_to(target)
    real = os.lstat
    monkeypatch.setattr(
        outputs.os, "lstat", lambda path: with_owner(path, real(path), STRANGER) if path == link else real(path)
    )
    return link, target


def test_a_link_of_another_user_is_not_followed(planted: tuple[Path, Path]) -> None:
    link, target = planted
    writers: list[Callable[[], object]] = [
        lambda: create(link, force=True),
        lambda: CsvFile(link, "recording", {}, ["time_s"], force=True),
        lambda: fill(link),
        lambda: Rig().save(link),
    ]
    for write in writers:
        with pytest.raises(CannotWrite, match="it is a link of another user in a folder that everybody can write"):
            write()
    assert target.read_text() == "precious" and link.is_symlink()


def test_a_link_of_this_user_stays_a_link(tmp_path: Path) -> None:
    link, target = tmp_path / "link.csv", tmp_path / "target.csv"
    link.symlink_to(target)
    target.write_text("old")
    for write in (lambda: os.close(create(link, force=True)), lambda: Rig().save(link)):
        write()
        assert link.is_symlink() and target.read_text() != "old"


def test_a_disk_is_not_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Path.stat
    disk = tmp_path / "sda"
    disk.touch()

    def as_disk(path: Path, **more: bool) -> object:
        found = real(path, **more)
        return SimpleNamespace(st_mode=stat.S_IFBLK | 0o660, st_uid=0) if path == disk else found

    monkeypatch.setattr(Path, "stat", as_disk)
    for write in (lambda: create(disk, force=False), lambda: create(disk, force=True), lambda: Rig().save(disk)):
        with pytest.raises(CannotWrite, match="it is a disk"):
            write()


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664])
def test_a_file_that_is_replaced_keeps_its_mode(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "a.csv"
    for write in (
        lambda: os.close(create(path, force=True)),
        lambda: replace_file(path, "new"),
        lambda: fill(path),
    ):
        path.write_text("old")
        path.chmod(mode)
        write()
        assert stat.S_IMODE(path.stat().st_mode) == mode


def test_the_mode_of_a_strangers_file_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """He could read and write the new one by it."""
    path = tmp_path / "a.csv"
    path.touch()
    path.chmod(0o666)
    user = os.geteuid()
    monkeypatch.setattr(outputs.os, "geteuid", lambda: user + 1)
    os.close(create(path, force=True))
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask


def test_a_file_that_cannot_be_filled_is_removed(tmp_path: Path) -> None:
    for failure, seen in ((OSError(errno.EIO, "Input/output error"), CannotWrite), (KeyboardInterrupt(), None)):
        path = tmp_path / "a.csv"
        with pytest.raises(seen or KeyboardInterrupt), new_file(path, force=False) as file:
            file.write(b"half")
            raise failure
        assert not path.exists()


@pytest.mark.parametrize("code", [errno.EIO, errno.EDQUOT, errno.ENOSPC, errno.ESTALE])
@pytest.mark.parametrize("call", ["fsync", "close"])
def test_what_a_network_file_system_reports_at_the_end_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, call: str
) -> None:
    real = getattr(os, call)

    def fail(descriptor: int) -> None:
        if call == "close":
            real(descriptor)
        raise OSError(code, os.strerror(code))

    file = CsvFile(tmp_path / "a.csv", "recording", {}, ["time_s"], force=False)
    file.write("1\n")
    with monkeypatch.context() as patch, pytest.raises(CannotWrite, match=os.strerror(code)):
        patch.setattr(os, call, fail)
        file.close({})


def test_a_folder_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(CannotWrite, match=re.escape(f"there is no folder {tmp_path / 'none'}")):
        create(tmp_path / "none" / "a.csv", force=False)


def test_a_folder_that_is_removed_meanwhile_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file has no folder to go on in, nor one for temporary files. The closing line failed with "Bad file
    descriptor" before.
    """
    (folder := tmp_path / "run").mkdir()
    file = CsvFile(folder / "a.csv", "recording", {}, ["time_s"], force=False)
    shutil.rmtree(folder)
    with pytest.raises(FileChanged, match="it was removed"):
        file.write("1\n")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    with pytest.raises(CannotWrite, match=r"a-2\.csv: there is no folder"):
        file.continue_elsewhere()
    with pytest.raises(FileChanged, match="it was removed"):
        file.close({})


@pytest.mark.parametrize("is_current", [False, True], ids=["named", "current"])
def test_a_file_whose_folder_is_removed_goes_on_among_the_temporary_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_current: bool
) -> None:
    """With the rows so far, which were lost before. A removed current folder gave a sentence without the file."""
    (folder := tmp_path / "run").mkdir()
    (other := tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(other))
    monkeypatch.chdir(folder if is_current else tmp_path)
    file = CsvFile(Path("a.csv") if is_current else folder / "a.csv", "recording", {}, ["time_s"], force=False)
    file.write("1\n")
    shutil.rmtree(folder)
    with pytest.raises(FileChanged, match="it was removed"):
        file.write("2\n")
    file.continue_elsewhere()
    file.write("2\n")
    file.close({})
    assert file.path == other / "a-2.csv"
    assert file.path.read_text().splitlines()[2:] == ["time_s", "1", "2", "# {}"]
    monkeypatch.chdir(tmp_path)


def test_a_check_that_fails_does_not_end_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A network folder for a moment: what the operating system cannot tell about a file is no reason to stop."""

    def fail(*_: object) -> None:
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))

    file = CsvFile(tmp_path / "a.csv", "recording", {}, ["time_s"], force=False)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fstat", fail)
        file.write("1\n")
        patch.setattr(os, "write", fail)
        with pytest.raises(FileError, match=r"cannot write to .*a\.csv any more: Stale file handle"):
            file.write("2\n")
    file.close({})
    assert (tmp_path / "a.csv").read_text().splitlines()[2:] == ["time_s", "1", "# {}"]


@pytest.mark.parametrize("error", [errno.EACCES, errno.ESTALE])
def test_a_name_that_cannot_be_looked_up_is_proposed(monkeypatch: pytest.MonkeyPatch, error: int) -> None:
    """The proposal of the next command ended a good recording with an error."""

    def fail(*_args: object, **_options: object) -> None:
        raise OSError(error, os.strerror(error))

    monkeypatch.setattr(os, "stat", fail)
    assert options.new_file("estimate.csv") == Path("estimate.csv")


def test_what_cannot_be_synchronised_ends_well(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    outputs.synchronise(writing)
    os.close(reading)
    os.close(writing)


def test_no_file_is_opened_twice_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the check and the writing, a stranger may put another file or a link in its place."""
    from linkpose import plotting
    from linkpose.convert import convert
    from linkpose.localization.maps import save_map

    precious = tmp_path / "precious"
    precious.write_text("precious")
    source = tmp_path / "e.csv"
    source.write_text("time_s,tilt_roll_deg,tilt_pitch_deg\n" + "".join(f"{i / 50},{i % 7},1\n" for i in range(60)))
    real = outputs.create

    def exchanged(path: Path, force: bool) -> int:
        descriptor = real(path, force)
        path.unlink()
        path.symlink_to(precious)
        return descriptor

    monkeypatch.setattr(outputs, "create", exchanged)
    for ending in ("sto", "trc", "tum", "c3d", "mot", "mcap", "parquet"):
        convert(source, tmp_path / f"a.{ending}")
    for ending in plotting.FORMATS:
        plotting.save(plotting.new_figure(1.0), tmp_path / f"a{ending}", False)
    save_map(tmp_path / "m.yaml", np.zeros((4, 4), bool), 0.1, (0.0, 0.0))
    assert precious.read_text() == "precious"


def test_an_existing_map_is_kept(tmp_path: Path) -> None:
    from linkpose.localization.maps import save_map

    (tmp_path / "m.pgm").write_text("mine")
    with pytest.raises(FileExists):
        save_map(tmp_path / "m.yaml", np.zeros((4, 4), bool), 0.1, (0.0, 0.0))
    assert (tmp_path / "m.pgm").read_text() == "mine"


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="this system does not tell the name of an open file")
@pytest.mark.parametrize("asked", ["run.csv", "/run.csv"], ids=["relative", "absolute"])
def test_a_file_that_is_renamed_while_it_is_written_has_its_new_name_at_the_end(
    asked: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The summary of a recording named a file that was not there any more, and proposed a command that would fail."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "kept").mkdir()
    with CsvFile(Path(f"{tmp_path}{asked}" if asked[0] == "/" else asked), "recording", {}, ["time_s"], False) as file:
        file.write("0.0\n")
        (tmp_path / "run.csv").rename(tmp_path / "kept" / "best.csv")
        file.write("1.0\n")
        file.close({})
    assert file.path == (tmp_path / "kept" / "best.csv" if asked[0] == "/" else Path("kept", "best.csv"))
    assert file.path.read_text().endswith("0.0\n1.0\n# {}\n")


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="this system does not tell the name of an open file")
def test_the_summary_names_a_recording_that_was_renamed(
    linkpose: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    close = CsvFile.close

    def rename_and_close(file: CsvFile, closing: Mapping[str, Any]) -> None:
        file.path.rename(f"new-{file.path}")
        close(file, closing)

    monkeypatch.setattr(CsvFile, "close", rename_and_close)
    done = linkpose("record", "r.csv", "--port", "sim://link?speed=0", "--duration", 1)
    assert "corrupt: new-r.csv\nnext: linkpose estimate new-r.csv" in done.err
    done = linkpose("estimate", "new-r.csv", "--filter", "tilt", "-o", "e.csv")
    assert "rows of tilt: new-e.csv\nnext: linkpose plot new-e.csv" in done.err
    done = linkpose("estimate", "--live", "--port", "sim://link?speed=0", "--duration", 1, "-o", "f.csv")
    assert "corrupt: new-f.csv\nnext: linkpose plot new-f.csv" in done.err
