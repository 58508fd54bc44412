"""`linkpose simulate underwater`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from linkpose.cli import options

NON_NEGATIVE = options.FiniteRange(min=0)


@click.command("underwater")
@click.option("-o", "--output", type=options.FILE, required=True, help="Log to write (CSV: time_s,kind,a,b,c).")
@click.option("--truth", type=options.FILE, required=True, help="Truth to write (CSV).")
@click.option("--beacons", type=options.FILE, help="Beacons to write. Default: OUT's name with _beacons.csv.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Motion, errors and noise.")
@click.option(
    "--duration", type=options.FiniteRange(min=5, max=3600), default=120.0, show_default=True, help="Length in seconds."
)
@click.option("--synchronous", is_flag=True, help="All sensors read at once, every 0.2 s (Table 2.3).")
@click.option("--range-std", type=NON_NEGATIVE, default=0.2, show_default=True, help="σ of a range (m), Table 2.6.")
@click.option(
    "--correlation-std",
    type=NON_NEGATIVE,
    default=0.15,
    show_default=True,
    help="σ of the error common to all ranges (m), Table 2.8.",
)
@click.option(
    "--correlation-interval", type=options.SecondsType(), default=1.0, show_default=True, help="How long it stays (s)."
)
@click.option("--outliers", type=click.IntRange(min=0), default=60, show_default=True, help="How many, Table 2.9.")
@click.option(
    "--outlier-size", type=options.FiniteRange(min=0.1), default=5.0, show_default=True, help="What each adds (m)."
)
@options.force
@options.as_json
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
) -> None:
    """Make a log of an underwater vehicle's sensors after the thesis's Tables 2.2 to 2.9, its beacons and its truth.

    The noise's statistics are computed back from the log and shown beside those asked for.
    """
    from linkpose.localization.events import HEADER, Event, format_event, write_lines
    from linkpose.simulation.underwater import BEACONS, UnderwaterErrors, self_check, simulate_underwater

    errors = UnderwaterErrors(
        range_m=range_std,
        correlation_m=correlation_std,
        correlation_interval_s=correlation_interval,
        outliers=outliers,
        outlier_m=outlier_size,
    )
    run = simulate_underwater(seed, errors, duration, synchronous)
    beacons = beacons or output.with_name(f"{output.stem}_beacons.csv")
    places = [f"{name},{x:g},{y:g},{z:g}" for name, (x, y, z) in BEACONS.items()]
    write_lines(beacons, ["id,x_m,y_m,z_m", *places], force)
    _write_truth(truth, run, seed, force)
    rows = [format_event(event) for event in run.log if isinstance(event, Event)]
    write_lines(output, [f"# linkpose simulate underwater --seed {seed}", ",".join(HEADER), *rows], force)
    for row in self_check(run):
        values = {"check": row.check, "asked": row.asked, "measured": row.measured}
        click.echo(
            json.dumps(values) if json_lines else f"{row.check:<20} asked {row.asked:<8g} measured {row.measured:.5g}"
        )
    click.echo(
        f"the beacons are {beacons}; next: linkpose localize {output} --beacons {beacons} --truth {truth}", err=True
    )


def _write_truth(path: Path, run: Any, seed: int, force: bool) -> None:
    from linkpose.recording.truth import write_truth

    columns = {"time_s": run.motion.time_s}
    columns |= dict(zip(("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "heading_rad"), run.motion.pose.T, strict=True))
    columns |= dict(
        zip(("vx_m_s", "vy_m_s", "vz_m_s", "wx_rad_s", "wy_rad_s", "wz_rad_s"), run.motion.twist.T, strict=True)
    )
    write_truth(path, columns, {"simulated": "underwater", "seed": seed}, force)
