"""Writes rig files: whole or not at all, and only where a rig file can be."""

from __future__ import annotations

import contextlib
import os
import stat
import tempfile
from pathlib import Path

from linkpose.errors import LinkposeError
from linkpose.sensors.rig import Rig


def write_rig(path: Path, rig: Rig) -> None:
    """Replaces a rig file, or makes a new one. Raises LinkposeError where it cannot be written.

    The text goes to a new file of unpredictable name first, which then takes the place of the old one: a reader sees
    the old rig or the new one. A symbolic link stays a link, and the file keeps its permissions.
    """
    target = path.resolve()
    if target.exists() and not target.is_file():
        raise LinkposeError(f"cannot write the rig file {path}: it is no regular file; name another one")
    partial = ""
    try:
        mode = stat.S_IMODE(target.stat().st_mode) if target.exists() else _mode_of_new_files()
        fd, partial = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
        with os.fdopen(fd, "w", encoding="utf-8") as file:
            file.write(rig.to_toml())
            file.flush()
            os.fsync(file.fileno())
        Path(partial).chmod(mode)
        Path(partial).replace(target)
    except OSError as error:
        if partial:
            with contextlib.suppress(OSError):
                Path(partial).unlink()
        reason = error.strerror
        raise LinkposeError(
            f"cannot write the rig file {path}: {reason}; name one in a folder you may write to"
        ) from error


def _mode_of_new_files() -> int:
    """What a file that is opened for writing gets."""
    umask = os.umask(0)
    os.umask(umask)
    return 0o666 & ~umask
