"""A position that one Gaussian does not describe: a sum of Gaussians over ranges to beacons, for tags without odometry.

Seconds after the last fix, a tag may be anywhere within some metres. The ranges are then circles, not lines: an
extended filter corrects with the slopes of a wrong place, and states a small σ there. Here the likelihood of such a
range is itself a sum of Gaussians, windows along its circle, so that each product with a Gaussian of the position is
linear. Products of small weight are left out, and those that agree become one: after three ranges usually one is left.
Source: Alspach and Sorenson, "Nonlinear Bayesian estimation using Gaussian sum approximations", IEEE Transactions on
Automatic Control 17 (1972), pages 439-448.

Of each range, one hypothesis is that it is an outlier, and says nothing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from linkpose.compiling import compiled, inner
from linkpose.localization.drift import drift
from linkpose.localization.ekf import ekf_predict
from linkpose.localization.linalg import Floats, symmetrise
from linkpose.localization.steps import Gaussian, Prediction

# A range is taken for a line where its circle departs from the tangent by less than this share of the range's standard
# deviation (second-order term of the expectation).
BEND = 0.25
# The same of a window, whose mean departure is taken out. Half of it takes 1.4 times as many windows.
WINDOW_BEND = 0.3
# Window's spacing in its standard deviations: the sum of the windows is flat within 2 % (Poisson's sum).
SPACING = 2.0
FEWEST_WINDOWS, MOST_WINDOWS = 3, 128
REACH = 4.0  # standard deviations of the position within which windows are placed
NEGLIGIBLE = 3e-4  # weight of a Gaussian, relative to the largest, that is left out
MOST, MOST_IN_SEARCH = 64, 16  # Gaussians after a measurement; in each of the passes that search for the noises
COMPARED = 4  # times as many are compared before
# Gaussians are one whose means are nearer than √SAME standard deviations, and whose variances differ by less than the
# factor ALIKE.
SAME, ALIKE = 0.7, 4.0
OUTLIERS = 0.05  # share of ranges that are outliers: radio ranges in buildings without line of sight


class Mixture(NamedTuple):
    """Weights (k,), which sum to 1, means (k, n) and covariances (k, n, n). x and y (m) are the first two states."""

    weights: Floats
    means: Floats
    covariances: Floats


class RangeRow(NamedTuple):
    """One range (m), its variance (m²), its row of the model's table as in `beacon_range`, and the density (1/m) of
    outliers; 0 takes all ranges.
    """

    value: float
    variance: float
    parameters: Floats
    outliers: float


@compiled
def single(mean: Floats, covariance: Floats) -> Mixture:
    """A mixture of one Gaussian."""
    n = mean.shape[0]
    means, covariances = np.empty((1, n)), np.empty((1, n, n))
    means[0], covariances[0] = mean, covariance
    return Mixture(np.ones(1), means, covariances)


@compiled
def is_bent(mean: Floats, covariance: Floats, row: RangeRow) -> bool:
    """Whether the range's circle is no line within this Gaussian."""
    across, distance = _across(mean, covariance, row.parameters)
    return across > 2.0 * BEND * math.sqrt(row.variance) * distance


@inner
def _across(mean: Floats, covariance: Floats, parameters: Floats) -> tuple[float, float]:
    """The variance (m²) of the position at right angles to the direction of the beacon, and the level distance (m)."""
    dx, dy = mean[0] - parameters[0], mean[1] - parameters[1]
    distance = math.sqrt(dx * dx + dy * dy)
    if distance < 1e-9:
        return max(covariance[0, 0], covariance[1, 1]), distance
    return _variance_across(covariance, dx / distance, dy / distance), distance


@inner
def _variance_across(covariance: Floats, c: float, s: float) -> float:
    """Variance (m²) of the position at right angles to the direction (c, s)."""
    return float(s * s * covariance[0, 0] - 2.0 * s * c * covariance[0, 1] + c * c * covariance[1, 1])


