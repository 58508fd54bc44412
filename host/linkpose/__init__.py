"""linkpose: motion measurement with an Arduino UNO, inertial sensors and PS/2 optical mice.

    import linkpose as lp

    recording = lp.load("swing.csv")
    estimates = lp.estimate(recording, filters=["joint-inertial"], j2s_m=(-0.09, -0.04, 1.65))
    print(estimates.joint_inertial.height_m)

The names below are imported when they are first used, so `import linkpose` is cheap.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from linkpose.errors import LinkposeError

if TYPE_CHECKING:
    from linkpose.board import Board
    from linkpose.board import Board as open
    from linkpose.estimation import Estimates, estimate
    from linkpose.filters import create as create_filter
    from linkpose.localization.paths import Paths, localize
    from linkpose.recording.reader import Recording
    from linkpose.recording.reader import load_recording as load
    from linkpose.sensors.measurements import Measurements
    from linkpose.sensors.rig import Rig
    from linkpose.wire.messages import VERSION as __version__

__all__ = [
    "Board", "Estimates", "LinkposeError", "Measurements", "Paths", "Recording", "Rig", "__version__", "create_filter",
    "errors", "estimate", "load", "localize", "open",
]  # fmt: skip

# Public name -> (module, name there).
_HOMES = {
    "Board": ("linkpose.board", "Board"),
    "open": ("linkpose.board", "Board"),
    "Estimates": ("linkpose.estimation", "Estimates"),
    "estimate": ("linkpose.estimation", "estimate"),
    "create_filter": ("linkpose.filters", "create"),
    "Paths": ("linkpose.localization.paths", "Paths"),
    "localize": ("linkpose.localization.paths", "localize"),
    "Recording": ("linkpose.recording.reader", "Recording"),
    "load": ("linkpose.recording.reader", "load_recording"),
    "Measurements": ("linkpose.sensors.measurements", "Measurements"),
    "Rig": ("linkpose.sensors.rig", "Rig"),
    "__version__": ("linkpose.wire.messages", "VERSION"),
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'linkpose' has no attribute {name!r}")
    module, attribute = _HOMES[name]
    value = getattr(importlib.import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
