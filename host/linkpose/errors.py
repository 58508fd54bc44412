"""The errors that linkpose raises. Each one carries its facts as attributes, and its text is a complete sentence.

The text names what happened and why. What to type on the command line is added there (`linkpose.cli.cures`), because a
Python program has no flags.
"""

from __future__ import annotations

import difflib
import itertools
import unicodedata
from collections.abc import Iterable, Sequence
from typing import Any

LONGEST_TEXT = 1500  # characters of a sentence. A list of all filters with reasons is shorter
MOST_STARTS = 3  # that a sentence lists


class LinkposeError(Exception):
    """The base of all errors that a user can cause or cure. On the command line: one sentence, exit status 1.

    A sentence that quotes too much of a damaged file is cut in its middle: it begins with the file and ends with the
    cure.
    """

    def __init__(self, text: str = "") -> None:
        if len(text) > LONGEST_TEXT:
            half = LONGEST_TEXT // 2
            text = f"{text[:half]} … {text[-half:]}"
        super().__init__(text)


# ---- files ----


class FileError(LinkposeError):
    """A file cannot be read or written, or does not hold what it should. `path`; `line` where a line is known."""

    def __init__(self, path: object, text: str, line: int | None = None) -> None:
        super().__init__(text)
        self.path = str(path)
        self.line = line


class FileFormatError(FileError):
    """The content of a file cannot be read: not a number, a missing column, another version."""


class FileExists(FileError):
    """An output file exists already and is kept."""

    def __init__(self, path: object) -> None:
        super().__init__(path, f"{path} exists already")


class NamedTwice(FileError):
    """One file is named for two outputs."""

    def __init__(self, path: object) -> None:
        super().__init__(path, f"{path} is named for two outputs; name two files")


class CannotRead(FileError):
    """The operating system does not give a file's content. `reason` is its own."""

    def __init__(self, path: object, reason: str | None, what: str = "") -> None:
        super().__init__(path, f"cannot read {what + ' ' if what else ''}{path}: {reason}")
        self.reason = reason


class UnknownPicture(FileError):
    """No picture has this ending. `formats` are the endings there are."""

    def __init__(self, path: object, formats: Sequence[str]) -> None:
        super().__init__(
            path, f"{path} is not a picture that linkpose writes; its name must end in {', '.join(formats)}"
        )
        self.formats = tuple(formats)


class CannotWrite(FileError):
    """The operating system does not take a file's content. `reason` is its own."""

    def __init__(self, path: object, reason: str | None, what: str = "") -> None:
        super().__init__(path, f"cannot write {what + ' ' if what else ''}{path}: {reason}")
        self.reason = reason


class FileChanged(CannotWrite):
    """Another program removed, replaced, truncated or changed a file during writing. `reason` states which."""


class MissingLibrary(LinkposeError):
    """A file format or a live output needs a library that is not installed. `library` is its name."""

    def __init__(self, library: str, path: object, extra: str = "files") -> None:
        super().__init__(f'{path} needs the library {library}. Install it: pip install "linkpose[{extra}]"')
        self.library, self.path = library, str(path)


class TooFewRows(LinkposeError):
    """Less than half of a filter's estimates have a reference: a score would describe another run than the user's.

    `rows` of `known` estimates have one, between `common_s` (from, to).
    """

    def __init__(
        self, name: str, paths: tuple[object, object], rows: tuple[int, int], common_s: tuple[float, float]
    ) -> None:
        self.filter, (self.rows, self.known), self.common_s = name, rows, common_s
        super().__init__(
            f"only {self.rows} of {self.known} estimates of {name} in {paths[0]} have a reference in {paths[1]}, "
            "less than half"
        )


class NoEstimate(LinkposeError):
    """A filter's columns are empty wherever they could be compared. `quantities` are their names."""

    def __init__(self, name: str, path: object, quantities: Sequence[str]) -> None:
        self.filter, self.quantities = name, tuple(quantities)
        super().__init__(f"{path}: {name} estimated no {' or '.join(quantities)}, so nothing of it can be compared")


# ---- ports and boards ----


class PortError(LinkposeError):
    """A serial port cannot be opened. `port` is its name."""

    def __init__(self, port: str, text: str) -> None:
        super().__init__(text)
        self.port = port


class WrongAddress(PortError):
    """The name of the port is no address that linkpose knows, or has a wrong part."""


class PortNotFound(PortError):
    """There is no port of this name."""

    def __init__(self, port: str) -> None:
        super().__init__(port, f"there is no port {port}")


class NotASerialPort(PortError):
    """The name belongs to a file or device that is not a serial port."""

    def __init__(self, port: str) -> None:
        super().__init__(port, f"{port} is not a serial port")


class PortBusy(PortError):
    """Another program has the port open. `holder` names it if the system reports it."""

    def __init__(self, port: str, holder: str | None = None) -> None:
        super().__init__(port, f"{port} is in use by {holder or 'another program'}. Close it and try again")
        self.holder = holder


class PermissionDenied(PortError):
    """The user may not open the port. `group` owns it."""

    def __init__(self, port: str, group: str) -> None:
        super().__init__(
            port,
            f"no permission to open {port}. Join the group that owns it with `sudo usermod -aG {group} $USER` "
            "and log in again",
        )
        self.group = group


