"""What the benchmarks share: taking the best of some runs, and printing rows."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

# Where the reports look for the recordings of others, which are no part of the project: beside the checkout.
RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "data"


class Row(NamedTuple):
    """Ours beside a peer's, in microseconds of one frame, sample or step."""

    bench: str
    ours_us: float
    peer: str
    peer_us: float


def best_of(run: Callable[[], object], times: int) -> float:
    """The shortest of some runs, µs: what the machine's other work disturbed least."""
    shortest = float("inf")
    for _ in range(times):
        began = time.perf_counter()
        run()
        shortest = min(shortest, time.perf_counter() - began)
    return 1e6 * shortest


def report(rows: Iterable[Row]) -> None:
    """Prints the rows: a table, or with --json on the command line one object a line."""
    for row in rows:
        ratio = row.ours_us / row.peer_us
        if "--json" in sys.argv[1:]:
            print(json.dumps({**row._asdict(), "ratio": ratio}))
        else:
            print(f"{row.bench:20} {row.ours_us:12.3f} us   {row.peer:12} {row.peer_us:12.3f} us   ratio {ratio:.4f}")
