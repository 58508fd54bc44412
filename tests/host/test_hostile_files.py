"""Nasty files, devices and places at every file argument of every command: one sentence, or a result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click
import pytest
from fuzzing import check
from hostile import INPUTS, KINDS, OUTPUTS, PLACES, valid_files, words
from test_consistency import ALL

from linkpose import inputs

# Each argument gets every eighth kind, and each kind is at every eighth argument. tests/fuzz.py runs all pairs.
SHARE = 8


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return valid_files(tmp_path_factory.mktemp("valid"))


def test_each_file_argument_is_in_a_table() -> None:
    """A new command or option with a file fails here."""
    expected = set()
    for name, command in ALL.items():
        for each in command.params:
            if isinstance(each.type, click.Path) or type(each.type).__name__ == "ErrorsType":
                shown = each.opts[0] if isinstance(each, click.Option) else each.make_metavar(click.Context(command))
                expected.add(f"{name} {shown.strip('[].')}")
    assert {*INPUTS, *OUTPUTS} == expected


@pytest.mark.parametrize("argument", INPUTS)
def test_a_nasty_input_is_a_sentence(
    tmp_path: Path, files: dict[str, Path], linkpose: Callable, monkeypatch: pytest.MonkeyPatch, argument: str
) -> None:
    monkeypatch.setattr(inputs, "PIPE_WAIT_S", 0.0)
    first = list(INPUTS).index(argument) % SHARE
    for number, kind in enumerate(list(KINDS)[first::SHARE]):
        (folder := tmp_path / str(number)).mkdir()
        KINDS[kind](at := folder / "a.csv")
        result = linkpose(*words(INPUTS[argument], files, at))
        check(result.status, result.err)


@pytest.mark.parametrize("argument", OUTPUTS)
def test_a_nasty_output_is_a_sentence(
    tmp_path: Path, files: dict[str, Path], linkpose: Callable, argument: str
) -> None:
    first = list(OUTPUTS).index(argument) % 4
    for number, place in enumerate(list(PLACES)[first::4]):
        (folder := tmp_path / str(number)).mkdir()
        PLACES[place](at := folder / "a.csv")
        result = linkpose(*words(OUTPUTS[argument], files, at))
        check(result.status, result.err)
