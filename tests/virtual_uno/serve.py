"""Serves the emulated board at a pseudo-terminal, as a command. `python tests/virtual_uno/serve.py --help`"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
sys.path.insert(0, str(HERE.parents[1] / "host"))

import parts  # noqa: E402
from bootloader import ATMEGABOOT, OPTIBOOT_RESETS, BootloaderImage, build_optiboot, programmed  # noqa: E402
from pty_server import PtyServer  # noqa: E402
from rig_signals import RigFeed  # noqa: E402

from linkpose.errors import LinkposeError  # noqa: E402
from linkpose.simulation.chain import ChainRun  # noqa: E402
from linkpose.simulation.link import LinkRun  # noqa: E402
from linkpose.simulation.mice import MiceRun, ring  # noqa: E402
from virtual_uno import Mouse, VirtualUno, VirtualUnoError  # noqa: E402

DEFAULT_HEX = HERE.parents[1] / ".pio" / "build" / "uno_distro" / "firmware.hex"

MICE = [{"clockHz": clock_hz} for clock_hz in (12_500, 10_200, 16_600, 14_000)]  # no two alike

FAULTS_HELP = f"""\
{parts.help_text()}
faults, at a time in seconds of the board (--fault 5:imu-unplug) or as lines on standard input (imu-unplug):
  imu-unplug imu-plug imu-nack imu-ok       the MPU-6050 loses its power, gets it back, NACKs, answers again
  baro-unplug baro-plug baro-nack baro-ok   the barometer; imu2-unplug and mag-unplug likewise
  imu-fault=FAULT imu2-fault=FAULT          zeros, frozen, full, stuck, hot, none
  sda-hold[=CLOCKS] sda-release             SDA is stuck, for so many clocks or until released
  i2c-corrupt=P                             each byte read has a wrong bit with probability P
  cable-pull cable-back cable-back=LINK     the port vanishes and returns, at another link if one is named
  flip-to-host=P drop-to-host=P insert-to-host=P   each byte of the line, and the same with to-board
  mouse1-unplug mouse1-plug                 and so for every mouse
  mouse1-parity=S                           one byte every S seconds has wrong parity (0: none)
  mouse1-set=OPTIONS                        other options from now on, such as responseUs=20000
  supply=V                                  the supply voltage
  reset                                     the reset line
  hang hang=interrupts                      the program stops in an endless loop, with interrupts off or on
