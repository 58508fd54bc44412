"""Options that several commands share, and how they are read."""

from __future__ import annotations

import itertools
import math
import os
import shlex
import subprocess
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import click
from click.shell_completion import CompletionItem

from linkpose.errors import CannotWrite
from linkpose.sensors.rig import LONGEST_LINK_M, UNKNOWN_JOINT, Joint, Rig, as_rig

if TYPE_CHECKING:
    from linkpose.recording.reader import Recording

Function = TypeVar("Function", bound=Callable[..., Any])


ERROR_LEVELS = ("calibrated", "datasheet", "none")


class AddressType(click.ParamType):  # type: ignore[type-arg]  # generic only in newer releases of click
    """An address or a name of this computer, without a port; an IPv6 address may stand in brackets, as in a browser."""

    name = "ADDRESS"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        address = str(value).strip().removeprefix("[").removesuffix("]")
        if not address or "/" in address or address.count(":") == 1:
            self.fail(f"{value!r} is no address alone, such as 0.0.0.0; --view-port names the port", param, ctx)
        return address


class VectorType(click.ParamType):  # type: ignore[type-arg]  # generic only in newer releases of click
    """A J2S: three numbers, X,Y,Z (m)."""

    name = "X,Y,Z"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        words = str(value).split(",")
        try:
            x, y, z = (float(word) for word in words)
        except ValueError:
            self.fail(f"{value!r} is not three numbers; type for example --j2s -0.09,-0.04,1.65 (metres)", param, ctx)
        if not all(map(math.isfinite, (x, y, z))):
            self.fail(f"{value!r} is not finite", param, ctx)
        if math.hypot(x, y, z) > LONGEST_LINK_M:
            self.fail(f"{value!r} is longer than {LONGEST_LINK_M:.0f} m; J2S is in metres", param, ctx)
        return x, y, z


class JointType(VectorType):
    """A joint by its J2S: three numbers, or `auto` for one that is to be estimated."""

    name = "X,Y,Z|auto"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Joint:
        return UNKNOWN_JOINT if str(value).lower() == "auto" else Joint(super().convert(value, param, ctx))


class SecondsType(click.ParamType):  # type: ignore[type-arg]
    """A time of more than 0 s."""

    name = "S"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        try:
            seconds = float(value)
        except ValueError:
            seconds = math.nan
        if not 0 < seconds < math.inf:
            self.fail(f"{value!r} is not a number of seconds above 0", param, ctx)
        return seconds


# Bounds of numbers in options: products of several much larger or smaller ones leave the range of numbers.
LARGEST, SMALLEST = 1e9, 1e-9


class FiniteRange(click.FloatRange):
    """A number within bounds. click's own range accepts NaN and infinity, and shows an open end as None."""

    def _describe_range(self) -> str:
        ends = (self.min, ">" if self.min_open else ">="), (self.max, "<" if self.max_open else "<=")
        return ", ".join(f"{sign}{end:g}" for end, sign in ends if end is not None)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value!r} is not finite", param, ctx)
        if abs(number) > LARGEST:
            self.fail(f"{value!r} is beyond {LARGEST:g}", param, ctx)
        if self.min_open and self.min == 0 and number < SMALLEST:
            self.fail(f"{value!r} is nearer to 0 than {SMALLEST:g}", param, ctx)
        return number


FILE = click.Path(path_type=Path, readable=False)  # what cannot be read is a failure of its own, not wrong usage


def port(function: Function) -> Function:
    return click.option(
        "--port",
        metavar="PORT",
        shell_complete=complete_port,
        help="Device, pyserial URL or sim://link. Default: $LINKPOSE_PORT, otherwise the only UNO connected.",
    )(function)


