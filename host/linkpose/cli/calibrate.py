"""`linkpose calibrate`: writes parts of a rig file from recordings made for it. Each is a module `calibrate_<part>`."""

from __future__ import annotations

import click

from linkpose.cli import LazyGroup

# Part of the rig file -> what is estimated.
PARTS = {
    "imu": "Bias, offset, scale and noise of the inertial sensor, from rests in several attitudes.",
    "joint": "J2S, the vector from the joint centre to the sensor, from the link in motion.",
    "chain": "Mounting of two sensors on two links and the joint between them, from both links in motion.",
    "mag": "Hard iron, soft iron and axes of the magnetometer, from the sensor turned through all attitudes.",
    "noise": "Allan deviation: noise density, bias instability, random walk, temperature drift, from a long rest.",
    "mice": "Counts per metre and mounting angle of each mouse, from a straight line and a full turn.",
}


@click.group("calibrate", cls=LazyGroup, table=PARTS, modules="linkpose.cli.calibrate_")
def command() -> None:
    """Estimate calibration values from recordings made for it, and write them into a rig file."""
