"""The compiler of the filters' steps (numba), and the two places of their machine code.

- Installation: a wheel that pip builds contains machine code for the processor it was built on, from
  host/build_package.py. linkpose only reads it.
- Cache: a run stores what the installation lacks in NUMBA_CACHE_DIR where that is set, in the user's cache directory,
  or beside this file. The first writable place is used. If none is writable, every run recompiles.

Numba checks only the file of a cached function. The machine code also contains what that function calls in other files,
so an edit or an upgrade there would go unnoticed. In both places, the folder is therefore named after a fingerprint of
all sources, numba's and LLVM's versions and the processor: other sources or another processor use another folder.

Machine code and its pickled index run with the user's rights. The cache is read only if the user owns it and nobody
else can write it. The installation's machine code is read only if everybody who can write it can also write this file.
Each file carries a checksum: a damaged file is recompiled.

Decorators: `compiled` for a function that Python calls, `compiled_rules` for one that decides more than it computes;
`inner` for one that only compiled code calls.
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
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

# Numba tries several types for each operation and formats an error for each that does not fit. Colours took 4 % of the
# time to compile. Numba reads this when it is imported.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")
import llvmlite
import numba
import numpy as np
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    UserProvidedCacheLocator,
)
from numba.core.registry import cpu_target
from numba.core.runtime.nrt import rtsys

from linkpose.lean_compiler import Inner, Outer, OuterOfRules, interruptible

Function = TypeVar("Function", bound=Callable[..., Any])

_PACKAGE = Path(__file__).parent
# All that compiled functions are in, call, or take constants from.
_SOURCES = (
    "__init__.py",
    "compiling.py",
    "errors.py",
    "exclusions.py",
    "inputs.py",
    "outputs.py",
    "presentation.py",
    "quantities.py",
    "rotations.py",
    "lean_compiler.py",
    "lean_lowering.py",
    "filters/**/*.py",
    "localization/**/*.py",
    "recording/**/*.py",
    "sensors/**/*.py",
    "wire/**/*.py",
)
_config: Any = numba.config  # its attributes are made as it is imported
# The steps of filters work in place. Without reference counts they compile in 10 % less time.
_ALLOCATE_NOTHING = "filters"  # the part of the package
_INSTALLED = "_machine_code"  # the folder in an installed package; host/build_package.py fills it
_PREFIX = "compiled-"
_OTHERS_KEPT = 2  # those last used: another version of this package may be at work beside this one


def cache_folder(package: Path = _PACKAGE, name: str = "") -> Path | None:
    """The folder for the machine code of this package's sources, created if missing; None if no place is writable.

    `name` is that of the folder, if it is known already.
    """
    name = name or _folder_name(package)
    for root in _roots(package):
        folder = root / "linkpose" / name
        with contextlib.suppress(OSError):
            _make(folder)
            return folder
    return None


def installed_folder(package: Path = _PACKAGE, name: str = "") -> Path | None:
    """The installation's machine code for these sources and this processor; None if it is missing or not safe.

    `name` is as for `cache_folder`.
    """
    folder = package / _INSTALLED / (name or _folder_name(package))
    with contextlib.suppress(OSError):
        for each in (folder.parent, folder):
            if not stat.S_ISDIR(os.lstat(each).st_mode) or not _is_as_safe(os.lstat(each), package):
                return None
        return folder
    return None


def _folder_name(package: Path) -> str:
    """Named after all that machine code depends on: numba and its libraries, the processor and the sources."""
    versions = numba.__version__, llvmlite.__version__, np.__version__.split(".")[0]
    processor = cpu_target.target_context.codegen().magic_tuple()
    digest = hashlib.blake2b(repr((versions, processor)).encode(), digest_size=10)
    for pattern in _SOURCES:
        for path in sorted(package.glob(pattern)):
            digest.update(f"\0{path.relative_to(package)}\0".encode())
            digest.update(path.read_bytes())
    return _PREFIX + digest.hexdigest()


def _roots(package: Path) -> Iterator[Path]:
    if _config.CACHE_DIR:
        yield Path(_config.CACHE_DIR)
    with contextlib.suppress(RuntimeError):  # the user has no home directory
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
    """Whether a file or folder belongs to this user and no other user can write it; Windows keeps its own lists."""
    if not hasattr(os, "geteuid"):
        return True
    return entry.st_uid == os.geteuid() and not entry.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _is_as_safe(entry: os.stat_result, package: Path) -> bool:
    """Whether only users who can write the package's sources can write a file or folder.

    It belongs to their owner or to this user, and its group and others may write it only if they may write the sources:
    with umask 002, pip makes both writable by the group.
    """
    if not hasattr(os, "geteuid"):
        return True
    source = os.lstat(package / "__init__.py")
    writers = entry.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    same_group = not writers & stat.S_IWGRP or entry.st_gid == source.st_gid
    return entry.st_uid in (source.st_uid, os.geteuid()) and not writers & ~source.st_mode and same_group


def _remove_unused(new: Path) -> None:
    others = []
    for other in new.parent.glob(_PREFIX + "*"):
        with contextlib.suppress(OSError):  # another process may have been faster
            others.append((other.stat().st_mtime_ns, other))
    others = sorted(entry for entry in others if entry[1] != new)
    for _, other in others[: max(0, len(others) - _OTHERS_KEPT)]:
        shutil.rmtree(other, ignore_errors=True)


class _CheckedFiles(IndexDataCacheFile):  # type: ignore[misc]
    """Numba's index and data files of one function, each behind a checksum, readable only where `is_safe`."""

    def __init__(self, impl: CompileResultCacheImpl, folder: Path, is_safe: Callable[[os.stat_result], bool]) -> None:
        super().__init__(str(folder / impl.locator.below), impl.filename_base, impl.locator.get_source_stamp())
        self._is_safe = is_safe

    def _load_index(self) -> Any:
        """Data file names by signature; empty if the index is missing, damaged, of other sources or not safe."""
        try:
            version, source, names = pickle.loads(self._read(self._index_path))
        except (OSError, ValueError):
            return {}
        return names if (version, source) == (self._version, self._source_stamp) else {}

    def _save_index(self, overloads: Any) -> None:
        self._write((self._version, self._source_stamp, overloads), self._index_path)

    def _load_data(self, name: str) -> Any:
        """Raises OSError or ValueError for a file that is missing, damaged or not safe."""
        return pickle.loads(self._read(self._data_path(name)))

    def _save_data(self, name: str, data: Any) -> None:
        self._write(data, self._data_path(name))

    def _read(self, path: str) -> bytes:
        """Content of a file. Raises ValueError where the checksum or the owner is wrong, OSError as `open` does."""
        with Path(path).open("rb") as file:
            for entry in (os.lstat(self._cache_path), os.fstat(file.fileno())):
                if not self._is_safe(entry):
                    raise ValueError(f"{path} can be written by others")
            digest, content = file.read(hashlib.blake2b().digest_size), file.read()
        if hashlib.blake2b(content).digest() != digest:
            raise ValueError(f"{path} is damaged")
        return content

    def _write(self, data: Any, path: str) -> None:
        content = self._dump(data)
        with self._open_for_write(path) as file:
            Path(file.name).chmod(0o600)
            file.write(hashlib.blake2b(content).digest() + content)


