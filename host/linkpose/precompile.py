"""Compiles filters in separate processes, so that a board can be read at once.

numba holds Python's global interpreter lock while it compiles: in this process, samples would wait. The other process
(`python -m linkpose.precompile NAME...`) keeps the machine code on disk, from where this process loads it in a moment.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Sequence

from linkpose import compiling, filters

# The name of what writes estimates as text: every run needs it, whatever its filters.
TEXT = "text"


class Precompilation:
    """Filters on their way to being compiled. A context manager: leaving it ends the processes."""

    def __init__(self, names: Sequence[str]) -> None:
        """Starts to compile those of `names` that are not compiled yet, in two processes.

        One compiles the inertial filters, which share their steps and take longest. The other compiles the rest, those
        that take least first, so that a first estimate appears soon.
        """
        self._names = [*names, TEXT]
        self._processes: dict[str, subprocess.Popen[bytes]] = {}  # by name of a filter
        if not compiling.can_keep_code():
            return
        missing = [name for name in reversed(self._names) if not compiling.is_compiled(name)]
        inertial = [name for name in missing if name.endswith("-inertial")]
        for group in (inertial, [name for name in missing if name not in inertial]):
            if not group:
                continue
            command = [sys.executable, "-m", "linkpose.precompile", *group]
            with contextlib.suppress(OSError):  # no other process: each filter is compiled here when it is first used
                process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
                self._processes |= dict.fromkeys(group, process)

    def is_ready(self, name: str) -> bool:
        """Whether a filter can run without waiting for the compiler; also if nothing compiles it any more."""
        process = self._processes.get(name)
        return process is None or compiling.is_compiled(name) or process.poll() is not None

    @property
    def waiting(self) -> list[str]:
        """The filters that are not ready."""
        return [name for name in self._names if not self.is_ready(name)]

    @property
    def progress(self) -> str:
        """A line for the user; empty when all filters are ready."""
        waiting = self.waiting
        if not waiting:
            return ""
        done = len(self._names) - len(waiting)
        return f"Compiling filters (first run only) {done + 1}/{len(self._names)} {waiting[0]}"

    def wait(self) -> None:
        """Waits until the other processes have ended."""
        for process in self._processes.values():
            process.wait()

    def __enter__(self) -> Precompilation:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes.values():
            if process.poll() is None:
                process.terminate()
                process.wait()


def compile_here(name: str) -> None:
    """Compiles a filter, or the writer of text, in this process, or loads it; notes that its code is kept."""
    if name == TEXT:
        import numpy as np

        from linkpose.recording.fixedpoint import format_rows

        format_rows(np.zeros((1, 1)), np.zeros(1, dtype=np.int64))
    else:
        filters.warm_up([name])
    compiling.mark_compiled(name)


if __name__ == "__main__":
    for each in sys.argv[1:]:
        compile_here(each)
