"""`linkpose simulate`: recordings of simulated rigs with their truth. Each rig is a module `simulate_<rig>`."""

from __future__ import annotations

import click

from linkpose.cli import LazyGroup

# Rig -> what it is.
RIGS = {
    "link": "A link on a ball joint, moved by hand: Tests 1 to 3 of the link paper.",
    "chain": "Two links with a sensor on each, a hinge or ball joint between them.",
    "mice": "A robot with optical mice under it.",
    "indoor": "A robot with a laser scanner in an office floor.",
    "underwater": "A vehicle with Doppler log, attitude sensor, depth and ranges to four beacons.",
}


@click.group("simulate", cls=LazyGroup, table=RIGS, modules="linkpose.cli.simulate_")
def command() -> None:
    """Simulate a recording and its truth. The same seed gives the same recording."""
