"""A CSV file that survives: metadata ahead, rows handed over as they come, whole rows only, a closing line.

# linkpose <kind> 1
# {"...": "metadata, JSON"}
time_s,...
0.000000,...
# {"...": "closing metadata, JSON"}

A plain file has the header and the rows only. Its metadata are beside it: run.meta.json beside run.csv.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import os
import stat
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from linkpose.errors import CannotWrite, FileChanged, FileError, FileExists

STDOUT = Path("-")  # as an output: the standard output
_COPIED_BYTES = 1 << 20  # at once


def head(kind: str, metadata: Mapping[str, Any], columns: Sequence[str]) -> str:
    """The three lines before the rows."""
    return f"# linkpose {kind} 1\n# {json.dumps(metadata)}\n{','.join(columns)}\n"


def metadata_path(path: Path) -> Path:
    """Where the metadata of a plain file are: run.meta.json for run.csv."""
    return path.with_suffix(".meta.json")


class CsvFile:
    """Writes such a file. Also a context manager: leaving it without `close` leaves out the closing line.

    Raises LinkposeError where the file cannot be made or written; what was written before stays whole and readable.
    """

    def __init__(
        self,
        path: Path,
        kind: str,
        metadata: Mapping[str, Any],
        columns: Sequence[str],
        force: bool,
        plain: bool = False,
    ) -> None:
        """`plain` writes no comment lines, and the metadata beside the file, or nowhere for STDOUT."""
        self.path = self._asked = path
        self._is_plain, self._fd = plain, -1
        self._start = ",".join(columns) + "\n" if plain else head(kind, metadata, columns)
        self._beside: dict[str, Any] | None = {"kind": kind, "metadata": metadata, "closing": None} if plain else None
        if path == STDOUT:
            self._beside = None
        self._open(force)
        self.write(self._start)

    def write(self, text: str | bytes) -> None:
        """Adds whole lines, in UTF-8. The operating system has them at once: killing this process does not lose them.

        Raises FileChanged, and writes nothing, when another program has changed the file.
        """
        if self._is_own:
            check_unchanged(self._fd, self.path)
        write_all(self._fd, self.path, text.encode() if isinstance(text, str) else text)

    def continue_elsewhere(self) -> None:
        """Goes on in a new file after FileChanged: run-2.csv for run.csv, or the next number that is free.

        The new file begins with the rows so far if the old one was removed, and with the head alone if another program
        changed its content. Raises CannotWrite and FileError.
        """
        has_all_rows = not _is_changed(self._fd)
        with os.fdopen(self._fd, "rb") as old:
            self._fd = -1
            for path in numbered(self._asked):
                self.path = path
                with contextlib.suppress(FileExists):
                    self._open(force=False)
                    break
            if has_all_rows:
                old.seek(0)
                while part := old.read(_COPIED_BYTES):
                    write_all(self._fd, self.path, part)
            else:
                self.write(self._start)

    def close(self, closing: Mapping[str, Any]) -> None:
        """Writes what is left and the closing line, and waits until the disk has it."""
        if not self._is_plain:
            self.write(f"# {json.dumps(closing)}\n")
        elif self._beside is not None:
            self._beside["closing"] = closing
            self._write_beside()
        with contextlib.suppress(OSError):  # a pipe cannot be synced
            os.fsync(self._fd)
        self._release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._fd >= 0:
            self._release()

    def _open(self, force: bool) -> None:
        """Creates the file, and the one of the metadata beside it."""
        if self._beside is not None:
            os.close(create(metadata_path(self.path), force))
        self._fd = create(self.path, force)
        self._is_own = os.fstat(self._fd).st_nlink > 0  # what is behind /dev/stdout may have no name
        self._write_beside()

    def _write_beside(self) -> None:
        """Writes the metadata of a plain file."""
        if self._beside is not None:
            path = metadata_path(self.path)
            try:
                path.write_text(json.dumps(self._beside) + "\n", encoding="utf-8")
            except OSError as error:
                raise CannotWrite(path, error.strerror) from error

    def _release(self) -> None:
        os.close(self._fd)
        self._fd = -1


def numbered(path: Path) -> Iterator[Path]:
    """Further names for a file: run-2.csv, run-3.csv and so on for run.csv."""
    return (path.with_stem(f"{path.stem}-{number}") for number in itertools.count(2))


def create(path: Path, force: bool) -> int:
    """Opens a new file for writing and gives its descriptor. An existing one is kept unless `force`.

    STDOUT gives a duplicate of the standard output's descriptor.
    """
    if path == STDOUT:
        return _standard_output()
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL
    try:
        if path.exists() and not path.is_file():  # a pipe or a device, such as /dev/stdout
            flags = os.O_WRONLY
        elif force:
            path = Path(os.path.realpath(path))  # a link stays a link, and may point to no file
            path.unlink(missing_ok=True)  # who still writes the old file notices, and does not write into the new one
        return os.open(path, flags | getattr(os, "O_BINARY", 0), 0o666)
    except FileExistsError:
        if force:  # another program created it in between; the last one has the name
            return create(path, force)
        raise FileExists(path) from None
    except OSError as error:
        raise CannotWrite(path, error.strerror) from error


def _standard_output() -> int:
    """A duplicate of the standard output's descriptor, after what is buffered for it was written."""
    try:
        sys.stdout.flush()
        return os.dup(1)
    except OSError as error:
        raise CannotWrite("the standard output", error.strerror) from error


def check_unchanged(fd: int, path: Path) -> None:
    """Raises FileChanged when another program removed the file, or changed its size.

    A pipe or a device has no size, and other programs may write what is behind the standard output.
    """
    of = os.fstat(fd)
    if path == STDOUT or not stat.S_ISREG(of.st_mode):
        return
    if of.st_nlink == 0:
        raise FileChanged(path, "it was removed while it was being written")
    if _is_changed(fd):
        raise FileChanged(path, "another program changed it while it was being written")


def _is_changed(fd: int) -> bool:
    """Whether the file does not end where this program's next byte goes."""
    return os.fstat(fd).st_size != os.lseek(fd, 0, os.SEEK_CUR)


def write_all(fd: int, path: Path, data: bytes) -> None:
    """Writes all of `data`, or cuts the file back to its last whole line and raises LinkposeError."""
    left = memoryview(data)
    written = 0
    try:
        while len(left):
            count = os.write(fd, left)
            written += count
            left = left[count:]
    except OSError as error:
        if written:
            _cut_back(fd, data[:written])
        name = "the standard output" if path == STDOUT else path
        if error.errno == errno.EPIPE:
            raise FileError(path, f"the reader of {name} has gone; nothing more can be written to it") from error
        raise FileError(
            path,
            f"cannot write to {name} any more: {error.strerror}; what was written so far is whole, "
            "make room or name a file on another disk",
        ) from error


def _cut_back(fd: int, written: bytes) -> None:
    """Removes a partial last line that a full disk left behind."""
    partial = len(written) - (written.rfind(b"\n") + 1)
    with contextlib.suppress(OSError):
        os.ftruncate(fd, os.lseek(fd, -partial, os.SEEK_END))
