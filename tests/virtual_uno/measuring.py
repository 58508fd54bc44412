"""What the tests and figures.py measure with: movements, counts, and figures from events seen outside the program."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pty_server import PtyServer
from wire_link import WireLink, us

from linkpose.wire.messages import Configure, Sample, SampleFlags, Start

CLOCKS_HZ = (12_500, 10_200, 16_600, 14_000)
MICE: list[dict[str, Any]] = [{"clockHz": clock_hz} for clock_hz in CLOCKS_HZ]  # no two alike
MOUSE_VALID = (SampleFlags.MOUSE1_VALID, SampleFlags.MOUSE2_VALID, SampleFlags.MOUSE3_VALID, SampleFlags.MOUSE4_VALID)
DEFAULTS = Configure(100, 8, 1000, 3, 1, 8, 400)
UP_MS = 1500.0  # from power-on until usual mice stream
PATIENCE_S = 600.0  # a bound for a command that hangs, on a loaded machine, never a wait


def lateness(server: PtyServer, budget_s: float) -> str:
    """What a test against the clock says when it fails: how late the board was, and how late it may be."""
    late_s = server.statistics.max_late_s
    verdict = "missed its budget" if late_s > budget_s else "kept within its budget"
    return f"the board was up to {late_s:.2f} s behind the clock: the test {verdict} of {budget_s} s"


def path(seconds: float, seed: int, top_speed_mm_s: float = 1000.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times (N,) s and a way (N, 2) mm whose speed swings up to `top_speed_mm_s`, with halts between."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0, seconds, 0.005)
    speed = np.zeros((len(time_s), 2))
    for axis in (0, 1):
        periods = rng.uniform(0.4, 6.0, 4)
        phases = rng.uniform(0, 2 * np.pi, 4)
        speed[:, axis] = sum(np.sin(2 * np.pi * time_s / p + phase) for p, phase in zip(periods, phases, strict=True))
    speed *= top_speed_mm_s / np.abs(speed).max()
    speed *= (np.sin(2 * np.pi * time_s / 7.0) > -0.7)[:, None]
    return time_s, np.cumsum(speed, axis=0) * 0.005


def move_all(link: WireLink, seconds: float) -> None:
    """Every mouse moves its own way from now on."""
    for seed, mouse in enumerate(link.uno.mice):
        mouse.feed(*path(seconds, seed), start_s=link.uno.time_s)


def stream(link: WireLink, rate_hz: int = 100) -> WireLink:
    """Gives sensors and mice time from power-on, and starts the stream with nothing kept."""
    link.run_ms(UP_MS)
    link.carry_out(DEFAULTS._replace(sample_rate_hz=rate_hz))
    link.run_ms(500)
    link.carry_out(Start())
    link.run_ms(100)
    link.forget()
    return link


def lost(samples: list[Sample]) -> int:
    """Samples missing between the first and the last."""
    return int(((np.diff([sample.seq for sample in samples]) - 1) & 0xFFFF).sum())


def movements(samples: list[Sample]) -> NDArray[np.int64]:
    """Counts of each mouse in each of the samples, (samples, mice, 2)."""
    counts: NDArray[np.int64] = np.array([sample.mice for sample in samples], dtype=np.int64)
    return counts.reshape(len(samples), -1, 2)


def totals(samples: list[Sample]) -> NDArray[np.int64]:
    """Sums of the counts, (mice, 2)."""
    return np.asarray(movements(samples).sum(axis=0))


def reported(link: WireLink) -> NDArray[np.int64]:
    """What the mice have put into their packets, (mice, 2)."""
    return np.array([mouse.state()["reported"] for mouse in link.uno.mice])


def invalid(samples: list[Sample], flag: SampleFlags) -> int:
    """How many samples come without a flag."""
    return sum(not sample.flags & flag for sample in samples)


def valid_again_ms(samples: list[Sample], flag: SampleFlags) -> float:
    """From the first of these samples, at 100 Hz, to the first one with a flag that stays; infinite when none does."""
    last_invalid = max((i for i, sample in enumerate(samples) if not sample.flags & flag), default=-1)
    return float("inf") if last_invalid == len(samples) - 1 else (last_invalid + 1) * 10.0


def busy(before: dict[str, Any], after: dict[str, Any]) -> float:
    """The share of the time between two states of the board that the core did not sleep."""
    return float(1 - (after["sleep_cycles"] - before["sleep_cycles"]) / (after["cycle"] - before["cycle"]))


def jitter_us(starts: NDArray[np.float64], rate_hz: int) -> float:
    """Peak to peak of the IMU reads' START conditions (cycles) against an even grid."""
    offset = us(starts - starts[0])
    return float(np.ptp(offset - np.round(offset * rate_hz / 1e6) * 1e6 / rate_hz))
