"""Checks the sizes that a C3D file states before its library reserves memory for them.

A damaged file of 8 kB made the library take 12 GB and minutes. Source: the C3D file format user guide (2008), chapters
"The header section" and "The parameter section".
"""

from __future__ import annotations

import math
import struct

_BLOCK = 512
_BIG_ENDIAN = 86  # the processor type of the parameter section; 84 and 85 are little-endian
_SIZES = {-1: 1, 1: 1, 2: 2, 4: 4}  # bytes of a value by the type of a parameter
_MOST_DIMENSIONS = 7  # of a parameter
_FACTS = ("USED", "FRAMES", "RATE")  # of the groups POINT, ANALOG and ROTATION: ezc3d reserves memory by them


class Damaged(Exception):
    """The sizes in a C3D file contradict its length. The text names them."""


def check_sizes(data: bytes) -> None:
    """Raises Damaged unless parameters and frames fit into the file."""
    section = (data[0] - 1) * _BLOCK
    if section + 4 > len(data):
        raise Damaged("it ends before its parameters")
    order = ">" if data[section + 3] == _BIG_ENDIAN else "<"
    points, analog, first, last = struct.unpack_from(f"{order}HHHH", data, 2)
    values = _parameters(data, section + 4, order)
    stated = [value for value in values.get("FRAMES", []) if value >= 0]
    frames = max([last - first + 1, *stated])
    rates = [value for value in values.get("RATE", []) if 0 < value < math.inf]
    per_frame = max(rates, default=1.0) / min(rates, default=1.0)  # analog samples in a frame of points
    used = [value for value in values.get("USED", []) if value >= 0]
    columns = max([points * 4.0, float(analog), *(value * max(1.0, min(per_frame, 1e9)) for value in used)])
    # A value takes at least two bytes. A file may be padded by its last block, hence the slack.
    if frames < 1 or frames * columns > len(data) + _BLOCK or per_frame > len(data):
        raise Damaged(f"it states {frames:.0f} frames of {columns:.0f} values, more than it can hold")


def _parameters(data: bytes, at: int, order: str) -> dict[str, list[float]]:
    """The first values of the parameters named in _FACTS, of all groups."""
    found: dict[str, list[float]] = {}
    while at + 2 <= len(data) and data[at]:
        length = abs(struct.unpack_from("b", data, at)[0])
        group = struct.unpack_from("b", data, at + 1)[0]
        body = at + 2 + length
        if body + 4 > len(data):
            raise Damaged("a parameter lies behind its end")
        name = data[at + 2 : body].decode("latin-1").upper()
        offset = struct.unpack_from(f"{order}H", data, body)[0]
        if group > 0 and (value := _first_value(data, body + 2, order)) is not None and name in _FACTS:
            found.setdefault(name, []).append(value)
        if not offset:
            return found
        at = body + offset
    if at + 2 > len(data):
        raise Damaged("a parameter lies behind its end")
    return found


def _first_value(data: bytes, at: int, order: str) -> float | None:
    """The first value of a parameter; None for text and for none. Raises Damaged where its values exceed the file."""
    kind, dimensions = struct.unpack_from("bB", data, at)
    if dimensions > _MOST_DIMENSIONS:
        raise Damaged(f"a parameter has {dimensions} dimensions")
    sizes = data[at + 2 : at + 2 + dimensions]
    start = at + 2 + dimensions
    if kind not in _SIZES or start + _SIZES[kind] * math.prod(sizes) > len(data):
        raise Damaged("a parameter has more values than the file can hold")
    if kind not in (2, 4) or not math.prod(sizes):
        return None
    value = struct.unpack_from(f"{order}{'H' if kind == 2 else 'f'}", data, start)[0]
    return float(value)
