"""`chain` over a whole recording: each estimate from the samples before it and from those after it.

The scheme is that of `linkpose.filters.smoother`: a first pass estimates mounting and sensor errors, then one filter
runs forwards and one backwards from these. At each sample their relative rotations are weighted by their covariances,

    φ = P_f (P_f + P_b)⁻¹ log(q_f⁻¹ q_b),   q = q_f exp(φ),   P = P_f − P_f (P_f + P_b)⁻¹ P_f

and hinge angle and heights by their variances. The angles of a ball joint follow from the rotations: D = q q_0⁻¹ with
the rotation q_0 of the neutral pose, the first one unless the rig states it.

Source: D. C. Fraser, J. E. Potter, "The optimum linear smoother as a combination of two optimum linear filters", IEEE
Trans. Automatic Control 14(4), 1969.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from linkpose.filters.chain import ChainFilter
from linkpose.filters.smoother import reversed_in_time, reversed_rig, share_of_first
from linkpose.rotations import matrices, of_vectors, product, rotation_vectors, swing_twist, wrapped
from linkpose.sensors.measurements import Floats, Measurements
from linkpose.sensors.rig import Quaternion, Rig

# Both filters begin with the same mounting and sensor errors, so that their errors have a common part: the variance of
# the mean is no less than this share of the smaller one. At 0.7, 65 % of a simulated hinge's errors with the data
# sheet's sensors are within 2σ.
_COMMON = 1.0
_STEP_RAD = 1e-4  # of the numerical derivative of the angles
_KNOWN_RAD = 1.0  # σ of a relative rotation beyond which its heading is unknown


class ChainSmoother:
    """The smoother over one whole recording; its columns are those of the filter."""

    name = ChainFilter.name

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._ahead = ChainFilter(rig)

    @property
    def columns(self) -> tuple[str, ...]:
        return self._ahead.columns

    @property
    def rejected(self) -> int:
        """Number of samples in the first pass at which a sensor had no usable reading."""
        return self._ahead.rejected

    @property
    def remarks(self) -> list[str]:
        """What is wrong with the readings, as the first pass found it."""
        return self._ahead.remarks

    def process(self, block: Measurements) -> Floats:
        """Estimates at each of the N samples: (N, len(columns)). The block is a whole recording."""
        self._ahead = ChainFilter(self._rig)
        before = self._ahead.estimates(block)
        forward, backward = self._ahead, ChainFilter(reversed_rig(self._rig))
        if self._ahead.knows_heading:  # without it, the mounting is uncertain, too
            forward = ChainFilter(self._rig)
            forward.start_from(self._ahead)
            backward.start_from(self._ahead, backwards=True)
            before = forward.estimates(block)
        after = backward.estimates(reversed_in_time(block))[::-1]
        found = _combined(before, after)
        if not forward.is_hinge:
            _set_ball_angles(found, forward.segment_axes, self._rig.chain.neutral)
        return forward.table(found)


def _combined(before: Any, after: Any) -> Any:
    """The mean of two estimates (N,) of `state.ESTIMATE`; that of one where the other is NaN."""
    out = before.copy()
    p, other = _covariance(before), _covariance(after)
    known, other_known = (np.isfinite(each["q"]).all(axis=1) for each in (before, after))
    # A rotation with an unknown heading has no mean with another: the one whose heading is known stands, or the first.
    sure, other_sure = (each["rotation_std"] < _KNOWN_RAD for each in (before, after))
    both = known & other_known & sure & other_sure
    apart = rotation_vectors(product(before["q"] * [1, -1, -1, -1], after["q"]))[both]
    gain = p[both] @ np.linalg.inv(p[both] + other[both])
    out["q"][both] = product(before["q"][both], of_vectors(np.einsum("nij,nj->ni", gain, apart)))
    out["q"] *= np.where(out["q"][:, :1] < 0, -1, 1)
    left = np.trace(p[both] - gain @ p[both], axis1=1, axis2=2)
    least = _COMMON * np.minimum(before["rotation_std"], after["rotation_std"])[both] ** 2
    variance = np.maximum(left, least)
    out["rotation_std"][both] = np.sqrt(variance)
    out["covariance"][both] = (p[both] - gain @ p[both]) * (variance / np.maximum(left, 1e-30))[:, None, None]
    only = other_known & ~(known & sure) & (other_sure | (not known.any()))
    for name in ("q", "rotation_std", "covariance"):
        out[name][only] = after[name][only]
    _combine_angles(out, after)
    for k in range(2):  # NaN without a fixed first joint
        _combine(out["height"][:, k], out["height_std"][:, k], after["height"][:, k], after["height_std"][:, k])
    return out


def _set_ball_angles(out: Any, axes: Floats, neutral: Quaternion | None) -> None:
    """Flexion, abduction and axial rotation and their σ, relative to the neutral rotation or the first known one.

    `axes` (3, 3): columns are the axes of segment 1 in sensor 1's axes. The error of the first rotation counts as
    independent of the later ones.
    """
    known = np.flatnonzero(np.isfinite(out["q"]).all(axis=1) & (out["rotation_std"] < _KNOWN_RAD))
    out["joint"][:], out["joint_std"][:] = np.nan, np.nan
    if not len(known):
        return
    first, error = out["q"][known[0]], _covariance(out[known[:1]])[0]
    if neutral is not None:
        first, error = np.asarray(neutral) / np.linalg.norm(neutral), np.zeros((3, 3))
    turned = product(out["q"][known], first * [1, -1, -1, -1])
    back = matrices(turned)
    covariance = _covariance(out[known]) + back @ error @ back.transpose(0, 2, 1)
    covariance = axes.T @ covariance @ axes
    turned[:, 1:] = turned[:, 1:] @ axes
    angles = swing_twist(turned)
    steps = [swing_twist(product(of_vectors(step[None]), turned)) for step in _STEP_RAD * np.eye(3)]
    by_error = np.stack([wrapped(moved - angles) / _STEP_RAD for moved in steps], axis=2)
    out["joint"][known] = angles
    variances = np.einsum("nia,nab,nib->ni", by_error, covariance, by_error)
    out["joint_std"][known] = np.minimum(np.sqrt(np.maximum(variances, 0.0)), np.pi)


def _covariance(found: Any) -> Floats:
    """Covariances (N, 3, 3) of the relative rotation that amount to its σ, which includes other hypotheses."""
    trace = np.trace(found["covariance"], axis1=1, axis2=2)
    scale: Floats = np.square(found["rotation_std"]) / np.where(trace > 0, trace, 1.0)
    return np.asarray(scale[:, None, None] * found["covariance"] + 1e-12 * np.eye(3))


def _combine_angles(out: Any, after: Any) -> None:
    """The hinge angle. That of the filter backwards counts from the last sample, so its offset is fitted first.

    The errors of both filters persist, so the offset is no surer than where their common variance is least.
    Where the heading is unknown, the filters may also have found opposite senses of the axis.
    """
    angle, std = after["angle"].copy(), after["angle_std"].copy()
    both = np.isfinite(out["angle"]) & np.isfinite(angle)
    if both.any():
        variance = out["angle_std"][both] ** 2 + std[both] ** 2
        weight = 1 / (variance + 1e-12)
        fits = [np.sum(weight * np.exp(1j * (out["angle"][both] - sense * angle[both]))) for sense in (1, -1)]
        sense = 1 if abs(fits[0]) >= abs(fits[1]) else -1
        angle = sense * angle + np.angle(fits[0 if sense > 0 else 1])
        angle[both] = out["angle"][both] - wrapped(out["angle"][both] - angle[both])
        std = np.minimum(np.sqrt(std**2 + variance.min()), np.pi)
    _combine(out["angle"], out["angle_std"], angle, std)
    out["angle"] = wrapped(out["angle"])


def _combine(mean: Floats, std: Floats, other: Floats, other_std: Floats) -> None:
    """Means and σ (N,) become those of both estimates."""
    only = ~np.isfinite(mean)
    mean[only], std[only] = other[only], other_std[only]
    both = ~only & np.isfinite(other)
    before, after = np.square(std[both]), np.square(other_std[both])
    share = share_of_first(before, after)
    mean[both] = share * mean[both] + (1 - share) * other[both]
    std[both] = np.sqrt(np.maximum(share * before, _COMMON * np.minimum(before, after)))
