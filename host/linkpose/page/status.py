"""What the page shows besides the estimates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from linkpose.device.session import Health
    from linkpose.estimation import FoundJ2s


@dataclass(frozen=True, slots=True)
class PageStatus:
    """What the page shows besides the estimates."""

    health: Health | None = None
    j2s: FoundJ2s | None = None  # where J2S is estimated
    line: str = ""  # what is not ready yet, such as filters that are being compiled
