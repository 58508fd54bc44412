"""Where estimates go: a file, the standard output, network outputs."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

from linkpose.errors import InvalidValue

if TYPE_CHECKING:
    from pathlib import Path

    from linkpose.cli.estimate import Request
    from linkpose.estimation import EstimateWriter, Estimator
    from linkpose.sensors.measurements import Floats
    from linkpose.streams import Output


def _output(target: str, columns: Sequence[str]) -> Output:
    """The output of a --to. Raises UsageError where the address is wrong."""
    from linkpose.streams import open_output

    try:
        return open_output(target, columns)
    except InvalidValue as error:
        raise click.UsageError(f"--{error}") from None


class Sink:
    """Where estimates go: a file, stdout as CSV, or stdout as JSON; file and JSON go together."""

    def __init__(self, estimator: Estimator, request: Request, head: dict[str, Any]) -> None:
        from linkpose.estimation import EstimateWriter
        from linkpose.recording.csvfile import head as csv_head

        self._estimator = estimator
        self._outputs = [_output(target, estimator.columns) for target in request.targets]
        self._json, self._is_plain = request.json_lines, request.plain
        self._file: EstimateWriter | None = None
        if request.output is not None:
            self._file = EstimateWriter(request.output, head, estimator.columns, request.force, request.plain)
        self._prints = self._file is None and not self._json and not sys.stdout.isatty()
        if self._prints:
            header = ",".join(estimator.columns) + "\n"
            _print(header if request.plain else csv_head("estimate", head, estimator.columns))

    def write(self, estimates: Floats, start_s: float = 0.0) -> None:
        """Puts out rows of estimates; `start_s` is the host's time (time.perf_counter, s) of `time_s` 0."""
        if self._file is not None:
            self._file.write(self._estimator.text(estimates))
        if self._prints:
            _print(self._estimator.text(estimates).decode())
        if self._json or self._outputs:
            rows = self._estimator.objects(estimates)
            for output in self._outputs:
                for row in rows:
                    output.send(row, start_s + (row["time_s"] or 0.0))
            if self._json:
                _print("".join(json.dumps(row) + "\n" for row in rows))

    @property
    def path(self) -> Path | None:
        """The file, under the name that it had last; None without one."""
        return None if self._file is None else self._file.path

    @property
    def gives_rows(self) -> bool:
        """Whether a file or the standard output gets the estimates; without -o and --json, a terminal gets none."""
        return self._prints or self._json or self._file is not None

    @property
    def dropped(self) -> list[str]:
        """What live outputs did not accept, in sentences."""
        return [
            f"{output.name}: {output.dropped} estimates were not sent" for output in self._outputs if output.dropped
        ]

    def close(self, closing: dict[str, Any]) -> None:
        """Writes the closing line."""
        from linkpose.recording.csvfile import tail

        if self._file is not None:
            self._file.close(closing)
        if self._prints and not self._is_plain:
            _print(tail(closing))

    def __enter__(self) -> Sink:
        return self

    def __exit__(self, *_: object) -> None:
        for output in self._outputs:
            output.close()
        if self._file is not None:
            self._file.__exit__()


def _print(text: str) -> None:
    """Put results on stdout at once."""
    sys.stdout.write(text)
    sys.stdout.flush()
