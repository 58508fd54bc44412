"""Gives the compiler LINKPOSE_SOURCE_REVISION: the CRC-32 of the firmware's sources, so that HELLO names them.

Computed over the paths (relative to firmware/) and the contents of all files in firmware/src and firmware/lib, sorted
by path. It needs no git, and the same sources give the same number in any checkout.
"""

import zlib
from pathlib import Path

Import("env")  # noqa: F821 - SCons puts Import and env here


def source_revision(firmware: Path) -> int:
    crc = 0
    files = [file for part in ("src", "lib") for file in (firmware / part).rglob("*") if file.is_file()]
    for file in sorted(files, key=lambda file: file.relative_to(firmware).as_posix()):
        crc = zlib.crc32(file.relative_to(firmware).as_posix().encode() + b"\0", crc)
        crc = zlib.crc32(file.read_bytes(), crc)
    return crc


firmware = Path(env["PROJECT_DIR"]) / "firmware"  # noqa: F821
env.Append(CPPDEFINES=[("LINKPOSE_SOURCE_REVISION", f"0x{source_revision(firmware):08x}UL")])  # noqa: F821