class _Place(UserProvidedCacheLocator):  # type: ignore[misc]
    """Where the files of one function lie below a folder of machine code."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file, self._lineno = file, function.__code__.co_firstlineno
        path = Path(file)
        self._stamp = hashlib.blake2b(path.read_bytes()).digest()
        if path.is_relative_to(_PACKAGE):  # an installation may move
            self.below = "-".join(["linkpose", *path.parent.relative_to(_PACKAGE).parts])
        else:
            self.below = self.get_suitable_cache_subpath(file)

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> _Place:
        return cls(function, file)

    def get_cache_path(self) -> str:
        return self.below

    def ensure_cache_path(self) -> None:
        """Nothing to do: `save_overload` makes the folder."""

    def get_source_stamp(self) -> bytes:
        """Of the content: older versions of numba use the time of the file, which an installation changes."""
        return self._stamp


class _Implementation(CompileResultCacheImpl):  # type: ignore[misc]
    """Numba's conversion of compiled functions to bytes and back."""

    _locator_classes = (_Place,)


class _KeptCode(FunctionCache):  # type: ignore[misc]
    """The stored machine code of one function; the function is compiled if a file is damaged or cannot be written.

    Processes that store code of the same function at once may overwrite each other's file, so the signature of what was
    loaded is compared.
    """

    _impl_class = _Implementation

    def __init__(self, function: Callable[..., Any], cache: Path | None, installed: Path | None) -> None:
        super().__init__(function)
        # Numba writes to its `_cache_file`; `_layers` are read, in this order.
        self._cache_file: Any = _CheckedFiles(self._impl, cache, _is_private) if cache else None
        self._layers: list[Any] = [self._cache_file] if cache else []
        if installed:
            self._layers.insert(0, _CheckedFiles(self._impl, installed, lambda entry: _is_as_safe(entry, _PACKAGE)))

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled function for these types of arguments, None if it is not stored.

        Numba's own method first registers all that it can compile (0.6 s of CPU and an import of scipy). Loading needs
        the runtime's symbols alone, and compiling registers the rest anyway.
        """
        with interruptible():
            rtsys.initialize(target_context)
            return self._load(sig, target_context)

    def _load(self, sig: Any, target_context: Any) -> Any:
        key = self._index_key(sig, target_context.codegen())
        for files in self._layers:
            try:
                data = files.load(key)
                if data is None:
                    continue
                loaded = self._impl.rebuild(target_context, data)
                if tuple(loaded.signature.args) == tuple(sig):
                    return loaded
            except Exception:  # code of another numba or LLVM raises anything
                pass
            if files is self._cache_file:
                with contextlib.suppress(OSError):
                    self.flush()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store it in the cache, unless there is none, the disk is full or the folder has gone."""
        if self._cache_file is None:
            return
        with contextlib.suppress(OSError):
            Path(self._cache_file._cache_path).mkdir(mode=0o700, exist_ok=True)
            super().save_overload(sig, data)


