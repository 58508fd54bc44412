"""The likely cause why a mouse was excluded, from its motion beside the motion that the others show.

A mouse of another resolution, at another angle, with exchanged axes or with a dead axis shows s = g p + h p* instead of
the motion p: a complex number g scales and turns, h mirrors. Least squares over the time of its exclusion gives both.
"""

from __future__ import annotations

import cmath
import math
from typing import Any

_LEAST_M2 = 1e-5  # Σ|p|² for a verdict: 1 s at 0.03 m/s
_OBSERVABLE = 0.05  # of Σ|p|²: without motion in two directions, mirroring is not observable
_NOTHING, _ALMOST, _TURNED_DEG = 0.2, 0.15, 6.0  # of g and h: taken for 0, for the expected value; a turned mouse
_SILENT_SHARE = 0.25  # of Σ|p|² without counts: lifted, asleep or unplugged; it is excluded until it agrees again


def _ratios(sums: Any) -> tuple[complex, complex] | None:
    """(g, h) of a mouse's sums; None where there was too little motion."""
    square, double = float(sums["by_others"]), complex(sums["by_others_double"])
    if not square > _LEAST_M2:
        return None
    direct, mirrored = complex(sums["direct"]), complex(sums["mirrored"])
    determinant = square * square - abs(double) ** 2
    if determinant < _OBSERVABLE * square * square:
        return direct / square, 0j
    g = (square * direct - double.conjugate() * mirrored) / determinant
    h = (square * mirrored - double * direct) / determinant
    return g, h


def causes(state: Any, mice: Any) -> dict[int, str]:
    """The cause of each mouse's exclusion where it is known (1 for the first mouse; 0: all mice together)."""
    sums = {0: state["while_excluded"]} | {i + 1: mice[i]["while_excluded"] for i in range(int(state["count"]))}
    found = {mouse: _likely_cause(each, mouse == 0) for mouse, each in sums.items()}
    return {mouse: cause for mouse, cause in found.items() if cause}


def _likely_cause(sums: Any, is_all: bool) -> str | None:
    """What the mouse did, as the end of a sentence; None where its motion fits none of the known faults."""
    found = _ratios(sums)
    if found is None:
        return None
    g, h = found
    it, its, is_ = ("they", "their", "are") if is_all else ("it", "its", "is")
    if abs(abs(g) - 0.5) < _ALMOST and abs(abs(h) - 0.5) < _ALMOST:
        return f"one of {its} axes counted nothing"
    if sums["without_counts"] > _SILENT_SHARE * sums["by_others"]:
        return f"{it} counted nothing while the {'gyro showed a turn' if is_all else 'others moved'}"
    if abs(g) < _NOTHING and abs(abs(h) - 1.0) < _ALMOST:
        return f"{its} x and y are exchanged, or one of them is reversed"
    if abs(h) > _NOTHING:
        return None
    size, angle_deg = abs(g), math.degrees(cmath.phase(g))
    as_much = "" if abs(size - 1.0) < _ALMOST else f"{size:.2f} times as much as counts_per_m in the rig file states"
    if abs(angle_deg) > _TURNED_DEG:
        turned = f"{it} {is_} turned by {angle_deg:.0f}° from the angle_deg in the rig file"
        return f"{turned}, and counted {as_much}" if as_much else turned
    return f"{it} counted {as_much}" if as_much else None
