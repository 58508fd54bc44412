"""`linkpose calibrate chain`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from linkpose.cli import options
from linkpose.cli.live import Console
from linkpose.sensors.rig import CHAIN_JOINTS

if TYPE_CHECKING:
    from linkpose.calibration.chain import ChainCalibration


@click.command("chain")
@click.argument("recordings", type=options.FILE, nargs=-1, required=True)
@click.option("--rig", "rig_file", type=options.FILE, required=True, help="Rig file to write the mounting into.")
@click.option(
    "--joint",
    type=click.Choice(CHAIN_JOINTS),
    help="Joint between the two links. Default: the kind that the motion shows.",
)
@options.as_json
@options.quiet
def command(
    recordings: tuple[Path, ...],
    rig_file: Path,
    joint: Literal["ball", "hinge"] | None,
    json_lines: bool,
    quiet: bool,
) -> None:
    """Estimate how two sensors are mounted on two links, and write it into the rig file.

    Finds r1 and r2, the vectors from the centre of the joint between the links to each sensor in its axes, the kind of
    this joint, and the axis of a hinge. Keep the links at rest for some seconds, then move both for half a minute or
    more, in all directions that the joint allows. What the motion does not show is written with a large standard
    deviation (r1, r2) or not at all (the axis).
    """
    from linkpose.calibration.chain import LARGE_RESIDUAL_M_S2, calibrate_chain, remarks, with_calibration

    console = Console(quiet, verbose=False)
    loaded, rig = options.recordings_and_rig(recordings, rig_file, console.report)
    found = calibrate_chain(loaded, rig, joint)
    with_calibration(rig, found).save(rig_file)
    if json_lines:
        click.echo(json.dumps(found.as_dict()))
    else:
        _show(found, joint, rig.chain.joint, console)
    for remark in remarks(found, joint, rig):
        console.report(remark)
    if found.residual_m_s2 > LARGE_RESIDUAL_M_S2:
        console.report("The residual is large. Check that each sensor is firm on its own link.")
    options.show_rig_written(rig_file, quiet, *options.estimate_command(recordings[0], "--rig", rig_file))


def _show(found: ChainCalibration, stated: str | None, of_rig: str, console: Console) -> None:
    """The result on stdout; what is not observable, and what to do, on stderr."""
    from linkpose.calibration.chain import WEAK_M

    for k in range(2):
        axes = zip(found.levers_m[k].tolist(), found.std_m[k].tolist(), strict=True)
        click.echo(f"r{k + 1} {', '.join(f'{value:.4f} ± {std:.4f}' for value, std in axes)} m")
    turned = (
        f"rotation about the best axis {found.motion.turn_deg:.1f}° rms, about others {found.motion.play_deg:.1f}° rms"
    )
    click.echo(f"joint: {_verdict(found, stated, of_rig)} ({turned})")
    if found.axes is not None:
        for k, (axis, std) in enumerate(zip(found.axes.tolist(), found.motion.std_deg.tolist(), strict=True), 1):
            click.echo(f"axis{k} {', '.join(f'{value:.3f}' for value in axis)} ± {std:.1f}°")
    click.echo(f"residual {found.residual_m_s2:.3f} m/s² over {found.samples} samples in motion")
    weak = [
        f"r{k + 1} along its {'xyz'[axis]} axis"
        for k, stds in enumerate(found.std_m.tolist())
        for axis, std in enumerate(stds)
        if std > WEAK_M
    ]
    if weak:
        console.report(
            f"Not observable: {', '.join(weak)}. Rotate that sensor's link about its other axes, faster, while the "
            "joint between the links moves to and fro."
        )
    if found.joint == "hinge" and found.axes is None:
        console.report("The axis is not observable. Move both links, in more than one direction.")


def _verdict(found: ChainCalibration, stated: str | None, of_rig: str) -> str:
    if stated:
        return f"{stated}, as stated"
    if found.joint == "hinge":
        return "hinge: the links turn about one axis only"
    if found.joint == "ball":
        return "ball joint: the links turn about several axes"
    return f"not shown by this motion; the rig file keeps {of_rig}"
