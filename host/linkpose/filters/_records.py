"""Arrays of records: the form in which compiled steps keep their state and read their parameters."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


def zeros(count: int, dtype: np.dtype[Any]) -> Any:
    """An array (count,) of records, all 0. The fields of an element are attributes too: `records[0].time`.

    The array is no numpy.recarray: at each call of a compiled function, numba takes 12 µs for the type of one, and
    0.2 µs for that of an array.
    """
    return np.zeros(count, np.dtype((np.record, dtype)))


def fields(**lengths: int) -> np.dtype[Any]:
    """The type of a record of vectors of float64, such as `fields(time=2, rate=3)`.

    A state is one array of such a record, and not a named tuple of arrays: at each call of a compiled function, numba
    takes 3 µs for the latter, as long as a filter takes for ten samples, and 0.1 µs for an array.
    """
    return np.dtype([(name, "f8", (length,)) for name, length in lengths.items()])


def record_of(parameters: NamedTuple) -> Any:
    """Parameters, all numbers, as an array of one record, which compiled code reads by name through one pointer."""
    dtype = np.dtype([(name, "f8") for name in parameters._fields], align=True)
    records = zeros(1, dtype)
    records[0] = tuple(parameters)
    return records
