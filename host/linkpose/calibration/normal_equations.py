"""Normal equations in blocks of a second, and how far the correlation of residuals reduces their information."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from linkpose.sensors.measurements import Floats

_BLOCK_S = 1.0  # residuals further apart than this are taken for independent


class Sums(NamedTuple):
    """Normal equations of U unknowns at some values of them, in B blocks."""

    normals: Floats  # (B, U, U)
    gradients: Floats  # (B, U), downhill
    residual: Floats  # (M, 3) m/s²
    equations: float  # their number, weighted


def huber(residual: Floats, limit: float) -> Floats:
    """Weights (M,), up to 1, of residual vectors (M, 3): those longer than `limit` count by their length only."""
    return np.asarray(np.minimum(1.0, limit / np.maximum(np.linalg.norm(residual, axis=1), 1e-12)))


def in_blocks(jacobian: Floats, weight: Floats, residual: Floats, duration_s: float) -> Iterator[tuple[Floats, Floats]]:
    """Normal matrix (U, U) and gradient (U,) of each block of the rows: (M, 3, U), (M,) and (M, 3)."""
    blocks = max(1, round(duration_s / _BLOCK_S))
    for rows in np.array_split(np.arange(len(weight)), blocks):
        j, w = jacobian[rows], weight[rows]
        yield np.einsum("n,nip,niq->pq", w, j, j), -np.einsum("n,nip,ni->p", w, j, residual[rows])


def correlation(sums: Sums, information: Floats, fewest: int | None = None) -> float:
    """Variance of the blocks' gradients over the variance with independent residuals; 1 or more.

    Σ sᵀ N⁻¹ s over the blocks' gradients s, over its expectation: a block's normal matrix less its share in the fit.
    Residuals may be correlated for longer than a block, as after a step of a bias. The largest ratio counts, with
    neighbours merged in pairs until `fewest` blocks or less remain; None: with the blocks as they are.
    """
    inverse, normals, gradients, largest = np.linalg.inv(information), sums.normals, sums.gradients, 1.0
    while True:
        measured = np.einsum("bp,pq,bq->", gradients, inverse, gradients)
        shares = inverse @ normals
        expected = np.einsum("bpp->", shares) - np.einsum("bpq,bqp->", shares, shares)
        largest = max(largest, float(measured / expected))
        if fewest is None or len(normals) <= fewest:
            return largest
        normals, gradients = _merged(normals), _merged(gradients)


def _merged(values: Floats) -> Floats:
    """Sums of neighbours; the last of an odd number stays alone."""
    return np.add.reduceat(values, np.arange(0, len(values), 2), axis=0)
