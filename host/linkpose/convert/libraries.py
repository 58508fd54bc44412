"""Loads libraries that only converters use."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from linkpose.errors import MissingLibrary


def load(module: str, path: Path) -> Any:
    """The module; raises MissingLibrary where it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingLibrary(module.split(".")[0], path) from error
