"""Variants of a localization filter, compared on the same simulated runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from typing import Any, TypeAlias

from linkpose.localization.kalman import FilterName
from linkpose.localization.tables import PathScore
from linkpose.presentation import counted

# Receives the runs of an experiment and yields them again: the place for a progress bar.
Progress: TypeAlias = Callable[[Iterable[Any]], Iterable[Any]]

SIGNIFICANCE = 0.05  # of the two-sided sign test
FEWEST_SEEDS = 6  # that reach it: six of six (p = 0.031), five of five do not (0.063)


@dataclass(slots=True)
class Variant:
    """One configuration of a filter, and its scores, one per seed. `others` are further settings that identify it."""

    filter: FilterName
    noise: str
    correlation: float
    gate: float | None
    others: dict[str, object] = field(default_factory=dict)
    scores: list[PathScore] = field(default_factory=list)

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


@dataclass(frozen=True, slots=True)
class ClaimVerdict:
    """Whether `after` has the smaller position error than `before`, seed by seed, by a two-sided exact sign test.

    `table` is the number of the thesis's table that makes the comparison; empty where none does.
    """

    claim: str
    table: str
    before_m: float
    after_m: float
    wins: int
    losses: int
    seeds: int

    @property
    def p(self) -> float:
        """Probability of wins and losses at least as uneven if both are equally likely."""
        return sign_test(self.wins, self.losses)

    @property
    def result(self) -> str:
        """holds, does not hold (the opposite does), or no difference."""
        if not self.p < SIGNIFICANCE:
            return "no difference"
        return "holds" if self.wins > self.losses else "does not hold"

    @property
    def text(self) -> str:
        """The verdict as a line of text."""
        source = f"Table {self.table}: " if self.table else ""
        return (
            f"{source}{self.claim}: {self.result}; {self.after_m:.4g} m instead of {self.before_m:.4g} m, "
            f"better on {self.wins} of {self.seeds} seeds (p = {self.p:.2g})"
        )

    def as_row(self) -> dict[str, object]:
        """The object that `reproduce --json` prints."""
        return asdict(self) | {"p": self.p, "result": self.result}


def verdict(claim: str, before: Variant, after: Variant, table: str = "") -> ClaimVerdict:
    """Compares two variants that ran on the same seeds."""
    pairs = [(old.position_rmse_m, new.position_rmse_m) for old, new in zip(before.scores, after.scores, strict=True)]
    wins, losses = sum(new < old for old, new in pairs), sum(new > old for old, new in pairs)
    return ClaimVerdict(claim, table, before.position_rmse_m(), after.position_rmse_m(), wins, losses, len(pairs))


def sign_test(wins: int, losses: int) -> float:
    """Two-sided p value of the exact binomial test; ties are left out."""
    n = wins + losses
    tail = sum(math.comb(n, i) for i in range(max(wins, losses), n + 1))
    return float(min(1.0, 2.0 * tail / 2**n))


def remark(seeds: int) -> str | None:
    """Why no verdict can be reached with so few seeds; None where one can."""
    if sign_test(seeds, 0) < SIGNIFICANCE:
        return None
    few = counted(seeds, "seed")
    return f"A sign test needs at least {FEWEST_SEEDS} seeds for p < {SIGNIFICANCE:g}; {few} cannot give a verdict."
