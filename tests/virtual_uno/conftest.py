"""The firmware's .hex, built once, and boards that run it or a program of the test's own."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from wire_link import WireLink

from virtual_uno import VirtualUno

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
FIRMWARE_HEX = ROOT / ".pio" / "build" / "uno_distro" / "firmware.hex"

# ldi r24, 1; out SMCR, r24; sleep; rjmp to the sleep: a program that leaves everything alone.
ASLEEP_HEX = ":0800000081E083BF8895FECF6B\n:00000001FF\n"


@pytest.fixture(scope="session")
def firmware_hex() -> Path:
    """LINKPOSE_HEX, or else the firmware as it is built from this tree."""
    if "LINKPOSE_HEX" in os.environ:
        return Path(os.environ["LINKPOSE_HEX"])
    settings = {
        "PLATFORMIO_CORE_DIR": str(ROOT / ".piocore"),
        "PLATFORMIO_SETTING_ENABLE_TELEMETRY": "No",
        "PLATFORMIO_DISABLE_UPGRADE_CHECK": "true",
        "PLATFORMIO_NO_ANSI": "true",
    }
    pio = str(Path(sys.executable).with_name("pio"))
    with (HERE / "conftest.py").open() as lock:  # several test processes may need it at once
        fcntl.flock(lock, fcntl.LOCK_EX)
        for command in ([sys.executable, "firmware/platform/make_core.py"], [pio, "run", "-s", "-e", "uno_distro"]):
            built = subprocess.run(command, cwd=ROOT, env={**settings, **os.environ}, capture_output=True, text=True)
            if built.returncode != 0:
                pytest.fail(f"the firmware does not build:\n{built.stdout}{built.stderr}", pytrace=False)
    return FIRMWARE_HEX


@pytest.fixture
def board(firmware_hex: Path) -> Iterator[Callable[..., WireLink]]:
    """Makes a board that runs the firmware: `board(seed=1)` and all that VirtualUno takes."""
    boards: list[VirtualUno] = []

    def make(**options: Any) -> WireLink:
        boards.append(VirtualUno(firmware_hex, **options))
        return WireLink(boards[-1])

    yield make
    for each in boards:
        each.close()


@pytest.fixture
def asleep(tmp_path: Path) -> Iterator[Callable[..., VirtualUno]]:
    """Makes a board whose program does nothing, for tests of what hangs on it."""
    boards: list[VirtualUno] = []
    program = tmp_path / "asleep.hex"
    program.write_text(ASLEEP_HEX)

    def make(**options: Any) -> VirtualUno:
        boards.append(VirtualUno(program, **options))
        return boards[-1]

    yield make
    for each in boards:
        each.close()
