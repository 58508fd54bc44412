"""Running another program and passing its output on as it comes."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Callable, Sequence
from typing import IO, cast


def follow(command: Sequence[str], environment: dict[str, str] | None, show: Callable[[str], None]) -> tuple[int, str]:
    """Run a program to its end; return its exit status and its whole output (stdout and stderr together).

    `show` receives each new piece of output. An exception, such as Ctrl-C, ends the program and its children. Raises
    OSError for a program that cannot be run.
    """
    process = subprocess.Popen(
        command,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,  # Ctrl-C reaches linkpose only, and the children can be ended together
    )
    output = ""
    try:
        with cast(IO[bytes], process.stdout) as stdout:  # Popen opens it for PIPE
            while chunk := os.read(stdout.fileno(), 4096):
                text = chunk.decode("utf-8", "replace")
                output += text
                show(text)
        return process.wait(), output
    finally:
        _end(process)


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
