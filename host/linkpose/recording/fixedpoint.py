"""Numbers as text with a fixed count of decimals, compiled: the same text live and replayed, and fast."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled

_WIDEST = 22  # sign, 19 digits, point, separator
_LARGEST = 9.2e18  # that a 64-bit integer holds
_COMMA, _NEWLINE, _MINUS, _POINT, _ZERO = 44, 10, 45, 46, 48
_MOST_DIGITS = 19
_POWERS: NDArray[np.float64] = np.array([10.0**power for power in range(_MOST_DIGITS)])
_TENS: NDArray[np.uint64] = np.array([10**power for power in range(_MOST_DIGITS)], np.uint64)
# Rows at once: their text stays in the processor's cache. Doubling it changes nothing that can be measured.
_ROWS = 4096


@compiled
def _format(
    values: NDArray[np.float64],
    decimals: NDArray[np.int64],
    powers: NDArray[np.float64],
    tens: NDArray[np.uint64],
    out: NDArray[np.uint8],
) -> int:
    """Writes rows of comma-separated numbers into `out`; the length. Missing or huge values are empty fields."""
    at = 0
    ten = np.uint64(10)
    rows, columns = values.shape
    for row in range(rows):
        for column in range(columns):
            places = decimals[column]
            scaled = values[row, column] * powers[places]
            if abs(scaled) < _LARGEST:  # False for NaN
                whole = np.uint64(np.rint(abs(scaled)))
                if scaled < 0 and whole:
                    out[at] = _MINUS
                    at += 1
                count = places + 1
                while count < _MOST_DIGITS and whole >= tens[count]:
                    count += 1
                end = at + count + (1 if places else 0)
                place = end - 1
                for digit in range(count):  # from the last one
                    if digit == places and places:
                        out[place] = _POINT
                        place -= 1
                    rest = whole // ten
                    out[place] = _ZERO + np.uint8(whole - ten * rest)
                    whole = rest
                    place -= 1
                at = end
            out[at] = _COMMA if column < columns - 1 else _NEWLINE
            at += 1
    return at


def format_rows(values: NDArray[np.float64], decimals: NDArray[np.int64]) -> bytes:
    """Rows of a CSV from values (N, M) with `decimals` (M,) places behind the point; NaN gives an empty field."""
    values = np.ascontiguousarray(values)
    out = np.empty(values[:_ROWS].size * _WIDEST, np.uint8)
    pieces = []
    for start in range(0, len(values), _ROWS):
        length = _format(values[start : start + _ROWS], decimals, _POWERS, _TENS, out)
        pieces.append(out[:length].tobytes())
    return b"".join(pieces)
