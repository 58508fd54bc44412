"""`linkpose flash` as a user types it, through Optiboot on the emulated board.

The command waits by the wall clock: the emulated bootloader must answer within 1.6 s, for which it needs 0.5 s of its
own time. A test that misses this budget says so. Every other test of the upload runs in the board's time
(test_bootloader.py).
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from bootloader import build_optiboot
from measuring import PATIENCE_S, lateness
from pty_server import PtyServer

from linkpose.flashing.image import PREBUILT, read_image
from virtual_uno import VirtualUno

ROOT = Path(__file__).parents[2]
BUDGET_S = 1.1  # 1.6 s without 0.5 s


@pytest.fixture
def blank(tmp_path: Path) -> Iterator[VirtualUno]:
    """A board as it is sold: nothing in its flash but the bootloader."""
    bootloader = build_optiboot(tmp_path)
    with VirtualUno(bootloader.path, boot_address=bootloader.address) as uno:
        yield uno


def flash(port: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "linkpose", "flash", "--port", str(port), *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "host"), "PLATFORMIO_CORE_DIR": str(ROOT / ".piocore")}
    return subprocess.run(command, env=environment | variables, capture_output=True, text=True, timeout=PATIENCE_S)


def test_the_prebuilt_firmware_is_built_from_these_sources(firmware_hex: Path) -> None:
    same = PREBUILT.read_bytes() == firmware_hex.read_bytes()
    assert same, "firmware.hex is stale: type `python firmware/platform/prebuilt.py`"


@pytest.mark.realtime
def test_a_blank_board_boots_the_prebuilt_firmware_with_no_program_on_the_path(
    blank: VirtualUno, tmp_path: Path
) -> None:
    image = read_image(PREBUILT)
    with PtyServer(blank, tmp_path / "port") as server:
        done = flash(tmp_path / "port", "--prebuilt", PATH=str(tmp_path))
    assert done.returncode == 0, f"{done.stderr}\n{lateness(server, BUDGET_S)}"
    assert blank.flash(0, len(image.data)) == image.data
    shown = dict(re.findall(r"^(\S.*?)  +(.*)$", done.stdout, re.MULTILINE))
    assert shown["firmware"] == image.identity.version
    assert shown["source revision"] == f"{image.identity.source_revision:08x}"


@pytest.mark.realtime
def test_platformio_builds_what_is_uploaded(firmware_hex: Path, blank: VirtualUno, tmp_path: Path) -> None:
    image = read_image(firmware_hex)
    with PtyServer(blank, tmp_path / "port") as server:
        done = flash(tmp_path / "port", "--env", "uno_distro")
    assert done.returncode == 0, f"{done.stderr}\n{lateness(server, BUDGET_S)}"
    assert blank.flash(0, len(image.data)) == image.data
    assert f"source revision    {image.identity.source_revision:08x}" in done.stdout
