"""Standard streams that may be closed, full or without a reader, and whose terminal obeys escape sequences.

A message that cannot be shown is dropped, because the measurement is worth more than the message. A result that cannot
be written is a failure with one sentence. On a terminal, control characters from files and devices are shown as text,
whichever way they come; what moves the cursor itself writes to `unfiltered`.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO, cast

from linkpose.cli import characters
from linkpose.errors import LinkposeError, printable


class _Stream:
    """A text stream whose failures are handled. Everything else is the stream's own."""

    def __init__(self, stream: TextIO, is_filtered: bool = True) -> None:
        self._stream = stream
        self._is_filtered = is_filtered and stream.isatty()

    def unfiltered(self) -> _Stream:
        """The stream for text that may move the cursor."""
        return type(self)(self._stream, is_filtered=False)

    def _shown(self, text: str) -> str:
        """As it may be written; bytes, with which click finds out the kind of a stream, are left to fail."""
        return printable(text) if self._is_filtered and isinstance(text, str) else text

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class _Messages(_Stream):
    """Drops what cannot be written."""

    def write(self, text: str) -> int:
        try:
            return self._stream.write(self._shown(text))
        except (OSError, ValueError):
            _discard(self._stream)
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except (OSError, ValueError):
            _discard(self._stream)


class _Results(_Stream):
    """Raises LinkposeError for what cannot be written."""

    def write(self, text: str) -> int:
        if text == "":  # click writes an empty text to test the stream, which fails on a full disk
            return 0
        with self._failing_well():
            return self._stream.write(self._shown(text))

    def flush(self) -> None:
        with self._failing_well():
            self._stream.flush()

    @contextlib.contextmanager
    def _failing_well(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            _discard(self._stream)
            if error.errno in (errno.EPIPE, errno.EINVAL):  # EINVAL: Windows
                raise LinkposeError("the reader of the output has gone; stopped") from None
            raise LinkposeError(f"cannot write the output: {error.strerror}; write it to another place") from None


def unfiltered(stream: TextIO) -> TextIO:
    """The stream for text that may move the cursor, and holds nothing from a file or a device that is not printable."""
    return cast(TextIO, stream.unfiltered()) if isinstance(stream, _Stream) else stream


def _discard(stream: TextIO) -> None:
    """What is still buffered goes nowhere: Python would try, and fail, to write it at the end."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class _Closed:
    """Takes the place of a stdout that was closed before the start."""

    encoding, errors = "utf-8", "strict"

    def write(self, _text: str) -> int:
        raise _closed()

    def flush(self) -> None:
        """Nothing is buffered."""

    def fileno(self) -> int:
        raise _closed()

    def isatty(self) -> bool:
        return False


def _closed() -> LinkposeError:
    return LinkposeError("cannot write the output: stdout is closed; write it to a file or a pipe")


def _occupy_closed() -> None:
    """Opens the null device as each standard stream that is closed.

    The next file that is opened would get the stream's number, and what another program or a library in C writes to the
    stream would go into that file.
    """
    with contextlib.suppress(OSError):
        while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
            os.set_inheritable(number, True)
        os.close(number)


@contextlib.contextmanager
def safe_streams() -> Iterator[None]:
    """Within this context, stdout and stderr fail as this module describes."""
    before = sys.stdout, sys.stderr
    _occupy_closed()
    characters.register()
    for stream in before:  # a code page without σ or −, as on Windows: a character is replaced, nothing fails
        if isinstance(stream, io.TextIOWrapper):
            characters.prepare(stream)
    nowhere = open(os.devnull, "w", encoding="utf-8") if sys.stderr is None else None  # noqa: SIM115, PTH123
    sys.stdout = cast(TextIO, _Closed() if sys.stdout is None else _Results(sys.stdout))
    sys.stderr = cast(TextIO, _Messages(nowhere or before[1]))
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
        if nowhere is not None:
            nowhere.close()
