"""Tells a user who waits for the compiler that it is at work."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Callable, Iterator

import click

PATIENCE_S = 0.7  # before the user is told what is going on

_to_stderr = functools.partial(click.echo, err=True)


@contextlib.contextmanager
def while_compiling(say: Callable[[str], object] = _to_stderr) -> Iterator[None]:
    """Says that the filters are being compiled when that takes long enough to be wondered at: the first time."""
    timer = threading.Timer(PATIENCE_S, say, ["compiling the filters, this once (some seconds) ..."])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