@compiled
def predict_sum(mixture: Mixture, prediction: Prediction, drifts: Floats) -> Mixture:
    """Moves each Gaussian on, in place; returns the mixture with those merged that the motion's noise made alike."""
    for i in range(mixture.weights.shape[0]):
        estimate = Gaussian(mixture.means[i], mixture.covariances[i])
        ekf_predict(estimate, prediction)
        drift(estimate, prediction.interval_s, drifts)
    return mixture if mixture.weights.shape[0] == 1 else _merged(mixture, MOST)


@compiled
def collapse(mixture: Mixture, mean: Floats, covariance: Floats) -> None:
    """Fills the mean (n,) and the covariance (n, n) of the whole mixture."""
    n = mean.shape[0]
    mean[:] = 0.0
    covariance[:, :] = 0.0
    for k in range(mixture.weights.shape[0]):
        for i in range(n):
            mean[i] += mixture.weights[k] * mixture.means[k, i]
    for k in range(mixture.weights.shape[0]):
        for i in range(n):
            for j in range(n):
                off = (mixture.means[k, i] - mean[i]) * (mixture.means[k, j] - mean[j])
                covariance[i, j] += mixture.weights[k] * (mixture.covariances[k, i, j] + off)


@compiled
def expected(mixture: Mixture, row: RangeRow) -> tuple[float, float]:
    """Innovation (m) of the range and its variance (m²), by the second-order moments of each Gaussian."""
    total = mean = square = 0.0
    slopes, at = np.zeros(5), np.zeros(5, np.int64)
    for k in range(mixture.weights.shape[0]):
        across, distance = _across(mixture.means[k], mixture.covariances[k], row.parameters)
        across = max(across, 0.0)
        bend = 0.5 * across / max(distance, math.sqrt(across), 1e-9)
        value = _linear(mixture.means[k], row.parameters, mixture.means[k], slopes, at)
        variance = _form(mixture.covariances[k], slopes, at, slopes, at) + 2.0 * bend * bend
        value += bend
        total += mixture.weights[k]
        mean += mixture.weights[k] * value
        square += mixture.weights[k] * (variance + value * value)
    return row.value - mean / total, max(square / total - (mean / total) ** 2, 0.0) + row.variance


@compiled
def correct_sum(mixture: Mixture, row: RangeRow, most: int) -> tuple[Mixture, float, float]:
    """Corrects with one range; at most `most` Gaussians are left.

    Returns the mixture, ln of the range's density (1/m), and the probability that the range is no outlier.
    """
    source, angle, width, logs, count = _candidates(mixture, row)
    best = -math.inf
    for c in range(count):
        best = max(best, logs[c])
    total = sound = 0.0
    for c in range(count):
        weight = math.exp(logs[c] - best)
        total += weight
        if width[c] >= 0.0:
            sound += weight
    lowest, size = best + math.log(NEGLIGIBLE), COMPARED * most + 1
    while size > COMPARED * most:
        size = 0
        for c in range(count):
            size += logs[c] > lowest
        lowest = 0.8 * lowest + 0.2 * best if size > COMPARED * most else lowest
    n, to = mixture.means.shape[1], -1
    out = Mixture(np.empty(size), np.empty((size, n)), np.empty((size, n, n)))
    for c in range(count):
        if logs[c] <= lowest:
            continue
        to += 1
        out.weights[to] = math.exp(logs[c] - best)
        out.means[to] = mixture.means[source[c]]
        out.covariances[to] = mixture.covariances[source[c]]
        if width[c] >= 0.0:
            _correct(out.means[to], out.covariances[to], row, angle[c], width[c])
    return _merged(out, most), best + math.log(total), sound / total


