"""Characters for a terminal whose encoding lacks those that linkpose prints, such as a code page of Windows.

Each is replaced by one like it: a minus sign stays a minus sign, and tables keep their columns.
"""

from __future__ import annotations

import codecs

ERRORS = "linkpose"  # name of the error handler, for `errors=` of a stream
_ALIKE = str.maketrans("−–—─└├┤│▸·…σχλωαβκηπΔµ²³×√‖≤≥≈→«»“”’", "----`|||>-.sxlwabknpDu23xV|<>~><>\"\"'") | {
    ord("±"): "+/-", ord("°"): " deg",
}  # fmt: skip
_FIRST_BRAILLE, _LAST_BRAILLE = 0x2800, 0x28FF
# Dots of a Braille cell in its upper and lower half and its two middle rows, by bit.
_UPPER, _LOWER, _MIDDLE = 0x1B, 0xE4, 0x36


def replacement(text: str) -> str:
    """The text in ASCII."""
    return "".join(_ascii(char) for char in text.translate(_ALIKE))


def _ascii(char: str) -> str:
    if not _FIRST_BRAILLE <= ord(char) <= _LAST_BRAILLE:
        return char if char.isascii() else "?"
    dots = ord(char) - _FIRST_BRAILLE
    if not dots:
        return " "
    if not dots & ~_MIDDLE:
        return "-"
    if dots & _UPPER and dots & _LOWER:
        return ":"
    return "'" if dots & _UPPER else "."


def _handle(error: UnicodeError) -> tuple[str | bytes, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return replacement(error.object[error.start : error.end]), error.end


def register() -> None:
    """Makes ERRORS known to Python."""
    codecs.register_error(ERRORS, _handle)
