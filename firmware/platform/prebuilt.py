"""Makes host/linkpose/flashing/firmware.hex, the firmware that `linkpose flash --prebuilt` uploads.

    python firmware/platform/prebuilt.py            builds it from firmware/ and puts it there
    python firmware/platform/prebuilt.py --check    puts nothing there; status 1 when it is stale

Builds [env:uno_distro] with the interpreter's PlatformIO. The same sources and compiler give the same bytes.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PREBUILT = ROOT / "host" / "linkpose" / "flashing" / "firmware.hex"
ENVIRONMENT = "uno_distro"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only check whether it is stale")
    check = parser.parse_args().check
    built = build()
    stale = not PREBUILT.is_file() or PREBUILT.read_bytes() != built
    if check:
        if stale:
            print(f"{PREBUILT} is stale: type `python firmware/platform/prebuilt.py`", file=sys.stderr)
        return int(stale)
    if stale:
        PREBUILT.write_bytes(built)
    print(f"{PREBUILT.relative_to(ROOT)} {'written' if stale else 'is up to date'}")
    return 0


def build() -> bytes:
    """The firmware's .hex as it is built from this tree."""
    settings = {
        "PLATFORMIO_CORE_DIR": str(ROOT / ".piocore"),
        "PLATFORMIO_SETTING_ENABLE_TELEMETRY": "No",
        "PLATFORMIO_DISABLE_UPGRADE_CHECK": "true",
        **os.environ,
    }
    run = [sys.executable, "-m", "platformio", "run", "-s", "-d", str(ROOT), "-e", ENVIRONMENT]
    for command in ([sys.executable, str(ROOT / "firmware" / "platform" / "make_core.py")], run):
        done = subprocess.run(command, env=settings, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        if done.returncode != 0:
            sys.exit(f"the firmware does not build:\n{done.stdout}")
    return (ROOT / ".pio" / "build" / ENVIRONMENT / "firmware.hex").read_bytes()


if __name__ == "__main__":
    sys.exit(main())
