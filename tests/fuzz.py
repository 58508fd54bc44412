"""Feeds damaged files to every reader for long.

    python tests/fuzz.py [--inputs N] [--seed S] [NAME ...]

Without NAME, every reader and every command gets N inputs (default 100 000; a fiftieth for commands), and each file
argument of each command gets all nasty files of hostile.py ("arguments"). An input fails
when it raises anything but a LinkposeError, takes more than 10 s, or needs more than 1 GB. Failing inputs are kept in
fuzz-failures/, and the status is 1.
"""

from __future__ import annotations

import argparse
import json
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

sys.path[:0] = [str(Path(__file__).parent / "host"), str(Path(__file__).parents[1] / "host")]

from fuzzing import Target, commands, mutate, read_mutated, targets  # noqa: E402
from hostile import INPUTS, KINDS, OUTPUTS, PLACES, check, valid_files, words  # noqa: E402

from linkpose.evaluation import markers  # noqa: E402

LONGEST_S = 10
MOST_BYTES = 1 << 30
COMMAND_SHARE = 50


class TooLong(BaseException):
    """An input took longer than LONGEST_S; no reader may catch it."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("names", nargs="*")
    chosen = parser.parse_args()
    signal.signal(signal.SIGALRM, _alarm)
    failures = 0
    forks = SimpleNamespace(run=_Forks().run, TimeoutExpired=subprocess.TimeoutExpired)  # all that markers uses of it
    with tempfile.TemporaryDirectory() as folder, mock.patch.object(markers, "subprocess", forks):
        readers = {name: (target, chosen.inputs) for name, target in targets(Path(folder)).items()}
        for name, target in commands(Path(folder)).items():
            readers[f"command {name}"] = (target, max(1, chosen.inputs // COMMAND_SHARE))
        for name, (target, inputs) in readers.items():
            if not chosen.names or name in chosen.names:
                failures += _run(name, target, inputs, chosen.seed)
        if not chosen.names or "arguments" in chosen.names:
            failures += _arguments(Path(folder))
    return 1 if failures else 0


def _arguments(folder: Path) -> int:
    """All nasty inputs and outputs of hostile.py, each in a process of its own, as a user runs it."""
    (valid := folder / "valid").mkdir()
    files, failures, slowest = valid_files(valid), 0, 0.0
    pairs = [(command, kind, make) for command in INPUTS.values() for kind, make in KINDS.items()]
    pairs += [(command, kind, make) for command in OUTPUTS.values() for kind, make in PLACES.items()]
    for number, (command, kind, make) in enumerate(pairs):
        (own := folder / f"arguments-{number}").mkdir()
        make(at := own / "a.csv")
        started = time.monotonic()
        bad, shown = False, ""
        call = [sys.executable, "-m", "linkpose", *words(command, files, at)]
        try:
            done = subprocess.run(
                call, capture_output=True, text=True, timeout=3 * LONGEST_S, errors="replace", stdin=subprocess.DEVNULL
            )
            check(done.returncode, done.stderr)
        except AssertionError:
            bad, shown = True, f"status {done.returncode}: {done.stderr[-300:]!r}"
        except subprocess.TimeoutExpired:
            bad, shown = True, "no end"
        slowest = max(slowest, time.monotonic() - started)
        if bad:
            failures += 1
            print(f"arguments: {command} with {kind}: {shown}", flush=True)
    print(f"{'arguments':22} {len(pairs)} inputs, {failures} failures, slowest {slowest:.2f} s", flush=True)
    return failures


def _run(name: str, target: Target, inputs: int, seed: int) -> int:
    rng = random.Random(f"{name} {seed}")
    valid = target.valid.read_bytes()
    read_mutated(target, valid)  # compiles and imports
    _limit_memory()
    failures, began, slowest = 0, time.monotonic(), 0.0
    kinds: dict[str, int] = {}
    for number in range(inputs):
        data = mutate(valid, rng)
        started = time.monotonic()
        signal.alarm(LONGEST_S)
        try:
            read_mutated(target, data)
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            signal.alarm(0)
            failures += 1
            place = traceback.extract_tb(error.__traceback__)[-1]
            kind = f"{type(error).__name__} at {Path(place.filename).name}:{place.lineno}"
            kinds[kind] = kinds.get(kind, 0) + 1
            if kinds[kind] == 1:
                _keep(name, number, target.valid.suffix, data)
                traceback.print_exception(error)
        signal.alarm(0)
        slowest = max(slowest, time.monotonic() - started)
    _limit_memory(unlimited=True)
    took = time.monotonic() - began
    print(
        f"{name:22} {inputs} inputs, {failures} failures, {took:.0f} s, slowest {slowest:.2f} s {kinds or ''}",
        flush=True,
    )
    return failures


# Runs a program of the form `python -c PROGRAM WORDS`, which reads a C3D file, in a fork that has the libraries.
# A new interpreter for each file takes 0.4 s.
_FORKS = """
import io, json, os, resource, signal, sys, tempfile
import ezc3d, numpy
numpy.savez(io.BytesIO(), a=0)  # imports what it needs
for line in sys.stdin:
    program, words, timeout = json.loads(line)
    with tempfile.TemporaryFile() as errors:
        pid = os.fork()
        if pid == 0:
            signal.setitimer(signal.ITIMER_REAL, timeout)
            os.dup2(errors.fileno(), 2)
            sys.argv = ["-c", *words]
            try:
                exec(program, {})
            except BaseException as error:
                os.write(2, f"{type(error).__name__}: {error}".encode(errors="replace"))
                os._exit(1)
            os._exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        errors.seek(0)
        print(json.dumps([code, errors.read().decode(errors="replace")]), flush=True)
"""


class _Forks:
    """In place of `subprocess.run`."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def run(self, command: list[str], timeout: float, **_: Any) -> subprocess.CompletedProcess[str]:
        if self._process is None:
            pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
            self._process = subprocess.Popen([sys.executable, "-c", _FORKS], **pipes)
        assert self._process.stdin and self._process.stdout
        self._process.stdin.write(json.dumps([command[2], command[3:], timeout]) + "\n")
        self._process.stdin.flush()
        code, errors = json.loads(self._process.stdout.readline())
        if code == -signal.SIGALRM:
            raise subprocess.TimeoutExpired(command, timeout)
        return subprocess.CompletedProcess(command, code, "", errors)


def _alarm(*_: object) -> None:
    raise TooLong


def _limit_memory(unlimited: bool = False) -> None:
    """Address space: what is mapped now, and MOST_BYTES."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (hard if unlimited else used + MOST_BYTES, hard))


def _keep(name: str, number: int, suffix: str, data: bytes) -> None:
    folder = Path("fuzz-failures")
    folder.mkdir(exist_ok=True)
    (folder / f"{name.replace(' ', '-')}-{number}{suffix}").write_bytes(data)


if __name__ == "__main__":
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # NumPy's warnings must not reach a user
        sys.exit(main())
