"""What users install: the sdist is whole; the wheel built from it can build and flash the firmware, and contains
machine code, which is loaded only where it is sound."""

from __future__ import annotations

import os
import re
import shutil
import stat
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path
from typing import get_args

import pytest

from linkpose import compiling, filters, precompile
from linkpose.localization.localizer import Method
from linkpose.wire.messages import VERSION

ROOT = Path(__file__).parents[2]
NOT_COPIED = shutil.ignore_patterns(".*", "node_modules", "__pycache__", "build", "dist", "*.egg-info")


def call_backend(source: Path, hook: str, out: Path, **environment: str) -> Path:
    """What `pip` and `build` do with pyproject.toml, without an environment of their own."""
    code = f"import sys; sys.path.insert(0, 'host'); import build_package; print(build_package.{hook}({str(out)!r}))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=source,
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
    )
    return out / done.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The unpacked sdist, and the unpacked wheel built from it, with the machine code of the writer of text."""
    folder = tmp_path_factory.mktemp("package")
    shutil.copytree(ROOT, folder / "tree", ignore=NOT_COPIED)
    with tarfile.open(call_backend(folder / "tree", "build_sdist", folder)) as archive:
        archive.extractall(folder, filter="data")
    source = folder / f"linkpose-{VERSION}"
    wheel = call_backend(source, "build_wheel", folder, LINKPOSE_MACHINE_CODE="text")
    python, platform = f"cp{sys.version_info[0]}{sys.version_info[1]}", sysconfig.get_platform()
    assert wheel.name == f"linkpose-{VERSION}-{python}-{python}-{re.sub('[-.]', '_', platform)}.whl"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "installed")
    return source, folder / "installed"


def run(installed: Path, *command: str, **changed: str) -> str:
    environment = {**os.environ, "PYTHONPATH": str(installed), **changed}
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


FORMAT = """
import numpy as np
from linkpose.precompile import prepare
from linkpose.recording import fixedpoint
lines = []
prepare([], lines.append)
text = fixedpoint.format_rows(np.array([[1.25]]), np.array([2]))
print(lines, text, sum(fixedpoint._format.stats.cache_hits.values()))
"""
LOADED, COMPILED = "[] b'1.25\\n' 1\n", "b'1.25\\n' 0\n"


@pytest.fixture
def package(built: tuple[Path, Path], tmp_path: Path) -> Path:
    """A copy of the installed package, in another place than the wheel was built for."""
    return Path(shutil.copytree(built[1] / "linkpose", tmp_path / "site" / "linkpose"))


def machine_code(package: Path, ending: str) -> Path:
    (found,) = (package / "_machine_code").rglob(f"*{ending}")
    return found


def test_machine_code_of_the_installation_is_loaded_and_the_cache_stays_empty(package: Path, tmp_path: Path) -> None:
    assert run(package.parent, "-c", FORMAT, NUMBA_CACHE_DIR=str(tmp_path / "cache")) == LOADED
    assert not list((tmp_path / "cache").rglob("*.nb?"))
    (tmp_path / "file").touch()
    places = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME", "LOCALAPPDATA", "USERPROFILE")
    (package / "__pycache__").touch()  # no place for a cache, as for a user without a home
    assert run(package.parent, "-c", FORMAT, **dict.fromkeys(places, str(tmp_path / "file"))) == LOADED


def test_damaged_machine_code_of_the_installation_is_compiled_into_the_cache(package: Path, tmp_path: Path) -> None:
    path = machine_code(package, ".nbc")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)
    cache = str(tmp_path / "cache")
    assert run(package.parent, "-c", FORMAT, NUMBA_CACHE_DIR=cache).endswith(COMPILED)
    assert run(package.parent, "-c", FORMAT, NUMBA_CACHE_DIR=cache) == LOADED
    assert path.read_bytes() == content


def test_another_processor_compiles_for_itself_and_says_so(package: Path, tmp_path: Path) -> None:
    other = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    assert run(package.parent, "-c", FORMAT, **other).startswith("['Compiling filters (first run only)")
    assert list((tmp_path / "cache").rglob("*.nbc"))


def test_machine_code_of_other_sources_is_not_used(package: Path) -> None:
    assert compiling.installed_folder(package) is not None
    with (package / "filters" / "_vector.py").open("a") as file:
        file.write("# edited\n")
    assert compiling.installed_folder(package) is None


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="POSIX file modes")
def test_machine_code_is_used_only_if_its_writers_can_write_the_sources(package: Path, tmp_path: Path) -> None:
    folder, cache = compiling.installed_folder(package), str(tmp_path / "cache")
    assert folder is not None
    for each in (folder, folder.parent):
        each.chmod(0o777)
        assert compiling.installed_folder(package) is None
        each.chmod(0o755)
    machine_code(package, ".nbc").chmod(0o666)
    assert run(package.parent, "-c", FORMAT, NUMBA_CACHE_DIR=cache).endswith(COMPILED)
    for path in (package, *package.rglob("*")):  # as pip leaves them with umask 002
        path.chmod(0o775 if path.is_dir() else 0o664)
    assert run(package.parent, "-c", FORMAT, NUMBA_CACHE_DIR=cache) == LOADED
    folder.rename(folder.with_name("elsewhere"))
    folder.symlink_to(folder.with_name("elsewhere"))
    assert compiling.installed_folder(package) is None


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="POSIX file modes")
def test_machine_code_belongs_to_the_owner_of_the_sources_or_to_the_user(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only root gives files away: who owns what is said by this test."""
    folder, owners, lstat = compiling.installed_folder(package), dict.fromkeys([package], os.geteuid()), os.lstat
    assert folder is not None

    def owned(path: Path) -> os.stat_result:
        entry = list(lstat(path))
        entry[stat.ST_UID] = next(owners[each] for each in (path, *path.parents) if each in owners)
        return os.stat_result(entry)

    monkeypatch.setattr(os, "lstat", owned)
    assert compiling.installed_folder(package) == folder
    owners[folder] = 12345
    assert compiling.installed_folder(package) is None
    owners[package] = 12345
    assert compiling.installed_folder(package) == folder
    owners[folder] = os.geteuid()
    assert compiling.installed_folder(package) == folder


