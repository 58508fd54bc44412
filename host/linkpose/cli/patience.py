"""Tells a user who waits for the compiler that it is at work."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator

PATIENCE_S = 0.7  # before the user is told what is going on


@contextlib.contextmanager
def while_compiling(say: Callable[[str], object]) -> Iterator[None]:
    """Says that the filters are being compiled when that takes long enough to be wondered at: the first time."""
    timer = threading.Timer(PATIENCE_S, say, ["compiling the filters, this once (some seconds) ..."])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
