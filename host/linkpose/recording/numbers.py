"""Rows of numbers between commas, as linkpose writes them, to arrays."""

from __future__ import annotations

import numpy as np

from linkpose.sensors.measurements import Floats

# Text of this length is parsed by compiled code: below it, numpy takes less time than loading numba (about 0.5 s).
# Doubling it adds 0.5 s to files of that size.
_LONG = 6_000_000


def parse_rows(body: bytes, width: int) -> Floats | None:
    """The rows as an array (width, N), NaN for an empty field; None unless each row has `width` numbers."""
    if len(body) >= _LONG:
        from linkpose.recording.fastnumbers import parse

        found = parse(body, width)
        if found is not None:
            return found
    return _parse_by_numpy(body, width)


def _parse_by_numpy(body: bytes, width: int) -> Floats | None:
    if b"\r" in body:
        body = body.replace(b"\r\n", b"\n")
    raw = np.frombuffer(body, np.uint8)
    ends = np.flatnonzero(raw == ord("\n"))
    commas = np.flatnonzero(raw == ord(","))
    per_row = np.diff(np.searchsorted(commas, ends), prepend=0) + 1
    if not len(ends) or (per_row != width).any():
        return None
    values = _fields(body, width * len(ends))
    return None if values is None else np.ascontiguousarray(values.reshape(len(ends), width).T)


def _fields(body: bytes, count: int) -> Floats | None:
    """All fields as numbers, an empty one as NaN; None when something is not a number."""
    flat = body.replace(b"\n", b",")
    if b",," in flat or flat.startswith(b","):
        flat = b"," + flat
        while b",," in flat:
            flat = flat.replace(b",,", b",nan,")
        flat = flat[1:]
    try:
        values = np.fromstring(flat[:-1].decode("ascii"), dtype=np.float64, sep=",")
    except (ValueError, UnicodeDecodeError):
        return None
    return values if len(values) == count else None
