"""What `reproduce indoor` and `reproduce underwater` share: variants of a filter over seeds, as a table, as JSON and as
a picture.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import click

from linkpose.localization.kalman import FilterName
from linkpose.localization.tables import Score

Item = TypeVar("Item")


@dataclass(slots=True)
class Variant:
    """One way to filter, and its scores, one a seed. `others` are further things that tell it from its neighbours."""

    filter: FilterName
    noise: str
    correlation: float
    gate: float | None
    others: dict[str, object] = field(default_factory=dict)
    scores: list[Score] = field(default_factory=list)

    def position_rmse_m(self) -> float:
        """Mean over the seeds."""
        return sum(score.position_rmse_m for score in self.scores) / len(self.scores)

    def as_row(self) -> dict[str, object]:
        """The JSON object."""
        headings = [score.heading_rmse_rad for score in self.scores if score.heading_rmse_rad is not None]
        return {
            "filter": self.filter,
            "noise": self.noise,
            "correlation": self.correlation,
            "gate": self.gate,
            **self.others,
            "seeds": len(self.scores),
            "position_rmse_m_mean": self.position_rmse_m(),
            "position_rmse_m_max": max(score.position_rmse_m for score in self.scores),
            "heading_rmse_rad_mean": sum(headings) / len(headings),
        }


def progress(items: Iterable[Item], label: str) -> Iterator[Item]:
    """The items, with a bar on stderr where that is a terminal."""
    if sys.stderr.isatty():
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


def verdict(claim: str, before: Variant, after: Variant) -> str:
    """Whether `after` is better than `before`, seed by seed, in words."""
    pairs = list(zip(before.scores, after.scores, strict=True))
    wins = sum(new.position_rmse_m < old.position_rmse_m for old, new in pairs)
    better = 2 * wins > len(pairs) and after.position_rmse_m() < before.position_rmse_m()
    holds = "holds" if wins == len(pairs) else "holds on most seeds" if better else "does not hold"
    return (
        f"{claim}: {holds}; {before.position_rmse_m():.4g} m against {after.position_rmse_m():.4g} m, "
        f"better on {wins} of {len(pairs)} seeds"
    )


def plot(path: Path, title: str, variants: Sequence[Variant], labels: Sequence[str]) -> None:
    """Draws each variant's position error, a dot a seed. Raises LinkposeError without matplotlib, or where the file
    cannot be written.
    """
    from linkpose import plotting

    figure = plotting.new_figure(9.0, 1.5 + 0.22 * len(variants))
    axes = figure.add_subplot()
    for row, variant in enumerate(variants):
        errors = [score.position_rmse_m for score in variant.scores]
        axes.plot(
            errors, [row] * len(errors), "o", color="tab:blue" if variant.filter == "ekf" else "tab:orange", alpha=0.6
        )
    axes.set_yticks(range(len(variants)), labels, fontsize=7)
    axes.set_xscale("log")
    axes.set_xlabel("position error, rms of a run (m)")
    axes.set_title(title)
    axes.grid(axis="x", alpha=0.3)
    axes.invert_yaxis()
    plotting.save(figure, path)