class NoBoardFound(LinkposeError):
    """No port was named, and none of the ports of this machine is an UNO. `ports` lists them.

    `simulated_will_do` is True where a simulated board would serve the purpose.
    """

    def __init__(self, ports: Sequence[Any], simulated_will_do: bool = True) -> None:
        self.ports, self.simulated_will_do = tuple(ports), simulated_will_do
        listed = describe_ports(self.ports)
        super().__init__(f"no UNO is connected; the ports are: {listed}" if ports else "no serial port is connected")


class SeveralBoardsFound(LinkposeError):
    """No port was named, and several ports are UNOs. `ports` lists those."""

    def __init__(self, ports: Sequence[Any]) -> None:
        self.ports = tuple(ports)
        super().__init__(f"{len(ports)} boards are connected: {describe_ports(self.ports)}")


def describe_ports(ports: Sequence[Any]) -> str:
    """Ports in a sentence."""
    return ", ".join(f"{port.port} ({port.description or 'no description'})" for port in ports)


class BoardError(LinkposeError):
    """The board refuses a command, is silent, or is a different board."""


class NoFirmware(BoardError):
    """No linkpose firmware answers at the port. `received` is what came instead (bytes)."""

    def __init__(self, port: str, received: bytes, text: str) -> None:
        super().__init__(f"{port}: {text}")
        self.port, self.received = port, received


class WrongFirmware(BoardError):
    """Firmware and linkpose use different protocols. `is_older` is True where the firmware is the older side."""

    def __init__(self, text: str, is_older: bool) -> None:
        super().__init__(text)
        self.is_older = is_older  # True: the firmware, False: linkpose


# ---- filters ----


class UnknownFilter(LinkposeError):
    """No filter has this `name`; `known` are the names there are."""

    def __init__(self, name: str, known: Sequence[str]) -> None:
        near = difflib.get_close_matches(name.lower(), known, 1)
        hint = f"did you mean {near[0]}?" if near else f"the filters are {', '.join(known)}"
        super().__init__(f"there is no filter {name!r}; {hint}")
        self.name, self.known = name, tuple(known)


class CannotRun(LinkposeError):
    """The rig or the sensors do not allow a filter."""


class MissingJ2S(CannotRun):
    """The filter needs J2S, the vector from the joint centre to the sensor, and the rig does not contain it."""

    def __init__(self, name: str) -> None:
        super().__init__(f"{name} needs J2S, the vector from the joint centre to the sensor")
        self.filter = name


class UncertainJ2S(CannotRun):
    """The filter requires a known J2S; the rig's is only an initial value. `estimators` estimate it."""

    def __init__(self, name: str, estimators: Sequence[str]) -> None:
        super().__init__(f"{name} needs a J2S that is known; {', '.join(estimators)} is the filter that estimates it")
        self.filter, self.estimators = name, tuple(estimators)


class SensorMissing(CannotRun):
    """The filter needs a sensor that gives no value."""

    def __init__(self, name: str, sensor: str) -> None:
        super().__init__(f"{name} needs the {sensor}, which does not answer: check its wiring")
        self.filter, self.sensor = name, sensor


class UncalibratedMagnetometer(CannotRun):
    """The heading is to be held by a magnetometer whose hard iron is unknown."""

    def __init__(self) -> None:
        super().__init__(
            "the magnetometer is not calibrated (the rig has no [mag]): the iron of the board would turn the heading "
            "by tens of degrees"
        )


class NoMagnetometer(CannotRun):
    """The heading is to be held by a magnetometer, and none gives a value.

    `port` is the board's, None of a recording; `is_simulated` is True of a simulated board.
    """

    def __init__(self, port: str | None = None) -> None:
        self.port, self.is_simulated = port, port is not None and port.startswith("sim://")
        super().__init__(
            f"{port} simulates no magnetometer"
            if self.is_simulated
            else "no magnetometer gives a value: check its wiring, or leave it out"
        )


class FilterCannotRun(LinkposeError):
    """A filter that was named cannot run. `filter` is its name, `reason` the error that explains it."""

    def __init__(self, name: str, reason: CannotRun) -> None:
        super().__init__(f"the filter {name} cannot run: {reason}")
        self.filter, self.reason = name, reason


class NoFilterRuns(LinkposeError):
    """None of the filters can run. `reasons` maps each filter's name to its error."""

    def __init__(self, reasons: dict[str, CannotRun]) -> None:
        listed = "; ".join(f"{name}: {reason}" for name, reason in reasons.items())
        super().__init__(f"no filter can run on this ({listed})")
        self.reasons = reasons


class NotPositiveDefinite(LinkposeError):
    """A covariance is no longer positive definite. `matrix` is its name, `where` the filter."""

    def __init__(self, matrix: str, where: str) -> None:
        super().__init__(f"the {matrix} of {where} is no longer positive definite; larger noises may prevent this")
        self.matrix, self.where = matrix, where


class NoUsableData(LinkposeError):
    """No inertial sensor and no mouse gave usable data."""


