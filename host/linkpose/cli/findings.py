"""What `estimate` reports besides the estimates: the filters that run, J2S, the mice and the magnetic field."""

from __future__ import annotations

from typing import TYPE_CHECKING

from linkpose.cli.cures import sentence
from linkpose.errors import LinkposeError, MissingJ2S
from linkpose.mice_findings import mice_findings

if TYPE_CHECKING:
    from linkpose.cli.live import Console
    from linkpose.estimation import Estimator
    from linkpose.sensors.rig import Joint

WORST_STD_M = 0.03  # (m, 1σ in the worst direction) from which on the heights are rough: 2 % of a link of 1.65 m


def report_running(estimator: Estimator, joint: Joint | None, console: Console) -> None:
    """Reports which filters run; `joint` is the joint that --j2s states.

    Raises LinkposeError if J2S is to be estimated and no filter that runs does it.
    """
    from linkpose import filters

    if joint is not None and joint.known_j2s_m is None and estimator.found_j2s is None:
        name = next(name for name, able in filters.REGISTRY.items() if able.j2s == "guess")
        raise LinkposeError(f"--j2s auto is estimated by {name}, which does not run; add --filter {name}")
    left_out = {name: sentence(reason) for name, reason in estimator.left_out.items()}
    for reason in dict.fromkeys(left_out.values()):
        names = ", ".join(name for name, why in left_out.items() if why == reason)
        console.detail(f"not running: {names}: {reason}")
    missing = [name for name, reason in estimator.left_out.items() if isinstance(reason, MissingJ2S)]
    is_robot = any(filters.REGISTRY[f.name].is_odometric for f in estimator.filters)  # which does not use J2S
    if missing and not is_robot and any(filters.REGISTRY[f.name].sensors for f in estimator.filters):
        console.report(left_out[missing[0]])
    others = " (-v: why not others)" if left_out else ""
    console.report(f"Running: {', '.join(f.name for f in estimator.filters)}{others}")


def report_findings(estimator: Estimator, console: Console) -> None:
    """What the filters found about J2S, the mice and the magnetic field, and what is wrong with the measurements."""
    _report_j2s(estimator, console)
    for text in mice_findings(estimator):
        console.report(text)
    _report_field(estimator, console)
    for remark in estimator.remarks:
        console.report(remark)


def _report_j2s(estimator: Estimator, console: Console) -> None:
    """J2S where it was estimated, and the axis along which the motion did not excite it."""
    found = estimator.found_j2s
    if not found:
        return
    axes = (f"{value:.4f} ± {std:.4f}" for value, std in zip(found.mean_m, found.std_m, strict=True))
    console.report(f"J2S {', '.join(axes)} m")
    if found.worst_std_m > WORST_STD_M:
        console.report(
            f"The motion does not determine J2S along the sensor's {found.worst_axis} axis (1σ is "
            f"{found.worst_std_m:.2f} m), so the heights are rough. Swing the link longer, in all directions."
        )


def _report_field(estimator: Estimator, console: Console) -> None:
    """How long the magnetometer held the heading, and the largest disturbance."""
    found = estimator.magnetic_field
    if found is None:
        return
    if not found.references:
        console.report(
            "The magnetometer did not hold the heading: the field is not as strong as at its calibration. Move away "
            "from iron, or calibrate it here: linkpose calibrate mag RECORDING --rig rig.toml"
        )
        return
    console.report(
        f"The magnetometer held the heading for {found.used_s:.0f} s."
        + (
            f" For {found.rejected_s:.0f} s the field was disturbed, by {found.largest_disturbance_uT:.1f} µT at most."
            if found.rejected_s >= 0.5  # which rounds to 1 s
            else ""
        )
        + ("" if found.north_deg is None else f" Magnetic north is at yaw {found.north_deg:.0f}°.")
    )
