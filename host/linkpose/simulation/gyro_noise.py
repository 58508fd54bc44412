"""Noise of a real MPU-6050's rate gyro at rest: white noise, flicker and a random walk of the bias.

The amplitudes reproduce the Allan deviation of an 11-minute recording of one sensor at rest (100 Hz, 44 Hz low-pass
filter), mean of the axes x and z: 0.12, 0.011, 0.0043 and 0.0019 °/s at 0.01, 1, 10 and 100 s.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

WHITE_RAD_S = math.radians(0.115)  # one sample at 100 Hz
WHITE_RATE_HZ = 100.0  # the density of the white noise is the same at any sample rate
BIAS_RAD_S = math.radians(1.1)  # 1σ: the three axes had 4.5, 0.05 and 1.1 °/s
WALK_RAD_S_SQRT_S = math.radians(3e-4)  # rad/s per √s
FLICKER_RAD_S = math.radians(0.0012)  # 1σ of each of the first-order processes below
_FLICKER_S = (3.0, 12.0, 48.0)  # their time constants: together nearly flat over the decades between


def rate_noise(seed: int, count: int, rate_hz: float) -> Floats:
    """What one axis adds to the true rate at `count` samples: (count,) rad/s, the constant bias included."""
    rng = np.random.default_rng([seed, 0x6050])
    noise = BIAS_RAD_S * rng.standard_normal() + WHITE_RAD_S * math.sqrt(rate_hz / WHITE_RATE_HZ) * rng.standard_normal(
        count
    )
    noise += WALK_RAD_S_SQRT_S / math.sqrt(rate_hz) * np.cumsum(rng.standard_normal(count))
    for time_constant_s in _FLICKER_S:
        noise += _first_order(rng.standard_normal(count + 1), math.exp(-1.0 / (rate_hz * time_constant_s)))
    return noise


def _first_order(white: Floats, keep: float) -> Floats:
    """A stationary first-order process of standard deviation FLICKER_RAD_S; the first white number is its start."""
    drive = FLICKER_RAD_S * math.sqrt(1.0 - keep * keep)
    out, value = np.empty(len(white) - 1), FLICKER_RAD_S * white[0]
    for i, w in enumerate(white[1:].tolist()):
        value = keep * value + drive * w
        out[i] = value
    return out
