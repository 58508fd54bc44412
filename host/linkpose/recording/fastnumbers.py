"""The compiled parser of numbers in long files: the same values as Python's `float`, to the last bit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled
from linkpose.sensors.measurements import Floats

# A number of at most 15 digits is an exact integer in a float64, and so is 10¹⁵: their quotient is rounded once, as
# IEEE 754 requires of the decimal number.
_MOST_DIGITS = 15
_POWERS: Floats = np.array([10.0**power for power in range(_MOST_DIGITS + 1)])
_NEWLINE, _RETURN, _COMMA, _MINUS, _POINT, _ZERO = 10, 13, 44, 45, 46, 48


@compiled
def _parse(data: NDArray[np.uint8], powers: Floats, out: Floats) -> bool:
    """Fills `out` (columns, rows); False unless `data` has this shape, and numbers of at most 15 digits."""
    columns, rows = out.shape
    size = len(data)
    at = 0
    for row in range(rows):
        for column in range(columns):
            begin = at
            negative = at < size and data[at] == _MINUS
            if negative:
                at += 1
            mantissa = np.int64(0)
            digits = decimals = 0
            has_point = False
            while at < size:
                digit = np.int64(data[at]) - _ZERO
                if 0 <= digit <= 9:
                    mantissa = 10 * mantissa + digit
                    digits += 1
                    decimals += has_point
                elif data[at] == _POINT and not has_point:
                    has_point = True
                else:
                    break
                at += 1
            if digits > _MOST_DIGITS or (digits == 0 and at > begin):
                return False
            if digits:
                value = mantissa / powers[decimals]
                out[column, row] = -value if negative else value
            else:
                out[column, row] = np.nan
            if column == columns - 1 and at + 1 < size and data[at] == _RETURN:
                at += 1
            if at >= size or data[at] != (_NEWLINE if column == columns - 1 else _COMMA):
                return False
            at += 1
    return at == size


def parse(body: bytes, width: int) -> Floats | None:
    """The rows as an array (width, N), NaN for an empty field; None for anything that only `float` can read."""
    out = np.empty((width, body.count(b"\n")))
    return out if _parse(np.frombuffer(body, np.uint8), _POWERS, out) else None
