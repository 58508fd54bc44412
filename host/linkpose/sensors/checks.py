"""Checks of readings: which are worth using, and why others are not.

The checks are causal: blocks of any length give the same result, live and in replay.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from linkpose.sensors.measurements import Floats
from linkpose.wire.messages import SampleFlags

Codes = NDArray[np.int8]
Bools = NDArray[np.bool_]

# A burst of the MPU-6050 that repeats to the last bit. Its accelerometer's noise at the slowest low-pass filter and the
# widest range is 2.3 counts (data sheet: 400 µg/√Hz, 5 Hz, 16 g), so that three axes repeat 10 times by chance once in
# 10²⁷ bursts. The firmware uses the same time. Doubling it lets twice as many repeated readings into the filters.
FROZEN_S = 0.2
FROZEN_REPEATS = 10  # for sensors slower than 50 Hz
# One axis that repeats while the other two change. Doubling it exceeds the second within which a fault is reported.
STUCK_S = 0.5
STUCK_REPEATS = 25
LIVELY_REPEATS = 5  # an axis that repeats so often is too quiet to compare another axis with it
# A block of at least this many samples is tested as a whole for repeats that matter: more than STUCK_REPEATS, so that
# the repeats at its end began in it. Doubled, more blocks are followed sample by sample.
_LIVELY_BLOCK = 64
_SHORT_RUN = 8  # repeats of an axis at the end of the block before, up to which a block is tested as a whole
# BMP180: noise 3 to 6 Pa, one new reading in 30 ms.
BARO_FROZEN_S = 1.0
BARO_FROZEN_REPEATS = 20
BARO_STALE_S = 3.0  # without a new reading
# QMC5883L: noise 2 mG (13-52-04, table 2), 6 counts; HMC5883L: 2 mG (900405 rev E, table 2), 2 counts. No recording so
# far holds three axes that repeat 25 times by chance. A fault must be reported within 1 s.
MAG_FROZEN_S = 0.5
MAG_FROZEN_REPEATS = 25  # for chips that convert slower than 50 Hz
MAG_STALE_S = 1.0  # without a new reading; the slowest supported setting gives 75 in a second
PRESSURE_RANGE_PA = (30_000.0, 110_000.0)  # BMP180 data sheet, table 1
TEMPERATURE_RANGE_DEGC = (-41.0, 126.0)  # of the die: the data sheet's operating range, and its tolerance


class Cause(IntEnum):
    """Why a reading is invalid."""

    OK = 0
    SILENT = 1  # no reading
    BLANK = 2  # all bytes equal
    FROZEN = 3  # repeats to the last bit
    OUT_OF_RANGE = 4
    STUCK = 5  # one axis repeats while the others change
    STARTING = 6  # being set up
    ABSENT = 7  # never found so far

    @property
    def label(self) -> str:
        """As in the summary and the closing line."""
        return {Cause.STARTING: "being set up"}.get(self, self.name.lower().replace("_", " "))


class _Repeats:
    """For each sample and column, how often and how long the value has repeated, over the borders of blocks."""

    def __init__(self) -> None:
        self._last: Floats | None = None
        self._count: NDArray[np.int64] | None = None
        self._begin_s: Floats | None = None

    def follow(self, values: Floats, time_s: Floats) -> tuple[NDArray[np.int64], Floats]:
        """`values` (N, K); repetitions (N, K) and their duration in s (N, K). NaN repeats nothing."""
        return self.run(self.same(values), time_s)

    def same(self, values: Floats) -> Bools:
        """Whether each value (N, K) equals the one before."""
        before = np.full((1, values.shape[1]), np.nan) if self._last is None else self._last
        self._last = values[-1:].copy()
        return np.asarray(values == (before if len(values) == 1 else np.concatenate([before, values[:-1]])))

    def restart(self, time_s: Floats) -> None:
        """As `run` of a block in which nothing repeats."""
        self._count, self._begin_s = np.zeros(1, np.int64), time_s[-1:].copy()

    @property
    def last(self) -> list[float] | None:
        """The values (K,) of the last sample."""
        return None if self._last is None else self._last[0].tolist()

    def continued(self, same: bool, time_s: float) -> tuple[int, float]:
        """As `run` gives them for the next sample of a single column: repetitions and when they began (s).

        The sample is not followed yet: see `set`.
        """
        if self._count is None or self._begin_s is None:
            return int(same), math.nan if same else time_s
        return (int(self._count[0]) + 1, float(self._begin_s[0])) if same else (0, time_s)

    def set(self, count: int, begin_s: float, values: list[float] | None = None) -> None:
        """Follows a single sample: repetitions, when they began (s), and the values (K,), if they count."""
        self._count, self._begin_s = np.array([count]), np.array([begin_s])
        if values is not None:
            self._last = np.array([values])

    def forget(self) -> None:
        """As if no block came before, but for the last value."""
        self._count = self._begin_s = None

    @property
    def longest(self) -> int:
        """How often the last value of any column has repeated."""
        return 0 if self._count is None else int(self._count.max())

    def run(self, same: Bools, time_s: Floats) -> tuple[NDArray[np.int64], Floats]:
        """`same` (N, K): the sample continues the run of the one before."""
        size, columns = same.shape
        count = self._count if self._count is not None else np.zeros(columns, np.int64)
        begin_s = self._begin_s if self._begin_s is not None else np.full(columns, np.nan)
        if size == 1:  # live
            counts, begins = np.where(same, count + 1, 0), np.where(same, begin_s, time_s)
        else:
            rows = np.arange(size)[:, None]
            start = np.maximum.accumulate(np.where(same, -1, rows), axis=0)
            inside = start >= 0
            counts = np.where(inside, rows - start, rows + 1 + count)
            begins = np.where(inside, time_s[start], begin_s)
        self._count, self._begin_s = counts[-1], begins[-1]
        return counts, time_s[:, None] - begins


def _has_run(same: Bools, length: int) -> bool:
    """Whether any column of `same` (N, …) is True for at least `length` rows in a row."""
    done = 1  # same[i] is now True where that many rows from i on are
    while done < length and same.any():
        step = min(done, length - done)
        same = same[: len(same) - step] & same[step:]
        done += step
    return bool(same.any())


@dataclass(frozen=True, slots=True)
class ImuFlags:
    """Flags of an inertial sensor."""

    valid: int
    saturated: int
    causes: Mapping[int, Cause]


def imu_flags(number: str) -> ImuFlags:
    """As plain integers: an IntFlag costs several µs each time it meets an array."""
    bit = {flag.name: int(flag) for flag in SampleFlags}
    causes = {f"IMU{number}_{cause.name}": cause for cause in (Cause.BLANK, Cause.FROZEN, Cause.OUT_OF_RANGE)}
    return ImuFlags(
        bit[f"IMU{number}_VALID"],
        bit[f"ACCEL{number}_SATURATED"] | bit[f"GYRO{number}_SATURATED"],
        {bit[name]: cause for name, cause in causes.items()},
    )


class ImuCheck:
    """Checks an inertial sensor."""

    def __init__(self, flags: ImuFlags) -> None:
        self._flags = flags
        self._caused = sum(flags.causes)  # all of these bits
        self._suspect = self._caused | flags.saturated
        self._burst = _Repeats()
        self._axes = _Repeats()
        self._stuck = _Repeats()

    def check(
        self, accel: Floats, gyro: Floats, temp: Floats, flags: NDArray[np.integer[Any]], time_s: Floats
    ) -> Codes:
        """Cause (N,) of each sample."""
        values = np.concatenate([accel, gyro], axis=1)
        codes = np.zeros(len(values), np.int8)
        same = self._axes.same(values)
        if not same.any():  # most samples of a sensor with noise
            for each in (self._axes, self._stuck, self._burst):
                each.restart(time_s)
            return self._judge(codes, values, temp, flags)
        if self._is_lively(same):
            self._follow_end(same, time_s)
            return self._judge(codes, values, temp, flags)
        counts, _ = self._axes.run(same, time_s)
        stuck_s = self._check_axes(same, counts, time_s)
        repeats, held_s = self._burst.run(np.asarray(same.all(axis=1))[:, None], time_s)
        codes[stuck_s.max(axis=1, initial=0.0) >= STUCK_S - 1e-6] = Cause.STUCK
        codes[(repeats[:, 0] >= FROZEN_REPEATS) & (held_s[:, 0] >= FROZEN_S - 1e-6)] = Cause.FROZEN
        return self._judge(codes, values, temp, flags)

    def passes(self, accel: Floats, gyro: Floats, temp: Floats, flags: int, time_s: Floats) -> bool:
        """Whether a single sample is plausible, unsaturated and repeats no value; if so, it has been followed.

        Live, most samples are so, and `check` takes five times as long.
        """
        values, last = [*accel[0].tolist(), *gyro[0].tolist()], self._axes.last
        low, high = TEMPERATURE_RANGE_DEGC
        if (
            flags & self._suspect
            or last is None
            or any(value == before for value, before in zip(values, last, strict=True))
            or not (math.isfinite(sum(values)) and any(values[:3]))
            or temp[0] < low
            or temp[0] > high
        ):
            return False
        begin_s = time_s.item()
        self._axes.set(0, begin_s, values)
        self._stuck.set(0, begin_s)
        self._burst.set(0, begin_s)
        return True

    def _is_lively(self, same: Bools) -> bool:
        """Whether nothing repeats so often, in this block and the ones before, that it can be stuck or frozen.

        `same` (N, 6): each value equals the one before. The test takes a tenth of the time of following all repeats.
        """
        if len(same) < _LIVELY_BLOCK or self._axes.longest > _SHORT_RUN or self._burst.longest > 1:
            return False
        all_same = np.asarray(same.all(axis=1))
        return not (_has_run(same, STUCK_REPEATS - _SHORT_RUN) or _has_run(all_same, FROZEN_REPEATS - 1))

    def _follow_end(self, same: Bools, time_s: Floats) -> None:
        """The repeats at the end of a lively block: all of them began within its last rows."""
        same, time_s = same[-_LIVELY_BLOCK:], time_s[-_LIVELY_BLOCK:]
        for each in (self._axes, self._stuck, self._burst):
            each.forget()
        counts, _ = self._axes.run(same, time_s)
        self._check_axes(same, counts, time_s)
        self._burst.run(np.asarray(same.all(axis=1))[:, None], time_s)

    def _judge(self, codes: Codes, values: Floats, temp: Floats, flags: NDArray[np.integer[Any]]) -> Codes:
        """Add to `codes` what a sample shows by itself."""
        codes[(temp < TEMPERATURE_RANGE_DEGC[0]) | (temp > TEMPERATURE_RANGE_DEGC[1])] = Cause.OUT_OF_RANGE
        codes[~values[:, :3].any(axis=1)] = Cause.BLANK  # not even gravity
        codes[~np.isfinite(values).all(axis=1)] = Cause.SILENT
        if (flags & self._caused).any():
            for flag, cause in self._flags.causes.items():
                codes[flags & flag != 0] = cause
        return codes

    def _check_axes(self, same: Bools, counts: NDArray[np.int64], time_s: Floats) -> Floats:
        """How long each axis has repeated while the two others of its kind changed; 0 for less than STUCK_REPEATS."""
        lively = (counts < LIVELY_REPEATS).reshape(len(counts), 2, 3)
        others = lively[:, :, [1, 0, 0]] & lively[:, :, [2, 2, 1]]
        repeats, held_s = self._stuck.run(same & others.reshape(same.shape), time_s)
        return np.where(repeats >= STUCK_REPEATS, held_s, 0.0)


class _Held:
    """Finds the faults of a sensor that holds each reading until the next: a barometer, a magnetometer."""

    def __init__(self, frozen_repeats: int, frozen_s: float, stale_s: float) -> None:
        self._frozen_repeats, self._frozen_s, self._stale_s = frozen_repeats, frozen_s, stale_s
        self._value = _Repeats()
        self._fresh = _Repeats()
        self._readings = 0  # equal ones in a row, the first excluded

    def check(self, values: Floats, fresh: Bools, time_s: Floats) -> Codes:
        """Cause (N,) of each sample of `values` (N, K)."""
        codes = np.zeros(len(values), np.int8)
        same = np.asarray(self._value.same(values).all(axis=1))[:, None]
        counts, held_s = self._value.run(same, time_s)
        readings = self._count_readings(fresh, counts[:, 0])
        _, stale_s = self._fresh.run(~fresh[:, None], time_s)
        with np.errstate(invalid="ignore"):
            codes[(readings >= self._frozen_repeats) & (held_s[:, 0] >= self._frozen_s)] = Cause.FROZEN
            codes[stale_s[:, 0] >= self._stale_s] = Cause.FROZEN
        return codes

    def passes(self, value: float, fresh: bool, time_s: float) -> bool:
        """Whether a sample of one value (K = 1) shows no fault; if so, it has been followed: see `ImuCheck.passes`."""
        last = self._value.last
        if last is None:
            return False
        count, begin_s = self._value.continued(value == last[0], time_s)
        stale, stale_since_s = self._fresh.continued(not fresh, time_s)
        readings = int(fresh) + (self._readings if count else 0)
        is_frozen = readings >= self._frozen_repeats and time_s - begin_s >= self._frozen_s
        if is_frozen or time_s - stale_since_s >= self._stale_s:
            return False
        self._value.set(count, begin_s, [value])
        self._fresh.set(stale, stale_since_s)
        self._readings = readings
        return True

    def _count_readings(self, fresh: Bools, repeats: NDArray[np.int64]) -> NDArray[np.int64]:
        """How many new readings in a row had the same value, up to each sample."""
        total = np.cumsum(fresh) + self._readings
        before = np.concatenate([[self._readings], total[:-1]])
        changed = repeats == 0
        base = np.maximum.accumulate(np.where(changed, before, 0))
        equal = total - base
        self._readings = int(equal[-1])
        return equal


class BaroCheck:
    """Checks a barometer."""

    def __init__(self) -> None:
        self._held = _Held(BARO_FROZEN_REPEATS, BARO_FROZEN_S, BARO_STALE_S)

    def passes(self, pressure: float, fresh: bool, time_s: float) -> bool:
        """Whether a single sample shows no fault; if so, it has been followed. See `ImuCheck.passes`."""
        low, high = PRESSURE_RANGE_PA
        return low <= pressure <= high and self._held.passes(pressure, fresh, time_s)

    def check(self, pressure: Floats, fresh: Bools, time_s: Floats) -> Codes:
        """Cause (N,) of each sample."""
        codes = self._held.check(pressure[:, None], fresh, time_s)
        codes[(pressure < PRESSURE_RANGE_PA[0]) | (pressure > PRESSURE_RANGE_PA[1])] = Cause.OUT_OF_RANGE
        codes[np.isnan(pressure)] = Cause.SILENT
        return codes


class MagCheck:
    """Checks a magnetometer."""

    def __init__(self) -> None:
        self._held = _Held(MAG_FROZEN_REPEATS, MAG_FROZEN_S, MAG_STALE_S)

    def check(self, field: Floats, fresh: Bools, time_s: Floats) -> Codes:
        """Cause (N,) of each sample of `field` (N, 3)."""
        codes = self._held.check(field, fresh, time_s)
        codes[~field.any(axis=1)] = Cause.BLANK  # the earth's field is nowhere zero
        codes[~np.isfinite(field).all(axis=1)] = Cause.SILENT
        return codes
