"""Every reader on damaged files: one sentence, or what the file holds; `tests/fuzz.py` does the same for longer."""

from __future__ import annotations

import collections
import random

import pytest
from fuzzing import READ, commands, read_mutated, targets
from mutations import mutate

INPUTS = 120  # a reader
FEWER = {"c3d": 12}  # each is read by a process of its own
COMMANDS = 12  # inputs for each command
# Damage tests what lies behind the first steps of a reader only if enough files pass them.
LEAST_READ = 0.05
MOST_REFUSED_AT_ONE_PLACE = 0.6


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
    inputs = FEWER.get(name, INPUTS)
    ends = collections.Counter(read_mutated(target, mutate(valid, rng, target.inside)) for _ in range(inputs))
    assert ends[READ] >= LEAST_READ * inputs, ends
    del ends[READ]
    assert max(ends.values()) <= MOST_REFUSED_AT_ONE_PLACE * inputs, ends


@pytest.mark.parametrize("name", ["estimate", "info", "evaluate", "plot", "convert", "localize", "localize-beacons"])
def test_a_command_on_a_damaged_file_ends_with_a_sentence(tmp_path, name):
    target, rng = commands(tmp_path)[name], random.Random(f"{name} 1")
    valid = target.valid.read_bytes()
    assert target.read(target.valid) == 0
    for _ in range(COMMANDS):
        read_mutated(target, mutate(valid, rng, target.inside))
