"""Motion and measurement models, one a file, and the choice among them that the compiled filters make.

A motion model has `propagate` and `jacobians`, a measurement model `predict` and `jacobian`, each compiled, and a
number `ID`. A new model is a new file and a branch below. The choice is by number because a compiled function that
takes functions as arguments cannot be cached on disk.
"""

from __future__ import annotations

from linkpose.compiling import compiled
from linkpose.localization.grid import GridMap
from linkpose.localization.linalg import Floats
from linkpose.localization.models import (
    beacon_range,
    beams,
    constant_velocity,
    direct,
    holonomic,
    landmark,
    submersible,
    submersible_in_current,
    unicycle,
)

UNICYCLE, HOLONOMIC, SUBMERSIBLE = unicycle.ID, holonomic.ID, submersible.ID
CONSTANT_VELOCITY, SUBMERSIBLE_IN_CURRENT = constant_velocity.ID, submersible_in_current.ID
BEAMS, BEACON_RANGE, LANDMARK, DIRECT = beams.ID, beacon_range.ID, landmark.ID, direct.ID
COLUMNS = {model.ID: model.COLUMNS for model in (beams, beacon_range, landmark, direct)}  # of a model's parameters


@compiled
def propagate(motion: int, state: Floats, control: Floats, noise: Floats, interval: float, out: Floats) -> None:
    """Fills `out` with the state after `interval` seconds."""
    if motion == UNICYCLE:
        unicycle.propagate(state, control, noise, interval, out)
    elif motion == HOLONOMIC:
        holonomic.propagate(state, control, noise, interval, out)
    elif motion == SUBMERSIBLE:
        submersible.propagate(state, control, noise, interval, out)
    elif motion == SUBMERSIBLE_IN_CURRENT:
        submersible_in_current.propagate(state, control, noise, interval, out)
    else:
        constant_velocity.propagate(state, control, noise, interval, out)


@compiled
def motion_jacobians(
    motion: int, state: Floats, control: Floats, interval: float, by_state: Floats, by_noise: Floats
) -> None:
    """Fills two zeroed matrices, (n, n) and (n, q), with the slopes of `propagate`."""
    if motion == UNICYCLE:
        unicycle.jacobians(state, control, interval, by_state, by_noise)
    elif motion == HOLONOMIC:
        holonomic.jacobians(state, control, interval, by_state, by_noise)
    elif motion == SUBMERSIBLE:
        submersible.jacobians(state, control, interval, by_state, by_noise)
    elif motion == SUBMERSIBLE_IN_CURRENT:
        submersible_in_current.jacobians(state, control, interval, by_state, by_noise)
    else:
        constant_velocity.jacobians(state, control, interval, by_state, by_noise)


@compiled
def predict(model: int, state: Floats, parameters: Floats, grid: GridMap, out: Floats) -> None:
    """Fills `out` with the measurement that `state` leads to expect."""
    if model == BEAMS:
        beams.predict(state, parameters, grid, out)
    elif model == BEACON_RANGE:
        beacon_range.predict(state, parameters, out)
    elif model == LANDMARK:
        landmark.predict(state, parameters, out)
    else:
        direct.predict(state, parameters, out)


@compiled
def jacobian(model: int, state: Floats, parameters: Floats, grid: GridMap, out: Floats) -> None:
    """Fills a zeroed matrix (m, n) with the slopes of `predict`."""
    if model == BEAMS:
        beams.jacobian(state, parameters, grid, out)
    elif model == BEACON_RANGE:
        beacon_range.jacobian(state, parameters, out)
    elif model == LANDMARK:
        landmark.jacobian(state, parameters, out)
    else:
        direct.jacobian(state, parameters, out)
