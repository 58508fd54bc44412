"""What the wheel and the sdist contain besides the package: the firmware's sources, so that an installed linkpose can
build and flash them, and the pages of the documentation. Both exist once, in the repository; pyproject.toml names this
class.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from setuptools.command.build_py import build_py

# Folder in the wheel's package -> (base, what is copied): the path below `base` is kept.
BUNDLED = {
    "_firmware": (Path(), ("platformio.ini", "firmware")),
    "_docs": (Path("host/docs"), ("host/docs",)),
}
REPOSITORY = (  # the sdist contains these as well
    "platformio.ini", "firmware", "protocol", "tests", "host/build_package.py", "host/mkdocs.yml", "host/docs",
    "CHANGELOG.md", "CITATION.cff",
)  # fmt: skip
NOT_SOURCES = {"__pycache__", "node_modules", ".pytest_cache"}


class BuildPackage(build_py):  # type: ignore[misc]  # setuptools' class, seen as Any
    """Adds the bundled folders to the package being built. An editable installation finds them in the checkout."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return
        for folder in BUNDLED:
            shutil.rmtree(self._package() / folder, ignore_errors=True)  # a previous build may have left other files
        for source, copy in self._copies():
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, copy)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        outputs: list[str] = super().get_outputs(include_bytecode)
        return outputs + [str(copy) for _, copy in self._copies()]

    def get_source_files(self) -> list[str]:
        files: list[str] = super().get_source_files()
        return files + [str(file) for file in _files(REPOSITORY)]

    def _package(self) -> Path:
        return Path(self.build_lib) / "linkpose"

    def _copies(self) -> list[tuple[Path, Path]]:
        """(source, copy in the package) of each bundled file."""
        return [
            (file, self._package() / folder / file.relative_to(base))
            for folder, (base, names) in BUNDLED.items()
            for file in _files(names)
        ]


def _files(names: tuple[str, ...]) -> list[Path]:
    """The files of these names and below these folders, relative to the top of the repository."""
    paths = [path for name in names for path in sorted([Path(name), *Path(name).rglob("*")])]
    return [path for path in paths if path.is_file() and NOT_SOURCES.isdisjoint(path.parts)]
