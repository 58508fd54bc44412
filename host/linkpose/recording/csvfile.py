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
import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from linkpose.errors import CannotWrite, FileExists
from linkpose.outputs import (
    STDOUT,
    check_unchanged,
    create,
    is_changed,
    name_now,
    numbered,
    replace_file,
    synchronise,
    write_all,
)

_COPIED_BYTES = 1 << 20  # at once


def head(kind: str, metadata: Mapping[str, Any], columns: Sequence[str]) -> str:
    """The three lines before the rows."""
    return f"# linkpose {kind} 1\n# {json.dumps(metadata)}\n{','.join(columns)}\n"


def tail(closing: Mapping[str, Any]) -> str:
    """The line after the rows."""
    return f"# {json.dumps(closing)}\n"


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
        changed its content. Where the folder takes no new file, the system's folder for temporary files does: the rows
        of a removed file are lost once it is closed. Raises CannotWrite and FileError.
        """
        has_all_rows = not is_changed(self._fd)
        before = self._fd  # stays in use where no new file can be created
        try:
            self._open_numbered(self._asked)
        except CannotWrite:
            with contextlib.suppress(FileNotFoundError):  # no such folder is there either
                self._open_numbered(Path(tempfile.gettempdir(), self._asked.name))
            if self._fd == before:
                raise
        with os.fdopen(before, "rb") as old:
            if has_all_rows:
                old.seek(0)
                while part := old.read(_COPIED_BYTES):
                    write_all(self._fd, self.path, part)
            else:
                self.write(self._start)

    def close(self, closing: Mapping[str, Any]) -> None:
        """Writes what is left and the closing line, and waits until the disk has it. `path` is the file's name then."""
        if not self._is_plain:
            self.write(tail(closing))
        elif self._beside is not None:
            self._beside["closing"] = closing
            self._write_beside()
        self.path = name_now(self._fd, self.path)
        try:
            synchronise(self._fd)
            self._release()
        except OSError as error:
            raise CannotWrite(self.path, error.strerror) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._fd >= 0:
            self._release()

    def _open_numbered(self, path: Path) -> None:
        """Creates the file, under the first of the further names for `path` that is free."""
        for name in numbered(path):
            self.path = name
            with contextlib.suppress(FileExists):
                self._open(force=False)
                return

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
                replace_file(path, json.dumps(self._beside) + "\n")
            except OSError as error:
                raise CannotWrite(path, error.strerror) from error

    def _release(self) -> None:
        descriptor, self._fd = self._fd, -1
        os.close(descriptor)
