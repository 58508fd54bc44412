"""What goes into the wheel and the sdist besides the package: the firmware's sources, so that an installed linkpose
can build and flash them. They stand once, at the top of the repository; pyproject.toml names this class.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from setuptools.command.build_py import build_py

FIRMWARE = ("platformio.ini", "firmware")  # to linkpose/_firmware in the wheel
REPOSITORY = (*FIRMWARE, "host/build_package.py", "protocol", "tests")  # to the sdist
NOT_SOURCES = {"__pycache__", "node_modules", ".pytest_cache"}


class BuildPackage(build_py):  # type: ignore[misc]  # setuptools' class, seen as Any
    """Puts the firmware's sources into the package that is built. An editable install finds them in the checkout."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return
        target = self._firmware_folder()
        shutil.rmtree(target, ignore_errors=True)  # an earlier build's may hold files that are gone
        for file in _files(FIRMWARE):
            copy = target / file
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, copy)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        outputs: list[str] = super().get_outputs(include_bytecode)
        return outputs + [str(self._firmware_folder() / file) for file in _files(FIRMWARE)]

    def get_source_files(self) -> list[str]:
        files: list[str] = super().get_source_files()
        return files + [str(file) for file in _files(REPOSITORY)]

    def _firmware_folder(self) -> Path:
        return Path(self.build_lib) / "linkpose" / "_firmware"


def _files(names: tuple[str, ...]) -> list[Path]:
    """The files of these names and below these folders, relative to the repository's top."""
    paths = [path for name in names for path in sorted([Path(name), *Path(name).rglob("*")])]
    return [path for path in paths if path.is_file() and NOT_SOURCES.isdisjoint(path.parts)]
