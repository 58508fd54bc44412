"""`linkpose calibrate noise`."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from linkpose.cli import options
from linkpose.cli.live import Console
from linkpose.errors import LinkposeError
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY

if TYPE_CHECKING:
    from linkpose.calibration.noise import AxisNoise, NoiseCalibration


@click.command("noise")
@click.argument("recordings", type=options.FILE, nargs=-1, required=True)
@options.rig_to_write("Rig file to write the noise into.")
@click.option("--force", is_flag=True, help="Write the rig file even if the sensor was not at rest.")
@options.as_json
@options.quiet
def command(recordings: tuple[Path, ...], rig_file: Path, force: bool, json_lines: bool, quiet: bool) -> None:
    """Estimate white noise, bias instability, random walk and temperature drift from a long rest.

    Lay the sensor on a firm table, away from motors and fans, and record it untouched for half an hour or more. The
    Allan deviation of each axis gives the coefficients. Without a change of temperature of 1 °C there is no drift.
    `linkpose simulate link --still --duration 1800` simulates such a recording.
    """
    from linkpose.calibration.noise import calibrate_noise, with_calibration

    console = Console(quiet, verbose=False)
    loaded, rig = options.recordings_and_rig(recordings, rig_file, console.report)
    found = calibrate_noise(loaded)
    if json_lines:
        click.echo(json.dumps(found.as_dict()))
    else:
        _show(found)
    if not found.is_rest and not force:
        raise LinkposeError(
            f"this was not a rest: {'; '.join(found.disturbances)}. {rig_file} is unchanged; record again, or add "
            "--force to write the figures all the same"
        )
    with_calibration(rig, found).save(rig_file)
    options.show_next_recording(rig_file, quiet, loaded[0], "imu")


def _show(found: NoiseCalibration) -> None:
    click.echo(
        f"rest of {found.duration_s:.0f} s at {found.rate_hz:.1f} Hz, "
        f"{100 * found.duration_s / found.recorded_s:.0f} % of the recording"
    )
    _show_sensor("gyro", found.gyro, math.degrees(1.0), "°/s", 4)
    _show_sensor("accelerometer", found.accel, 1e6 / STANDARD_GRAVITY, "µg", 0)
    if found.gyro[0].drift is None:
        change = "unknown" if found.temperature_range_degC is None else f"{found.temperature_range_degC:.1f} °C"
        click.echo(f"temperature drift: not observable, change of temperature {change}")
    for name, ratios in found.worse_than_data_sheet.items():
        sensor = "gyro" if name == "gyro" else "accelerometer"
        click.echo(
            f"{sensor}: noisier than the MPU-6050's data sheet, {', '.join(f'{ratio:.1f}' for ratio in ratios)} times "
            "its density"
        )
    if not found.worse_than_data_sheet:
        click.echo("white noise: within the MPU-6050's data sheet")
    if found.is_long_enough:
        click.echo("The rest was long enough for the density and the bias instability of each axis.")
    else:
        click.echo(
            "The rest was too short: a bias instability marked ≤ is an upper bound. Record "
            f"{found.missing_duration_s / 60:.0f} min or more."
        )


def _show_sensor(name: str, axes: Sequence[AxisNoise], scale: float, unit: str, decimals: int) -> None:
    """The coefficients of a sensor, `scale` times those in SI units."""
    models = [axis.model for axis in axes]
    click.echo(
        f"{name}: white noise "
        + ", ".join([f"{scale * m.density:.{decimals}f} ± {scale * m.density_std:.{decimals}f}" for m in models])
        + f" {unit}/√Hz"
    )
    bounds = [
        f"{'≤ ' if m.instability_is_bound else ''}{scale * m.instability:.{decimals}f} (at {m.instability_at_s:.0f} s)"
        for m in models
    ]
    click.echo(f"{name}: bias instability {', '.join(bounds)} {unit}")
    walks = [
        f"{scale * m.walk:.{decimals + 1}f} ± {scale * m.walk_std:.{decimals + 1}f}" if m.walk else "not observed"
        for m in models
    ]
    click.echo(f"{name}: random walk {', '.join(walks)} {unit}/√s")
    if axes[0].drift is not None:
        drifts = [f"{scale * (a.drift or 0):.{decimals}f} ± {scale * (a.drift_std or 0):.{decimals}f}" for a in axes]
        click.echo(f"{name}: temperature drift {', '.join(drifts)} {unit}/°C")
