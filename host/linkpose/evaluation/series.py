"""Signals over time with gaps: reading one at another's instants, and finding the offset between two clocks."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.recording.table import LONGEST_HOLE
from linkpose.rotations import wrapped
from linkpose.sensors.measurements import Floats

# An offset is taken only if it is more than half a sample and leaves less than this share of the residual.
_CLEARLY_BETTER = 0.7
SPARSER = 1.05  # a longer interval than this one's times that is another rate, not its jitter
_FEWEST = 10  # instants that a fit is judged by
# Points of the grid on which the lag is searched: 3 h at 100 Hz; longer files on a coarser one. 100 MB at most. More
# than 2²⁰ double memory and time.
_LARGEST_GRID = 1_000_000
_MOST_COMPARED = 100_000  # instants by which an offset is judged: 17 min at 100 Hz
_MOST_STEPS = 1_000_000  # between stamps, by which the usual one is judged
_STRAY = 0.01  # share of the stamps at either end that may be far from the others
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


@dataclass(frozen=True, eq=False)
class Series:
    """A signal; NaN where there is none."""

    time_s: Floats  # (N,) not decreasing
    value: Floats  # (N,) angles in radians
    is_angle: bool = False
    step_s: float | None = None  # the usual step between two stamps of the whole signal, where this is a part of it

    def at(self, time_s: Floats) -> Floats:
        """Linear interpolation, NaN outside, next to a NaN, and within a gap."""
        t, value, longest = self._known
        if len(t) < 2:
            return np.full(len(time_s), np.nan)
        found = np.interp(time_s, t, value, left=np.nan, right=np.nan)
        after = np.clip(np.searchsorted(t, time_s), 1, len(t) - 1)
        hole = (t[after] - t[after - 1] > longest) & (t[after] != time_s)
        return np.where(hole, np.nan, found)

    @functools.cached_property
    def _known(self) -> tuple[Floats, Floats, float]:
        """Times and values (an angle's unwrapped) where there is a value, and the longest step that is no gap (s)."""
        time_s, value = self.time_s, self.value
        good = np.isfinite(value)
        if not good.all():
            time_s, value = time_s[good], value[good]
        return time_s, np.unwrap(value) if self.is_angle else value, LONGEST_HOLE * self.interval_s

    @functools.cached_property
    def interval_s(self) -> float:
        """The usual step between two stamps."""
        return interval(self.time_s) if self.step_s is None else self.step_s

    @functools.cached_property
    def spread(self) -> float:
        """Standard deviation of the values."""
        return float(np.nanstd(self.value)) if np.isfinite(self.value).any() else 0.0


Pair = tuple[Series, Series]  # estimate, reference


class Lag(NamedTuple):
    """An offset between two clocks, found on a grid."""

    lag_s: float  # added to the estimate's clock to get the reference's
    step_s: float  # of the grid


def interval(time_s: Floats) -> float:
    """The usual step between two stamps (s); of very many stamps, by some of the steps."""
    every = max(1, len(time_s) // _MOST_STEPS)
    return usual(time_s[1::every] - time_s[: len(time_s) - 1 : every])


def usual(steps: Floats) -> float:
    """The usual one of the steps between two stamps (s); 0 where none is positive."""
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else 0.0


def is_sparser(one: Series, other: Series) -> bool:
    """Whether `one` has clearly fewer instants than `other`."""
    return one.interval_s > SPARSER * other.interval_s


def paired(estimate: Series, reference: Series, offset_s: float) -> tuple[Floats, Floats]:
    """Both at the instants of the sparser one, (N,), NaN where either is unknown; angles not wrapped.

    `offset_s` is added to the estimate's clock to get the reference's. The denser one is interpolated, because lines
    between its samples are closer to the motion than lines between the other's.
    """
    if is_sparser(reference, estimate):
        return estimate.at(reference.time_s - offset_s), reference.value
    return estimate.value, reference.at(estimate.time_s + offset_s)


def difference(estimate: Series, reference: Series, offset_s: float) -> Floats:
    """estimate − reference at the instants of `paired`; angles in ±π."""
    ours, theirs = paired(estimate, reference, offset_s)
    error = ours - theirs
    if estimate.is_angle:
        error = wrapped(error)
    return error


def find_offset(pairs: Sequence[Pair], near: Lag | None = None) -> tuple[float, float]:
    """Offset (s) to add to the estimate's clock to get the reference's, and the residual with it.

    `pairs` are of one filter, `near` is where the offset is if it is not 0; None: it is searched for in the pairs.
    0 unless another offset fits clearly better. The residual is the RMS of the differences without their means, each
    over the reference's standard deviation; inf without an overlap.
    """
    step = max(pairs[0][0].interval_s, pairs[0][1].interval_s)
    thin = [(_thinned(estimate), reference) for estimate, reference in pairs]
    if step == 0.0:
        return 0.0, _residual(thin, 0.0)
    near = near or strongest_lag(pairs)
    offset = _refine(thin, near.lag_s - 2 * near.step_s, near.lag_s + 2 * near.step_s)
    if abs(offset) > 0.5 * step and _fits_clearly_better(thin, offset):
        return offset, _residual(thin, offset)
    return 0.0, _residual(thin, 0.0)


def _thinned(series: Series) -> Series:
    """At most some _MOST_COMPARED of the samples: an offset needs no more, and a day at 100 Hz has 8.6 million."""
    every = max(1, len(series.time_s) // _MOST_COMPARED)
    return Series(series.time_s[::every], series.value[::every], series.is_angle, series.step_s)


def _fits_clearly_better(pairs: Sequence[Pair], offset_s: float) -> bool:
    """Whether the offset fits better than none on the instants that have a reference either way.

    On all instants an offset would look better for merely pushing a bad one, often the first, out of the reference.
    """
    both = _instants(pairs, (0.0, offset_s))
    here, there = _residual(pairs, 0.0, both), _residual(pairs, offset_s, both)
    if there < float("inf"):
        return there < _CLEARLY_BETTER * here
    return _residual(pairs, 0.0) == float("inf")


def _instants(pairs: Sequence[Pair], offsets_s: Sequence[float]) -> list[NDArray[np.bool_]]:
    """Of each pair, which of its instants (N,) can be compared with each of these offsets."""
    return [
        np.logical_and.reduce([np.isfinite(difference(*pair, offset_s)) for offset_s in offsets_s]) for pair in pairs
    ]


def _residual(pairs: Sequence[Pair], offset_s: float, instants: Sequence[NDArray[np.bool_]] | None = None) -> float:
    squares: list[float] = []
    for i, (estimate, reference) in enumerate(pairs):
        error = difference(estimate, reference, offset_s)
        if instants is not None:
            error = error[instants[i]]
        error = error[np.isfinite(error)]
        spread = reference.spread
        if len(error) < _FEWEST or not spread > 0:
            continue
        squares.append(float(np.var(error) / spread**2))
    return float(np.sqrt(np.mean(squares))) if squares else float("inf")


def strongest_lag(pairs: Sequence[Pair]) -> Lag:
    """The lag with the largest sum of cross-correlations on a common grid."""
    step = max(pairs[0][0].interval_s, pairs[0][1].interval_s)
    (estimate_from, estimate_to), (reference_from, reference_to) = (_span(series.time_s) for series in pairs[0])
    length = max(estimate_to - estimate_from, reference_to - reference_from)
    step = max(step, length / _LARGEST_GRID)
    grid = np.arange(0.0, length, step)
    size = 1 << (2 * len(grid)).bit_length()
    spectrum: NDArray[np.complex128] = np.zeros(size // 2 + 1, np.complex128)
    for estimate, reference in pairs:
        ours = _standard(estimate.at(estimate_from + grid))
        theirs = _standard(reference.at(reference_from + grid))
        spectrum += np.fft.rfft(theirs, size) * np.conj(np.fft.rfft(ours, size))
    lag = int(np.argmax(np.fft.irfft(spectrum, size)))
    lag = lag - size if lag > size // 2 else lag
    return Lag(float(reference_from - estimate_from + lag * step), step)


def _span(time_s: Floats) -> tuple[float, float]:
    """From where to where the stamps are, without the few that are far from all others: one late stamp is no hour."""
    few = int(_STRAY * len(time_s))
    core = time_s[few : len(time_s) - few]
    margin = max(10.0, float(core[-1] - core[0]))
    near = time_s[(time_s >= core[0] - margin) & (time_s <= core[-1] + margin)]
    return float(near[0]), float(near[-1])


def _standard(value: Floats) -> Floats:
    """Zero mean, unit variance, 0 in gaps."""
    good = np.isfinite(value)
    if not good.any() or not np.std(value[good]) > 0:
        return np.zeros(len(value))
    return np.where(good, (value - np.mean(value[good])) / np.std(value[good]), 0.0)


def _refine(pairs: Sequence[Pair], low: float, high: float) -> float:
    """The offset with the least residual within the bracket, by golden section to 10 µs."""
    instants = _instants(pairs, (low, high))
    a, b = low, high
    c, d = b - _GOLDEN * (b - a), a + _GOLDEN * (b - a)
    at_c, at_d = _residual(pairs, c, instants), _residual(pairs, d, instants)
    while b - a > 1e-5:
        if at_c < at_d:
            b, d, at_d = d, c, at_c
            c = b - _GOLDEN * (b - a)
            at_c = _residual(pairs, c, instants)
        else:
            a, c, at_c = c, d, at_d
            d = a + _GOLDEN * (b - a)
            at_d = _residual(pairs, d, instants)
    return 0.5 * (a + b)
