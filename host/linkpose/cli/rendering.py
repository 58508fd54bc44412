"""What several commands print: progress on a terminal, rows as a table, and an experiment with its figures."""

from __future__ import annotations

import functools
import json
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import click

from linkpose.cli.characters import fitting
from linkpose.cli.streams import unfiltered
from linkpose.errors import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table
    from rich.text import Text

    from linkpose.experiments.variants import ClaimVerdict


_TABLE_WIDTH = 160  # characters; tables take as many as they need


def progress(label: str, quiet: bool = False) -> Callable[[Iterable[Any]], Iterable[Any]]:
    """Passes items on and shows a bar on stderr where that is a terminal and `quiet` is not set."""
    return functools.partial(_with_bar, label, not quiet and sys.stderr.isatty())


def _with_bar(label: str, is_shown: bool, items: Iterable[Any]) -> Iterator[Any]:
    if is_shown:
        with click.progressbar(list(items), label=label, file=unfiltered(sys.stderr)) as bar:
            yield from bar
    else:
        yield from items


def wrapped(text: str, stream: TextIO) -> str:
    """The text, broken between words where the stream is a terminal; a file or a pipe gets whole lines."""
    if not stream.isatty():
        return text
    width = shutil.get_terminal_size().columns
    lines = text.split("\n")
    indents = [" " * (len(line) - len(line.lstrip())) for line in lines]
    return "\n".join(
        textwrap.fill(line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
        for line, indent in zip(lines, indents, strict=True)
    )


def show_text(text: str) -> None:
    """Prints sentences; a terminal breaks them between words."""
    click.echo(wrapped(text, sys.stdout))


def show_table(table: Table) -> None:
    """Prints a table below its title.

    On a narrow terminal it has fewer lines and spaces between its columns. It is never cut: a terminal that is narrower
    still wraps its lines, a file gets whole ones.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console

    class SafeConsole(Console):
        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(fitting(printable(text), sys.stdout.encoding), **options)

    console = SafeConsole(file=unfiltered(sys.stdout))
    terminal_width = console.width if sys.stdout.isatty() else _TABLE_WIDTH
    console.width = max(console.width, _TABLE_WIDTH)
    for box in (SIMPLE_HEAD, None):
        if console.measure(table).maximum > terminal_width:
            table.box, table.show_edge, table.pad_edge, table.padding = box, False, False, (0, 1, 0, 0)
    title, table.title = table.title, None  # above the table, rich would wrap it at the table's width
    if title:
        console.print(title, highlight=False)
    console.print(table)


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


def show_experiment(
    tables: Sequence[Sequence[dict[str, object]]], verdicts: Sequence[ClaimVerdict], seeds: int, json_lines: bool
) -> None:
    """An experiment's tables and verdicts: as JSON lines, or as text."""
    if json_lines:
        rows = [*(row for table in tables for row in table), *(verdict.as_row() for verdict in verdicts)]
        click.echo("\n".join(json.dumps(row) for row in rows))
        return
    from linkpose.experiments.variants import remark

    click.echo("\n\n".join(as_table(table) for table in tables))
    show_text("\n".join(["", "Claims of the thesis:", *(one.text for one in verdicts if one.table)]))
    further = [one.text for one in verdicts if not one.table]
    if further:
        show_text("\n".join(["", "Comparisons that the thesis does not make:", *further]))
    note = remark(seeds)
    if note:
        show_text(f"\n{note}")


def files_of_figures(place: Path | None, whole: str, numbers: Sequence[str], force: bool) -> dict[str, Path]:
    """The file of the picture `whole`, which shows all variants, and of each figure; none without a place.

    Raises FileError where one cannot be written: better before the work than after it.
    """
    from linkpose import plotting

    if place is None:
        return {}
    files = plotting.picture_files(place, whole, [f"figure-{number}" for number in numbers], force)
    return dict(zip((whole, *numbers), files.values(), strict=True))


def save_figures(figures: Mapping[str, Figure], files: Mapping[str, Path], force: bool, quiet: bool) -> None:
    """Writes each figure to its file, and lists the files on stderr."""
    from linkpose import plotting

    for name, file in files.items():
        plotting.save(figures[name], file, force)
        if not quiet:
            click.echo(f"{f'Figure {name}' if name[0].isdigit() else name}: {file}", err=True)
