"""The bootloaders that UNOs and Nanos are sold with, for the emulated board.

ATmegaBOOT is the binary that the Arduino core brings. Optiboot is compiled from the core's source, with the reset
handling of each of its versions: they differ in when they start the firmware at once, and in what they leave in MCUSR
and r2.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import NamedTuple

_FOLDER = Path(os.environ.get("AVRDISTRO_ARDUINO", "/usr/share/arduino/hardware/arduino/avr")) / "bootloaders"
_COMPILED_ADDRESS = 0x7C00  # 1 KiB before the end: not every compiler fits it into the UNO's 512 bytes


class BootloaderImage(NamedTuple):
    """A bootloader as it lies in the flash."""

    path: Path  # Intel HEX
    address: int  # where every reset begins


ATMEGABOOT = BootloaderImage(_FOLDER / "atmega" / "ATmegaBOOT_168_atmega328.hex", 0x7800)  # the old Nano's, 57600 baud

_RESET_HANDLING = "MCUSR = 0;\n  if (!(ch & _BV(EXTRF))) appStart();"  # of Optiboot 4.4
_TO_R2 = 'asm volatile ("mov r2, %0" :: "r" (ch));'
OPTIBOOT_RESETS = {
    # Optiboot 4.4: the firmware starts after any reset but that of the pin, and does not have its cause.
    "4.4": _RESET_HANDLING,
    # Optiboot 4.6 to 6.2: the same, and r2 holds what MCUSR was.
    "6.2": f"MCUSR = 0; {_TO_R2}\n  if (ch & (_BV(WDRF) | _BV(BORF) | _BV(PORF))) appStart();",
    # Optiboot 7 and 8: r2 holds MCUSR, which stays as it was. WDRF is cleared only when the bootloader itself set it:
    # after a watchdog reset of the firmware the watchdog stays on at its shortest time.
    "8": f"""{_TO_R2}
  if (ch != 0 && (ch & (_BV(WDRF) | _BV(EXTRF))) != _BV(EXTRF)) {{
    if (ch & _BV(EXTRF)) MCUSR = ~_BV(WDRF);
    appStart();
  }}""",
}


def build_optiboot(folder: Path, processor: str = "atmega328p", resets: str = "4.4") -> BootloaderImage:
    """Optiboot with the signature of a processor and the reset handling of a version (OPTIBOOT_RESETS)."""
    text = (_FOLDER / "optiboot" / "optiboot.c").read_text()
    assert text.count(_RESET_HANDLING) == 1
    source = folder / "optiboot.c"
    source.write_text(text.replace(_RESET_HANDLING, OPTIBOOT_RESETS[resets]))
    elf, image = folder / "optiboot.elf", folder / "optiboot.hex"
    options = ["-Os", "-fno-inline-small-functions", "-fno-split-wide-types", "-mrelax", "-nostartfiles"]
    options += [f"-mmcu={processor}", "-DF_CPU=16000000L", "-DBAUD_RATE=115200", "-DLED_START_FLASHES=3"]
    options += [f"-Wl,--section-start=.text={_COMPILED_ADDRESS:#x}", "-Wl,--section-start=.version=0x7ffe"]
    subprocess.run(["avr-gcc", *options, "-iquote", _FOLDER / "optiboot", "-o", elf, source], check=True)
    subprocess.run(["avr-objcopy", "-O", "ihex", "-j", ".text", "-j", ".version", elf, image], check=True)
    return BootloaderImage(image, _COMPILED_ADDRESS)


def programmed(folder: Path, firmware: Path, bootloader: BootloaderImage) -> BootloaderImage:
    """One .hex in `folder` with the firmware and a bootloader."""
    records = firmware.read_text().splitlines()[:-1] + bootloader.path.read_text().splitlines()
    path = folder / "programmed.hex"
    path.write_text("\n".join(record for record in records if record[7:9] in ("00", "01")) + "\n")
    return bootloader._replace(path=path)
