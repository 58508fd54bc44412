"""Feeds damaged files to every reader for long.

    python tests/fuzz.py [--inputs N] [--seed S] [NAME ...]

Without NAME, every reader gets N inputs (default 100 000), the commands get N together, and each file argument of each
command gets all nasty files of hostile.py ("arguments"). NAME is a reader, "command NAME", "commands" or "arguments".
An input fails when it raises anything but a LinkposeError, warns, takes more than 10 s of processor time or 60 s, or
needs more than 1 GB. Failing inputs are kept in fuzz-failures/, and the status is 1.

Each line of output also tells how many inputs were read to their end, how many lines of linkpose refused the others,
and which of them most: inputs that all fail at one place test nothing behind it.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import itertools
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

sys.path[:0] = [str(Path(__file__).parent / "host"), str(Path(__file__).parents[1] / "host")]

import child  # noqa: E402
from fuzzing import READ, Target, check, commands, read_mutated, targets  # noqa: E402
from hostile import INPUTS, KINDS, OUTPUTS, PLACES, valid_files, words  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from mutations import mutate  # noqa: E402

from linkpose.evaluation import markers  # noqa: E402

LONGEST_S = 10  # of processor time: an answer to whether a reader hangs must not depend on what else runs
LONGEST_WAIT_S = 60  # for a reader that waits; a second in which this process was suspended for longer counts as one
MOST_BYTES = 1 << 30
PAIRS_PROGRESS = 100
PROGRESS = 10_000  # inputs between two lines that tell how far a run has come
DRAWN = 10  # of so many pictures that a command makes, one is drawn: that takes 100 times as long as reading its file


class TooLong(BaseException):
    """An input took longer than LONGEST_S; no reader may catch it."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("names", nargs="*")
    chosen = parser.parse_args()
    signal.signal(signal.SIGPROF, _too_long)
    failures = 0
    workers = SimpleNamespace(run=_Workers().run, TimeoutExpired=subprocess.TimeoutExpired)  # all that markers uses
    with tempfile.TemporaryDirectory() as folder, mock.patch.object(markers, "subprocess", workers):
        readers = {name: (target, chosen.inputs) for name, target in targets(Path(folder)).items()}
        whole = commands(Path(folder))
        share = -(-chosen.inputs // len(whole))
        readers |= {f"command {name}": (target, share) for name, target in whole.items()}
        for name, (target, inputs) in readers.items():
            if not {name, name.split()[0] + "s"}.isdisjoint(chosen.names or [name]):
                failures += _run(name, target, inputs, chosen.seed)
        if not chosen.names or "arguments" in chosen.names:
            failures += _arguments(Path(folder))
    return 1 if failures else 0


def _arguments(folder: Path) -> int:
    """All nasty inputs and outputs of hostile.py, each in a process of its own, as a user runs it."""
    (valid := folder / "valid").mkdir()
    files, failures = valid_files(valid), 0
    pairs = [(command, kind, make) for command in INPUTS.values() for kind, make in KINDS.items()]
    pairs += [(command, kind, make) for command in OUTPUTS.values() for kind, make in PLACES.items()]
    ends: collections.Counter[int] = collections.Counter()
    for number, (command, kind, make) in enumerate(pairs, 1):
        (own := folder / f"arguments-{number}").mkdir()
        make(at := own / "a.csv")
        done = _bounded(own, words(command, files, at))
        ends[done.status] += 1
        try:
            check(done.status, done.err)
        except AssertionError:
            failures += 1
            print(f"arguments: {command} with {kind}: status {done.status}: {done.err[-300:]!r}", flush=True)
        if number % PAIRS_PROGRESS == 0:
            print(f"arguments: {number} of {len(pairs)}, {failures} failures", file=sys.stderr, flush=True)
    print(f"{'arguments':24} {len(pairs)} inputs, {failures} failures, by status {dict(ends)}", flush=True)
    return failures


def _bounded(folder: Path, arguments: list[str]) -> child.Ended:
    """A command within the bounds; once more where it took too long, as the first run compiles what is missing."""
    done = child.run(folder, arguments, longest_s=LONGEST_S, most_bytes=MOST_BYTES)
    if done.status != -signal.SIGPROF:
        return done
    child.run(folder, arguments)
    return child.run(folder, arguments, longest_s=LONGEST_S, most_bytes=MOST_BYTES)


def _run(name: str, target: Target, inputs: int, seed: int) -> int:
    rng = random.Random(f"{name} {seed}")
    valid = target.valid.read_bytes()
    read_mutated(target, valid)  # compiles and imports
    child.limit_memory(MOST_BYTES)
    failures, began, slowest = 0, time.monotonic(), 0.0
    kinds: collections.Counter[str] = collections.Counter()
    ends: collections.Counter[str] = collections.Counter()
    for number in range(inputs):
        data = mutate(valid, rng, target.inside)
        started = time.process_time()
        try:
            with _timers(), _some_drawn(number):
                ends[read_mutated(target, data)] += 1
            if time.process_time() - started > LONGEST_S:
                raise TooLong  # in machine code, during which Python runs no handler
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            failures += 1
            place = traceback.extract_tb(error.__traceback__)[-1]
            kind = f"{type(error).__name__} at {Path(place.filename).name}:{place.lineno}"
            kinds[kind] += 1
            if kinds[kind] == 1:
                _keep(name, number, target.valid.suffix, data)
                traceback.print_exception(error)
        slowest = max(slowest, time.process_time() - started)
        if (number + 1) % PROGRESS == 0 and number + 1 < inputs:
            print(f"{name}: {number + 1} of {inputs} inputs, {failures} failures", file=sys.stderr, flush=True)
    child.limit_memory(None)
    took = time.monotonic() - began
    read = ends.pop(READ, 0)
    most = "; ".join(f"{place} {count / inputs:.0%}" for place, count in ends.most_common(3))
    print(
        f"{name:24} {inputs} inputs, {failures} failures, {took:.0f} s, slowest {slowest:.2f} s; {read / inputs:.0%} "
        f"read, the others refused at {len(ends)} places ({most}) {dict(kinds) or ''}",
        flush=True,
    )
    return failures


@contextlib.contextmanager
def _timers() -> Iterator[None]:
    """Raises TooLong when the body takes too long."""
    seconds = itertools.count(1)
    signal.signal(signal.SIGALRM, lambda *_: _too_long() if next(seconds) >= LONGEST_WAIT_S else None)
    signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
    signal.setitimer(signal.ITIMER_REAL, 1, 1)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)