@inner
def _candidates(mixture: Mixture, row: RangeRow) -> tuple[NDArray[np.int64], Floats, Floats, Floats, int]:
    """The Gaussians that the product with the range's likelihood consists of: index of the Gaussian before, direction
    (rad) from the beacon and σ (m) of the window, ln weight, and their number.

    A width of 0 is a range that is a line within the Gaussian, a negative one the hypothesis of an outlier.
    """
    most = mixture.weights.shape[0] * (MOST_WINDOWS + 1)
    source, angle, width, logs = np.empty(most, np.int64), np.empty(most), np.empty(most), np.empty(most)
    count = 0
    for k in range(mixture.weights.shape[0]):
        mean, covariance, start = mixture.means[k], mixture.covariances[k], math.log(mixture.weights[k])
        if row.outliers > 0.0:
            source[count], angle[count], width[count] = k, 0.0, -1.0
            logs[count] = start + math.log(row.outliers)
            count += 1
        if not is_bent(mean, covariance, row):
            source[count], angle[count], width[count] = k, 0.0, 0.0
            logs[count] = start + _log_density(mean, covariance, row)
            count += 1
            continue
        middle, half, windows, sigma = _windows(mean, covariance, row)
        first = count
        for i in range(windows):
            angle[count] = middle + half * (2.0 * i + 1.0 - windows) / windows
            source[count], width[count] = k, sigma
            count += 1
        _log_windows(mean, covariance, row, angle[first:count], sigma, logs[first:count])
        for i in range(first, count):
            logs[i] += start
    return source, angle, width, logs, count


@inner
def _windows(mean: Floats, covariance: Floats, row: RangeRow) -> tuple[float, float, int, float]:
    """Middle and half of the arc (rad) that the Gaussian reaches, the number of windows on it, and their σ (m)."""
    radius = _radius(mean, row)
    dx, dy = mean[0] - row.parameters[0], mean[1] - row.parameters[1]
    distance = math.sqrt(dx * dx + dy * dy)
    reach = REACH * math.sqrt(max(covariance[0, 0] + covariance[1, 1], 0.0)) + abs(distance - radius)
    half = math.pi if reach >= max(distance, radius) else min(math.pi, 1.6 * reach / max(distance, radius))
    sigma = math.sqrt(2.0 * WINDOW_BEND * math.sqrt(row.variance) * radius)
    windows = min(max(math.ceil(2.0 * half * radius / (SPACING * sigma)), FEWEST_WINDOWS), MOST_WINDOWS)
    return math.atan2(dy, dx), half, windows, 2.0 * half * radius / (SPACING * windows)


@inner
def _radius(mean: Floats, row: RangeRow) -> float:
    """The level radius (m) of the range's circle; at least the distance within which the range changes by one σ."""
    distance, sigma = row.value, math.sqrt(row.variance)
    bias, drifting, scale = int(row.parameters[5]), int(row.parameters[6]), int(row.parameters[4])
    if bias >= 0:
        distance -= mean[bias]
    if drifting >= 0:
        distance -= mean[drifting]
    if scale >= 0:
        distance /= max(1.0 + mean[scale], 0.1)
    distance = max(distance, sigma)
    return math.sqrt(max(distance * distance - row.parameters[2] ** 2, 2.0 * distance * sigma))


@inner
def _linear(mean: Floats, parameters: Floats, at_place: Floats, slopes: Floats, at: NDArray[np.int64]) -> float:
    """The range at the place (x, y) with the constants of `mean`; fills its slopes (5,) by the states `at` (5,). A
    missing state has slope 0.
    """
    dx, dy, dz = at_place[0] - parameters[0], at_place[1] - parameters[1], parameters[2]
    distance = math.sqrt(dx * dx + dy * dy + dz * dz)
    scale, bias, drifting = int(parameters[4]), int(parameters[5]), int(parameters[6])
    factor = 1.0 + mean[scale] if scale >= 0 else 1.0
    at[0], at[1], at[2], at[3], at[4] = 0, 1, max(scale, 0), max(bias, 0), max(drifting, 0)
    slopes[0] = factor * dx / max(distance, 1e-9)
    slopes[1] = factor * dy / max(distance, 1e-9)
    slopes[2] = distance if scale >= 0 else 0.0
    slopes[3] = 1.0 if bias >= 0 else 0.0
    slopes[4] = 1.0 if drifting >= 0 else 0.0
    value = factor * distance
    if bias >= 0:
        value += mean[bias]
    if drifting >= 0:
        value += mean[drifting]
    return value


