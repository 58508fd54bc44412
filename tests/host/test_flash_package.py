"""What users install: the sdist is whole, and the wheel built from it can build and flash the firmware."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from linkpose.wire.messages import VERSION

ROOT = Path(__file__).parents[2]
NOT_COPIED = shutil.ignore_patterns(".*", "node_modules", "__pycache__", "build", "dist", "*.egg-info")


def call_backend(source: Path, hook: str, out: Path) -> Path:
    """What `pip` and `build` do with pyproject.toml, without an environment of their own."""
    code = f"from setuptools import build_meta; print(build_meta.{hook}({str(out)!r}))"
    done = subprocess.run([sys.executable, "-c", code], cwd=source, check=True, capture_output=True, text=True)
    return out / done.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The unpacked sdist, and the unpacked wheel that was built from it."""
    folder = tmp_path_factory.mktemp("package")
    shutil.copytree(ROOT, folder / "tree", ignore=NOT_COPIED)
    with tarfile.open(call_backend(folder / "tree", "build_sdist", folder)) as archive:
        archive.extractall(folder, filter="data")
    source = folder / f"linkpose-{VERSION}"
    wheel = call_backend(source, "build_wheel", folder)
    assert wheel.name == f"linkpose-{VERSION}-py3-none-any.whl"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "installed")
    return source, folder / "installed"


def run(installed: Path, *command: str) -> str:
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    return subprocess.run(
        [sys.executable, *command], cwd=installed.parent, env=environment, check=True, capture_output=True, text=True
    ).stdout


def files(folder: Path) -> dict[str, bytes]:
    paths = [path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def test_the_sdist_holds_the_project(built: tuple[Path, Path]) -> None:
    source, _ = built
    for name in ("platformio.ini", "README.md", "LICENSE", "protocol/generate.py", "tests/run"):
        assert (source / name).read_bytes() == (ROOT / name).read_bytes()
    assert files(source / "firmware") == files(ROOT / "firmware")


def test_the_wheel_holds_the_firmware_as_it_stands_here(built: tuple[Path, Path]) -> None:
    _, installed = built
    brought = installed / "linkpose" / "_firmware"
    assert files(brought / "firmware") == files(ROOT / "firmware")
    assert (brought / "platformio.ini").read_bytes() == (ROOT / "platformio.ini").read_bytes()
    assert files(installed / "linkpose" / "_docs") == files(ROOT / "host" / "docs")
    prebuilt = Path("linkpose", "flashing", "firmware.hex")
    assert (installed / prebuilt).read_bytes() == (ROOT / "host" / prebuilt).read_bytes()


def test_the_wheel_is_typed_and_holds_nothing_else(built: tuple[Path, Path]) -> None:
    _, installed = built
    assert (installed / "linkpose" / "py.typed").is_file()
    assert sorted(path.name for path in installed.iterdir()) == ["linkpose", f"linkpose-{VERSION}.dist-info"]


def test_an_installed_linkpose_says_its_version_and_builds_what_it_brought(built: tuple[Path, Path]) -> None:
    _, installed = built
    assert run(installed, "-m", "linkpose", "--version") == f"linkpose, version {VERSION}\n"
    code = "from linkpose.flashing.build import project\nwith project('uno') as p: print(p.folder, p.hex_path)"
    folder, hex_path = map(Path, run(installed, "-c", code).split())
    assert folder == installed / "linkpose" / "_firmware"
    assert not hex_path.is_relative_to(installed)  # the installation may be read-only
    assert not hex_path.parents[2].exists()  # and nothing is left behind
