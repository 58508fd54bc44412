"""Writes what a user names as an output: a file, the standard output, a pipe or a device.

Other users can put links into a folder that everybody can write, such as /tmp. A link there that belongs to another
user is refused, as Linux refuses to follow it (fs.protected_symlinks): with the rights of this user, it would replace a
file that the other user may not write.
"""

from __future__ import annotations

import contextlib
import errno
import io
import itertools
import os
import stat
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

from linkpose.errors import CannotWrite, FileChanged, FileError, FileExists, NamedTwice

STDOUT = Path("-")  # as an output: the standard output
_BINARY = getattr(os, "O_BINARY", 0)
_NOT_SYNCED = (errno.EINVAL, errno.ENOTSUP, errno.EROFS)  # what fsync gives for a pipe, a socket or a device


def numbered(path: Path) -> Iterator[Path]:
    """Further names for a file: run-2.csv, run-3.csv and so on for run.csv."""
    return (path.with_stem(f"{path.stem}-{number}") for number in itertools.count(2))


def check_outputs(paths: Iterable[Path], force: bool) -> None:
    """Raises FileError where two of the files are one, one exists and `force` is not set, or its folder is not there
    or not open to this user.

    Called before the work whose results the files take: nobody waits for minutes to learn that a file exists.
    """
    named = [(path, path if path == STDOUT else path.absolute()) for path in paths]
    for path, place in named:
        if [other for _, other in named].count(place) > 1:
            raise NamedTwice(path)
        if path == STDOUT:
            continue
        try:
            is_folder, is_file = path.is_dir(), path.is_file()
            has_folder = place.parent.is_dir()
        except OSError as error:  # a folder that is closed to this user, a name that is too long
            raise CannotWrite(path, error.strerror) from error
        if is_folder:
            raise CannotWrite(path, "it is a folder")
        if is_file and not force:
            raise FileExists(path)
        if not has_folder:
            raise CannotWrite(path, f"there is no folder {place.parent}")


def create(path: Path, force: bool) -> int:
    """Opens a new file for writing and gives its descriptor. An existing one is kept unless `force`.

    A file that replaces one of this user has the mode of the old one. STDOUT gives a duplicate of the standard output's
    descriptor. Raises FileExists and CannotWrite, also for a disk such as /dev/sda and for a link of another user.
    """
    if path == STDOUT:
        return _standard_output()
    try:
        target = _target(path)
        if target is not None and not stat.S_ISREG(target.st_mode):  # a pipe or a device, such as /dev/stdout
            return os.open(path, os.O_WRONLY | _BINARY)
        if not force:
            return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | _BINARY, 0o666)
        path = Path(os.path.realpath(path))  # a link stays a link, and may point to no file
        path.unlink(missing_ok=True)  # who still writes the old file notices, and does not write into the new one
        return _open_as_before(path, target)
    except FileExistsError:
        if force:  # another program created it in between; the last one has the name
            return create(path, force)
        raise FileExists(path) from None
    except FileNotFoundError as error:
        is_there = path.parent.exists()  # not by its absolute name: the current folder may have been removed
        raise CannotWrite(
            path, error.strerror if is_there else f"there is no folder {path.absolute().parent}"
        ) from error
    except OSError as error:
        raise CannotWrite(path, error.strerror) from error


@contextlib.contextmanager
def new_file(path: Path, force: bool) -> Iterator[BinaryIO]:
    """A new file, as `create` makes it, to be filled within this context. It is removed where that fails.

    Raises FileExists, and CannotWrite also for what fails within the context by the system.
    """
    descriptor = create(path, force)
    try:
        with os.fdopen(descriptor, "wb") as file:
            yield file
            file.flush()
            synchronise(file.fileno())
    except BaseException as error:
        with contextlib.suppress(OSError):
            if path != STDOUT and path.is_file():
                path.unlink()
        if isinstance(error, OSError) and error.errno == errno.EPIPE:
            raise _without_reader(path) from error
        if isinstance(error, OSError):
            raise CannotWrite(_shown(path), error.strerror) from error
        raise


def replace_file(path: Path, text: str) -> None:
    """Writes `text` to `path`, completely or not at all: through a temporary file in the same folder.

    A file of this user keeps its mode, and a symbolic link its target. Raises OSError.
    """
    target = _target(path)
    path = path.resolve()
    if target is not None and not stat.S_ISREG(target.st_mode):
        raise OSError(errno.EINVAL, "it is not a file")
    descriptor, partial = tempfile.mkstemp(prefix=f".{path.name}."[:100], dir=path.parent)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        mode = _mode_of_own(target)
        Path(partial).chmod(0o666 & ~_umask() if mode is None else mode)
        Path(partial).replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            Path(partial).unlink()
        raise


