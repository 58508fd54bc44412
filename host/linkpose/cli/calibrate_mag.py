"""`linkpose calibrate mag`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options
from linkpose.cli.live import Console
from linkpose.errors import LinkposeError

if TYPE_CHECKING:
    from linkpose.calibration.mag import MagCalibration


@click.command("mag")
@click.argument("recordings", type=options.FILE, nargs=-1, required=True)
@options.rig_to_write("Rig file to write the magnetometer's calibration into.")
@click.option("--force", is_flag=True, help="Write the rig file even if the field is not the earth's.")
@options.as_json
@options.quiet
def command(recordings: tuple[Path, ...], rig_file: Path, force: bool, json_lines: bool, quiet: bool) -> None:
    """Estimate hard iron, soft iron and the axes of the magnetometer, and write them into the rig file.

    Turn the sensor, mounted as it will be used, by hand through all attitudes for a minute, away from iron and cables.
    The calibration of the gyro in the rig file is applied.
    """
    from linkpose.calibration.mag import LEAST_FIELD_UT, MOST_FIELD_UT, calibrate_mag, with_calibration

    console = Console(quiet, verbose=False)
    loaded, rig = options.recordings_and_rig(recordings, rig_file, console.report)
    found = calibrate_mag(loaded, rig)
    if json_lines:
        click.echo(json.dumps(found.as_dict()))
    else:
        _show(found)
    if not found.is_plausible and not force:
        raise LinkposeError(
            f"the field of {found.field_uT:.1f} µT is not the earth's ({LEAST_FIELD_UT:.0f} to "
            f"{MOST_FIELD_UT:.0f} µT): a magnet or iron is near the sensor. "
            f"{rig_file} is unchanged; record elsewhere, or add --force"
        )
    if found.outliers:
        readings = "1 reading is" if found.outliers == 1 else f"{found.outliers} readings are"
        console.report(f"{readings} left out: the magnitude is far from the median of all readings.")
    if not found.is_clean:
        console.report(
            "The residual is large: iron or a current was near the sensor in a part of the recording. Record again, "
            "away from both."
        )
    if found.rotation is None:
        console.report(
            "The rotation into the inertial sensor's axes is not determined, and the axes are assumed to agree: turn "
            "the sensor faster, about all axes."
        )
    with_calibration(rig, found).save(rig_file)
    options.show_next_recording(rig_file, quiet, loaded[0], "joint")


def _show(found: MagCalibration) -> None:
    from linkpose.calibration.mag import GOOD_COVERAGE

    iron = zip(found.hard_iron_uT.tolist(), found.hard_iron_std_uT.tolist(), strict=True)
    click.echo(f"hard iron {', '.join(f'{value:.2f} ± {std:.2f}' for value, std in iron)} µT")
    click.echo("soft iron " + "; ".join(", ".join(f"{value:.4f}" for value in row) for row in found.soft_iron))
    if found.rotation is not None:
        rows = "; ".join(", ".join(f"{value:.3f}" for value in row) for row in found.rotation)
        click.echo(f"rotation into the inertial sensor's axes {rows} (± {found.rotation_std_deg:.2f}°)")
    dip = "" if found.dip_deg is None else f", dip {found.dip_deg:.1f}°"
    click.echo(
        f"field {found.field_uT:.2f} µT{dip}, residual {found.residual_uT:.2f} µT over {found.readings} readings"
    )
    verdict = "good" if found.coverage >= GOOD_COVERAGE else "fair; turn the sensor through more attitudes"
    click.echo(f"coverage {100 * found.coverage:.0f} % of all attitudes: {verdict}")
