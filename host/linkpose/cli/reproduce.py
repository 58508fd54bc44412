"""`linkpose reproduce`: the papers' tables and figures, measured anew. Each rig is a module `reproduce_<rig>`."""

from __future__ import annotations

import click

from linkpose.cli import LazyGroup

# Rig -> what is measured.
RIGS = {
    "link": "Methods A to D on Tests 1 to 3 (Tables 1 and 2, Figure 2), and joint-inertial beside them.",
    "mice": "Noise of two and three optical mice against one (Figures 2 and 3).",
    "indoor": "Fixed against adaptive R, diagonal against off-diagonal, EKF against UKF, in an office floor.",
    "underwater": "The same under water, and the simulator's check of itself.",
}


@click.group("reproduce", cls=LazyGroup, table=RIGS, modules="linkpose.cli.reproduce_")
def command() -> None:
    """Measure the papers' tables and figures anew, on simulated runs of several seeds."""
