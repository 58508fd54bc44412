"""Loads libraries that only converters and live outputs use."""

from __future__ import annotations

import importlib
from typing import Any

from linkpose.errors import MissingLibrary


def load(module: str, path: object, extra: str = "files") -> Any:
    """The module; raises MissingLibrary, which names the `extra` of linkpose that contains it, if it is missing."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingLibrary(module.split(".")[0], path, extra) from error
