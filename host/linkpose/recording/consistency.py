"""Whether the accelerometer and the gyro of a recording describe one motion, and which change would make them agree.

At J2S r from a joint and with the tilt n, the specific force is f = g n + ω × (ω × r) + dω/dt × r, and dn/dt = −ω × n
([Link]). For a given ω, f is linear in r and in the tilt at the start of a short window. Least squares therefore gives
the part of f that the motion does not explain. It is small for the right unit, sign and axes of ω and f, whatever r and
the attitude are. Scaling ω and scaling the time have the same effect. The reversal of all axes of f has none, because n
and r are reversed with it; `units.is_negated` therefore needs a known J2S.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.mpu6050 import STANDARD_GRAVITY

_WINDOW = 50  # samples: half a second at 100 Hz, in which a gyro's offset turns the tilt little; doubled, twice as far
_PERIOD_S = 0.01  # samples closer than this are averaged; a wrong unit of time must not average more than
_MOST_AVERAGED = 5  # of them
_WINDOWS = 30  # those with the fastest motion; twice of them take twice as long (50 ms)
_FEWEST_WINDOWS = 3
# A contradiction is reported where a change leaves less than these parts of what is left without it, and of the
# variation of f, and where both are clear of the noise. In simulated and public recordings, right data came to 0.97 and
# more of the first; wrong ones of links and of a robot's arm to 0.02 to 0.5.
_BETTER = 0.6
_EXPLAINS = 0.5
_CLEAR_M_S2 = 0.1
_TIE = 1.05  # explanations as good as the best
# Delays (s) of one sensor against the other that are tried: shorter ones are those of low-pass filters, and a step is
# small beside a swing. A delay is an explanation where it leaves less than this part of what is left without one: right
# data came to 3.5 and more in simulated recordings and to 0.64 and more in public ones, those with a delay of 0.05 to
# 0.5 s to 0.14 and less in simulated ones.
_DELAYED = 0.4
_DELAYS_S = (0.03, 0.04, 0.05, 0.06, 0.08, 0.1, 0.12, 0.15, 0.18, 0.22, 0.26, 0.3, 0.35, 0.4, 0.45, 0.5)
_DEGREES = 180 / np.pi
_FACTORS = (1 / _DEGREES, 0.5, 2.0, 0.1, 10.0, 0.25, 4.0, 0.01, 100.0, 0.001, 1000.0, _DEGREES, -1.0)
_AXES = "xyz"
# Scales of one axis: another range or unit in one column. In right data of public recordings, the best of 0.5 and 2
# left 0.91 and more of what is left without it, and each of the others as much. A gyro's axis that is ten times too
# large stays within the range of the sensor where the motion is slow; an accelerometer's does not, because of gravity.
_SCALES = [
    (sensor, axis, factor)
    for sensor, more in (("accel", (STANDARD_GRAVITY,)), ("gyro", (0.1, 10.0)))
    for axis in range(3)
    for factor in (0.5, 2.0, _DEGREES, 1000.0, *more)
]


class _Explanation(NamedTuple):
    """A change of the data, in a sentence, and what it leaves unexplained of the specific force."""

    left_m_s2: float
    sentence: str
    alone: str = ""  # said instead where no other change explains as much


def contradiction(measurements: Measurements) -> str:
    """A sentence on the gyro and the accelerometer if they contradict each other; "" if not, or if nothing moves."""
    gyro = measurements.gyro_rad_s
    known = gyro[np.isfinite(gyro).all(axis=1)]
    if len(known) and (silent := _silent(known, measurements.accel_m_s2)):
        return silent
    windows = _windows(measurements)
    if windows is None:
        return ""
    step_s, force, rate = windows
    variation = (still := _Motion(np.zeros_like(rate), step_s)).unexplained(force)
    as_is = (motion := _Motion(rate, step_s)).unexplained(force)
    if not _CLEAR_M_S2 < as_is < np.inf or variation < _CLEAR_M_S2:
        return ""
    explanations = [
        *_of_factors(rate, step_s, force),
        *_of_exchanges(motion, _Motion(-rate, step_s), force),
        *_of_scales(motion, still, rate, step_s, force),
        *(found for found in _of_delays(measurements) if found.left_m_s2 < _DELAYED * as_is),
    ]
    best = min(found.left_m_s2 for found in explanations)
    if best > _BETTER * as_is or best > _EXPLAINS * variation:
        return ""
    first, *others = [found for found in explanations if found.left_m_s2 <= _TIE * best]
    return first.sentence if others else first.alone or first.sentence


def _of_factors(rate: Floats, step_s: float, force: Floats) -> Iterator[_Explanation]:
    """All axes of the gyro times one factor, or the time."""
    for factor in _FACTORS:
        if factor == -1.0:
            sentence = "gyro_* states the reverse of the rotation of gravity: its sign is wrong"
        elif factor == 1 / _DEGREES:
            sentence = f"gyro_* states 57 times the rotation of gravity: is it in °/s? multiply it by {factor:.7f}"
        else:
            sentence = (
                f"gyro_* states {1 / factor:.4g} times the rotation of gravity: check the range (gyro_range_deg_s) and "
                f"the unit, and multiply it by {factor:.4g}; or, if time_s is wrong, multiply that by {factor:.4g}"
            )
        yield _Explanation(_Motion(factor * rate, step_s).unexplained(force), sentence)


def _of_exchanges(motion: _Motion, reversed_: _Motion, force: Floats) -> Iterator[_Explanation]:
    """Axes exchanged or reversed, with the rates as they are or all reversed."""
    for name, (sign, axes) in _exchanges().items():
        left = (motion if sign > 0 else reversed_).unexplained(force @ axes.T)
        text, alone = (
            f"accel_* and gyro_* do not have the same axes{how}: were columns exchanged, or an axis reversed?"
            for how in ("", f" ({name})")
        )
        yield _Explanation(left, text, alone)


def _of_scales(motion: _Motion, still: _Motion, rate: Floats, step_s: float, force: Floats) -> Iterator[_Explanation]:
    """One axis of one sensor times a factor."""
    variation = still.unexplained(force)
    for sensor, axis, factor in _SCALES:
        by_axis = np.where(np.arange(3) == axis, factor, 1.0)
        if sensor == "accel":  # against its own variation: any force becomes small when it is scaled down
            scaled = by_axis * force
            left = motion.unexplained(scaled) * variation / still.unexplained(scaled)
        else:
            left = _Motion(by_axis * rate, step_s).unexplained(force)
        yield _Explanation(
            left,
            f"{sensor}_{_AXES[axis]} is {1 / factor:g} times what the motion in the other columns shows: check its "
            f"unit, and multiply it by {factor:g}",
        )


def _of_delays(measurements: Measurements) -> Iterator[_Explanation]:
    """One sensor is later than the other."""
    period_s = float(np.median(np.diff(measurements.time_s)))
    for delay_s in _DELAYS_S:
        rows = round(delay_s / period_s)
        kept = len(measurements) - rows
        if not 0 < rows < kept:
            continue
        for late, other, of_accel, of_gyro in (("accel", "gyro", rows, 0), ("gyro", "accel", 0, rows)):
            moved = replace(
                measurements[:kept],
                accel_m_s2=measurements.accel_m_s2[of_accel : of_accel + kept],
                gyro_rad_s=measurements.gyro_rad_s[of_gyro : of_gyro + kept],
            )
            if (windows := _windows(moved)) is not None:
                step_s, force, rate = windows
                yield _Explanation(
                    _Motion(rate, step_s).unexplained(force),
                    f"{late}_* comes later than {other}_* by {delay_s:g} s, by the motion that both describe: were "
                    "columns of two logs joined? Correct the times of one",
                )


def _silent(gyro: Floats, accel: Floats) -> str:
    """A sentence on axes of the gyro that read the same in all rows. Data without noise come from a simulation."""
    same = np.ptp(gyro, axis=0) == 0
    known = accel[np.isfinite(accel).all(axis=1)]
    if not same.any() or len(known) < _WINDOW or (np.ptp(known, axis=0) == 0).any():
        return ""
    names = "gyro_*" if same.all() else " and ".join(f"gyro_{_AXES[i]}" for i in np.flatnonzero(same))
    values = " and ".join(dict.fromkeys(f"{gyro[0, i] + 0.0:g}" for i in np.flatnonzero(same)))
    return f"{names} is {values} in all rows: the gyro gives no reading there, or the column is of another quantity"


@functools.cache
def _exchanges() -> dict[str, tuple[int, Floats]]:
    """Exchanges and reversals of axes: sign of the gyro, and rotation (3, 3) of the accelerometer's axes, by name.

    A rotation of the accelerometer's axes is also named by its reverse, which fits as well, if that reverses fewer. A
    rotation with a reversed gyro is named by the change of the gyro's axes.
    """
    found: dict[str, tuple[int, Floats]] = {}
    for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)):
        axes = np.array(signs)[:, None] * np.eye(3)[list(order)]
        if np.linalg.det(axes) > 0 and not np.array_equal(axes, np.eye(3)):
            found["accel x, y, z fit as " + _axes_text(-axes if sum(signs) < 0 else axes)] = (1, axes)
            found["gyro x, y, z fit as " + _axes_text(-axes.T)] = (-1, axes)
    return found


def _axes_text(axes: Floats) -> str:
    """Such as "y, x, -z"."""
    return ", ".join("-" * int(row.min() < 0) + _AXES[np.abs(row).argmax()] for row in axes)


def _windows(measurements: Measurements) -> tuple[float, Floats, Floats] | None:
    """Step (s), specific force (W, n, 3) and angular rate (W, n, 3) of the windows with the fastest motion."""
    steps = np.diff(measurements.time_s)
    step_s = float(np.median(steps)) if len(steps) else 0.0
    if not step_s > 0:
        return None
    size = int(np.clip(round(_PERIOD_S / step_s), 1, _MOST_AVERAGED))
    count = len(measurements) // (size * _WINDOW)
    if count < _FEWEST_WINDOWS:
        return None
    rows = count * size * _WINDOW
    time_s, force, rate = (
        values[:rows].reshape(count, _WINDOW, size, -1).mean(axis=2)
        for values in (measurements.time_s, measurements.accel_m_s2, measurements.gyro_rad_s)
    )
    regular = np.diff(time_s[..., 0], axis=1).max(axis=1, initial=0.0) < 1.5 * size * step_s
    usable = np.flatnonzero(regular & np.isfinite(force).all(axis=(1, 2)) & np.isfinite(rate).all(axis=(1, 2)))
    if len(usable) < _FEWEST_WINDOWS:
        return None
    motion = (rate[usable] ** 2).sum(axis=(1, 2))
    chosen = usable[np.argsort(motion)[-_WINDOWS:]]
    return size * step_s, force[chosen], rate[chosen]


class _Motion:
    """What the rotation with rates (W, n, 3) explains of a specific force."""

    def __init__(self, rate: Floats, step_s: float) -> None:
        self._turned = _turned(rate, step_s)
        lever = _skew(rate) @ _skew(rate) + _skew(np.gradient(rate, step_s, axis=1))
        self._design = _without_tilt(self._turned, lever).reshape(-1, 3)

    def unexplained(self, force: Floats) -> float:
        """Rms (m/s²) of the rest of the specific force (W, n, 3); infinite for rates beyond all numbers."""
        if not np.isfinite(self._design).all():
            return np.inf
        left = _without_tilt(self._turned, force[..., None]).reshape(-1)
        j2s_m = np.linalg.lstsq(self._design, left, rcond=1e-4)[0]
        return float(np.sqrt(np.mean((left - self._design @ j2s_m) ** 2)))


def _without_tilt(turned: Floats, values: Floats) -> Floats:
    """Values (W, n, 3, k) less what a constant vector, turned by (W, n, 3, 3), explains of them."""
    constant = np.einsum("wnij,wnik->wjk", turned, values) / turned.shape[1]
    return np.asarray(values - turned @ constant[:, None])


def _turned(rate: Floats, step_s: float) -> Floats:
    """Rotations (W, n, 3, 3) that carry a constant vector from the sensor's axes at a window's start to each sample."""
    angle = -(rate[:, 1:] + rate[:, :-1]) / 2 * step_s
    size = np.maximum(np.linalg.norm(angle, axis=-1), 1e-12)[..., None, None]
    cross = _skew(angle)
    steps = np.eye(3) + np.sin(size) / size * cross + (1 - np.cos(size)) / size**2 * (cross @ cross)
    turned = np.empty((*rate.shape, 3))
    turned[:, 0] = np.eye(3)
    for i in range(steps.shape[1]):
        turned[:, i + 1] = steps[:, i] @ turned[:, i]
    return turned


def _skew(vectors: Floats) -> Floats:
    """Matrices (…, 3, 3) of the cross product with vectors (…, 3)."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape, 3)
