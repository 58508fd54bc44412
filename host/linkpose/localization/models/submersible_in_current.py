"""Motion of an underwater vehicle whose Doppler log measures its velocity through water that moves.

State (x, y, z, ψ, r, c_x, c_y): as in `submersible`, and the velocity of the water (m/s) along x and y, which adds to
the vehicle's and is constant. Source: the ocean current of Fossen, Handbook of Marine Craft Hydrodynamics and Motion
Control, Wiley 2011, section 8.3.
"""

from __future__ import annotations

from linkpose.compiling import compiled
from linkpose.localization.linalg import Floats
from linkpose.localization.models import submersible

ID = 4
CURRENT_X, CURRENT_Y = 5, 6  # in the state


@compiled
def propagate(state: Floats, control: Floats, noise: Floats, interval: float, out: Floats) -> None:
    """As `submersible.propagate`, carried by the current."""
    submersible.propagate(state, control, noise, interval, out)
    out[0] += interval * state[CURRENT_X]
    out[1] += interval * state[CURRENT_Y]


@compiled
def jacobians(state: Floats, control: Floats, interval: float, by_state: Floats, by_noise: Floats) -> None:
    """Fills ∂out/∂state and ∂out/∂noise at zero noise."""
    submersible.jacobians(state, control, interval, by_state, by_noise)
    by_state[0, CURRENT_X] = by_state[1, CURRENT_Y] = interval
