"""Characters for a terminal whose encoding lacks those that linkpose prints, such as a code page of Windows.

Each is replaced by one like it: a minus sign stays a minus sign, and tables keep their columns.
"""

from __future__ import annotations

import codecs
import functools
import io

ERRORS = "linkpose"  # name of the error handler, for `errors=` of a stream
# ASCII under a name of our own. click writes UTF-8 to the file under a stream of a known ASCII encoding, past the
# replacements of this module and past the failures that `streams` handles.
ASCII = "linkpose_ascii"
_ALIKE = str.maketrans("−–—─└├┤│▸·…χλωαβκηπΔµ²³×‖≤≥≈→«»“”’", "----`|||>-.xlwabknpDu23x|<>~><>\"\"'") | {
    ord("±"): "+/-", ord("°"): " deg", ord("σ"): "sd", ord("√"): "sqrt",
}  # fmt: skip
_FIRST_BRAILLE, _LAST_BRAILLE = 0x2800, 0x28FF
# Dots of a Braille cell in its upper and lower half and its two middle rows, by bit.
_UPPER, _LOWER, _MIDDLE = 0x1B, 0xE4, 0x36


def replacement(text: str) -> str:
    """The text in ASCII."""
    return "".join(_ascii(char) for char in text.translate(_ALIKE))


def fitting(text: str, encoding: str | None) -> str:
    """The text as a stream of this encoding would show it: a table lays out its columns by it."""
    if encoding is None:
        return text
    register()
    return text.encode(encoding, ERRORS).decode(encoding).replace("( deg", "(deg")


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


def _find_codec(name: str) -> codecs.CodecInfo | None:
    if name != ASCII:
        return None
    plain = codecs.lookup("ascii")
    return codecs.CodecInfo(
        plain.encode, plain.decode, plain.streamreader, plain.streamwriter, plain.incrementalencoder,
        plain.incrementaldecoder, name=ASCII,
    )  # fmt: skip


def prepare(stream: io.TextIOWrapper) -> None:
    """Lets the stream replace the characters that its encoding lacks."""
    is_ascii = codecs.lookup(stream.encoding).name == "ascii"
    stream.reconfigure(encoding=ASCII if is_ascii else None, errors=ERRORS)


@functools.cache  # Python keeps each function that searches codecs for good
def register() -> None:
    """Makes ERRORS and ASCII known to Python."""
    codecs.register_error(ERRORS, _handle)
    codecs.register(_find_codec)