# ---- localization ----


class MissingMap(LinkposeError):
    """The log holds laser scans, and there is no map. `log` names it."""

    def __init__(self, log: str) -> None:
        super().__init__(f"{log} holds laser scans, which need the map they were taken in")
        self.log = log


class MissingBeacons(LinkposeError):
    """The log holds ranges to beacons, and their positions are not given. `log` names it."""

    def __init__(self, log: str) -> None:
        super().__init__(f"{log} holds ranges to beacons, whose positions must be known")
        self.log = log


class MissingStart(LinkposeError):
    """Neither the log nor the settings state the pose at the start."""

    def __init__(self) -> None:
        super().__init__("the log does not state where the robot starts")


class AmbiguousStart(LinkposeError):
    """The beacons are near one line, and the log fits two starts on its two sides; `places` are their x and y (m)."""

    def __init__(self, *places: tuple[float, float]) -> None:
        words = " and ".join(f"({x:.1f}, {y:.1f})" for x, y in places)
        super().__init__(f"the beacons are near one line, and the first ranges fit a start at {words} m")
        self.places = places


class UndecidedStart(LinkposeError):
    """No place of the map explains the laser scans of the log better than all others. `log` names it.

    `starts` (x m, y m, heading rad) explain them best at the time `time_s`, the best one first. They explain them alike
    unless the robot `is_still`: then it moved too little to exclude other places.
    """

    def __init__(
        self, log: str, time_s: float, starts: Sequence[tuple[float, float, float]], is_still: bool = False
    ) -> None:
        words = [f"({x:.1f}, {y:.1f}, {heading:.2f})" for x, y, heading in starts[:MOST_STARTS]]
        if is_still:
            text = f"the robot moves too little to be sure of its place: the scans fit {words[0]} (m, m, rad) best"
        else:
            text = (
                f"the scans fit {len(starts)} places of the map alike, "
                f"{'' if len(starts) == len(words) else 'such as '}{', '.join(words[:-1])} and {words[-1]} (m, m, rad)"
            )
        super().__init__(f"{log}: {text} at {time_s:.6g} s, so the path stays unknown")
        self.log, self.time_s, self.starts, self.is_still = log, time_s, tuple(starts), is_still


class NothingToEstimate(LinkposeError):
    """Errors of the ranges are to be estimated, and the log holds no ranges. `log` names it."""

    def __init__(self, log: str) -> None:
        super().__init__(f"{log} holds no ranges from which a scale or bias could be estimated")
        self.log = log


class NeedsScans(LinkposeError):
    """The filter needs laser scans, and the log holds none. `log` names it, `filter` is the filter."""

    def __init__(self, log: str, name: str) -> None:
        super().__init__(f"{log} holds no laser scans, which the filter {name} needs")
        self.log, self.filter = log, name


class MapMismatch(LinkposeError):
    """The scans fit another form of the map much better. `log` names their log; `share` of the beams hit a wall of the
    map, and `changed_share` of the map as `change` describes it.
    """

    def __init__(self, log: str, change: str, share: float, changed_share: float) -> None:
        super().__init__(
            f"{log}: {share:.0%} of the beams end at a wall of the map, and {changed_share:.0%} if the map is {change}"
        )
        self.log, self.change, self.share, self.changed_share = log, change, share, changed_share


class NothingApplied(LinkposeError):
    """A filter applied no measurement of the log, and rejected `rejected`. `log` names it, `filter` is the filter.

    `remark` states what a comparison of single scans with the map has found; empty where there was none.
    """

    def __init__(self, log: str, name: str, rejected: int, remark: str = "") -> None:
        super().__init__(
            f"{log}: {name} found no pose that explains the scans: {remark}"
            if remark
            else f"{log}: {name} applied none of the measurements ({rejected} rejected), so there is no estimate; "
            "check the units (m, s, rad), the start, and the places of the beacons or the map"
        )
        self.log, self.filter, self.rejected, self.remark = log, name, rejected, remark


# ---- values ----


class InvalidValue(LinkposeError, ValueError):
    """An argument is out of range or of a wrong shape. `name` is the argument's."""

    def __init__(self, name: str, text: str) -> None:
        super().__init__(f"{name} {text}")
        self.name = name


# ---- text ----


def listed(names: Iterable[str], most: int = 200) -> str:
    """Names with commas between them, in at most `most` characters, for tables of any number of columns."""
    text = ", ".join(itertools.islice(names, most))
    return text if len(text) <= most else text[: most - 1] + "…"


def printable(text: object, most: int | None = None) -> str:
    """Text from a file or a device, safe for a terminal: control characters as escapes, and at most `most` characters.

    Escape sequences in a column name, a rig key or a USB description would otherwise move the cursor, retitle the
    window or, in some terminals, type a command. Line ends and tabs stay.
    """
    shown = "".join(
        c
        if c in "\n\t" or unicodedata.category(c) not in ("Cc", "Cf", "Cs", "Co")
        else c.encode("unicode_escape").decode()
        for c in str(text)
    )
    return shown if most is None or len(shown) <= most else shown[: most - 1] + "…"
