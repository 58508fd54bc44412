"""Builds the package: the backend that pyproject.toml names, and the commands of setuptools that it runs.

The wheel contains three things besides the Python sources:

- the firmware's sources, so that an installed linkpose can build and flash them;
- the pages of the documentation;
- the machine code of the filters for the processor of this machine, so that the first run does not compile them. It
  makes the wheel one of this platform. Where numba is missing or fails, the wheel does without, and the filters are
  compiled at their first use.

The environment variable LINKPOSE_MACHINE_CODE controls the last: `no` builds a wheel for all platforms, such as one to
publish; a list such as `tilt,baro` compiles these filters only.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403  # the hooks that stay as they are
from setuptools.command.bdist_wheel import bdist_wheel
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

MACHINE_CODE = "_machine_code"  # folder in the wheel's package, which linkpose.compiling reads
# What linkpose.precompile compiles, in one process per group. Each takes about 35 s of a 2021 server's processor.
GROUPS = (
    ("joint-inertial", "tilt-inertial", "joint", "tilt", "imu-baro", "baro", "chain", "text", "files"),
    ("mice", "planar-ekf", "planar-ukf", "ekf", "ukf", "scan-match", "mcl", "noises"),
)
LIMIT_S = 900.0  # for a compiler that hangs; 15 times the usual time


def get_requires_for_build_wheel(config_settings: dict[str, object] | None = None) -> list[str]:
    """The wheel's machine code requires numba and what the compiled modules import; an sdist requires neither."""
    others: list[str] = build_meta.get_requires_for_build_wheel(config_settings)
    return others + (["numba>=0.62", "cobs>=1.2"] if any(_groups()) else [])


class BuildPackage(build_py):  # type: ignore[misc]  # setuptools' class, seen as Any
    """Adds the bundled folders and the machine code to the package. An editable installation uses the checkout's."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return
        for folder in (*BUNDLED, MACHINE_CODE):
            shutil.rmtree(self._package() / folder, ignore_errors=True)  # a previous build may have left other files
        for source, copy in self._copies():
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, copy)
        if _has_machine_code():
            _compile(Path(self.build_lib), self._package() / MACHINE_CODE)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        outputs: list[str] = super().get_outputs(include_bytecode)
        machine_code = [str(path) for path in (self._package() / MACHINE_CODE).rglob("*") if path.is_file()]
        return outputs + [str(copy) for _, copy in self._copies()] + machine_code

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


class BuildWheel(bdist_wheel):  # type: ignore[misc]
    """Tags a wheel that contains machine code with this platform."""

    def finalize_options(self) -> None:
        if _has_machine_code():
            self.distribution.has_ext_modules = lambda: True
        super().finalize_options()


def _groups() -> list[tuple[str, ...]]:
    """GROUPS, or those of their names that LINKPOSE_MACHINE_CODE lists. Raises SystemExit for another name."""
    chosen = os.environ.get("LINKPOSE_MACHINE_CODE", "")
    if chosen in ("", "no"):
        return [] if chosen else list(GROUPS)
    names = [name.strip() for name in chosen.split(",")]
    known = [name for group in GROUPS for name in group]
    if unknown := [name for name in names if name not in known]:
        sys.exit(f"LINKPOSE_MACHINE_CODE names {unknown[0]!r}; set it to `no` or to some of {','.join(known)}")
    return [tuple(name for name in group if name in names) for group in GROUPS]


def _has_machine_code() -> bool:
    return any(_groups()) and importlib.util.find_spec("numba") is not None


def _compile(library: Path, folder: Path) -> None:
    """Stores the machine code of the package in `library`; nothing, or a part, where the compiler fails.

    Each process runs as it does for a user, with a temporary folder as its cache.
    """
    print("compiling the filters for this processor", flush=True)
    with tempfile.TemporaryDirectory() as cache:
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, [str(library.resolve()), os.environ.get("PYTHONPATH")])),
            "PYTHONDONTWRITEBYTECODE": "1",  # these files would enter the wheel
            "PYTHONHASHSEED": "0",  # the same bytes from each build
            "NUMBA_CACHE_DIR": cache,
        }
        command = [sys.executable, "-m", "linkpose.precompile"]
        processes = [subprocess.Popen([*command, *group], cwd=cache, env=environment) for group in _groups() if group]
        for process in processes:
            try:
                process.wait(LIMIT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if any(process.returncode for process in processes):
            print("some filters could not be compiled; linkpose compiles them at their first use", flush=True)
        for path in (Path(cache) / "linkpose").rglob("*.*"):
            if path.is_file():
                copy = folder / path.relative_to(Path(cache) / "linkpose")
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, copy)  # without its mode 0600: others may use this installation


def _files(names: tuple[str, ...]) -> list[Path]:
    """The files of these names and below these folders, relative to the top of the repository."""
    paths = [path for name in names for path in sorted([Path(name), *Path(name).rglob("*")])]
    return [path for path in paths if path.is_file() and NOT_SOURCES.isdisjoint(path.parts)]