def test_a_compiler_that_fails_costs_the_machine_code_and_not_the_wheel(
    built: tuple[Path, Path], tmp_path: Path
) -> None:
    (tmp_path / "numba.py").write_text("raise ImportError('as where a library of the system is missing')")
    broken = call_backend(built[0], "build_wheel", tmp_path, PYTHONPATH=str(tmp_path), LINKPOSE_MACHINE_CODE="text")
    assert not [name for name in zipfile.ZipFile(broken).namelist() if "_machine_code" in name]


def test_a_wheel_for_all_platforms_can_be_built(built: tuple[Path, Path], tmp_path: Path) -> None:
    wheel = call_backend(built[0], "build_wheel", tmp_path, LINKPOSE_MACHINE_CODE="no")
    assert wheel.name == f"linkpose-{VERSION}-py3-none-any.whl"
    assert not [name for name in zipfile.ZipFile(wheel).namelist() if "_machine_code" in name]


def test_an_unknown_filter_to_compile_ends_the_build(built: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(subprocess.CalledProcessError) as failed:
        call_backend(built[0], "build_wheel", tmp_path, LINKPOSE_MACHINE_CODE="tilt,barro")
    assert "names 'barro'; set it to `no`" in failed.value.stderr


def test_the_wheel_compiles_every_filter_and_method() -> None:
    sys.path.insert(0, str(ROOT / "host"))
    try:
        import build_package
    finally:
        sys.path.pop(0)
    compiled = {name for group in build_package.GROUPS for name in group}
    names = {*filters.NAMES, *get_args(Method), precompile.TEXT, precompile.NOISES, precompile.FILES}
    assert compiled == names