def check_unchanged(fd: int, path: Path) -> None:
    """Raises FileChanged when another program removed the file, or changed its size.

    A pipe or a device has no size, and other programs may write what is behind the standard output.
    """
    try:
        of = os.fstat(fd)
    except OSError:  # a network folder is gone: the next write reports it
        return
    if path == STDOUT or not stat.S_ISREG(of.st_mode):
        return
    if of.st_nlink == 0:
        raise FileChanged(path, "it was removed while it was being written")
    if is_changed(fd):
        raise FileChanged(path, "another program changed it while it was being written")


def is_changed(fd: int) -> bool:
    """Whether the file does not end where this program's next byte goes."""
    return os.fstat(fd).st_size != os.lseek(fd, 0, os.SEEK_CUR)


def name_now(fd: int, path: Path) -> Path:
    """The name of an open file, which another program may have renamed; `path` where the system does not tell."""
    with contextlib.suppress(OSError):
        of = os.fstat(fd)
        if path == STDOUT or not stat.S_ISREG(of.st_mode) or _is_at(path, of):
            return path
        found = Path(f"/proc/self/fd/{fd}").readlink()
        if _is_at(found, of):
            return found if path.is_absolute() else Path(os.path.relpath(found))
    return path


def _is_at(path: Path, of: os.stat_result) -> bool:
    try:
        return os.path.samestat(path.stat(), of)
    except OSError:
        return False


def write_all(fd: int, path: Path, data: bytes) -> None:
    """Writes all of `data`, or cuts the file back to its last whole line and raises FileError."""
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
        if error.errno == errno.EPIPE:
            raise _without_reader(path) from error
        raise FileError(
            path,
            f"cannot write to {_shown(path)} any more: {error.strerror}; what was written so far is whole, "
            "make room or name a file on another disk",
        ) from error


def _shown(path: Path) -> str:
    """The name of an output in a message."""
    return "the standard output" if path == STDOUT else str(path)


def _without_reader(path: Path) -> FileError:
    return FileError(path, f"the reader of {_shown(path)} has gone; nothing more can be written to it")


def synchronise(fd: int) -> None:
    """Waits until the disk has what was written. Raises OSError: a network file system reports a full disk here."""
    try:
        os.fsync(fd)
    except OSError as error:
        if error.errno not in _NOT_SYNCED:
            raise


def _target(path: Path) -> os.stat_result | None:
    """What is at the path, behind links; None for nothing.

    Raises CannotWrite for a disk, which would be overwritten, and for a link that another user has put there.
    """
    with contextlib.suppress(FileNotFoundError):
        link, folder = os.lstat(path), path.absolute().parent.stat()
        if stat.S_ISLNK(link.st_mode) and _is_planted(link, folder):
            raise CannotWrite(path, "it is a link of another user in a folder that everybody can write")
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    if stat.S_ISBLK(found.st_mode):
        raise CannotWrite(path, "it is a disk")
    return found


def _is_planted(link: os.stat_result, folder: os.stat_result) -> bool:
    return bool(
        hasattr(os, "geteuid") and folder.st_mode & stat.S_IWOTH and link.st_uid not in (os.geteuid(), folder.st_uid)
    )


def _open_as_before(path: Path, old: os.stat_result | None) -> int:
    """A new file with the mode of the old one."""
    mode = _mode_of_own(old)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | _BINARY, 0o666 if mode is None else 0o600)
    if mode is not None:
        os.fchmod(descriptor, mode)
    return descriptor


def _mode_of_own(old: os.stat_result | None) -> int | None:
    """The mode of a file; None for none, and for one of another user, who could read or write the new one by it."""
    if old is None or not hasattr(os, "geteuid") or old.st_uid != os.geteuid():
        return None
    return stat.S_IMODE(old.st_mode) & 0o777


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _standard_output() -> int:
    """A duplicate of the standard output's descriptor, after what is buffered for it was written."""
    try:
        sys.stdout.flush()
        return os.dup(_descriptor())
    except OSError as error:
        raise CannotWrite("the standard output", error.strerror) from error


def _descriptor() -> int:
    """The standard output's, also where a notebook or a test has put another object in its place."""
    try:
        return sys.stdout.fileno()
    except io.UnsupportedOperation:
        return 1


def _cut_back(fd: int, written: bytes) -> None:
    """Removes a partial last line that a full disk left behind."""
    partial = len(written) - (written.rfind(b"\n") + 1)
    with contextlib.suppress(OSError):
        os.ftruncate(fd, os.lseek(fd, -partial, os.SEEK_END))
