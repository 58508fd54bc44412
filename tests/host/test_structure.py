"""The structure of the package: imports point downwards only, and there is no circle."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "host" / "linkpose"

# From the bottom up. A part imports parts of lower levels only; those of one level do not import each other, except as
# listed. A string that names a module for import_module or pyserial counts as an import in the registries that use it.
LEVELS = [
    {"errors", "compiling", "quantities"},
    {"wire"},
    {"sensors"},
    {"filters", "device", "recording", "localization", "flashing"},
    {"precompile", "calibration", "evaluation", "recorder", "simulation", "convert"},
    {"board"},
    {"estimation"},
    {"experiments", "plotting", "page", "streams"},
    {"cli"},
]
SAME_LEVEL = {
    ("flashing", "device"),  # opens the port
    ("localization", "recording"),  # odometry from an estimate file
    ("plotting", "experiments"),  # the pictures of `reproduce`
}


def level(part: str) -> int:
    return next((at for at, parts in enumerate(LEVELS) if part in parts), len(LEVELS))


def imports(path: Path) -> Iterator[str]:
    """The parts of linkpose that a module imports at run time, also inside functions."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    typing_only = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "linkpose":
            parts = node.module.split(".")
            yield from [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            for alias in node.names:
                parts = alias.name.split(".")
                if parts[0] == "linkpose" and len(parts) > 1:
                    yield parts[1]


def arrows() -> set[tuple[str, str]]:
    found = set()
    for path in PACKAGE.rglob("*.py"):
        part = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if part in ("__init__", "__main__"):
            continue
        found |= {(part, other) for other in imports(path) if other not in (part, "__version__")}
    return found


def test_imports_point_downwards() -> None:
    upward = {
        (part, other)
        for part, other in arrows()
        if level(other) > level(part) or (level(other) == level(part) and (part, other) not in SAME_LEVEL)
    }
    assert not upward


def test_every_part_has_its_level() -> None:
    parts = {path.name.removesuffix(".py") for path in PACKAGE.iterdir() if path.suffix == ".py" or path.is_dir()}
    parts -= {"__init__", "__main__", "__pycache__", "_firmware", "_docs", "py.typed"}
    assert parts <= set().union(*LEVELS)


def test_device_names_no_upper_part() -> None:
    for path in (PACKAGE / "device").glob("*.py"):
        assert "linkpose.simulation" not in path.read_text(encoding="utf-8")
