"""The structure of the package: imports point downwards only, and there is no circle."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "host" / "linkpose"

# From the bottom up. A part imports parts of lower levels only; those of one level do not import each other, except as
# listed. A string that names a module of linkpose, for import_module or for pyserial, counts as an import.
LEVELS = [
    {"lean_lowering", "rotations"},
    {"lean_compiler"},
    {"errors", "compiling", "quantities"},
    {"inputs", "outputs"},
    {"wire", "presentation", "extremes"},
    {"sensors"},
    {"exclusions"},
    {"filters", "device", "recording", "localization", "flashing"},
    {"precompile", "calibration", "evaluation", "recorder", "simulation", "convert", "mice_findings"},
    {"board"},
    {"estimation"},
    {"live_estimation", "experiments", "plotting", "streams"},
    {"page"},
    {"cli"},
]
SAME_LEVEL = {
    ("flashing", "device"),  # opens the port
    ("localization", "recording"),  # odometry from an estimate file
    ("plotting", "experiments"),  # the pictures of `reproduce`
}


def level(part: str) -> int:
    return next((at for at, parts in enumerate(LEVELS) if part in parts), len(LEVELS))


# A module name in a string: the whole string, or the constant beginning of an f-string.
MODULE_NAME = re.compile(r"linkpose\.([a-z_0-9]+)(\.[a-z_0-9]*)*")


def imports(source: str) -> Iterator[str]:
    """The parts of linkpose that a module imports at run time, also inside functions and by name in a string."""
    tree = ast.parse(source)
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
        elif isinstance(node, ast.Constant) and (named := MODULE_NAME.fullmatch(str(node.value))):
            yield named[1]


def arrows() -> set[tuple[str, str]]:
    found = set()
    for path in PACKAGE.rglob("*.py"):
        part = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if part in ("__init__", "__main__"):
            continue
        found |= {
            (part, other) for other in imports(path.read_text(encoding="utf-8")) if other not in (part, "__version__")
        }
    return found


@pytest.mark.parametrize(
    "source",
    [
        "import linkpose.cli.options",
        "from linkpose import cli",
        "from linkpose.cli import options",
        "def late():\n    from linkpose.cli.options import port",
        "import importlib\nimportlib.import_module('linkpose.cli.estimate')",
        "import importlib\nimportlib.import_module(f'linkpose.cli.{name}')",
        "register_scheme('linkpose.cli')",
    ],
)
def test_every_form_of_import_is_found(source: str) -> None:
    assert list(imports(source)) == ["cli"]


def test_imports_for_types_only_are_left_out() -> None:
    assert not list(imports("if TYPE_CHECKING:\n    from linkpose.cli import options"))


def test_imports_point_downwards() -> None:
    upward = {
        (part, other)
        for part, other in arrows()
        if level(other) > level(part) or (level(other) == level(part) and (part, other) not in SAME_LEVEL)
    }
    assert not upward


def parts() -> set[str]:
    found = {path.name.removesuffix(".py") for path in PACKAGE.iterdir() if path.suffix == ".py" or path.is_dir()}
    return found - {"__init__", "__main__", "__pycache__", "_firmware", "_docs"}


def test_every_part_has_its_level() -> None:
    assert parts() == set().union(*LEVELS)


def test_the_architecture_page_describes_every_part() -> None:
    page = (PACKAGE.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = page.split("## Packages")[1].split("## ")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == parts()


def test_gravity_and_the_number_of_mouse_ports_stand_in_one_place() -> None:
    constant = re.compile(r"9\.80665|\bM(?:OST|AX)_MICE = ")
    found = sorted(
        (path.relative_to(PACKAGE).as_posix(), match[0])
        for path in PACKAGE.rglob("*.py")
        for match in constant.finditer(path.read_text(encoding="utf-8"))
    )
    assert found == [("sensors/devices.py", "MAX_MICE = "), ("sensors/mpu6050.py", "9.80665")]


def test_no_two_classes_share_a_name() -> None:
    names = [
        node.name
        for path in PACKAGE.rglob("*.py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    ]
    assert sorted(names) == sorted(set(names))


BENCHES = sorted((PACKAGE.parents[1] / "tests" / "bench").glob("*.py"))


@pytest.mark.parametrize("path", BENCHES, ids=lambda path: path.stem)
def test_what_the_benches_import_from_linkpose_is_there(path):
    """Nothing else runs them: a renamed function broke one for a day."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "linkpose":
            module = import_module(node.module)
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                assert hasattr(module, alias.name) or (hasattr(module, "__path__") and find_spec(whole)), whole
