"""`linkpose calibrate imu`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from linkpose.cli import options

if TYPE_CHECKING:
    from linkpose.calibration.imu import ImuCalibration


@click.command("imu")
@click.argument("recordings", type=options.FILE, nargs=-1, required=True)
@click.option("--rig", "rig_file", type=options.FILE, required=True, help="Rig file to write the calibration into.")
@options.as_json
def command(recordings: tuple[Path, ...], rig_file: Path, json_lines: bool) -> None:
    """Find the inertial sensor's errors and noise from rests, and write them into the rig file.

    Lay the sensor on each of its six sides in turn, some seconds each, in one recording or several. From fewer
    attitudes the gyro's bias and the noises are found all the same.
    """
    from linkpose.calibration.imu import FEWEST_ATTITUDES, calibrate_imu, with_calibration

    loaded = options.load_recordings(recordings)
    rig = options.resolve_rig(rig_file if rig_file.exists() else None, None, loaded[0].rig)
    found = calibrate_imu(loaded)
    with_calibration(rig, found).save(rig_file)
    if json_lines:
        click.echo(json.dumps(_object(found)))
    else:
        _show(found)
    if found.accel_scale is None:
        click.echo(
            f"offset and scale of the accelerometer stay as they were: {_count(found.attitudes, 'attitude')}, "
            f"{FEWEST_ATTITUDES} are needed",
            err=True,
        )
    click.echo(f"written to {rig_file}", err=True)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _object(found: ImuCalibration) -> dict[str, Any]:
    values = {name: getattr(found, name) for name in found.__slots__}
    return {name: value.tolist() if hasattr(value, "tolist") else value for name, value in values.items()}


def _show(found: ImuCalibration) -> None:
    from linkpose.calibration.imu import FEWEST_ATTITUDES

    x, y, z = found.gyro_bias_rad_s
    click.echo(f"{_count(found.rests, 'rest')} in {_count(found.attitudes, 'attitude')}")
    click.echo(f"gyro: bias {x:.5f}, {y:.5f}, {z:.5f} rad/s, noise {found.gyro_noise_rad_s:.5f} rad/s")
    click.echo(f"accelerometer: noise {found.accel_noise_m_s2:.4f} m/s²")
    if found.accel_offset_m_s2 is not None and found.accel_scale is not None:
        (ox, oy, oz), (kx, ky, kz) = found.accel_offset_m_s2, found.accel_scale
        click.echo(f"accelerometer: offset {ox:.4f}, {oy:.4f}, {oz:.4f} m/s², scale {kx:.5f}, {ky:.5f}, {kz:.5f}")
        if found.attitudes > FEWEST_ATTITUDES:
            click.echo(f"accelerometer: residual {found.accel_residual_m_s2:.4f} m/s²")
        else:  # as many equations as unknowns: what is left says nothing
            click.echo(f"accelerometer: no residual from {FEWEST_ATTITUDES} attitudes, which always fit; more tell it")
    if found.pressure_noise_Pa is not None:
        click.echo(f"barometer: noise {found.pressure_noise_Pa:.2f} Pa")
