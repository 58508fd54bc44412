"""Building the firmware with PlatformIO, from a checkout or from the sources that an installed package brings along."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from linkpose.errors import LinkposeError
from linkpose.flashing.image import Image, read_image
from linkpose.flashing.process import follow

# PlatformIO says the one or the other when its registry is out of reach.
UNREACHABLE = re.compile(
    r"HTTPClientError|InternetConnectionError|not connected to the Internet|Could not install package|"
    r"Could not find the package|PackageException|Max retries exceeded|Connection(Error| refused| reset)|timed out|"
    r"name resolution",
    re.IGNORECASE,
)
TOOLCHAIN_UNREACHABLE = (
    "PlatformIO cannot download its toolchain; connect to the internet, or type `linkpose flash --prebuilt` to upload "
    "the firmware that comes ready built"
)

_PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True, slots=True)
class Project:
    """The firmware as PlatformIO builds it."""

    folder: Path  # holds platformio.ini and firmware/
    environment_name: str  # of platformio.ini
    variables: dict[str, str]  # that PlatformIO runs with

    def command(self, *arguments: str) -> list[str]:
        """`pio run` of this project."""
        run = [sys.executable, "-m", "platformio", "run", "-d", str(self.folder), "-e", self.environment_name]
        return [*run, *arguments]

    @property
    def hex_path(self) -> Path:
        """What a build leaves."""
        workspace = Path(self.variables.get("PLATFORMIO_WORKSPACE_DIR", self.folder / ".pio"))
        build = Path(self.variables.get("PLATFORMIO_BUILD_DIR", workspace / "build"))
        return build / self.environment_name / "firmware.hex"


@contextlib.contextmanager
def project(environment_name: str) -> Iterator[Project]:
    """The firmware's project. Raises LinkposeError when its sources or PlatformIO are missing.

    A checkout builds in its own `.pio`. An installed package, which may be read-only, builds in a folder that is gone
    when the context is left.
    """
    if importlib.util.find_spec("platformio") is None:
        raise LinkposeError(
            "PlatformIO is not installed; type `pip install platformio`, or `linkpose flash --prebuilt` to do without"
        )
    variables = {
        **os.environ,
        "PLATFORMIO_NO_ANSI": "true",
        "PLATFORMIO_DISABLE_PROGRESSBAR": "true",
        "PLATFORMIO_DISABLE_UPGRADE_CHECK": "true",
        "PLATFORMIO_SETTING_ENABLE_TELEMETRY": "No",
    }
    installed, checkout = _PACKAGE / "_firmware", _PACKAGE.parents[1]
    if (installed / "platformio.ini").is_file():
        with tempfile.TemporaryDirectory(prefix="linkpose-firmware-") as workspace:
            yield Project(installed, environment_name, variables | {"PLATFORMIO_WORKSPACE_DIR": workspace})
    elif (checkout / "platformio.ini").is_file():
        yield Project(checkout, environment_name, variables)
    else:
        raise LinkposeError(
            "the firmware's sources are missing from this installation; type `pip install --force-reinstall linkpose`, "
            "or `linkpose flash --prebuilt` to do without"
        )


def build(firmware: Project, listen: Callable[[str], None]) -> Image:
    """Builds the firmware; its image. Raises LinkposeError. `listen` gets what PlatformIO says, as it comes."""

    def go_on(said: str) -> bool:
        listen(said)
        return True

    status, output = follow(firmware.command(), firmware.variables, go_on)
    if status != 0:
        raise LinkposeError(_why_not_built(output))
    return read_image(firmware.hex_path)


def _why_not_built(output: str) -> str:
    if "Compiling" not in output and UNREACHABLE.search(output):
        return f"the firmware was not built: {TOOLCHAIN_UNREACHABLE}"
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    errors = [line for line in lines if re.search(r"\berror\b|undefined reference", line, re.IGNORECASE)]
    said = (errors or lines[-1:] or ["no reason"])[0]
    return f"PlatformIO did not build the firmware ({said}); see all of it with -v, or type `linkpose flash --prebuilt`"
