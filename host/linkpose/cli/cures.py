"""What to type: the one table that adds flags and commands to the library's errors."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from typing import Any

from linkpose import errors
from linkpose.cli.options import port_names

FLASH = "type `linkpose flash`"

# Error -> what the user types, from the error's facts. The most derived class counts.
CURES: dict[type[errors.LinkposeError], Callable[[Any], str]] = {
    errors.FileExists: lambda e: "name another file or add --force to replace it",
    errors.FileChanged: lambda e: "start again, and let no other program remove or write the file",
    errors.CannotWrite: lambda e: "name a file in a folder you may write to",
    errors.TooFewRows: lambda e: (
        f"to score the common part alone, add --from {e.common_s[0]:.6g} --to {e.common_s[1]:.6g}"
    ),
    errors.NoEstimate: lambda e: (
        "the height needs J2S: estimate with --j2s X,Y,Z, or with --j2s auto from a recording that turns the link "
        "about all axes"
        if "height" in e.quantities
        else "`linkpose info RECORDING` shows which sensors work"
    ),
    errors.UnknownPicture: lambda e: (
        "`linkpose plot ESTIMATE.csv -o FILE.html` plays an estimate in 3-D" if e.path.endswith(".html") else ""
    ),
    errors.PortNotFound: lambda e: _nearest_port(e.port) + "`linkpose ports` lists the ports",
    errors.NotASerialPort: lambda e: "`linkpose ports` lists the ports",
    errors.NoBoardFound: lambda e: (
        ("connect it or choose with --port" if e.ports else "plug the board in")
        + (", or try --port sim://link" if e.simulated_will_do else "")
    ),
    errors.SeveralBoardsFound: lambda e: "choose one with --port",
    errors.NoFirmware: lambda e: f"{FLASH} to put linkpose's firmware on the board, or choose another port with --port",
    errors.WrongFirmware: lambda e: FLASH if e.is_older else "type `pip install --upgrade linkpose`",
    errors.MissingJ2S: lambda e: (
        "type `linkpose calibrate joint`, give it with --j2s X,Y,Z, or estimate it with --j2s auto"
    ),
    errors.UncalibratedMagnetometer: lambda e: (
        "record it turned through all attitudes, type `linkpose calibrate mag RECORDING --rig rig.toml`, and add "
        "--rig rig.toml"
    ),
    errors.NoMagnetometer: lambda e: "type --port 'sim://link?mag=1'" if e.is_simulated else "",
    errors.FilterCannotRun: lambda e: cure(e.reason),
    errors.NoFilterRuns: lambda e: "; ".join(dict.fromkeys(filter(None, map(cure, e.reasons.values())))),
    errors.MissingMap: lambda e: "add --map MAP.yaml",
    errors.MissingBeacons: lambda e: "add --beacons BEACONS.csv",
    errors.MissingStart: lambda e: "add --start X,Y,HEADING (m, m, rad)",
    errors.AmbiguousStart: lambda e: "add --start X,Y,0 with the true one, or a beacon off the line",
    errors.UndecidedStart: lambda e: "add the true one as --start X,Y,HEADING, or drive to where the places differ",
    errors.NothingToEstimate: lambda e: "leave out --estimate",
    errors.NeedsScans: lambda e: "use --filter ekf",
    errors.NotPositiveDefinite: lambda e: (
        "give larger noises (--range-std, --speed-std, --turn-std) or a larger --alpha"
    ),
}

# Errors that are wrong usage: a name on the command line that cannot exist.
WRONG_USAGE = (errors.UnknownFilter, errors.UnknownPicture, errors.NamedTwice, errors.WrongAddress)


def _nearest_port(name: str) -> str:
    """A question about the port whose name is most like this one; empty where none is."""
    near = difflib.get_close_matches(name, port_names(), 1)
    return f"did you mean {near[0]}? " if near else ""


def cure(error: errors.LinkposeError) -> str:
    """What to type against an error; empty where the error's own text suffices."""
    for kind in type(error).__mro__:
        if kind in CURES:
            return CURES[kind](error)
    return ""


def sentence(error: errors.LinkposeError) -> str:
    """The error as the user reads it: what, why, what to type."""
    return "; ".join(filter(None, (str(error), cure(error))))
