"""`linkpose simulate indoor`."""

from __future__ import annotations

from pathlib import Path

import click

from linkpose.cli import options
from linkpose.errors import LinkposeError


@click.command("indoor")
@click.option("-o", "--output", type=options.FILE, required=True, help="Log to write (CARMEN: ODOM and FLASER lines).")
@click.option("--truth", type=options.FILE, required=True, help="Truth to write (CSV).")
@click.option("--map", "map_path", type=options.FILE, help="Map to write. Default: OUT's name with .yaml.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Motion, errors and noise.")
@click.option(
    "--duration", type=options.FiniteRange(min=5, max=3600), help="Length in seconds. Default: one round, some 200 s."
)
@click.option(
    "--range-std", type=options.FiniteRange(min=0), default=0.03, show_default=True, help="σ of a beam at range 0 (m)."
)
@click.option(
    "--range-growth", type=options.FiniteRange(min=0), default=0.02, show_default=True, help="And its growth (m/m)."
)
@click.option(
    "--outliers",
    type=options.FiniteRange(0, 1),
    default=0.02,
    show_default=True,
    help="Share of beams that end at something that the map does not know.",
)
@options.force
def command(
    output: Path,
    truth: Path,
    map_path: Path | None,
    seed: int,
    duration: float | None,
    range_std: float,
    range_growth: float,
    outliers: float,
    force: bool,
) -> None:
    """Make a log of a robot with odometry and a laser scanner in a floor of 100 x 40 m, its map and its truth."""
    from linkpose.localization.carmen import format_reading
    from linkpose.localization.events import write_lines
    from linkpose.localization.maps import save_map
    from linkpose.recording.truth import write_truth
    from linkpose.simulation.indoor import CELL_M, IndoorErrors, office_floor, simulate_indoor

    map_path = map_path or output.with_suffix(".yaml")
    if not force and (map_path.exists() or map_path.with_suffix(".pgm").exists()):
        raise LinkposeError(
            f"{map_path} or its image exists already; name another with --map or add --force to replace it"
        )
    errors = IndoorErrors(range_m=range_std, range_growth=range_growth, outlier_fraction=outliers)
    run = simulate_indoor(seed, errors, duration)
    columns = {
        "time_s": run.time_s,
        "x_m": run.pose[:, 0],
        "y_m": run.pose[:, 1],
        "heading_rad": run.pose[:, 2],
        "vx_m_s": run.twist[:, 0],
        "wz_rad_s": run.twist[:, 1],
    }
    write_truth(truth, columns, {"simulated": "indoor", "seed": seed}, force)
    save_map(map_path, office_floor(), CELL_M, (0.0, 0.0))
    lines = [format_reading(reading) for reading in run.readings]
    write_lines(output, [f"# linkpose simulate indoor --seed {seed}", *lines], force)
    click.echo(f"the map is {map_path}; next: linkpose localize {output} --map {map_path} --truth {truth}", err=True)