@inner
def _form(
    covariance: Floats, left: Floats, left_at: NDArray[np.int64], right: Floats, right_at: NDArray[np.int64]
) -> float:
    """left P rightᵀ of two sparse rows."""
    total = 0.0
    for i in range(left.shape[0]):
        if left[i] != 0.0:
            for j in range(right.shape[0]):
                if right[j] != 0.0:
                    total += left[i] * covariance[left_at[i], right_at[j]] * right[j]
    return total


@inner
def _rows(
    mean: Floats,
    covariance: Floats,
    row: RangeRow,
    direction: float,
    sigma: float,
    slopes: Floats,
    at: NDArray[np.int64],
    side: Floats,
) -> tuple[float, float, float]:
    """Innovations (m) of the range, linearised in the middle of the window, and of the window, and the variance (m²) of
    the range's departure from the tangent; fills the slopes of both (5,).

    With σ 0 there is no window, and the range is linearised at the mean.
    """
    if sigma == 0.0:
        side[:] = 0.0
        return row.value - _linear(mean, row.parameters, mean, slopes, at), 0.0, 0.0
    radius = _radius(mean, row)
    c, s = math.cos(direction), math.sin(direction)
    place = np.array([row.parameters[0] + radius * c, row.parameters[1] + radius * s])
    value = _linear(mean, row.parameters, place, slopes, at)
    off_x, off_y = mean[0] - place[0], mean[1] - place[1]
    side[:] = 0.0
    side[0], side[1] = -s, c
    across = _variance_across(covariance, c, s)
    bend = _departure(across, sigma, c * slopes[0] + s * slopes[1], radius)
    return row.value - value - bend - slopes[0] * off_x - slopes[1] * off_y, s * off_x - c * off_y, 2.0 * bend * bend


@inner
def _log_density(mean: Floats, covariance: Floats, row: RangeRow) -> float:
    """ln of the density of a range that is a line within the Gaussian, before the correction."""
    slopes, at = np.empty(5), np.empty(5, np.int64)
    off = row.value - _linear(mean, row.parameters, mean, slopes, at)
    variance = _form(covariance, slopes, at, slopes, at) + row.variance
    return -0.5 * (off * off / variance + math.log(2.0 * math.pi * variance))


@inner
def _departure(across: float, sigma: float, steep: float, radius: float) -> float:
    """How much longer (m) the range is in the mean than on the tangent, where the variance (m²) along it is `across`
    before and the window has σ.
    """
    return 0.5 * steep / radius * across * sigma * sigma / (across + sigma * sigma)


@inner
def _log_windows(mean: Floats, covariance: Floats, row: RangeRow, angles: Floats, sigma: float, logs: Floats) -> None:
    """Fills ln of the density of range and window, before the correction, for each window's direction (rad), times the
    windows' spacing.
    """
    slopes, at, radius = np.empty(5), np.empty(5, np.int64), _radius(mean, row)
    east = np.array([row.parameters[0] + radius, row.parameters[1]])
    ahead = row.value - _linear(mean, row.parameters, east, slopes, at)  # the same in all directions, as the next four
    steep = slopes[0]
    slopes[0] = slopes[1] = 0.0
    rest = _form(covariance, slopes, at, slopes, at) + row.variance
    by_x = by_y = 0.0
    for i in range(2, 5):
        by_x += covariance[0, at[i]] * slopes[i]
        by_y += covariance[1, at[i]] * slopes[i]
    xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    for i in range(angles.shape[0]):
        c, s = math.cos(angles[i]), math.sin(angles[i])
        off_x = mean[0] - row.parameters[0] - radius * c
        off_y = mean[1] - row.parameters[1] - radius * s
        across = _variance_across(covariance, c, s)
        bend = _departure(across, sigma, steep, radius)
        first, second = ahead - bend - steep * (c * off_x + s * off_y), s * off_x - c * off_y
        a = (
            2.0 * bend * bend
            + steep * (steep * (c * c * xx + 2.0 * c * s * xy + s * s * yy) + 2.0 * (c * by_x + s * by_y))
            + rest
        )
        b = steep * (c * s * (yy - xx) + (c * c - s * s) * xy) - s * by_x + c * by_y
        d = across + sigma * sigma
        determinant = a * d - b * b
        logs[i] = -math.inf
        if determinant > 0.0:
            d2 = (d * first * first - 2.0 * b * first * second + a * second * second) / determinant
            logs[i] = math.log(SPACING * sigma) - 0.5 * (d2 + math.log(4.0 * math.pi * math.pi * determinant))


