"""Puts a `tool-scons` package into PLATFORMIO_CORE_DIR that runs the SCons installed from PyPI.

PlatformIO asks for the package platformio/tool-scons at the version named in its own dependency table ("~4.41101.0"
means SCons 4.11.1) and would download it. Run with the interpreter that has both `platformio` and `scons`; running it
again does no harm.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import SCons
from platformio.dependencies import get_core_dependencies
from platformio.project.config import ProjectConfig


def main() -> None:
    wanted = get_core_dependencies()["tool-scons"].lstrip("~^=")
    digits = re.fullmatch(r"4\.(\d)(\d\d)(\d\d)\.\d+", wanted)
    if digits is None:
        sys.exit(f"platformio requires tool-scons {wanted}, which does not read as an SCons version")
    scons = ".".join(str(int(number)) for number in digits.groups())
    if SCons.__version__ != scons:
        sys.exit(f"platformio requires SCons {scons}, installed is {SCons.__version__}: pip install scons=={scons}")

    folder = Path(ProjectConfig.get_instance().get("platformio", "packages_dir")) / "tool-scons"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scons.py").write_text("from SCons.Script.Main import main\n\nmain()\n")
    description = f"Runs SCons {scons} from PyPI"
    package = {"name": "tool-scons", "version": wanted, "license": "MIT", "description": description}
    (folder / "package.json").write_text(json.dumps(package))
    owner = {"owner": "platformio", "id": None, "name": "tool-scons", "requirements": None, "uri": None}
    manifest = {"type": "tool", "name": "tool-scons", "version": wanted, "spec": owner}
    (folder / ".piopm").write_text(json.dumps(manifest))
    print(f"tool-scons {wanted} -> SCons {scons} in {folder}")


if __name__ == "__main__":
    main()
