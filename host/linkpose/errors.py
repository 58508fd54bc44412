"""Failures that are reported to the user, and text that is safe to print."""

from __future__ import annotations

import unicodedata


class LinkposeError(Exception):
    """A failure that the user can read: one sentence that says what, why and what to type. Exit status 1."""


def printable(text: object, most: int | None = None) -> str:
    """Text from a file or a device, safe for a terminal: control characters as escapes, and at most `most` characters.

    Escape sequences in a column name, a rig key or a USB description would otherwise move the cursor, retitle the
    window or, in some terminals, type a command. Line ends and tabs stay.
    """
    shown = "".join(
        c
        if c in "\n\t" or unicodedata.category(c) not in ("Cc", "Cf", "Cs", "Co")
        else c.encode("unicode_escape").decode()
        for c in str(text)
    )
    return shown if most is None or len(shown) <= most else shown[: most - 1] + "…"
