"""Every reader on damaged files: one sentence, or what the file holds; `tests/fuzz.py` does the same for longer."""

from __future__ import annotations

import random

import pytest
from fuzzing import commands, mutate, read_mutated, targets

INPUTS = 120  # a reader
FEWER = {"c3d": 12}  # each is read by a process of its own
COMMANDS = 12  # inputs for each command


@pytest.fixture(scope="module")
def readers(tmp_path_factory):
    return targets(tmp_path_factory.mktemp("fuzz"))


@pytest.mark.parametrize(
    "name",
    [
        "recording", "raw", "parquet", "estimate", "truth", "picture", "motive", "c3d", "trc", "rig", "map",
        "map-image", "carmen", "beacons", "events", "robot-truth", "hex",
    ],
)  # fmt: skip
def test_a_damaged_file_is_read_or_refused_with_a_sentence(readers, name):
    target, rng = readers[name], random.Random(f"{name} 1")
    valid = target.valid.read_bytes()
    target.read(target.valid)
    for _ in range(FEWER.get(name, INPUTS)):
        read_mutated(target, mutate(valid, rng))


@pytest.mark.parametrize("name", ["estimate", "info", "evaluate", "plot", "convert", "localize", "localize-beacons"])
def test_a_command_on_a_damaged_file_ends_with_a_sentence(tmp_path, name):
    target, rng = commands(tmp_path)[name], random.Random(f"{name} 1")
    valid = target.valid.read_bytes()
    assert target.read(target.valid) == 0
    for _ in range(COMMANDS):
        read_mutated(target, mutate(valid, rng))
