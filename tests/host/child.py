"""A command in a process of its own, forked from one that has everything imported: 30 ms instead of a second.

Its standard streams may be closed, full or without a reader, and a signal may arrive at an exact place in the program.
"""

from __future__ import annotations

import contextlib
import functools
import io
import multiprocessing
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

PRELOADED = [
    "linkpose.cli", "linkpose.live_estimation", "linkpose.plotting", "linkpose.cli.live", "linkpose.localization.paths",
    "linkpose.simulation.export", "linkpose.device.session", "linkpose.evaluation.longfiles", "matplotlib.figure",
    "matplotlib.backends.backend_agg", "linkpose.plotting.tables", "linkpose.localization.localizer",
    "linkpose.localization.tuning", "linkpose.calibration.joint", "linkpose.filters.tilt", "scipy.optimize",
]  # fmt: skip
# Processor time of a command: whether it hangs must not depend on what else runs. The first command that uses a filter
# also compiles it.
LONGEST_S = 120.0
LONGEST_WAIT_S = 600  # by the clock, above pytest's limit for a test: a command that waits for ever does not outlive it


class Ended(NamedTuple):
    """How a command ended: its status (negative: the signal that ended it), and what it wrote, as far as it could."""

    status: int
    out: str
    err: str


@functools.cache
def _context() -> Any:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    return context


def run(
    folder: Path,
    words: Sequence[object],
    streams: dict[int, str] | None = None,
    signalled: tuple[str, int] | None = None,
    longest_s: float = LONGEST_S,
    most_bytes: int | None = None,
    environment: dict[str, str] | None = None,
) -> Ended:
    """Runs `linkpose WORDS` in a folder, with these variables of the environment changed.

    `streams` maps numbers of standard streams to "closed", "full" or "gone" (a pipe whose reader has ended).
    `signalled` names a function of the program, as MODULE.NAME, at whose first call this signal arrives. SIGPROF
    ends a command that takes longer (processor time). `most_bytes` bounds its memory beside what is imported.
    """
    texts = [str(word) for word in words]
    arguments = (str(folder), texts, streams or {}, signalled, longest_s, most_bytes, environment or {})
    process = _context().Process(target=_main, args=arguments)
    process.start()
    process.join()
    out, err = ((folder / name).read_text(encoding="utf-8", errors="replace") for name in ("out", "err"))
    return Ended(process.exitcode, out, err)


def _main(
    folder: str,
    words: list[str],
    streams: dict[int, str],
    signalled: tuple[str, int] | None,
    longest_s: float,
    most_bytes: int | None,
    environment: dict[str, str],
) -> None:
    """In the child: the process becomes the command."""
    os.environ.update(environment)
    signal.setitimer(signal.ITIMER_PROF, longest_s)
    signal.alarm(LONGEST_WAIT_S)
    if most_bytes is not None:
        limit_memory(most_bytes)
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        signal.signal(getattr(signal, name), signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL)
    os.chdir(folder)
    for number, name in ((0, os.devnull), (1, "out"), (2, "err")):
        _redirect(number, name, "")
    for number, kind in streams.items():
        _redirect(number, "", kind)
    sys.stdin, sys.stdout, sys.stderr = (_text(number, streams) for number in range(3))
    sys.argv = ["linkpose", *words]
    if signalled:
        _signal_at(*signalled)
    os._exit(_status())


def limit_memory(most_bytes: int | None) -> None:
    """Bounds the address space of this process to what is mapped now, and so much more; None lifts the bound."""
    import resource  # Windows has none

    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (hard if most_bytes is None else used + most_bytes, hard))


def _redirect(number: int, name: str, kind: str) -> None:
    if kind == "closed":
        os.close(number)
        return
    if kind == "gone":
        reader, other = os.pipe()
        os.close(reader)
    else:
        flags = os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_TRUNC
        other = os.open("/dev/full" if kind == "full" else name, flags, 0o600)
    if other != number:
        os.dup2(other, number)
        os.close(other)


def _text(number: int, streams: dict[int, str]) -> Any:
    """As Python makes them at its start; None for a closed one."""
    if streams.get(number) == "closed":
        return None
    raw = io.FileIO(number, "r" if number == 0 else "w", closefd=False)
    if number == 0:
        return io.TextIOWrapper(io.BufferedReader(raw), "utf-8")
    return io.TextIOWrapper(io.BufferedWriter(raw), "utf-8", line_buffering=number == 2)


def _signal_at(place: str, number: int) -> None:
    module, _, name = place.rpartition(".")
    of = sys.modules.get(module) or __import__(module, fromlist=[name])
    real = getattr(of, name)

    def and_signal(*args: Any, **more: Any) -> Any:
        setattr(of, name, real)
        signal.raise_signal(number)
        return real(*args, **more)

    setattr(of, name, and_signal)


def _status() -> int:
    """The command's exit status, as Python gives it: 120 where what is left in stdout cannot be written at the end."""
    from linkpose.cli import main

    try:
        main()
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 0
    except KeyboardInterrupt:
        status = 130
    except BaseException:
        import traceback

        with contextlib.suppress(Exception):
            traceback.print_exc()
        status = 1
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except (OSError, ValueError):
        status = 120
    with contextlib.suppress(OSError, ValueError):
        if sys.stderr is not None:
            sys.stderr.flush()
    return status
