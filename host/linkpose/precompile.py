"""Compiles filters in separate processes, so that a board can be read at once and both cores are used.

numba holds Python's global interpreter lock while it compiles: in this process, samples would wait. The other processes
(`python -m linkpose.precompile NAME...`) store the machine code on disk, from where this process loads it in a moment.
host/build_package.py runs the same command when pip builds a wheel.
"""

from __future__ import annotations

import contextlib
import gc
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, cast

from linkpose import compiling, filters
from linkpose.sensors.devices import Sensors

# The name of what writes estimates as text: every run needs it, whatever its filters.
TEXT = "text"
# The name of the search for the noises of a log, which `localize` runs before a filter.
NOISES = "noises"
# The name of the parsers of long CSV files and of raw captures.
FILES = "files"
POLL_S = 0.05  # between two looks at what the other processes have compiled

# Ctrl-C reaches all processes of a terminal's group. Those that compile would each end with a traceback.
_APART: dict[str, Any] = {"start_new_session": True}
if sys.platform == "win32":
    _APART = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}


class Precompilation:
    """Filters on their way to being compiled. A context manager: leaving it ends the processes."""

    def __init__(self, names: Sequence[str]) -> None:
        """Starts to compile those of `names` that are not compiled yet, in two processes.

        One compiles the inertial filters, which share their steps and take longest. The other compiles the rest: first
        the last, which takes least, so that a first estimate appears soon; the writer of text after it. Filters that
        need a second inertial sensor come next.
        """
        self._names = list(names)
        self._processes: dict[str, subprocess.Popen[bytes]] = {}  # by name of a filter
        self._ready: set[str] = set()  # filters once found ready: the question comes with each sample
        if not compiling.can_keep_code():
            return
        order = list(reversed(self._names))
        order[1:] = sorted(order[1:], key=lambda name: not _needs_second_sensor(name))
        missing = [name for name in [*order[:1], TEXT, *order[1:]] if not compiling.is_compiled(name)]
        inertial = [name for name in missing if name.endswith("-inertial")]
        for group in (inertial, [name for name in missing if name not in inertial]):
            if not group:
                continue
            command = [sys.executable, "-m", "linkpose.precompile", *group]
            with contextlib.suppress(OSError):  # no other process: each filter is compiled here when it is first used
                process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, **_APART)
                self._processes |= dict.fromkeys(group, process)

    def is_ready(self, name: str) -> bool:
        """Whether a filter can run without waiting for the compiler; also if nothing compiles it any more."""
        if name not in self._ready:
            process = self._processes.get(name)
            if process is None or compiling.is_compiled(name) or process.poll() is not None:
                self._ready.add(name)
        return name in self._ready

    def load(self) -> None:
        """Loads the machine code if all filters have it (0.2 s), so that the first samples do not wait for it."""
        if not self._processes and compiling.can_keep_code():
            for name in [*self._names, TEXT]:
                _run_once(name)

    @property
    def waiting(self) -> list[str]:
        """The filters, and TEXT, that are not ready."""
        return [name for name in [*self._names, TEXT] if not self.is_ready(name)]

    @property
    def progress(self) -> str:
        """A line for the user; empty when all filters are ready."""
        waiting = self.waiting
        if not waiting:
            return ""
        total = len(self._names)
        done = sum(map(self.is_ready, self._names))
        what = waiting[0] if waiting[0] != TEXT else "the CSV writer"
        return f"Compiling filters (first run only) {min(done + 1, total)}/{total} {what}"

    def wait(self, report: Callable[[str], object]) -> None:
        """Waits until the other processes have ended; `report` receives each new line of progress."""
        before = ""
        while (text := self.progress) or any(process.poll() is None for process in self._processes.values()):
            if text and text != before:
                report(text)
                before = text
            time.sleep(POLL_S)

    def __enter__(self) -> Precompilation:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes.values():
            if process.poll() is None:
                process.terminate()
                process.wait()


def _needs_second_sensor(name: str) -> bool:
    able = filters.capabilities(name)
    return able is not None and bool(able.sensors & Sensors.IMU2)


def prepare(names: Sequence[str], report: Callable[[str], object]) -> None:
    """Returns when the filters, or methods of localization, are compiled. Does nothing where all are.

    `report` receives lines such as "Compiling filters (first run only) 3/6 joint-inertial".
    """
    if all(map(compiling.is_compiled, [*names, TEXT])):
        return
    if not compiling.can_keep_code():
        report("Compiling filters (in each run, because no folder for the machine code is writable)")
        return
    with Precompilation(names) as compilation:
        compilation.wait(report)


def compile_here(name: str) -> None:
    """Compiles a filter, a method of localization, TEXT, NOISES or FILES in this process, and marks it as stored."""
    _run_once(name)
    compiling.mark_compiled(name)


def _run_once(name: str) -> None:
    """Runs what `name` stands for on a few values, so that its machine code is compiled or loaded."""
    if name == TEXT:
        import numpy as np

        from linkpose.recording.fixedpoint import format_rows

        format_rows(np.zeros((1, 1)), np.zeros(1, dtype=np.int64))
    elif name == FILES:
        from linkpose.recording import fastnumbers
        from linkpose.wire import capture

        fastnumbers.parse(b"0\n", 1)
        capture.decode_capture(b"\0")
    elif name in filters.NAMES:
        filters.warm_up([name])
    elif name == NOISES:
        from linkpose.localization import tuning

        tuning.warm_up()
    else:
        from linkpose.localization import localizer

        localizer.warm_up([cast(localizer.Method, name)])


def _save_time() -> None:
    """For a process that only compiles: no searches for garbage, and no BLAS, which numba looks for in scipy.

    Both together took 0.8 s of CPU. No compiled function here multiplies matrices by BLAS.
    """
    gc.disable()
    sys.modules["scipy"] = None  # type: ignore[assignment]


if __name__ == "__main__":
    _save_time()
    for each in sys.argv[1:]:
        compile_here(each)
