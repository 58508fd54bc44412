"""Variants of a localisation filter, compared on the same simulated runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from linkpose.localization.kalman import FilterName
from linkpose.localization.tables import Score

# Receives the runs of an experiment and yields them again: the place for a progress bar.
Progress: TypeAlias = Callable[[Iterable[Any]], Iterable[Any]]

SIGNIFICANCE = 0.05  # of the one-sided sign test: five seeds of five reach it (p = 0.031), four of four do not


@dataclass(slots=True)
class Variant:
    """One configuration of a filter, and its scores, one per seed. `others` are further settings that identify it."""

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
        """The object that `reproduce --json` prints."""
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


def verdict(claim: str, before: Variant, after: Variant) -> str:
    """A sentence on whether `after` has the smaller position error, seed by seed, by a sign test."""
    pairs = [(old.position_rmse_m, new.position_rmse_m) for old, new in zip(before.scores, after.scores, strict=True)]
    wins, losses = sum(new < old for old, new in pairs), sum(new > old for old, new in pairs)
    better, worse = sign_test(wins, losses), sign_test(losses, wins)
    result = "holds" if better < SIGNIFICANCE else "does not hold" if worse < SIGNIFICANCE else "no difference"
    return (
        f"{claim}: {result}; {before.position_rmse_m():.4g} m against {after.position_rmse_m():.4g} m, "
        f"better on {wins} of {len(pairs)} seeds (p = {min(better, worse):.2g})"
    )


def sign_test(wins: int, losses: int) -> float:
    """One-sided p value: how likely so many wins or more are if wins and losses are equally likely."""
    n = wins + losses
    return float(sum(math.comb(n, i) for i in range(wins, n + 1)) / 2**n)
