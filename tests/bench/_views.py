"""What the benches of the page and the terminal view share: a healthy board, and the browser of the tests."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests" / "host"))
from browser import Browser  # noqa: E402

HEALTH: Any = SimpleNamespace(
    rate_hz=100.0, lost=0, sensors={"imu": {"state": "ok"}, "baro": {"state": "ok"}}, silent_s=0.0
)

__all__ = ["HEALTH", "ROOT", "Browser"]
