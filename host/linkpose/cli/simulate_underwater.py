"""`linkpose simulate underwater`."""

from __future__ import annotations

import json
from pathlib import Path

import click

from linkpose.cli import options

NON_NEGATIVE = options.FiniteRange(min=0)


@click.command("underwater")
@options.simulated_outputs("Log to write (CSV: time_s,kind,a,b,c).")
@click.option("--beacons", type=options.FILE, help="Beacons to write. Default: OUT's name with _beacons.csv.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Motion, errors and noise.")
@click.option(
    "--duration", type=options.FiniteRange(min=5, max=3600), default=120.0, show_default=True, help="Length in seconds."
)
@click.option("--synchronous", is_flag=True, help="Read all sensors at once, every 0.2 s (Table 2.3).")
@click.option("--range-std", type=NON_NEGATIVE, default=0.2, show_default=True, help="σ of a range (m), Table 2.6.")
@click.option(
    "--correlation-std",
    type=NON_NEGATIVE,
    default=0.15,
    show_default=True,
    help="σ of the error common to all ranges (m), Table 2.8.",
)
@click.option(
    "--correlation-interval",
    type=options.SecondsType(),
    default=1.0,
    show_default=True,
    help="Time for which it is constant (s).",
)
@click.option(
    "--outliers", type=click.IntRange(min=0), default=60, show_default=True, help="Number of outliers, Table 2.9."
)
@click.option(
    "--outlier-size", type=options.FiniteRange(min=0.1), default=5.0, show_default=True, help="Size of an outlier (m)."
)
@options.force
@options.as_json
@options.quiet
def command(
    output: Path,
    truth: Path,
    beacons: Path | None,
    seed: int,
    duration: float,
    synchronous: bool,
    range_std: float,
    correlation_std: float,
    correlation_interval: float,
    outliers: int,
    outlier_size: float,
    force: bool,
    json_lines: bool,
    quiet: bool,
) -> None:
    """Simulate an underwater vehicle's sensors after the thesis's Tables 2.2 to 2.9: its log, beacons and truth.

    Prints the statistics of the noise as set and as computed from the log.
    """
    from linkpose.cli.rendering import as_table
    from linkpose.outputs import STDOUT, check_outputs
    from linkpose.simulation.export import write_underwater
    from linkpose.simulation.underwater import UnderwaterErrors, self_check, simulate_underwater

    options.refuse_mixed_output(output, json_lines)
    named = truth if output == STDOUT else output
    beacons = beacons or named.with_name(f"{named.stem}_beacons.csv")
    check_outputs((output, truth, beacons), force)
    errors = UnderwaterErrors(
        range_m=range_std,
        correlation_m=correlation_std,
        correlation_interval_s=correlation_interval,
        outliers=outliers,
        outlier_m=outlier_size,
    )
    run = simulate_underwater(seed, errors, duration, synchronous)
    write_underwater(run, seed, output, truth, beacons, force)
    rows: list[dict[str, object]] = [
        {"check": row.check, "asked": row.asked, "measured": row.measured} for row in self_check(run)
    ]
    click.echo("\n".join(map(json.dumps, rows)) if json_lines else as_table(rows), err=output == STDOUT)
    options.show_next(quiet, "localize", output, "--beacons", beacons, "--truth", truth)
