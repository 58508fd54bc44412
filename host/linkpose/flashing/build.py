"""Building the firmware with PlatformIO, from a checkout or from the sources in an installed package."""

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

# What PlatformIO prints when its registry cannot be reached.
UNREACHABLE = re.compile(
    r"HTTPClientError|InternetConnectionError|not connected to the Internet|Could not install package|"
    r"Could not find the package|PackageException|Max retries exceeded|Connection(Error| refused| reset)|timed out|"
    r"name resolution|UnknownPackageError",
    re.IGNORECASE,
)

_PACKAGE = Path(__file__).parents[1]


class CannotBuild(LinkposeError):
    """PlatformIO, its toolchain or the sources are missing: no build is possible here. The prebuilt image helps."""


@dataclass(frozen=True, slots=True)
class Project:
    """The firmware as a PlatformIO project."""

    folder: Path  # contains platformio.ini and firmware/
    environment_name: str  # in platformio.ini
    variables: dict[str, str]  # the environment variables of PlatformIO

    def command(self) -> list[str]:
        """`pio run` of this project."""
        return [sys.executable, "-m", "platformio", "run", "-d", str(self.folder), "-e", self.environment_name]

    @property
    def hex_path(self) -> Path:
        """The result of a build."""
        workspace = Path(self.variables.get("PLATFORMIO_WORKSPACE_DIR", self.folder / ".pio"))
        build = Path(self.variables.get("PLATFORMIO_BUILD_DIR", workspace / "build"))
        return build / self.environment_name / "firmware.hex"


@contextlib.contextmanager
def project(environment_name: str) -> Iterator[Project]:
    """The firmware's project. Raises CannotBuild when PlatformIO or the sources are missing.

    A checkout builds in its own `.pio`. An installed package, which may be read-only, builds in a temporary folder that
    is removed at the end of the context.
    """
    if importlib.util.find_spec("platformio") is None:
        raise CannotBuild("PlatformIO is not installed (`pip install platformio`)")
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
        raise CannotBuild("the firmware's sources are missing from this installation")


def build(firmware: Project, show: Callable[[str], None]) -> Image:
    """Build the firmware and return its image. `show` receives PlatformIO's output as it comes.

    Raises CannotBuild when PlatformIO cannot download its toolchain, and LinkposeError when the sources do not compile.
    """
    try:
        status, output = follow(firmware.command(), firmware.variables, show)
    except OSError as error:
        raise CannotBuild(f"PlatformIO does not run ({error.strerror})") from error
    if status != 0:
        raise _why_not_built(output)
    return read_image(firmware.hex_path)


def _why_not_built(output: str) -> LinkposeError:
    if "Compiling" not in output and UNREACHABLE.search(output):
        return CannotBuild("PlatformIO cannot download its toolchain (no internet connection?)")
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    errors = [line for line in lines if re.search(r"\berror\b|undefined reference", line, re.IGNORECASE)]
    reason = (errors or lines[-1:] or ["no reason"])[0]
    return LinkposeError(
        f"PlatformIO did not build the firmware ({reason}). Add -v to see all of its output, or run `linkpose flash "
        "--prebuilt`"
    )
