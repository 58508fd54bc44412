"""The upload through real bootloaders into the flash of the emulated board, and each way it can fail.

Time is the emulated board's, so that nothing here depends on how fast the machine is; test_upload.py types the command.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from bootloader import ATMEGABOOT, OPTIBOOT_RESETS, BootloaderImage, build_optiboot
from emulated_port import EmulatedPort

from linkpose.errors import LinkposeError
from linkpose.flashing.image import PREBUILT, Image, read_image
from linkpose.flashing.upload import Progress, Stage, upload
from virtual_uno import VirtualUno

OnStep = Callable[[EmulatedPort], None]
PORT = "/dev/ttyACM0"


@pytest.fixture(scope="module")
def image() -> Image:
    return read_image(PREBUILT)


@pytest.fixture(scope="module")
def optiboot(tmp_path_factory: pytest.TempPathFactory) -> BootloaderImage:
    return build_optiboot(tmp_path_factory.mktemp("optiboot"))


@pytest.fixture
def short(image: Image) -> Image:
    """The first five pages and a half, for tests that do not start it."""
    return replace(image, data=image.data[: 5 * 128 + 64])


def blank(bootloader: BootloaderImage) -> VirtualUno:
    """A board as it is sold: nothing in its flash but the bootloader."""
    return VirtualUno(bootloader.path, boot_address=bootloader.address)


def opener(uno: VirtualUno, on_step: OnStep | None = None) -> Callable[[str, int], EmulatedPort]:
    return lambda _name, baud: EmulatedPort(uno, baud, on_step)


def fail(uno: VirtualUno, image: Image, on_step: OnStep | None = None) -> str:
    """The sentence of an upload that must fail."""
    with pytest.raises(LinkposeError) as caught:
        upload(image, PORT, lambda _: None, opener(uno, on_step))
    return str(caught.value)


# ---- bootloaders ----


@pytest.mark.parametrize("old", [False, True], ids=["UNO's Optiboot", "old Nano's ATmegaBOOT"])
def test_a_bootloader_writes_the_firmware_and_stays_as_it_is(
    image: Image, optiboot: BootloaderImage, old: bool
) -> None:
    bootloader = ATMEGABOOT if old else optiboot
    seen: list[tuple[Stage, int]] = []
    with blank(bootloader) as uno:
        section = uno.flash(bootloader.address, 0x8000 - bootloader.address)
        upload(image, PORT, lambda now: seen.append((now.stage, now.percent)), opener(uno))
        assert uno.flash(0, len(image.data)) == image.data
        assert set(uno.flash(len(image.data), bootloader.address - len(image.data))) == {0xFF}
        assert uno.flash(bootloader.address, len(section)) == section
    writing = [percent for stage, percent in seen if stage is Stage.WRITING]
    assert writing[0] == 0
    assert writing == sorted(writing)
    assert len(writing) == -(-len(image.data) // 128)


@pytest.mark.parametrize("resets", OPTIBOOT_RESETS)
def test_each_optiboot_starts_the_firmware_after_the_upload(tmp_path: Path, image: Image, resets: str) -> None:
    with blank(build_optiboot(tmp_path, resets=resets)) as uno:
        upload(image, PORT, lambda _: None, opener(uno))
        uno.set_line(baud=250_000)
        assert uno.run_until(lambda: len(uno.take_received()) > 0, limit_ms=1000)
        assert uno.flash(0, len(image.data)) == image.data


def test_a_board_that_prints_until_the_reset_is_flashed_again(
    image: Image, optiboot: BootloaderImage, short: Image
) -> None:
    with blank(optiboot) as uno:
        upload(image, PORT, lambda _: None, opener(uno))  # its own firmware sends at another bit rate
        uno.run_ms(500)
        upload(short, PORT, lambda _: None, opener(uno))
        assert uno.flash(0, len(short.data)) == short.data


# ---- failures ----


def test_a_board_without_bootloader_does_not_answer(asleep: Callable[..., VirtualUno], short: Image) -> None:
    reason = fail(asleep(), short)
    assert reason.startswith(f"No UNO bootloader answers at {PORT}; nothing was written")


def test_another_processor_is_not_written_to(tmp_path: Path, short: Image) -> None:
    with blank(build_optiboot(tmp_path, "atmega168")) as uno:
        reason = fail(uno, short)
        assert uno.state()["pages_written"] == 0
    assert "is no UNO: its processor has the signature 0x1E9406" in reason
    assert "Nothing was written" in reason


class Enough(Exception):
    """The test has seen what it is about."""


def test_an_image_that_reaches_into_the_old_bootloader_is_refused(image: Image) -> None:
    def stop(_: Progress) -> None:
        raise Enough

    with blank(ATMEGABOOT) as uno:
        reason = fail(uno, replace(image, data=bytes(0x7801)))
        with pytest.raises(Enough):
            upload(replace(image, data=bytes(0x7800)), PORT, stop, opener(uno))
        assert uno.state()["pages_written"] == 0
    assert "has 30721 bytes" in reason
    assert "30720 bytes in front of its bootloader. Nothing was written" in reason


def test_a_board_that_does_not_verify_is_reported(optiboot: BootloaderImage, short: Image) -> None:
    with blank(optiboot) as uno:
        uno.stick_flash(0x200, 0xFF)
        reason = fail(uno, short)
    assert f"Verification failed: address 0x0200 contains 0x00, and {short.data[0x200]:#04x} was written" in reason
    assert "The bootloader is intact but the firmware is wrong" in reason


@pytest.mark.parametrize(("pages", "stage"), [(0, "before anything was written"), (3, r"at \d+ % of writing")])
def test_a_cable_pulled_leaves_a_board_that_can_be_flashed(
    optiboot: BootloaderImage, short: Image, pages: int, stage: str
) -> None:
    def pull(port: EmulatedPort) -> None:
        port.unplugged = uno.state()["pages_written"] >= pages

    with blank(optiboot) as uno:
        reason = fail(uno, short, pull)
        assert re.match(f"{PORT} disappeared {stage}. .*Check the cable and run `linkpose flash` again$", reason)
        assert ("bootloader is intact but the firmware is incomplete" in reason) == (pages > 0)
        upload(short, PORT, lambda _: None, opener(uno))
        assert uno.flash(0, len(short.data)) == short.data


def test_an_upload_is_repeated_when_the_bootloader_gave_up(optiboot: BootloaderImage, short: Image) -> None:
    def stall(port: EmulatedPort) -> None:
        """The host stops for longer than the bootloader waits, once."""
        if not stalled and uno.state()["pages_written"] == 3:
            stalled.append(True)
            uno.run_ms(1500)

    stalled: list[bool] = []
    with blank(optiboot) as uno:
        upload(short, PORT, lambda _: None, opener(uno, stall))
        assert stalled
        assert uno.flash(0, len(short.data)) == short.data


def test_a_board_that_stops_answering_is_reported(optiboot: BootloaderImage, short: Image) -> None:
    def hold(_: EmulatedPort) -> None:
        if uno.state()["pages_written"] % 5 == 3:
            uno.reset()

    with blank(optiboot) as uno:
        reason = fail(uno, short, hold)
    assert f"The board at {PORT} stopped answering" in reason or "No UNO bootloader answers" in reason


def test_an_interrupt_reports_the_state_of_the_board(optiboot: BootloaderImage, short: Image) -> None:
    def interrupt(progress: Progress) -> None:
        if progress.stage is Stage.WRITING and progress.percent >= 50:
            raise KeyboardInterrupt

    with blank(optiboot) as uno, pytest.raises(LinkposeError) as caught:
        upload(short, PORT, interrupt, opener(uno))
    assert str(caught.value).startswith("The upload was interrupted at 50 % of writing. The bootloader is intact")