"""


def main() -> int:
    options = _parse()
    if not options.blank and not options.hex.is_file():
        print(f"there is no {options.hex}: type `pio run -e uno_distro`, or give --hex", file=sys.stderr)
        return 1
    try:
        run, drive = _runs(options)
        with (
            _program(options) as (program, boot_address),
            VirtualUno(
                program,
                seed=options.seed,
                bootloader_s=0.0 if boot_address else options.bootloader,
                boot_address=boot_address,
                **_parts(options),
            ) as uno,
        ):
            statistics = _serve(uno, run, drive, options)
    except (VirtualUnoError, LinkposeError) as error:
        print(error, file=sys.stderr)
        return 1
    print(json.dumps({"event": "end", **statistics, **_load(statistics)}), flush=True)
    return 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=FAULTS_HELP, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hex", type=Path, default=DEFAULT_HEX, help="the firmware")
    parser.add_argument("--blank", action="store_true", help="Optiboot and no firmware: a board for `linkpose flash`")
    parser.add_argument("--link", type=Path, default=Path("virtual-uno"), help="symbolic link to the port")
    parser.add_argument(
        "--rig",
        choices=("link", "chain", "mice"),
        default="link",
        help="what is simulated (default: link; chain needs --imu2)",
    )
    parser.add_argument("--test", type=int, default=1, help="Test of the link: 1, 2 or 3")
    parser.add_argument("--seed", type=int, default=0, help="of the rig and of everything random on the board")
    parser.add_argument("--errors", default="calibrated", help="of the sensors: calibrated, datasheet or none")
    parser.add_argument("--mice", type=int, choices=range(5), help="how many (default: 3 with the rig mice, else none)")
    parser.add_argument("--mouse", action="append", default=[], metavar="PORT:OPTIONS", help="a mouse that deviates")
    parser.add_argument(
        "--imu", default="", metavar="OPTIONS", help="the inertial sensor at 0x68; `none`: there is none"
    )
    parser.add_argument("--imu2", nargs="?", const="", metavar="OPTIONS", help="a second one at 0x69")
    parser.add_argument("--bmp180", default="", metavar="OPTIONS", help="the barometer; `none`: there is none")
    parser.add_argument("--bmp280", nargs="?", const="", metavar="OPTIONS", help="this one in place of the BMP180")
    parser.add_argument("--mag", choices=parts.MAGNETOMETERS, help="a magnetometer")
    parser.add_argument("--supply", type=float, default=5.0, metavar="V", help="the supply voltage")
    images = (*OPTIBOOT_RESETS, "ATmegaBOOT")
    parser.add_argument("--bootloader-image", choices=images, help="this Optiboot, or the old Nano's bootloader")
    parser.add_argument("--duration", type=float, default=None, help="seconds of the board's time; else endless")
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument("--pace", dest="paced", action="store_true", default=True, help="by the wall clock (default)")
    pace.add_argument("--flat-out", dest="paced", action="store_false", help="as fast as the host reads")
    parser.add_argument("--clock-ppm", type=float, default=0.0, metavar="PPM", help="how fast the board's clock is")
    parser.add_argument("--no-reset-on-open", dest="reset_on_open", action="store_false", help="as without DTR")
    parser.add_argument(
        "--bootloader", type=float, default=1.0, metavar="S", help="its wait after a reset (default: 1)"
    )
    parser.add_argument("--disturbance", type=float, default=30.0, metavar="PA", help="what traffic adds to the BMP180")
    parser.add_argument("--fault", action="append", default=[], metavar="SECONDS:FAULT", help="see below")
    options = parser.parse_args()
    if options.mice is None:
        options.mice = 3 if options.rig == "mice" else 0
    return options


@contextlib.contextmanager
def _program(options: argparse.Namespace) -> Iterator[BootloaderImage]:
    """The .hex that the board begins with, and where in it a reset begins."""
    if not options.blank and options.bootloader_image is None:
        yield BootloaderImage(options.hex, 0)
        return
    with tempfile.TemporaryDirectory() as name:
        folder, version = Path(name), options.bootloader_image or "4.4"
        bootloader = ATMEGABOOT if version == "ATmegaBOOT" else build_optiboot(folder, resets=version)
        yield bootloader if options.blank else programmed(folder, options.hex, bootloader)


def _parts(options: argparse.Namespace) -> dict[str, Any]:
    """The parts on the board, as arguments of VirtualUno. Raises VirtualUnoError."""
    mice = [dict(mouse) for mouse in MICE[: options.mice]]
    for text in options.mouse:
        port, _, deviations = text.partition(":")
        if port not in map(str, range(1, len(mice) + 1)):
            raise VirtualUnoError(f"--mouse {text} names no mouse: the board has {len(mice)} (--mice)")
        mice[int(port) - 1] |= parts.parse(deviations, parts.MOUSE)
    bmp180 = "" if options.bmp180 == "none" else options.bmp180
    return {
        "adc": {"supplyV": options.supply},
        "mpu6050": parts.parse("" if options.imu == "none" else options.imu, parts.IMU),
        "imu2": None if options.imu2 is None else parts.parse(options.imu2, parts.IMU),
        "bmp180": {"disturbancePa": options.disturbance} | parts.parse(bmp180, parts.BMP180),
        "bmp280": None if options.bmp280 is None else parts.parse(options.bmp280, parts.BMP280),
        "magnetometer": options.mag,
        "mice": mice,
    }


def _runs(options: argparse.Namespace) -> tuple[LinkRun | MiceRun, MiceRun | None]:
    """What is simulated: the rig, and how the mice move if the rig is the link."""
    drive = MiceRun(options.seed, None, mice=ring(options.mice), errors=options.errors) if options.mice else None
    if options.rig == "mice":
        return MiceRun(options.seed, None, mice=ring(options.mice), errors=options.errors), None
    if options.rig == "chain":
        return ChainRun("hinge", options.seed, None, errors=options.errors), drive
    link = LinkRun(
        options.test,
        options.seed,
        None,
        errors=options.errors,
        imu2=options.imu2 is not None,
        mag=options.mag is not None,
    )
    return link, drive


def _serve(
    uno: VirtualUno, run: LinkRun | MiceRun, drive: MiceRun | None, options: argparse.Namespace
) -> dict[str, float]:
    feed = RigFeed(uno, run, drive)
    for sensor, part in ((uno.imu, options.imu), (uno.baro, options.bmp180)):
        if part == "none":
            sensor.unplug()
    planned = sorted((float(at), fault) for at, _, fault in (text.partition(":") for text in options.fault))

    def before_slice() -> None:
        feed.supply()
        while planned and uno.time_s >= planned[0][0]:
            faults.act(planned.pop(0)[1])
        for line in _lines_waiting():
            faults.act(line)

    def first_open() -> None:
        if server.statistics.opens == 1:
            feed.restart()  # the rig's time zero is the moment in which the port is first opened

    server = PtyServer(
        uno, options.link, paced=options.paced, clock_ppm=options.clock_ppm, reset_on_open=options.reset_on_open,
        on_slice=before_slice, on_open=first_open,
    )  # fmt: skip
    faults = Faulty(uno, server)
    for stop_signal in (signal.SIGTERM, signal.SIGINT):
        signal.signal(stop_signal, lambda *_: server.end())
    print(json.dumps({"event": "ready", "port": str(options.link)}), flush=True)
    try:
        server.run(options.duration)
    finally:
        server.pull_cable()
    return {**asdict(server.statistics), **uno.state(), "rig_start_s": feed.start_s}


def _load(statistics: dict[str, float]) -> dict[str, float]:
    return {"cpu_load": round(1 - statistics["sleep_cycles"] / max(1, statistics["cycle"]), 4)}


class Faulty:
    """The faults that can be asked for by name."""

    def __init__(self, uno: VirtualUno, server: PtyServer) -> None:
        self._server = server
        self._named: dict[str, Callable[[], object]] = {
            "sda-release": uno.release_sda,
            "cable-pull": server.pull_cable,
            "cable-back": server.put_cable_back,
            "reset": uno.reset,
            "hang": uno.hang,
        }
        for name, sensor in (("imu", uno.imu), ("imu2", uno.imu2), ("baro", uno.baro), ("mag", uno.mag)):
            self._named[f"{name}-unplug"] = sensor.unplug
            self._named[f"{name}-plug"] = sensor.plug
            self._named[f"{name}-nack"] = partial(sensor.nack, address=True)
            self._named[f"{name}-ok"] = sensor.nack
        self._valued: dict[str, Callable[[str], object]] = {
            "sda-hold": lambda value: uno.hold_sda(int(value) if value else None),
            "i2c-corrupt": lambda value: uno.corrupt_i2c(float(value)),
            "imu-fault": lambda value: uno.imu.set(**parts.parse(f"fault={value}", parts.IMU)),
            "imu2-fault": lambda value: uno.imu2.set(**parts.parse(f"fault={value}", parts.IMU)),
            "supply": lambda value: uno.supply(float(value)),
            "hang": lambda value: uno.hang(interrupts={"interrupts": True}[value]),
            "cable-back": lambda value: server.put_cable_back(Path(value)),
        }
        for number, mouse in enumerate(uno.mice, start=1):
            self._named[f"mouse{number}-unplug"] = mouse.unplug
            self._named[f"mouse{number}-plug"] = mouse.plug
            self._valued[f"mouse{number}-parity"] = partial(self._spoil_parity, mouse)
            self._valued[f"mouse{number}-set"] = partial(self._set_mouse, mouse)
        for kind in ("flip", "drop", "insert"):
            for way in ("to_host", "to_board"):
                self._valued[f"{kind}-{way.replace('_', '-')}"] = partial(self._disturb_line, way, kind)

    def act(self, text: str) -> None:
        """Raises VirtualUnoError for a fault that there is not."""
        name, _, value = text.partition("=")
        try:
            if name in self._named and not value:
                self._named[name]()
            else:
                self._valued[name](value)
        except (KeyError, ValueError):
            raise VirtualUnoError(f"there is no fault {text!r}: serve.py --help lists them") from None

    def _spoil_parity(self, mouse: Mouse, seconds: str) -> None:
        mouse.spoil_parity_every(float(seconds))

    def _set_mouse(self, mouse: Mouse, text: str) -> None:
        mouse.set(**parts.parse(text, parts.MOUSE))

    def _disturb_line(self, way: str, kind: str, probability: str) -> None:
        setattr(self._server, way, getattr(self._server, way)._replace(**{kind: float(probability)}))
        self._server.apply_line()


_standard_input = bytearray()


def _lines_waiting() -> list[str]:
    """Whole lines on standard input, without waiting for them."""
    if not select.select([sys.stdin], [], [], 0)[0]:
        return []
    _standard_input.extend(os.read(sys.stdin.fileno(), 4096))
    *lines, rest = bytes(_standard_input).split(b"\n")
    _standard_input[:] = rest
    return [line.decode().strip() for line in lines if line.strip()]


if __name__ == "__main__":
    sys.exit(main())
