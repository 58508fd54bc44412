"""Optiboot, the UNO's own bootloader, for the emulated board: compiled from the source that the Arduino core brings."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

BOOT_ADDRESS = 0x7C00  # 1 KiB before the end: not every compiler gets it into the UNO's 512 bytes

_CORE = os.environ.get("AVRDISTRO_ARDUINO", "/usr/share/arduino/hardware/arduino/avr")


def build_optiboot(folder: Path, processor: str = "atmega328p") -> Path:
    """Optiboot at BOOT_ADDRESS as a .hex in `folder`, with the signature of the processor."""
    source = Path(_CORE) / "bootloaders" / "optiboot" / "optiboot.c"
    elf, image = folder / f"{processor}.elf", folder / f"{processor}.hex"
    options = ["-Os", "-fno-inline-small-functions", "-fno-split-wide-types", "-mrelax", "-nostartfiles"]
    options += [f"-mmcu={processor}", "-DF_CPU=16000000L", "-DBAUD_RATE=115200", "-DLED_START_FLASHES=3"]
    options += [f"-Wl,--section-start=.text={BOOT_ADDRESS:#x}", "-Wl,--section-start=.version=0x7ffe"]
    subprocess.run(["avr-gcc", *options, "-o", elf, source], check=True)
    subprocess.run(["avr-objcopy", "-O", "ihex", "-j", ".text", "-j", ".version", elf, image], check=True)
    return image
