"""The short LLVM code does what Python does with the same function: to the last bit, also where numba's is left out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from linkpose import lean_compiler
from linkpose.compiling import compiled, inner

PART = np.dtype([("place", np.complex128), ("counts", np.int32, (4,)), ("is_on", np.bool_)], align=True)
STATE = np.dtype(
    [("values", np.float64, (3,)), ("matrix", np.float64, (3, 4)), ("parts", PART, (2,)), ("n", np.int64), ("x", "f4")],
    align=True,
)


@pytest.fixture
def states() -> np.ndarray:
    made, rng = np.zeros(2, dtype=STATE), np.random.default_rng(0)
    made["values"], made["matrix"] = rng.normal(size=(2, 3)), rng.normal(size=(2, 3, 4))
    made["parts"]["counts"], made["parts"]["place"] = rng.integers(-99, 99, (2, 2, 4)), 1.0 + 2.0j
    made["n"], made["x"] = 3, 0.3
    return made


@compiled
def fields(states: Any) -> float:
    state, other = states[1], states[-2]
    state.n += 2
    x = state.n / 7
    state.x = x  # kept in 32 bits
    other.parts[1].place += complex(x, 1.0)
    other.parts[0].is_on = state.n > 4
    values, matrix = state.values, other.matrix
    values[0] = 1  # an integer into an array of floats
    other.values[2] += values[0] ** 2 + values[-1] ** 2 - x**2
    return matrix[0, 0] + matrix[-1, -1] + other.parts[1].place.real + other.parts[0].is_on


@compiled
def items(states: Any, at: int, row: Any) -> float:
    state, total = states[0], 0.0
    for k in range(-3, 3):
        state.values[k] += k
        total += state.matrix[k, at] * row[k] - state.matrix[at, k + 1]
        state.parts[k % 2].counts[k] = row[at] * 10.0
    counts, last = state.parts[-1].counts, row[len(row) - 1 :]
    view = state.matrix[1]
    view[at] += 1.0
    return total + counts[at] + counts[3] + last[0] + view[0] + row[::2][-1] + state.matrix[1][at]


@compiled
def loops(first: int, end: int, step: int) -> tuple[int, int, int, int]:
    plain = ranged = stepped = nested = 0
    for k in range(end):
        if k == 7:
            break
        plain += k
    for k in range(first, end):
        ranged = 3 * ranged + k
        for i in range(k):
            nested += i
            if i > 4:
                continue
            nested -= 1
    for k in range(first, end, step):
        stepped = 3 * stepped + k
    steps = range(first, end)
    return plain, ranged + len(steps), stepped, nested


@inner
def _refuse(value: float) -> float:
    if value < 0.0:
        raise ValueError("negative")
    return value


@inner
def _pass_on(value: float, times: int) -> float:
    total = 0.0
    for _ in range(times):
        total += _refuse(value) + _refuse(value + 1.0)
    return total


@inner
def _perhaps(value: float) -> float | None:
    return None if value > 1.0 else value


@compiled
def calls(value: float, times: int = 2) -> float:
    found = _perhaps(value)
    return (100.0 if found is None else found) + _pass_on(value, times)


@pytest.mark.parametrize("at", [-3, -1, 0, 2])
def test_fields_and_items_are_those_of_python(states, at):
    row = np.array([0.1, 0.7, -1.3])
    for function, arguments in ((fields, ()), (items, (at, row)), (items, (at, np.repeat(row, 2)[::2]))):
        theirs = states.copy().view(np.recarray)
        assert function(states, *arguments) == function.py_func(theirs, *arguments)
        np.testing.assert_array_equal(states, theirs)


@pytest.mark.parametrize("arguments", [(0, 5, 2), (-3, 9, 4), (4, 1, -1), (5, 5, 1), (3, -2, 1), (-9, -2, 3)])
def test_loops_are_those_of_python(arguments):
    assert loops(*arguments) == loops.py_func(*arguments)


def test_a_loop_over_steps_of_zero_is_refused():
    with pytest.raises(ValueError, match="must not be zero"):
        loops(0, 5, 0)


def test_calls_hand_on_results_and_exceptions():
    assert (calls(0.25), calls(2.0, 1)) == (0.25 + 2 * 1.5, 100.0 + 5.0)
    assert calls(-0.5, 0) == -0.5
    for _ in range(2):
        with pytest.raises(ValueError, match="negative"):
            calls(-0.5)


@inner
def power(base: float, exponent: int) -> float:
    return base**exponent


@compiled
def powers(base: float, exponent: int) -> float:
    return power(base, 3) + power(base, exponent) + power(base=base, exponent=2)


def test_constants_and_numbers_are_one_type() -> None:
    assert powers(2.0, 4) == 8.0 + 16.0 + 4.0
    assert len(power.signatures) == 1


def test_a_caller_remembers_what_it_knew_before_its_callee_was_compiled() -> None:
    before = lean_compiler._functions.get_call_type
    with lean_compiler._remembering():
        with lean_compiler._remembering():
            pass
        assert lean_compiler._functions.get_call_type is lean_compiler._remembered_call_type
    assert lean_compiler._functions.get_call_type is before