def _some_drawn(number: int) -> contextlib.AbstractContextManager[object]:
    if number % DRAWN == 0:
        return contextlib.nullcontext()
    return mock.patch.object(Figure, "savefig", lambda *_, **__: None)


# Runs programs of the form `python -c PROGRAM WORDS`, which read a C3D file each, in a fork that has the libraries and
# serves until one of them ends it: a new process for each file takes 0.4 s.
_WORKERS = """
import io, json, os, signal, sys
import ezc3d, numpy
numpy.savez(io.BytesIO(), a=0)  # imports what it needs

def answer(*content):
    os.write(1, json.dumps(content).encode() + b"\\n")

def serve():
    while request := os.read(0, 65536):  # a pipe gives it whole: it is short, and the next one waits for the answer
        program, words, timeout = json.loads(request)
        signal.setitimer(signal.ITIMER_PROF, timeout)
        sys.argv = ["-c", *words]
        try:
            exec(program, {})
        except BaseException as error:
            answer(1, f"{type(error).__name__}: {error}")
        else:
            answer(0, "")
        signal.setitimer(signal.ITIMER_PROF, 0)
    os._exit(0)

code = None
while code != 0:
    pid = os.fork()
    if pid == 0:
        serve()
    if code := os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]):
        answer(code, "")
"""


class _Workers:
    """In place of `subprocess.run`."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self._process = subprocess.Popen([sys.executable, "-c", _WORKERS], **pipes)

    def run(self, command: list[str], timeout: float, **_: Any) -> subprocess.CompletedProcess[str]:
        assert self._process.stdin and self._process.stdout
        self._process.stdin.write(json.dumps([command[2], command[3:], timeout]))
        self._process.stdin.flush()
        try:
            code, errors = json.loads(self._process.stdout.readline())
        except BaseException:  # the next answer would be that to this request
            self._process.kill()
            self._start()
            raise
        if code == -signal.SIGPROF:
            raise subprocess.TimeoutExpired(command, timeout)
        return subprocess.CompletedProcess(command, code, "", errors)


def _too_long(*_: object) -> None:
    raise TooLong


def _keep(name: str, number: int, suffix: str, data: bytes) -> None:
    folder = Path("fuzz-failures")
    folder.mkdir(exist_ok=True)
    (folder / f"{name.replace(' ', '-')}-{number}{suffix}").write_bytes(data)


if __name__ == "__main__":
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # no library's warnings may reach a user
        warnings.simplefilter("ignore", ResourceWarning)  # Python shows it to nobody
        sys.exit(main())
