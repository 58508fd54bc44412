"""A sensor that reads elements of the state as they are, up to a factor: h_i = factor_i · state[index_i].

Depth below the surface is -z, a compass reads the heading, a pose fix reads three states. A row of parameters is
(index, factor).
"""

from __future__ import annotations

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats

ID = 3
COLUMNS = 2  # of parameters


@compiled
def predict(state: Floats, parameters: Floats, out: Floats) -> None:
    """The readings, in the units of the states."""
    for i in range(out.shape[0]):
        out[i] = parameters[i, 1] * state[int(parameters[i, 0])]


@compiled
def jacobian(state: Floats, parameters: Floats, out: Floats) -> None:
    """Fills ∂h/∂state."""
    for i in range(out.shape[0]):
        out[i, int(parameters[i, 0])] = parameters[i, 1]
