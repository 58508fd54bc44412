"""`linkpose calibrate imu`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options
from linkpose.cli.live import Console
from linkpose.presentation import counted

if TYPE_CHECKING:
    from linkpose.calibration.imu import FoundImuErrors


@click.command("imu")
@click.argument("recordings", type=options.FILE, nargs=-1, required=True)
@click.option("--rig", "rig_file", type=options.FILE, required=True, help="Rig file to write the calibration into.")
@options.as_json
@options.quiet
def command(recordings: tuple[Path, ...], rig_file: Path, json_lines: bool, quiet: bool) -> None:
    """Estimate the inertial sensor's errors and noise from rests, and write them into the rig file.

    Lay the sensor on each of its six sides in turn, for some seconds each, in one recording or several. Fewer attitudes
    are enough for the gyro's bias and the noise. `linkpose simulate link --rests` simulates such a recording.
    """
    from linkpose.calibration.imu import calibrate_imu, with_calibration

    console = Console(quiet, verbose=False)
    loaded, rig = options.recordings_and_rig(recordings, rig_file, console.report)
    found = calibrate_imu(loaded)
    with_calibration(rig, found).save(rig_file)
    if json_lines:
        click.echo(json.dumps(found.as_dict()))
    else:
        _show(found)
    if found.saturated:
        console.report(
            f"{counted(found.saturated, 'rest')} with saturated readings left out; record them with a larger range."
        )
    if found.accel_scale is None:
        console.report(_unchanged(found))
    options.show_next_recording(rig_file, quiet, loaded[0], "joint")


def _unchanged(found: FoundImuErrors) -> str:
    from linkpose.calibration.imu import FEWEST_ATTITUDES

    sides = ", ".join(found.missing_sides)
    lacking = f" Add a rest with {sides} upwards." if sides else " Add rests in further attitudes."
    return (
        f"Offset and scale of the accelerometer are unchanged: {counted(found.attitudes, 'attitude')} recorded, "
        f"{FEWEST_ATTITUDES} that determine all axes needed.{lacking}"
    )


def _show(found: FoundImuErrors) -> None:
    from linkpose.calibration.imu import FEWEST_ATTITUDES

    x, y, z = found.gyro_bias_rad_s
    click.echo(f"{counted(found.rests, 'rest')} in {counted(found.attitudes, 'attitude')}")
    click.echo(
        f"gyro: bias {x:.5f}, {y:.5f}, {z:.5f} ± {found.gyro_bias_std_rad_s:.5f} rad/s, "
        f"noise {found.gyro_noise_rad_s:.5f} rad/s"
    )
    click.echo(f"accelerometer: noise {found.accel_noise_m_s2:.4f} m/s²")
    if found.accel_offset_m_s2 is not None and found.accel_scale is not None:
        (ox, oy, oz), (kx, ky, kz) = found.accel_offset_m_s2, found.accel_scale
        click.echo(
            f"accelerometer: offset {ox:.4f}, {oy:.4f}, {oz:.4f} ± {found.accel_offset_std_m_s2:.4f} m/s², "
            f"scale {kx:.5f}, {ky:.5f}, {kz:.5f}"
        )
        if found.attitudes > FEWEST_ATTITUDES:
            click.echo(f"accelerometer: residual {found.accel_residual_m_s2:.4f} m/s²")
        else:  # as many equations as unknowns
            click.echo(f"accelerometer: {FEWEST_ATTITUDES} attitudes always fit; record more to get a residual")
    if found.pressure_noise_Pa is not None:
        click.echo(f"barometer: noise {found.pressure_noise_Pa:.2f} Pa")
