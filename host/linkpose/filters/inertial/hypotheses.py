"""Two filters with different assumptions about the sensors, mixed by their probabilities.

The filter is not told whether the sensors were calibrated, and the two hypotheses behave differently during start-up.
Two filters therefore run in parallel, one with the errors that a calibration leaves and one with the data sheet's. A
filter whose estimated sensor errors lie far outside its own prior becomes less probable: its likelihood is e^−χ²/2 of
those errors. The estimate is the mean of both.

Source: D. T. Magill, "Optimal adaptive estimation of sampled stochastic processes", IEEE Trans. Automatic Control
10(4), 1965.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from linkpose.filters.inertial.state import HEIGHT, PITCH, ROLL, YAW, Floats, SensorErrors, roll_pitch

# What a calibration leaves (simulated twelve-position calibration, ../simulation/link.py), and what the MPU-6050's data
# sheet allows (zero-rate output ±20 °/s after a rough subtraction, zero-g output ±50 mg, scale ±3 %, cross-axis ±2 %).
# The former drifts with the temperature, in minutes. A part's tolerances are constant: a decay in 1000 s in place of
# 3000 s doubles the error of the height.
CALIBRATED = SensorErrors(0.03, 0.0015, 0.0007, 0.016, 0.0015, 0.0005, 200.0)
DATA_SHEET = SensorErrors(0.2, 0.02, 0.012, 0.3, 0.02, 0.012, 3000.0)

# Prior log odds of the calibrated hypothesis. Doubling it delays the change to the other on an uncalibrated sensor.
_LOG_ODDS = 15.0
# The wider hypothesis also fits what is no error of a sensor, so its own χ² counts this many times (Occam's factor).
_OCCAM = 8.0
_MOST = 50.0  # log odds beyond which the other filter has no weight


def log_odds(first: Floats, second: Floats) -> Floats:
    """Log odds of the first hypothesis, from half the χ² of the sensor errors that each filter has estimated."""
    return np.clip(_LOG_ODDS + _OCCAM * second - first, -_MOST, _MOST)


def mix(a: NDArray[Any], b: NDArray[Any]) -> tuple[Floats, Floats]:
    """The mean of two filters' estimates (arrays (N,) of ESTIMATE): values and σ (N, 6), in the order of ESTIMATE.

    A variance includes how far the filters differ. Where one filter has no position, the other's counts alone.
    """
    probability = 1.0 / (1.0 + np.exp(-log_odds(a["distance"], b["distance"])))
    share = np.repeat(probability[:, None], YAW + 1, axis=1)
    unknown_a, unknown_b = np.isnan(a["value"][:, HEIGHT]), np.isnan(b["value"][:, HEIGHT])
    share[unknown_b & ~unknown_a, :ROLL] = 1.0
    share[unknown_a & ~unknown_b, :ROLL] = 0.0
    apart = b["value"] - a["value"]
    apart[:, ROLL:] = wrapped(apart[:, ROLL:])
    values = _mixed(share, a["value"], np.where(share == 0.0, b["value"], a["value"] + apart))
    # Roll and pitch of the mean tilt: near the vertical, the mean of two angles is not that of their tilts.
    values[:, ROLL], values[:, PITCH] = roll_pitch(_mixed(probability[:, None], a["tilt"], b["tilt"]))
    values[:, YAW] = wrapped(values[:, YAW])
    both = share * (1.0 - share)
    between = np.where(both == 0.0, 0.0, both * np.square(apart))
    stds = np.sqrt(_mixed(share, np.square(a["std"]), np.square(b["std"])) + between)
    stds[:, ROLL:] = np.minimum(stds[:, ROLL:], np.pi)
    return values, stds


def wrapped(angle: Floats) -> Floats:
    """An angle (rad) between −π and π."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _mixed(share: Floats, a: Floats, b: Floats) -> Floats:
    """`share` of a and the rest of b; one alone where its share is 1, whatever the other is."""
    return np.where(share == 1.0, a, np.where(share == 0.0, b, share * a + (1.0 - share) * b))
