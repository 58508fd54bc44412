"""Running another program while listening to it."""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import subprocess
import threading
from collections.abc import Callable, Sequence

LISTEN_INTERVAL_S = 0.2


def follow(
    command: Sequence[str], environment: dict[str, str] | None, listen: Callable[[str], bool]
) -> tuple[int | None, str]:
    """Runs a program to its end; its exit status and all it said.

    `listen` gets what was newly said (stdout and stderr together) several times a second, also when that is nothing.
    When it returns False the program and its children are ended, and the status is None. Raises OSError for a program
    that cannot be run.
    """
    process = subprocess.Popen(
        command,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,  # Ctrl-C is ours, and the children can be ended together
    )
    said: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    reader = threading.Thread(target=_read, args=(process, said), name="linkpose-follow", daemon=True)
    reader.start()
    output = ""
    try:
        while True:
            try:
                chunk = said.get(timeout=LISTEN_INTERVAL_S)
            except queue.Empty:
                chunk = None
            text = (chunk or b"").decode("utf-8", "replace")
            output += text
            if chunk == b"":
                return process.wait(), output
            if not listen(text):
                return None, output
    finally:
        _end(process)
        reader.join(timeout=1.0)


def _read(process: subprocess.Popen[bytes], said: queue.SimpleQueue[bytes]) -> None:
    """Passes on what the program says as it comes; b"" when it has ended."""
    assert process.stdout is not None
    with process.stdout as stdout:
        while chunk := os.read(stdout.fileno(), 4096):
            said.put(chunk)
    said.put(b"")


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is not None:
        return
    with contextlib.suppress(ProcessLookupError):
        if os.name == "posix":
            os.killpg(process.pid, signal.SIGTERM)
        else:
            process.terminate()
    try:
        process.wait(timeout=2.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
