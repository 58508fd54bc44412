"""Numbers as text with a fixed count of decimals, compiled: the same text live and replayed, and fast."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled

_WIDEST = 22  # sign, 19 digits, point, separator
_LARGEST = 9.2e18  # that a 64-bit integer holds
_COMMA, _NEWLINE, _MINUS, _POINT, _ZERO = 44, 10, 45, 46, 48


@compiled
def _format(values: NDArray[np.float64], decimals: NDArray[np.int64], out: NDArray[np.uint8]) -> int:
    """Writes rows of comma-separated numbers into `out`; the length. Missing or huge values are empty fields."""
    at = 0
    digits = np.empty(20, np.uint8)
    rows, columns = values.shape
    for row in range(rows):
        for column in range(columns):
            places = decimals[column]
            scaled = values[row, column] * 10.0**places
            if abs(scaled) < _LARGEST:  # False for NaN
                whole = np.int64(np.rint(abs(scaled)))
                if scaled < 0 and whole:
                    out[at] = _MINUS
                    at += 1
                count = 0
                while whole or count <= places:
                    digits[count] = _ZERO + whole % 10
                    whole //= 10
                    count += 1
                for i in range(count - 1, -1, -1):
                    out[at] = digits[i]
                    at += 1
                    if i == places and places:
                        out[at] = _POINT
                        at += 1
            out[at] = _COMMA if column < columns - 1 else _NEWLINE
            at += 1
    return at


def format_rows(values: NDArray[np.float64], decimals: NDArray[np.int64]) -> str:
    """Rows of a CSV from values (N, M) with `decimals` (M,) places behind the point; NaN gives an empty field."""
    out = np.empty(values.size * _WIDEST, np.uint8)
    length = _format(np.ascontiguousarray(values), decimals, out)
    return out[:length].tobytes().decode("ascii")
