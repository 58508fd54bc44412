"""What goes wrong towards the user."""

from __future__ import annotations


class LinkposeError(Exception):
    """A failure that the user can read: one sentence that says what, why and what to type. Exit status 1."""