_the_name = functools.cache(lambda: _folder_name(_PACKAGE))  # reads all sources
_the_cache = functools.cache(lambda: cache_folder(name=_the_name()))
_the_installed = functools.cache(lambda: installed_folder(name=_the_name()))


def _call_template(resolve: Callable[..., Any], args: Sequence[Any], kws: dict[str, Any]) -> Any:
    """Numba's answer to a call from compiled code, with the types of constants in place of the constants.

    Numba takes the constant 16 and an integer for two types, and would compile the function for both.
    """
    plain = {name: numba.types.unliteral(each) for name, each in kws.items()}
    return resolve([numba.types.unliteral(each) for each in args], plain)


def _decorator(keep: bool, **options: Any) -> Callable[[Function], Function]:
    # Division by zero gives inf, as in the hardware: a check at each would cost more than the arithmetic.
    options = {"error_model": "numpy", **options}

    def decorate(function: Function) -> Function:
        counts = function.__module__.split(".")[1:2] != [_ALLOCATE_NOTHING]
        made: Any = numba.njit(_nrt=counts, **options)(function)
        if not _config.DISABLE_JIT:
            made.get_call_template = functools.partial(_call_template, made.get_call_template)
        if keep and (_the_cache() or _the_installed()):
            made._cache = _KeptCode(function, _the_cache(), _the_installed())
        return cast(Function, made)

    return decorate


compiled = _decorator(True, no_cfunc_wrapper=True, nogil=True, pipeline_class=Outer)  # filters run in parallel
# For functions that decide more than they compute.
compiled_rules = _decorator(True, no_cfunc_wrapper=True, nogil=True, pipeline_class=OuterOfRules)
# Without a wrapper for Python and without a file of its own.
inner = _decorator(False, no_cpython_wrapper=True, no_cfunc_wrapper=True, pipeline_class=Inner)


def mark_compiled(name: str) -> None:
    """Notes that all machine code of a filter is stored, so that later runs load it."""
    folder = _the_cache()
    if folder is not None:
        with contextlib.suppress(OSError):
            (folder / f"{name}.compiled").touch()


def is_compiled(name: str) -> bool:
    """Whether the machine code of a filter is stored, and loading it takes a moment only."""
    return any(
        folder is not None and (folder / f"{name}.compiled").exists() for folder in (_the_installed(), _the_cache())
    )


def can_keep_code() -> bool:
    """Whether there is a cache: without one, another process cannot compile for this one."""
    return _the_cache() is not None
