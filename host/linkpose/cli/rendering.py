"""What several commands print: progress on a terminal, and rows as a table."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import click


def progress(label: str, quiet: bool = False) -> Callable[[Iterable[Any]], Iterable[Any]]:
    """Passes items on and shows a bar on stderr where that is a terminal and `quiet` is not set."""
    return functools.partial(_with_bar, label, not quiet and sys.stderr.isatty())


def _with_bar(label: str, is_shown: bool, items: Iterable[Any]) -> Iterator[Any]:
    if is_shown:
        with click.progressbar(list(items), label=label, file=sys.stderr) as bar:
            yield from bar
    else:
        yield from items


def as_table(rows: Sequence[dict[str, object]]) -> str:
    """Rows with the same keys as text in columns."""
    texts = [list(rows[0]), *([_text(name, value) for name, value in row.items()] for row in rows)]
    widths = [max(len(text[i]) for text in texts) for i in range(len(texts[0]))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(text, widths, strict=True)).rstrip() for text in texts
    )


def _text(name: str, value: object) -> str:
    if value is None:
        return "off" if name == "gate" else "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
