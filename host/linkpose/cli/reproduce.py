"""`linkpose reproduce`: the papers' tables and figures, on simulated runs. Each rig is a module `reproduce_<rig>`."""

from __future__ import annotations

import click

from linkpose.cli import LazyGroup

# Rig -> what is reproduced.
RIGS = {
    "link": "Methods A to D and joint-inertial on Tests 1 to 3 (Tables 1 and 2, Figure 2).",
    "mice": "Noise of two and three optical mice compared with one (Figures 2 and 3).",
    "indoor": "Fixed against adaptive R, diagonal against off-diagonal, EKF against UKF, on an office floor.",
    "underwater": "The same under water, and the simulator's self-check.",
}


@click.group("reproduce", cls=LazyGroup, table=RIGS, modules="linkpose.cli.reproduce_")
def command() -> None:
    """Reproduce the papers' tables and figures on simulated runs of several seeds."""
