"""The command line as a user types it, in this process."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from typing import NamedTuple

import pytest
from hypothesis import settings

from linkpose.cli import main
from linkpose.device.ports import register_scheme

# The first example may wait for a compiler.
settings.register_profile("linkpose", deadline=None)
settings.load_profile("linkpose")
# A shell starts its background jobs with SIGINT ignored, and children inherit that: the commands under test would, too.
signal.signal(signal.SIGINT, signal.default_int_handler)
register_scheme("linkpose.simulation")  # tests open sim:// through the device layer too


class Result(NamedTuple):
    """What a command left behind."""

    status: int
    out: str
    err: str


@pytest.fixture
def linkpose(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Result]:
    """Runs `linkpose ARGUMENTS...`; an exception that is no sentence for the user fails the test."""
    monkeypatch.setenv("LINKPOSE_DEBUG", "1")

    def run(*arguments: object) -> Result:
        monkeypatch.setattr(sys, "argv", ["linkpose", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        code = end.value.code
        return Result(code if isinstance(code, int) else 0, *capsys.readouterr())

    return run


@pytest.fixture
def refused(linkpose: Callable[..., Result]) -> Callable[..., str]:
    """Runs a command that must be refused: status 1 or 2 and one sentence, which it gives."""

    def run(*arguments: object) -> str:
        result = linkpose(*arguments)
        assert result.status in (1, 2), result
        assert result.out == ""
        sentence = result.err.strip().splitlines()[-1]
        assert "Traceback" not in result.err
        return sentence

    return run
