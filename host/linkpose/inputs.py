"""Opens what a user names as a file: a file, a pipe, a device, or nothing at all."""

from __future__ import annotations

import contextlib
import io
import os
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from linkpose.errors import CannotRead

# A program that writes into a named pipe must start within this time. Doubled, a forgotten pipe is reported later.
PIPE_WAIT_S = 3.0
# What is read as a whole: a pipe, and files of kinds that are small or cannot be read in parts. Reading takes several
# times as much memory; doubled, it takes more than 1 GB.
MOST_BYTES = 200_000_000
_POLL_S = 0.02
_READ_SIZE = 1 << 20

_pipes: dict[tuple[int, int, int], bytes] = {}  # read already, by device, inode and time of the last write


def open_binary(path: Path, what: str = "") -> BinaryIO:
    """The file, opened at its start. A pipe is read to its end first, and gives the same bytes when opened again.

    `what` names the kind of file in a message, such as "the log". Raises CannotRead, also for a device such as
    /dev/zero, and for a pipe into which no program writes.
    """
    try:
        mode = path.stat().st_mode
        if stat.S_ISFIFO(mode):
            return io.BytesIO(_pipe(path, what))
        if stat.S_ISCHR(mode) or stat.S_ISBLK(mode):
            raise CannotRead(path, "it is a device, not a file", what)
        return io.BufferedReader(_File(path, what))
    except OSError as error:
        raise CannotRead(path, error.strerror, what) from error


class _File(io.FileIO):
    """A file whose failures while it is read are CannotRead: a disk that fails, a network file system that has gone."""

    def __init__(self, path: Path, what: str) -> None:
        super().__init__(path)
        self._path, self._what = path, what

    def readinto(self, buffer: Any) -> int | None:
        with self._failing_well():
            return super().readinto(buffer)

    def readall(self) -> bytes:
        with self._failing_well():
            return super().readall()

    @contextlib.contextmanager
    def _failing_well(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise CannotRead(self._path, error.strerror, self._what) from error


def read_bytes(path: Path, what: str = "") -> bytes:
    """All bytes of a file. Raises CannotRead, also for one that is larger than MOST_BYTES."""
    with open_binary(path, what) as file:
        data = file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise CannotRead(path, f"it is larger than {MOST_BYTES // 10**6} MB, and files of its kind are not", what)
    return data


def _pipe(path: Path, what: str) -> bytes:
    """What is or was written into a pipe."""
    if (kept := _pipes.get(_identity(path))) is not None:
        return kept
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))  # without it, this waits for a writer
    try:
        data = _read_pipe(descriptor, path, what)
    finally:
        os.close(descriptor)
    _pipes[_identity(path)] = data
    return data


def _read_pipe(descriptor: int, path: Path, what: str) -> bytes:
    parts: list[bytes] = []
    size, waited_s = 0, 0.0
    while True:
        try:
            part = os.read(descriptor, _READ_SIZE)
        except BlockingIOError:  # a program has opened it for writing, and has not written yet
            os.set_blocking(descriptor, True)
            continue
        if not part and size:
            return b"".join(parts)
        if not part:
            if waited_s >= PIPE_WAIT_S:
                raise CannotRead(path, "it is a pipe, and no program writes into it", what)
            time.sleep(_POLL_S)
            waited_s += _POLL_S
            continue
        parts.append(part)
        size += len(part)
        if size > MOST_BYTES:
            raise CannotRead(path, f"it is a pipe with more than {MOST_BYTES // 10**6} MB; save it to a file", what)


def _identity(path: Path) -> tuple[int, int, int]:
    of = path.stat()
    return of.st_dev, of.st_ino, of.st_mtime_ns
