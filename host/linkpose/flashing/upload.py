"""Uploading through the UNO's bootloader with avrdude, and saying what state the board is in when that fails."""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from linkpose.errors import LinkposeError
from linkpose.flashing.build import TOOLCHAIN_UNREACHABLE, UNREACHABLE, Project
from linkpose.flashing.image import Image
from linkpose.flashing.process import follow

ATTEMPTS = 2  # avrdude would make ten, each with a reset of the board and five seconds of waiting
STALL_S = 8.0  # while pages are written or read back, one every few hundredths of a second
BOOTLOADER_BAUD = 115200

_BAR = re.compile(r"(Writing|Reading) \| (#*)")


class Stage(Enum):
    """How far an upload has come."""

    CONNECTING = "connecting"
    WRITING = "writing"
    VERIFYING = "verifying"


@dataclass(slots=True)
class Upload:
    """An upload as avrdude tells of it, directly or through PlatformIO."""

    port: str
    said: str = ""
    heard_at: float = 0.0  # s, monotonic: when avrdude last said something
    gone: bool = False  # the port has vanished
    stalled: bool = False

    @property
    def stage(self) -> Stage:
        return self._progress()[0]

    @property
    def percent(self) -> int:
        """Of the stage."""
        return self._progress()[1]

    def _progress(self) -> tuple[Stage, int]:
        """avrdude draws a bar of 50 for each stage; some draw one more for the signature, which is read first."""
        stage, percent = Stage.CONNECTING, 0
        for name, bar in _BAR.findall(self.said):
            if name == "Writing":
                stage, percent = Stage.WRITING, 2 * len(bar)
            elif stage is not Stage.CONNECTING:
                stage, percent = Stage.VERIFYING, 2 * len(bar)
        return stage, percent

    def hear(self, said: str) -> bool:
        """Takes what avrdude says; False when there is no use in waiting on."""
        now = time.monotonic()
        self.said += said
        if said or not self.heard_at:
            self.heard_at = now
        self.gone = self.port.startswith("/") and not os.path.exists(self.port)  # noqa: PTH110  a device, not a file
        if self.stage is Stage.CONNECTING:
            return not self.gone and self.said.count("not in sync") < ATTEMPTS
        silent = now - self.heard_at > STALL_S or "not responding" in self.said[self.said.rindex("Writing | ") :]
        self.stalled = silent and not self.gone
        return not self.gone and not silent

    def why_failed(self) -> str:
        """The sentence for the user: what went wrong, the board's state, and what to type."""
        said = self.said.lower()
        if self.stage is not Stage.CONNECTING:
            return self._why_broken_off(said)
        port = self.port
        if self.gone:
            return f"{port} went away before anything was written; check the cable and type `linkpose flash` again"
        if "expected signature" in said:
            return (
                f"the board at {port} is no UNO: its processor is not an ATmega328P; nothing was written, choose the "
                "UNO with --port"
            )
        if "not in sync" in said or "not responding" in said:
            return (
                f"no UNO bootloader answers at {port}, nothing was written: it is another board or another port, or "
                "another program holds it; see `linkpose ports`, close the other, type `linkpose flash --port PORT`"
            )
        if "permission denied" in said or "access is denied" in said:
            return (
                f"no permission to open {port}, nothing was written; join the group that owns it with `sudo usermod "
                "-aG dialout $USER` and log in again"
            )
        if "open" in said and port.lower() in said:
            return f"{port} cannot be opened, nothing was written; close other programs and type `linkpose flash` again"
        if UNREACHABLE.search(said):
            return f"nothing was written: {TOOLCHAIN_UNREACHABLE}"
        return f"the upload failed before anything was written ({_last_complaint(self.said)}); add -v to see all of it"

    def _why_broken_off(self, said: str) -> str:
        if not self.gone and re.search(r"verification (error|mismatch)|mismatch at|content mismatch", said):
            return (
                "verification failed: the board read back something else than was written; its bootloader is intact, "
                "its firmware is not to be trusted; type `linkpose flash` again, and replace the board if it comes back"
            )
        cause = f"{self.port} went away" if self.gone else "the board stopped answering"
        return (
            f"{cause} at {self.percent} % of {self.stage.value}: the board's bootloader is intact, its firmware is "
            "incomplete; check the cable and type `linkpose flash` again"
        )


def upload_with_platformio(firmware: Project, port: str, listen: Callable[[Upload], None]) -> None:
    """Uploads what was built, with PlatformIO's uploader. Raises LinkposeError; `listen` hears how far it has come."""
    command = firmware.command("-t", "nobuild", "-t", "upload", "--upload-port", port)
    _run(command, firmware.variables, port, listen)


def upload_with_avrdude(image: Image, port: str, listen: Callable[[Upload], None]) -> None:
    """Uploads an image with avrdude. Raises LinkposeError; `listen` hears how far it has come."""
    programmer = ["-p", "atmega328p", "-c", "arduino", "-b", str(BOOTLOADER_BAUD), "-P", port, "-D"]
    _run([*find_avrdude(), *programmer, "-U", f"flash:w:{image.path}:i"], None, port, listen)


def find_avrdude() -> list[str]:
    """The command that runs avrdude: the system's, or PlatformIO's. Raises LinkposeError when there is none."""
    system = shutil.which("avrdude")
    if system:
        return [system]
    core = Path(os.environ.get("PLATFORMIO_CORE_DIR") or Path.home() / ".platformio")
    folder = core / "packages" / "tool-avrdude"
    own = shutil.which("avrdude", path=os.pathsep.join([str(folder), str(folder / "bin")]))
    if own is None:
        raise LinkposeError(
            "avrdude is not installed; type `sudo apt install avrdude` (macOS: `brew install avrdude`, Windows: "
            "`winget install AVRDudes.AVRDUDE`) and then `linkpose flash --prebuilt` again"
        )
    settings = folder / "avrdude.conf"
    return [own, "-C", str(settings)] if settings.is_file() else [own]


def _run(command: list[str], environment: dict[str, str] | None, port: str, listen: Callable[[Upload], None]) -> None:
    upload = Upload(port)

    def go_on(said: str) -> bool:
        waits = upload.hear(said)
        listen(upload)
        return waits

    try:
        status, _ = follow(command, environment, go_on)
    except OSError as error:
        raise LinkposeError(f"cannot run {command[0]}: {error.strerror}; nothing was written") from error
    except KeyboardInterrupt:
        raise LinkposeError(_interrupted(upload)) from None
    if status != 0:
        raise LinkposeError(upload.why_failed())


def _interrupted(upload: Upload) -> str:
    if upload.stage is Stage.CONNECTING:
        return "interrupted before anything was written; type `linkpose flash` again"
    return (
        f"interrupted at {upload.percent} % of {upload.stage.value}: the board's bootloader is intact, its firmware is "
        "incomplete; type `linkpose flash` again"
    )


def _last_complaint(said: str) -> str:
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    complaints = [line for line in lines if re.search(r"\b(error|failed|cannot|can't)\b", line, re.IGNORECASE)]
    return (complaints or lines or ["no reason was given"])[-1]
