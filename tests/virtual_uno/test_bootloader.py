"""`linkpose flash` through avrdude and Optiboot into the flash of the emulated board, and what can go wrong."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from bootloader import BOOT_ADDRESS, build_optiboot
from pty_server import PtyServer

from linkpose.errors import LinkposeError
from linkpose.flashing import upload
from linkpose.flashing.image import PREBUILT, Image, read_image
from linkpose.flashing.upload import Stage, Upload, upload_with_avrdude
from virtual_uno import VirtualUno

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def optiboot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_optiboot(tmp_path_factory.mktemp("optiboot"))


@pytest.fixture
def blank(optiboot: Path) -> Iterator[VirtualUno]:
    """An UNO as it is sold: nothing in its flash but the bootloader."""
    with VirtualUno(optiboot, boot_address=BOOT_ADDRESS) as uno:
        yield uno


@pytest.fixture
def port(tmp_path: Path) -> Path:
    return tmp_path / "port"


@pytest.fixture
def short_image(tmp_path: Path) -> Image:
    """The first pages of the firmware, for tests that need not boot it."""
    path = tmp_path / "short.hex"
    path.write_text("".join(PREBUILT.read_text().splitlines(keepends=True)[:48]) + ":00000001FF\n")
    return read_image(path)


def flash(port: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "linkpose", "flash", "--port", str(port), *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "host"), "PLATFORMIO_CORE_DIR": str(ROOT / ".piocore")}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)


def fail_to_upload(image: Image, port: Path, listen: Callable[[Upload], None] = lambda _: None) -> str:
    with pytest.raises(LinkposeError) as caught:
        upload_with_avrdude(image, str(port), listen)
    return str(caught.value)


def test_the_prebuilt_firmware_is_that_of_the_sources(firmware_hex: Path) -> None:
    same = PREBUILT.read_bytes() == firmware_hex.read_bytes()
    assert same, "firmware.hex is stale: type `python firmware/platform/prebuilt.py`"


def test_a_blank_board_boots_the_prebuilt_firmware(blank: VirtualUno, port: Path) -> None:
    image = read_image(PREBUILT)
    with PtyServer(blank, port):
        done = flash(port, "--prebuilt")
    assert done.returncode == 0, done.stderr
    assert blank.flash(0, len(image.data)) == image.data
    shown = dict(re.findall(r"^(\S.*?)  +(.*)$", done.stdout, re.MULTILINE))
    assert shown["firmware"] == image.identity.version
    assert shown["source revision"] == f"{image.identity.source_revision:08x}"


def test_platformio_builds_and_uploads(firmware_hex: Path, blank: VirtualUno, port: Path) -> None:
    image = read_image(firmware_hex)
    with PtyServer(blank, port):
        done = flash(port, "--env", "uno_distro")
    assert done.returncode == 0, done.stderr
    assert blank.flash(0, len(image.data)) == image.data
    assert f"source revision    {image.identity.source_revision:08x}" in done.stdout


def test_what_is_read_back_must_be_what_was_written(blank: VirtualUno, port: Path, short_image: Image) -> None:
    blank.stick_flash(0x200, 0xFF)
    with PtyServer(blank, port):
        said = fail_to_upload(short_image, port)
    assert said.startswith("verification failed")
    assert "bootloader is intact" in said


def test_a_cable_pulled_halfway_leaves_a_board_that_can_be_flashed(
    blank: VirtualUno, port: Path, short_image: Image
) -> None:
    def pull_once() -> None:
        if not pulled and blank.state()["pages_written"] >= 2:
            pulled.append(True)
            server.pull_cable()

    pulled: list[bool] = []
    server = PtyServer(blank, port, on_slice=pull_once)
    with server:
        said = fail_to_upload(short_image, port)
        assert re.search(r"went away at \d+ % of writing: .* bootloader is intact, its firmware is incomplete", said)
        back = threading.Event()
        server.call(server.put_cable_back)
        server.call(back.set)
        assert back.wait(10)
        upload_with_avrdude(short_image, str(port), lambda _: None)
    assert blank.flash(0, len(short_image.data)) == short_image.data


def test_an_interrupt_says_what_state_the_board_is_in(blank: VirtualUno, port: Path, short_image: Image) -> None:
    def interrupt(progress: Upload) -> None:
        if progress.stage is Stage.WRITING and progress.percent >= 20:
            raise KeyboardInterrupt

    with PtyServer(blank, port):
        said = fail_to_upload(short_image, port, interrupt)
    assert said.startswith("interrupted at")
    assert "firmware is incomplete" in said


def test_a_board_without_bootloader_does_not_answer(
    asleep: Callable[..., VirtualUno], port: Path, short_image: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(upload, "ATTEMPTS", 1)  # each takes avrdude more than five seconds
    with PtyServer(asleep(), port):
        said = fail_to_upload(short_image, port)
    assert said.startswith("no UNO bootloader answers")
    assert "nothing was written" in said


def test_another_processor_is_not_written_to(tmp_path: Path, port: Path, short_image: Image) -> None:
    other = build_optiboot(tmp_path, "atmega168")
    with VirtualUno(other, boot_address=BOOT_ADDRESS) as uno:
        with PtyServer(uno, port):
            said = fail_to_upload(short_image, port)
        assert uno.state()["pages_written"] == 0
    assert "is no UNO" in said
