"""`linkpose calibrate joint`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options
from linkpose.cli.live import Console

if TYPE_CHECKING:
    from linkpose.calibration.joint import JointCalibration


@click.command("joint")
@click.argument("recordings", type=options.FILE, nargs=-1, required=True)
@click.option("--rig", "rig_file", type=options.FILE, required=True, help="Rig file to write J2S into.")
@click.option("--imu", "with_imu", is_flag=True, help="Write the sensor's bias, offset and scale as well.")
@options.as_json
@options.quiet
def command(recordings: tuple[Path, ...], rig_file: Path, with_imu: bool, json_lines: bool, quiet: bool) -> None:
    """Estimate J2S, the vector from the joint centre to the sensor in its axes, and write it into the rig file.

    Record the link on its fixed joint, swung for half a minute or more in all directions. The calibration of the
    inertial sensor in the rig file is applied. Sensor errors that remain are estimated together with J2S; --imu writes
    them, too. A hinge rotates about one axis: J2S along this axis is not observable, and its σ is large.
    """
    from linkpose.calibration.joint import (
        LARGE_RESIDUAL_M_S2,
        SENSOR_ERRORS,
        calibrate_joint,
        is_calibrated,
        with_calibration,
    )

    console = Console(quiet, verbose=False)
    loaded, rig = options.recordings_and_rig(recordings, rig_file, console.report)
    found = calibrate_joint(loaded, rig)
    with_calibration(rig, found, with_imu).save(rig_file)
    if json_lines:
        click.echo(json.dumps(found.as_dict()))
    else:
        axes = zip(found.j2s_m.tolist(), found.std_m.tolist(), strict=True)
        click.echo(f"J2S {', '.join(f'{value:.4f} ± {std:.4f}' for value, std in axes)} m")
        click.echo(f"residual {found.residual_m_s2:.3f} m/s² over {found.samples} samples in motion")
        for name in SENSOR_ERRORS:
            click.echo(f"{name} {', '.join(f'{value:.4f}' for value in getattr(found.imu, name))}")
    if found.weak_axis is not None and not json_lines:
        _show_weak(found, console)
    if found.residual_m_s2 > LARGE_RESIDUAL_M_S2:
        console.report("The residual is large. Check that the joint is fixed and the sensor firm on the link.")
    if not with_imu:
        console.report(f"The sensor errors found ({', '.join(SENSOR_ERRORS)}) are not saved. Add --imu to save them.")
        if not is_calibrated(rig.imu, found):
            console.report("The rig file does not calibrate the sensor: add --imu, or type `linkpose calibrate imu`.")
    options.show_rig_written(rig_file, quiet, *options.estimate_command(recordings[0], "--rig", rig_file))


def _show_weak(found: JointCalibration, console: Console) -> None:
    """The direction along which the motion does not show J2S, and what to do."""
    axis = found.weak_axis
    others = " and ".join(name for at, name in enumerate("xyz") if at != axis)
    x, y, z = found.worst_direction
    console.report(
        f"J2S is not observable along the sensor's {'xyz'[axis or 0]} axis (direction {x:.2f}, {y:.2f}, {z:.2f}): "
        f"σ {found.worst_std_m:.3f} m. Rotate the link about its {others} axes too, and faster; on a hinge with a "
        "horizontal axis this direction does not enter the height."
    )
