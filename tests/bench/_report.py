"""What the benchmarks share: taking the best of some runs, the recordings of others, and printing rows."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

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


def bench_parser(description: str) -> argparse.ArgumentParser:
    """--json, which every bench has."""
    made = argparse.ArgumentParser(description=description.splitlines()[0])
    made.add_argument("--json", action="store_true", help="one object a line")
    return made


def recordings_parser(description: str) -> argparse.ArgumentParser:
    """--json, --data and --only of the benches on recordings."""
    made = bench_parser(description)
    made.add_argument("--data", type=Path, default=RECORDINGS, help="folder of the recordings")
    made.add_argument("--only", default="", help="only cases whose name contains this text")
    return made


def is_there(folder: Path) -> bool:
    """Whether recordings are there; the bench leaves out those that are not."""
    if not folder.is_dir():
        print(f"{folder} is missing: skipped", file=sys.stderr)
    return folder.is_dir()


def print_rows(
    sets: Mapping[str, Callable[[Path], Iterable[Any]]],
    rows_of: Callable[[Any], Iterable[dict[str, object]]],
    options: argparse.Namespace,
) -> Iterator[dict[str, object]]:
    """The rows of all cases of the sets that are there, each printed as soon as it is known."""
    for name, read in sets.items():
        for case in read(options.data / name) if is_there(options.data / name) else ():
            for row in rows_of(case) if options.only in case.name else ():
                print_row(row, options.json)
                yield row


def print_row(row: dict[str, object], as_json: bool) -> None:
    """A row as JSON or as text."""
    print(json.dumps(row) if as_json else _text(row), flush=True)


def _text(row: dict[str, object]) -> str:
    return "  ".join(f"{key} {value:.3f}" if isinstance(value, float) else str(value) for key, value in row.items())
