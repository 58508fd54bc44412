"""The compiler of the filters' steps (numba), and the cache of their machine code.

Numba checks only the file of a cached function. The machine code also contains what that function calls in other files,
so an edit or an upgrade there would go unnoticed. The cache folder is therefore named after a fingerprint of all
sources: other sources, another folder. It lies in NUMBA_CACHE_DIR where that is set, in the user's cache directory, or
beside this file: the first place that can be written is used. If none can be written, every run recompiles.

Machine code and its pickled index run with the user's rights. They are loaded only from a folder and files that the
user owns and that nobody else can write, and each file carries a checksum: a damaged file is recompiled.

Decorators: `compiled` for a function that Python calls; `inner` for one that only compiled code calls.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import pickle
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

# Numba tries several types for each operation and formats an error for each that does not fit. Colours took 4 % of the
# time to compile. Numba reads this when it is imported.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")
import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.runtime.nrt import rtsys

from linkpose.lean_compiler import Inner, Outer

Function = TypeVar("Function", bound=Callable[..., Any])

_PACKAGE = Path(__file__).parent
# All that compiled functions are in, call, or take constants from.
_SOURCES = (
    "__init__.py",
    "compiling.py",
    "errors.py",
    "inputs.py",
    "presentation.py",
    "quantities.py",
    "rotations.py",
    "lean_compiler.py",
    "filters/**/*.py",
    "localization/**/*.py",
    "recording/**/*.py",
    "sensors/**/*.py",
    "wire/**/*.py",
)
_config: Any = numba.config  # its attributes are made as it is imported
# The steps of filters work in place. Without reference counts they compile in 10 % less time.
_ALLOCATE_NOTHING = "filters"  # the part of the package
_PREFIX = "compiled-"
_OTHERS_KEPT = 2  # those last used: another version of this package may be at work beside this one


def cache_folder(package: Path = _PACKAGE) -> Path | None:
    """The folder for the machine code of this package's sources, created if missing; None if no place is writable."""
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
    """Create the folder and remove those out of use, or mark it as used.

    Raises OSError, also where others can write the folder.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError:
        if not _is_private(os.lstat(folder)):
            raise PermissionError(f"{folder} can be written by others") from None
        os.utime(folder)
    else:
        _remove_unused(folder)
    tempfile.TemporaryFile(dir=folder).close()  # a read-only file system shows only now


def _is_private(entry: os.stat_result) -> bool:
    """Whether a file or folder belongs to this user and nobody else can write it; Windows keeps its own lists."""
    if not hasattr(os, "geteuid"):
        return True
    return entry.st_uid == os.geteuid() and not entry.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _remove_unused(new: Path) -> None:
    others = []
    for other in new.parent.glob(_PREFIX + "*"):
        with contextlib.suppress(OSError):  # another process may have been faster
            others.append((other.stat().st_mtime_ns, other))
    others = sorted(entry for entry in others if entry[1] != new)
    for _, other in others[: max(0, len(others) - _OTHERS_KEPT)]:
        shutil.rmtree(other, ignore_errors=True)


class _CheckedFiles(IndexDataCacheFile):  # type: ignore[misc]
    """Numba's index and data files, each behind a checksum, readable only if private to the user."""

    def _load_index(self) -> Any:
        """Data file names by signature; empty if the index is missing, damaged, of other sources or not private."""
        try:
            version, source, names = pickle.loads(_read_checked(self._index_path))
        except (OSError, ValueError):
            return {}
        return names if (version, source) == (self._version, self._source_stamp) else {}

    def _save_index(self, overloads: Any) -> None:
        self._write((self._version, self._source_stamp, overloads), self._index_path)

    def _load_data(self, name: str) -> Any:
        """Raises OSError or ValueError for a file that is missing, damaged or not private."""
        return pickle.loads(_read_checked(self._data_path(name)))

    def _save_data(self, name: str, data: Any) -> None:
        self._write(data, self._data_path(name))

    def _write(self, data: Any, path: str) -> None:
        content = self._dump(data)
        with self._open_for_write(path) as file:
            Path(file.name).chmod(0o600)
            file.write(hashlib.blake2b(content).digest() + content)


def _read_checked(path: str) -> bytes:
    """Content of a cache file. Raises ValueError where the checksum or the owner is wrong, OSError as `open` does."""
    with Path(path).open("rb") as file:
        if not _is_private(os.fstat(file.fileno())):
            raise ValueError(f"{path} can be written by others")
        digest, content = file.read(hashlib.blake2b().digest_size), file.read()
    if hashlib.blake2b(content).digest() != digest:
        raise ValueError(f"{path} is damaged")
    return content


class _KeptCode(FunctionCache):  # type: ignore[misc]
    """The cached code of one function; the function is compiled if a file is damaged or cannot be written.

    Processes that store code of the same function at once may overwrite each other's file, so the signature of what was
    loaded is compared.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        source_stamp = self._impl.locator.get_source_stamp()
        self._cache_file: Any = _CheckedFiles(self._cache_path, self._impl.filename_base, source_stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled function for these types of arguments, None if it is not cached.

        Numba's own method first registers all that it can compile (0.6 s of CPU and an import of scipy). Loading needs
        the runtime's symbols alone, and compiling registers the rest anyway.
        """
        try:
            rtsys.initialize(target_context)
            loaded = self._load_overload(sig, target_context)
            if loaded is None or tuple(loaded.signature.args) == tuple(sig):
                return loaded
        except Exception:  # code of another numba or LLVM raises anything
            pass
        with contextlib.suppress(OSError):
            self.flush()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store it, unless the disk is full or the folder has gone."""
        with contextlib.suppress(OSError):
            super().save_overload(sig, data)


_the_folder = functools.cache(cache_folder)


def _decorator(keep: bool, **options: Any) -> Callable[[Function], Function]:
    # Division by zero gives inf, as in the hardware: a check at each would cost more than the arithmetic.
    options = {"error_model": "numpy", **options}

    def decorate(function: Function) -> Function:
        counts = function.__module__.split(".")[1:2] != [_ALLOCATE_NOTHING]
        made: Any = numba.njit(_nrt=counts, **options)(function)
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


compiled = _decorator(True, no_cfunc_wrapper=True, nogil=True, pipeline_class=Outer)  # filters run in parallel
# Without a wrapper for Python and without a file of its own.
inner = _decorator(False, no_cpython_wrapper=True, no_cfunc_wrapper=True, pipeline_class=Inner)


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