def complete_filter(_ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[str]:
    """Names of filters for the shell's completion."""
    from linkpose.filters import NAMES

    return [name for name in NAMES if name.startswith(incomplete.replace("_", "-"))]


def complete_port(_ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[str]:
    """Names of ports for the shell's completion."""
    return [name for name in port_names() if name.startswith(incomplete)]


def port_names() -> list[str]:
    """The serial ports that are connected, and the simulated boards."""
    from linkpose.device.ports import find_ports

    return [*(port.port for port in find_ports()), "sim://link", "sim://chain", "sim://mice"]


def duration(function: Function) -> Function:
    return click.option(
        "--duration", type=SecondsType(), help="Stop after this time (s). Default: Ctrl-C ends the run."
    )(function)


def page(function: Function) -> Function:
    """--view, --view-host and --view-port of a command that can serve a page."""
    function = click.option(
        "--view-port",
        type=click.IntRange(1, 65535),
        metavar="PORT",
        help="TCP port of the page. Default: from 8080 on.",
    )(function)
    function = click.option(
        "--view-host",
        type=AddressType(),
        default="127.0.0.1",
        show_default=True,
        metavar="ADDRESS",
        help="Serve the page at this address; 0.0.0.0: at all of this computer, for others in the network.",
    )(function)
    return click.option(
        "--view",
        "has_page",
        is_flag=True,
        help="Show the estimates in the browser: link or robot in 3-D, charts, sensor health.",
    )(function)


def rig_and_j2s(function: Function) -> Function:
    function = click.option(
        "--j2s-std",
        type=FiniteRange(min=0, min_open=True),
        metavar="METRES",
        help="Standard deviation of --j2s, each axis (m); joint-inertial refines J2S within it. Default: 0.0001.",
    )(function)
    function = click.option(
        "--j2s",
        "joint",
        type=JointType(),
        help="J2S, the vector from the joint centre to the sensor, in the sensor's axes (m); auto: estimate it.",
    )(function)
    return click.option("--rig", "rig_file", type=FILE, help="Rig file: calibration, J2S, mice.")(function)


def rig_to_write(what: str) -> Callable[[Function], Function]:
    """--rig of a command that writes its part of a rig file."""
    return click.option(
        "--rig", "rig_file", type=FILE, default=Path("rig.toml"), show_default=True, metavar="RIG.toml", help=what
    )


def joint_from(joint: Joint | None, j2s_std_m: float | None) -> Joint | None:
    """The joint that --j2s and --j2s-std describe. Raises UsageError for --j2s-std alone, and for no link."""
    if j2s_std_m is not None:
        if joint is None or joint is UNKNOWN_JOINT:
            raise click.UsageError("--j2s-std is the uncertainty of --j2s X,Y,Z: add --j2s X,Y,Z")
        joint = replace(joint, j2s_std_m=j2s_std_m)
    if joint is not None and joint.is_too_short:
        raise click.UsageError("--j2s places the sensor in the joint's centre; if J2S is unknown, type --j2s auto")
    return joint


def sensor_errors(function: Function) -> Function:
    return click.option(
        "--errors",
        type=click.Choice(ERROR_LEVELS),
        default="calibrated",
        show_default=True,
        help="What the sensors get wrong; none: the noise of a converter.",
    )(function)


class ErrorsType(click.ParamType):  # type: ignore[type-arg]
    """Sensor errors of a simulation: a level by name, or a rig file whose noise the sensors have."""

    name = "calibrated|datasheet|none|RIG.toml"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str | Rig:
        if isinstance(value, Rig) or value in ERROR_LEVELS:
            return value  # type: ignore[no-any-return]
        if Path(value).suffix == ".toml":
            return Rig.load(value)
        return self.fail(f"{value!r} is neither {', '.join(ERROR_LEVELS)} nor a rig file (.toml)", param, ctx)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        levels = [CompletionItem(level) for level in ERROR_LEVELS if level.startswith(incomplete)]
        return levels or [CompletionItem(incomplete, type="file")]


def sensor_errors_or_rig(function: Function) -> Function:
    return click.option(
        "--errors",
        type=ErrorsType(),
        default="calibrated",
        show_default=True,
        help="Errors of the simulated sensors: a level (none: the noise of a converter), or a rig file with the noise "
        "that `calibrate noise` measured.",
    )(function)


def up(function: Function) -> Function:
    return click.option(
        "--up",
        type=click.Choice(["y", "z"]),
        help="Upward axis of a motion-capture take. Default: y; z for C3D, unless the file states another.",
    )(function)


def seeds(what: str, default: int = 5) -> Callable[[Function], Function]:
    """--seeds of an experiment: how many of these simulated runs."""
    return click.option(
        "--seeds", type=click.IntRange(min=1), default=default, show_default=True, help=f"Number of simulated {what}."
    )


def refuse_standard_output(_ctx: click.Context, _param: click.Parameter, path: Path | None) -> Path | None:
    """The path of a picture; raises BadParameter for the standard output, which already takes the figures."""
    if str(path) == "-":
        raise click.BadParameter("the figures go to the standard output: name a file for the picture")
    return path


def plot(what: str) -> Callable[[Function], Function]:
    """--plot of a command that draws its result."""
    return click.option(
        "--plot",
        "plot_path",
        type=FILE,
        callback=refuse_standard_output,
        metavar="FILE.png",
        help=f"{what} PNG, SVG or PDF, by the file's ending.",
    )


def thesis_figures(chapter: str) -> Callable[[Function], Function]:
    """--plot of an experiment of the thesis: one picture per figure."""
    return click.option(
        "--plot",
        "plot_path",
        type=FILE,
        callback=refuse_standard_output,
        metavar="FOLDER|FILE.png",
        help=f"Draw the figures of {chapter}, one picture each, and the errors of all variants, into this folder "
        "(figure-3.1.png …, variants-….png). FILE.png (or .svg, .pdf) names the picture of the variants; figures lie "
        "beside it as FILE-figure-3.1.png ….",
    )


def simulated_outputs(what: str) -> Callable[[Function], Function]:
    """-o and --truth of a simulator."""

    def decorate(function: Function) -> Function:
        function = click.option("--truth", type=FILE, required=True, help="Truth to write (CSV).")(function)
        return click.option("-o", "--output", type=FILE, required=True, help=what)(function)

    return decorate


def quiet(function: Function) -> Function:
    """-q of a command without -v."""
    return click.option("-q", "--quiet", is_flag=True, help="Print results and errors only.")(function)


def show_next(quiet: bool, *words: object, then: Sequence[object] = ()) -> None:
    """The command to type next, and the one after it, on stderr; nothing where a file is the standard output."""
    if quiet or "-" in map(str, words):
        return
    for when, command in (("next", words), ("then", then)):
        if command:
            click.echo(f"{when}: {typed(command)}", err=True)


def estimate_command(recording: Path, *flags: object) -> tuple[object, ...]:
    """The command that estimates over a recording, to propose as the next one."""
    return "estimate", recording, *flags, "-o", new_file("estimate.csv")


def plot_command(estimates: Path) -> tuple[object, ...]:
    """The command that draws estimates, to propose as the next one; it replaces no picture."""
    picture = estimates.with_suffix(".png")
    return "plot", estimates, *(("-o", new_file(str(picture))) if _exists(picture) else ())


def new_file(name: str) -> Path:
    """A file to propose: of this name, or estimate-2.csv and so on where estimate.csv exists."""
    from linkpose.outputs import numbered

    path = Path(name)
    return next(free for free in itertools.chain([path], numbered(path)) if not _exists(free))


def _exists(path: Path) -> bool:
    """Whether the file exists; False where the folder cannot be looked at, which is no reason to fail."""
    try:
        return path.exists()
    except OSError:
        return False


def typed(words: Iterable[object]) -> str:
    """A command of linkpose as the user types it: a file's name with a space is quoted."""
    texts = ["linkpose", *map(str, words)]
    return subprocess.list2cmdline(texts) if os.name == "nt" else shlex.join(texts)


def written(path: Path | None) -> str:
    """The end of a message that names the file that was written; empty for none and for the standard output."""
    return "" if path is None or str(path) == "-" else f": {path}"


def refuse_mixed_output(output: Path | None, json_lines: bool) -> None:
    """Raises UsageError where two kinds of results would be mixed on the standard output."""
    if json_lines and str(output) == "-":
        raise click.UsageError("-o - and --json both write to the standard output: leave out one of them")


def as_json(function: Function) -> Function:
    return click.option("--json", "json_lines", is_flag=True, help="One JSON object a line on stdout.")(function)


def force(function: Function) -> Function:
    return click.option("--force", is_flag=True, help="Replace an existing file.")(function)


def plain(function: Function) -> Function:
    return click.option(
        "--plain", is_flag=True, help="Write no comment lines; the metadata go to NAME.meta.json beside NAME.csv."
    )(function)


def verbosity(function: Function) -> Function:
    function = click.option("-q", "--quiet", is_flag=True, help="Print results and errors only.")(function)
    return click.option("-v", "--verbose", is_flag=True, help="Print details.")(function)


def resolve_rig(rig_file: Path | None, joint: Joint | None, brought: Rig | None) -> Rig:
    """The rig file if one is named, otherwise the rig of the recording or simulated board; --j2s replaces its J2S."""
    rig = as_rig(rig_file, brought)
    return replace(rig, joint=joint) if joint else rig


def recordings_and_rig(
    paths: Sequence[Path], rig_file: Path, report: Callable[[str], None]
) -> tuple[list[Recording], Rig]:
    """The recordings of a calibration, and the rig that it changes: the file's, or else that of the first recording.

    `report` gets the remarks on the recordings.
    """
    from linkpose.recording.reader import load_recording

    loaded = [load_recording(path) for path in paths]
    for remark in (remark for recording in loaded for remark in recording.remarks):
        report(remark)
    try:
        is_there = rig_file.exists()
    except OSError as error:
        raise CannotWrite(rig_file, error.strerror, "the rig file") from error
    return loaded, resolve_rig(rig_file if is_there else None, None, loaded[0].rig)


# The recording that a calibration needs: its file, and the motion of the simulated link.
_RECORDINGS = {"imu": ("rests.csv", "sides"), "joint": ("swing.csv", "swing")}


def show_next_recording(rig_file: Path, quiet: bool, before: Recording, calibration: Literal["imu", "joint"]) -> None:
    """Where the rig was written, the command that records for the next calibration, and that calibration.

    Where the recording `before` is of a simulated board, this board is simulated again.
    """
    name, motion = _RECORDINGS[calibration]
    recording, device = new_file(name), str(before.metadata.get("device"))
    port = ("--port", _with_motion(device, motion)) if device.startswith("sim://link") else ()
    then = ("calibrate", calibration, recording, "--rig", rig_file)
    show_rig_written(rig_file, quiet, "record", recording, *port, then=then)


def _with_motion(address: str, motion: str) -> str:
    """The address of a simulated link with this motion."""
    rig, _, query = address.partition("?")
    options = [option for option in query.split("&") if option and not option.startswith("motion=")]
    options += [f"motion={motion}"] * (motion != "swing")
    return "?".join(filter(None, (rig, "&".join(options))))


def show_rig_written(rig_file: Path, quiet: bool, *words: object, then: Sequence[object] = ()) -> None:
    """The end of a calibration, on stderr: the rig file that was written, and what to type next, as `show_next`."""
    if not quiet:
        click.echo(f"written to {rig_file}", err=True)
    show_next(quiet, *words, then=then)
