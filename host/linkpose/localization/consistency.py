"""Whether the stated noises fit the measurements: the normalised innovation squared (NIS) of each sensor.

For a consistent filter νᵀ S⁻¹ ν follows the χ² distribution of the measurement's size (Bar-Shalom, Li and Kirubarajan,
Estimation with Applications to Tracking and Navigation, Wiley 2001, section 5.4). Outliers would rule the mean, so the
verdict compares medians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from linkpose.localization.gate import chi_square_quantile
from linkpose.presentation import counted

FEWEST = 20  # innovations of a sensor below which there is no verdict
# The stated noise is called too small or too large beyond this factor. The median of 100 innovations scatters by 15 %.
FACTOR = 1.3
# The mean NIS of normal errors equals their median over the χ² one. A larger ratio is due to outliers; that of 100
# innovations in one dimension scatters by 25 %.
_RULED = FACTOR**2
LEAST_FACTOR = 0.01  # a sensor is not a hundred times better than stated: it is silent, or the filter's only source
NAMES = {
    "range": "range", "bearing_range": "range and bearing", "depth": "depth", "attitude": "attitude", "pose": "pose",
    "scan": "laser scan",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Verdict:
    """NIS of one sensor over `count` measurements of `degrees` rows; `mean_nis` is divided by `degrees`.

    `noise_factor` is what the standard deviation should be multiplied by for the median to be the χ² one.
    """

    sensor: str
    count: int
    degrees: int
    mean_nis: float
    noise_factor: float

    def sentence(self) -> str:
        """The verdict in words."""
        name = NAMES.get(self.sensor.split(":")[0], self.sensor)
        if self.count < FEWEST:
            return f"{name} noise: only {counted(self.count, 'measurement')}, no verdict"
        if self.noise_factor > FACTOR:
            return f"{name} noise is set {self.noise_factor:.1f} times too small"
        if self.noise_factor < LEAST_FACTOR:
            return f"{name} noise: the measurements equal their predictions, no verdict"
        if self.noise_factor < 1.0 / FACTOR:
            return f"{name} noise is set {1.0 / self.noise_factor:.1f} times too large"
        return f"{name} noise fits"

    def figures(self) -> str:
        """The median NIS, by which the verdict is decided, over the χ² one; and the mean where outliers rule it. Empty
        where too few innovations decide nothing.
        """
        if self.count < FEWEST:
            return ""
        median = self.noise_factor**2
        text = f"median NIS {median:.2f}, 1 is consistent"
        if self.mean_nis > _RULED * max(median, 1.0):
            text += f"; outliers raise the mean to {self.mean_nis:.3g}"
        return text


@dataclass(slots=True)
class Consistency:
    """NIS by sensor, `range` or `range:BEACON`, each with its degrees of freedom."""

    nis: dict[str, list[float]] = field(default_factory=dict)
    degrees: dict[str, int] = field(default_factory=dict)

    def add(self, sensor: str, degrees: int, value: float) -> None:
        """Adds one innovation."""
        if math.isfinite(value):
            self.nis.setdefault(sensor, []).append(value)
            self.degrees[sensor] = degrees

    def verdicts(self, each: bool = False) -> list[Verdict]:
        """One for each sensor, or with `each` one for each beacon."""
        found = []
        for sensor, values in self.nis.items():
            if (":" in sensor) == each:
                degrees = self.degrees[sensor]
                ratio = float(np.median(values)) / chi_square_quantile(0.5, degrees)
                found.append(Verdict(sensor, len(values), degrees, float(np.mean(values)) / degrees, math.sqrt(ratio)))
        return found
