"""Frozen sensors: readings that repeat to the last bit for longer than any live sensor does.

A live MPU-6050 has noise of several counts on every axis. A burst that repeats in all axes for 0.2 s comes from a
sensor that has stopped converting, or from a logger that repeats a stale buffer.
"""

from __future__ import annotations

import numpy as np

from linkpose.compiling import inner
from linkpose.filters._vector import Floats, Vec

FROZEN_S = 0.2  # twice the longest hold of a logger over a slow sensor (0.1 s)
MEMORY = 7  # numbers that `is_frozen` keeps: the last force and rate, and since when they have not changed (s)


def fresh_memory() -> Floats:
    """The memory before the first sample: (MEMORY,)."""
    return np.full(MEMORY, np.nan)


@inner
def is_frozen(memory: Floats, time_s: float, force: Vec, rate: Vec) -> bool:
    """Whether the readings as recorded have repeated for FROZEN_S or more. NaN is not a repeat.

    The first FROZEN_S of a freeze cannot be distinguished from a slow logger and are not reported.
    """
    repeats = True
    for i in range(3):
        repeats = repeats and memory[i] == force[i] and memory[3 + i] == rate[i]
        memory[i], memory[3 + i] = force[i], rate[i]
    if not repeats:
        memory[6] = time_s
    return repeats and time_s - memory[6] >= FROZEN_S
