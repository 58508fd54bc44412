"""The compiler of the filters' steps (numba), and where its machine code is kept from run to run.

Numba looks only at the file of a cached function. What that function calls or reads in other files is in its machine
code too, and would go stale unseen by an edit or an upgrade. So the code is kept in a folder that is named by all
sources it may come from: other sources, another folder. That is in NUMBA_CACHE_DIR where the user has set it, in the
user's cache directory, or beside this file, whichever first can be written; nowhere, and each run compiles anew.

Decorators: `compiled` for any function, `inlined` for a long part of a step, which is put into its caller before that
is compiled (else it stays a call), `inner` for what only compiled code calls.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import FunctionCache

Function = TypeVar("Function", bound=Callable[..., Any])

_PACKAGE = Path(__file__).parent
# All that compiled functions are in, call, or take constants from.
_SOURCES = (
    "__init__.py",
    "compiling.py",
    "errors.py",
    "filters/**/*.py",
    "localization/**/*.py",
    "recording/**/*.py",
    "sensors/**/*.py",
    "wire/**/*.py",
)
_config: Any = numba.config  # its attributes are made as it is imported
_PREFIX = "compiled-"
_OTHERS_KEPT = 2  # those last used: another version of this package may be at work beside this one


def cache_folder(package: Path = _PACKAGE) -> Path | None:
    """Where the machine code of this package's sources is kept, made if need be; None where nothing can be written."""
    name = _PREFIX + _fingerprint(package)
    for root in _roots(package):
        folder = root / "linkpose" / name
        with contextlib.suppress(OSError):
            _make(folder)
            return folder
    return None


def _fingerprint(package: Path) -> str:
    digest = hashlib.blake2b(numba.__version__.encode(), digest_size=10)
    for pattern in _SOURCES:
        for path in sorted(package.glob(pattern)):
            digest.update(f"\0{path.relative_to(package)}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _roots(package: Path) -> Iterator[Path]:
    if _config.CACHE_DIR:
        yield Path(_config.CACHE_DIR)
    with contextlib.suppress(RuntimeError):  # nobody's home
        yield _user_cache()
    yield package / "__pycache__"


def _user_cache() -> Path:
    """Raises RuntimeError where there is no home directory."""
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    windows = sys.platform == "win32"
    named = Path(os.environ.get("LOCALAPPDATA" if windows else "XDG_CACHE_HOME", ""))
    if named.is_absolute():
        return named
    return Path.home() / ("AppData/Local" if windows else ".cache")


def _make(folder: Path) -> None:
    """Makes the folder and removes those that are out of use, or marks it as used. Raises OSError."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        folder.mkdir()
    except FileExistsError:
        os.utime(folder)
    else:
        _remove_unused(folder)
    tempfile.TemporaryFile(dir=folder).close()  # a read-only file system tells it only so


def _remove_unused(new: Path) -> None:
    others = []
    for other in new.parent.glob(_PREFIX + "*"):
        with contextlib.suppress(OSError):  # another process may have been faster
            others.append((other.stat().st_mtime_ns, other))
    others = sorted(entry for entry in others if entry[1] != new)
    for _, other in others[: max(0, len(others) - _OTHERS_KEPT)]:
        shutil.rmtree(other, ignore_errors=True)


class _KeptCode(FunctionCache):  # type: ignore[misc]
    """The kept code of one function, which is compiled instead where a file is damaged or cannot be written.

    Processes that keep code of the same function at once may overwrite each other's: code of other arguments is not
    taken.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled function for these types of arguments, None where it is not kept."""
        try:
            loaded = super().load_overload(sig, target_context)
            if loaded is None or tuple(loaded.signature.args) == tuple(sig):
                return loaded
        except Exception:  # a damaged pickle raises anything
            pass
        with contextlib.suppress(OSError):
            self.flush()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keeps it, unless the disk is full or the folder has gone."""
        with contextlib.suppress(OSError):
            super().save_overload(sig, data)


_the_folder = functools.cache(cache_folder)


def _decorator(keep: bool, **options: Any) -> Callable[[Function], Function]:
    # Division by zero gives inf, as in the hardware: a check at each would cost more than the arithmetic.
    options = {"error_model": "numpy", **options}

    def decorate(function: Function) -> Function:
        made: Any = numba.njit(**options)(function)
        folder = _the_folder() if keep else None
        if folder is not None:
            made._cache = _kept(function, folder)
        return cast(Function, made)

    return decorate


def _kept(function: Callable[..., Any], folder: Path) -> _KeptCode:
    asked = _config.CACHE_DIR
    _config.CACHE_DIR = str(folder)
    try:  # the place is asked for here, once: other users of numba keep theirs
        return _KeptCode(function)
    finally:
        _config.CACHE_DIR = asked


compiled = _decorator(True)
inlined = _decorator(False, inline="always")
# Without wrappers for Python and without a file of its own: both cost half of the time to compile.
inner = _decorator(False, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def mark_compiled(name: str) -> None:
    """Notes that all machine code of a filter is kept, so that later runs load it."""
    folder = _the_folder()
    if folder is not None:
        with contextlib.suppress(OSError):
            (folder / f"{name}.compiled").touch()


def is_compiled(name: str) -> bool:
    """Whether the machine code of a filter is kept, and loading it takes a moment only."""
    folder = _the_folder()
    return folder is not None and (folder / f"{name}.compiled").exists()


def can_keep_code() -> bool:
    """Whether there is a folder for machine code: without one, another process cannot compile for this one."""
    return _the_folder() is not None