@inner
def _correct(mean: Floats, covariance: Floats, row: RangeRow, direction: float, sigma: float) -> None:
    """The Kalman correction with the range, and with its window where σ is above 0, in place."""
    n = mean.shape[0]
    slopes, side, at = np.empty(5), np.empty(5), np.empty(5, np.int64)
    first, second, bent = _rows(mean, covariance, row, direction, sigma, slopes, at, side)
    cross = np.zeros((n, 2))
    for i in range(n):
        for j in range(5):
            cross[i, 0] += covariance[i, at[j]] * slopes[j]
            cross[i, 1] += covariance[i, at[j]] * side[j]
    a = _form(covariance, slopes, at, slopes, at) + row.variance + bent
    b = _form(covariance, slopes, at, side, at)
    d = _form(covariance, side, at, side, at) + (sigma * sigma if sigma > 0.0 else 1.0)
    determinant = a * d - b * b
    for i in range(n):
        gain_1 = (d * cross[i, 0] - b * cross[i, 1]) / determinant
        gain_2 = (a * cross[i, 1] - b * cross[i, 0]) / determinant
        mean[i] += gain_1 * first + gain_2 * second
        for j in range(n):
            covariance[i, j] -= gain_1 * cross[j, 0] + gain_2 * cross[j, 1]
    symmetrise(covariance)


@inner
def _merged(mixture: Mixture, most: int) -> Mixture:
    """The mixture, normalised, with Gaussians that agree made one; at most `most`, the largest."""
    total, n = mixture.weights.shape[0], mixture.means.shape[1]
    group, count = np.empty(total, np.int64), 0
    for i in range(total):
        group[i] = -1
    while count < most:
        head = -1  # the largest that is in no group
        for i in range(total):
            if group[i] < 0 and (head < 0 or mixture.weights[i] > mixture.weights[head]):
                head = i
        if head < 0:
            break
        for j in range(total):
            if group[j] < 0 and (j == head or _is_same(mixture, head, j)):
                group[j] = count
        count += 1
    out = Mixture(np.zeros(count), np.zeros((count, n)), np.zeros((count, n, n)))
    for i in range(total):
        if group[i] >= 0:
            out.weights[group[i]] += mixture.weights[i]
    for i in range(total):
        g = group[i]
        if g >= 0:
            for a in range(n):
                out.means[g, a] += mixture.weights[i] / out.weights[g] * mixture.means[i, a]
    for i in range(total):
        g = group[i]
        if g >= 0:
            for a in range(n):
                for b in range(n):
                    off = (mixture.means[i, a] - out.means[g, a]) * (mixture.means[i, b] - out.means[g, b])
                    share = mixture.weights[i] / out.weights[g]
                    out.covariances[g, a, b] += share * (mixture.covariances[i, a, b] + off)
    whole = 0.0
    for g in range(count):
        whole += out.weights[g]
    for g in range(count):
        out.weights[g] /= whole
    return out


@inner
def _is_same(mixture: Mixture, i: int, j: int) -> bool:
    """Whether two Gaussians have nearly the same position and variance of it."""
    one, other = mixture.covariances[i], mixture.covariances[j]
    ratio = (one[0, 0] + one[1, 1]) / (other[0, 0] + other[1, 1])
    if not 1.0 / ALIKE < ratio < ALIKE:
        return False
    dx, dy = mixture.means[i, 0] - mixture.means[j, 0], mixture.means[i, 1] - mixture.means[j, 1]
    determinant = one[0, 0] * one[1, 1] - one[0, 1] * one[0, 1]
    d2 = one[1, 1] * dx * dx - 2.0 * one[0, 1] * dx * dy + one[0, 0] * dy * dy
    return bool(d2 < SAME * determinant)
