"""Normal equations in blocks of a second, and how far the correlation of residuals reduces their information."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from linkpose.sensors.measurements import Floats


class Sums(NamedTuple):
    """Normal equations of U unknowns at some values of them, in B blocks."""

    normals: Floats  # (B, U, U)
    gradients: Floats  # (B, U), downhill
    residual: Floats  # (M, 3) m/s²
    equations: float  # their number, weighted


def correlation(sums: Sums, information: Floats) -> float:
    """Variance of the blocks' gradients over the variance with independent residuals; 1 or more.

    Σ sᵀ N⁻¹ s over the blocks' gradients s, over its expectation: a block's normal matrix less its share in the fit.
    """
    inverse = np.linalg.inv(information)
    measured = np.einsum("bp,pq,bq->", sums.gradients, inverse, sums.gradients)
    shares = inverse @ sums.normals
    expected = np.einsum("bpp->", shares) - np.einsum("bpq,bqp->", shares, shares)
    return max(1.0, float(measured / expected))
