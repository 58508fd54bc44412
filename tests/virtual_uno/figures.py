"""The firmware's figures, measured on the emulated board from pins, bus and line, not from what it reports of itself.

    python tests/virtual_uno/figures.py [--hex FILE] [--minutes 10] [--json]

Each row: what was measured, its value, and what it must reach; with --json {"figure", "value", "unit", "must"}.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
sys.path.insert(0, str(HERE.parents[1] / "host"))

from measuring import (  # noqa: E402
    DEFAULTS,
    MICE,
    MOUSE_VALID,
    busy,
    invalid,
    jitter_us,
    lost,
    move_all,
    reported,
    stream,
    totals,
    valid_again_ms,
)
from wire_link import WATCHED_BUS, WireLink, burst_starts  # noqa: E402

from linkpose.wire.messages import Nak, NakReason, SampleFlags, Stop  # noqa: E402
from virtual_uno import VirtualUno, VirtualUnoError  # noqa: E402

DEFAULT_HEX = HERE.parents[1] / ".pio" / "build" / "uno_distro" / "firmware.hex"
RATES_HZ = (100, 125, 160, 200, 250, 400, 500)  # divisors of 2 MHz


class Figure(NamedTuple):
    figure: str
    value: float
    unit: str
    must: str


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hex", type=Path, default=DEFAULT_HEX)
    parser.add_argument("--minutes", type=float, default=10.0, help="of the board's time with three mice (default 10)")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if not options.hex.is_file():
        print(f"there is no {options.hex}: type `pio run -e uno_distro`, or give --hex", file=sys.stderr)
        return 1
    try:
        for figure in measure(options.hex, options.minutes):
            text = f"{figure.figure:58}{figure.value:9.6g} {figure.unit:4}must: {figure.must}"
            print(json.dumps(figure._asdict()) if options.json else text, flush=True)
    except VirtualUnoError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def measure(program: Path, minutes: float) -> Iterator[Figure]:
    yield from sizes(program.with_suffix(".elf"))
    yield from long_run(program, minutes)
    yield Figure("highest rate with nothing lost, three mice", highest_rate(program, 3), "Hz", ">= 200")
    yield Figure("highest rate with nothing lost, no mice", highest_rate(program, 0), "Hz", ">= 400")
    for name, harm, mend, flag in FAULTS:
        yield from recovery(program, name, harm, mend, flag)
    yield from mouse_recovery(program)


def sizes(elf: Path) -> Iterator[Figure]:
    """Flash and static RAM, when the .elf lies beside the .hex."""
    if not elf.is_file():
        return
    printed = subprocess.run(["avr-size", elf], check=True, capture_output=True, text=True).stdout
    text, data, bss = map(int, printed.splitlines()[1].split()[:3])
    yield Figure("flash", text + data, "B", "<= 24576")
    yield Figure("static RAM", data + bss, "B", "<= 1300")


@contextmanager
def running(program: Path, mice: int, rate_hz: int = 100) -> Iterator[WireLink]:
    with VirtualUno(program, mice=MICE[:mice]) as uno:
        yield stream(WireLink(uno), rate_hz)


def long_run(program: Path, minutes: float) -> Iterator[Figure]:
    """Three mice at up to 1 m/s at 100 Hz, a parity error of each every 2 s."""
    seconds = round(60 * minutes)
    with running(program, 3) as link:
        uno = link.uno
        uno.watch(WATCHED_BUS)
        before, counts_before = uno.state(), reported(link)
        move_all(link, seconds - 1.0)
        for mouse in uno.mice:
            mouse.spoil_parity_every(2.0)
        link.run_ms(seconds * 1000.0)
        starts, after = burst_starts(uno.events()), uno.state()
        wrong = np.abs(totals(link.samples) - (reported(link) - counts_before)).sum()
        yield Figure("IMU read START, jitter peak to peak", jitter_us(starts, 100), "us", "<= 5")
        yield Figure(f"samples lost in {minutes:g} min", seconds * 100 - len(link.samples), "", "0")
        yield Figure(f"counts lost or too many in {minutes:g} min", float(wrong), "", "0")
        yield Figure("core busy", 100 * busy(before, after), "%", "<= 40")
        yield Figure("stack never used", link.status.stack_free, "B", ">= 400")


def highest_rate(program: Path, mice: int) -> float:
    """The highest of RATES_HZ that the board accepts and at which 20 s come complete, with counts exact."""
    best = 0
    for rate_hz in RATES_HZ:
        with VirtualUno(program, mice=MICE[:mice]) as uno:
            link = stream(WireLink(uno))
            link.carry_out(Stop())
            answer = link.command(DEFAULTS._replace(sample_rate_hz=rate_hz))
            if isinstance(answer, Nak) and answer.reason == NakReason.LINK_TOO_SLOW:
                break  # the serial line does not carry this rate
            stream(link, rate_hz)
            before = reported(link)
            move_all(link, 19.0)
            link.run_ms(20_000)
            complete = lost(link.samples) == 0 and len(link.samples) >= 20 * rate_hz - 1
            exact = mice == 0 or totals(link.samples).tolist() == (reported(link) - before).tolist()
            if complete and exact:
                best = rate_hz
    return best


Action = Callable[[VirtualUno], Any]
FAULTS: tuple[tuple[str, Action, Action, SampleFlags], ...] = (
    ("SDA stuck", lambda uno: uno.hold_sda(), lambda uno: uno.release_sda(), SampleFlags.IMU_VALID),
    ("IMU NACK", lambda uno: uno.imu.nack(address=True), lambda uno: uno.imu.nack(), SampleFlags.IMU_VALID),
    ("IMU pulled", lambda uno: uno.imu.unplug(), lambda uno: uno.imu.plug(), SampleFlags.IMU_VALID),
    ("barometer pulled", lambda uno: uno.baro.unplug(), lambda uno: uno.baro.plug(), SampleFlags.BARO_VALID),
)


def recovery(program: Path, name: str, harm: Action, mend: Action, flag: SampleFlags) -> Iterator[Figure]:
    """A fault for half a second, at ten moments of the tick: samples lost, and the longest time until valid again."""
    missing, longest = 0, 0.0
    with running(program, 3) as link:
        move_all(link, 20.0)
        for _ in range(10):
            harm(link.uno)
            link.run_ms(501.3)
            missing += lost(link.samples) + sum(invalid(link.samples, valid) for valid in MOUSE_VALID[:3])
            link.forget()
            mend(link.uno)
            link.run_ms(1000)
            missing += lost(link.samples)
            longest = max(longest, valid_again_ms(link.samples, flag))
            link.forget()
    yield Figure(f"{name}: samples and valid mouse counts lost", missing, "", "0")
    yield Figure(f"{name}: valid again after its end, at most", longest, "ms", "<= 100")


def mouse_recovery(program: Path) -> Iterator[Figure]:
    """A mouse pulled and put back ten times while all move."""
    longest = 0.0
    with running(program, 3) as link:
        before = reported(link)
        move_all(link, 29.0)
        samples = []
        for turn in range(10):
            link.run_ms(103.7 + turn)
            link.uno.mice[1].unplug()
            link.run_ms(400)
            samples += link.samples
            link.forget()
            link.uno.mice[1].plug()
            link.run_ms(2500)
            longest = max(longest, valid_again_ms(link.samples, MOUSE_VALID[1]))
            samples += link.samples
            link.forget()
        wrong = np.abs(totals(samples) - (reported(link) - before))[[0, 2]].sum()
    yield Figure("mouse pulled: others' counts lost", float(wrong), "", "0")
    yield Figure("mouse pulled: back after it was put back, at most", longest / 1000, "s", "<= 2")


if __name__ == "__main__":
    sys.exit(main())
