"""`linkpose calibrate joint`."""

from __future__ import annotations

import json
from pathlib import Path

import click

from linkpose.cli import options

_ERRORS = ("gyro_bias_rad_s", "accel_offset_m_s2", "accel_scale")


@click.command("joint")
@click.argument("recordings", type=options.FILE, nargs=-1, required=True)
@click.option("--rig", "rig_file", type=options.FILE, required=True, help="Rig file to write J2S into.")
@click.option("--imu", "with_imu", is_flag=True, help="Write the sensor's bias, offset and scale, too.")
@options.as_json
def command(recordings: tuple[Path, ...], rig_file: Path, with_imu: bool, json_lines: bool) -> None:
    """Find J2S, the vector from the joint's centre to the sensor in its axes, and write it into the rig file.

    Record the link on its fixed joint, swung for half a minute or more in all directions. The rig file's calibration of
    the inertial sensor is applied, and what is left of its errors is estimated with J2S; --imu keeps that as well.
    """
    from linkpose.calibration.joint import LARGE_RESIDUAL_M_S2, calibrate_joint, is_calibrated, with_calibration

    loaded = options.load_recordings(recordings)
    rig = options.resolve_rig(rig_file if rig_file.exists() else None, None, loaded[0].rig)
    found = calibrate_joint(loaded, rig)
    with_calibration(rig, found, with_imu).save(rig_file)
    (x, y, z), (sx, sy, sz) = found.j2s_m.tolist(), found.std_m.tolist()
    if json_lines:
        values = {"j2s_m": [x, y, z], "std_m": [sx, sy, sz], "residual_m_s2": found.residual_m_s2}
        errors = {name: getattr(found.imu, name) for name in _ERRORS}
        click.echo(json.dumps({**values, "samples": found.samples, **errors}))
    else:
        click.echo(f"J2S {x:.4f} ± {sx:.4f}, {y:.4f} ± {sy:.4f}, {z:.4f} ± {sz:.4f} m")
        click.echo(f"residual {found.residual_m_s2:.3f} m/s² over {found.samples} samples in motion")
        for name in _ERRORS:
            click.echo(f"{name} {', '.join(f'{value:.4f}' for value in getattr(found.imu, name))}")
    if found.residual_m_s2 > LARGE_RESIDUAL_M_S2:
        click.echo("a large residual: see that the joint is fixed, and the sensor firmly on the link", err=True)
    if not with_imu and not is_calibrated(rig.imu, found):
        click.echo(
            "the sensor is not calibrated: add --imu to write what was found of its errors, or type "
            "`linkpose calibrate imu`",
            err=True,
        )
    click.echo(f"written to {rig_file}", err=True)
