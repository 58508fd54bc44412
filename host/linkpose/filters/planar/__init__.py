"""`planar-ekf`, `planar-ukf`: pose of a robot from its mice and gyro, with self-calibration of the mice.

In each step from one reading of the mice to the next, the gyro measures ω + b, each mouse its own velocity, and a rest
shows b. The pose then advances on the arc of the updated velocity. `state` lists the state, `measure` holds the
measurement and the update, `linear` and `sigma` the moments of the two filters, `rest` the zero-rate updates, `slip`
what the mice lose of the way in turns. The fault tests are those of the `mice` filter, with this filter's calibration
and bias.

Angles, relative scales and positions of the mice follow from any drive with turns. Two things cannot be observed: the
angle common to all mice, which defines "ahead", and their common scale beyond what the gyro and the positions of the
mice show. Another floor, which changes the scale of all mice, is recognised when the robot turns. An error of the
gyro's own scale is not observable. Where it may explain the turns of the mice, it is in the standard deviations.

Source: [Thesis], equations (1)-(17); [Mice], (6), (7).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from linkpose.exclusions import ExcludedMice
from linkpose.filters import GyroJumps, MovedMouse
from linkpose.filters._records import record_of, zeros
from linkpose.filters.mice import MiceParameters, check_placement
from linkpose.filters.mice.causes import causes
from linkpose.filters.mice.places import remarks_on_places
from linkpose.filters.mice.reading import BIAS_STD
from linkpose.filters.mice.state import Floats, fresh_state, mouse_records, sample_records
from linkpose.filters.planar.process import process
from linkpose.filters.planar.state import (
    ANGLE,
    ESTIMATE,
    MICE,
    OF_MOUSE,
    POSITION,
    SCALE,
    SIGMA,
    TANGENT,
    PlanarParameters,
)
from linkpose.filters.planar.state import fresh_state as fresh_planar_state
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Rig

__all__ = ["FoundMouse", "PlanarEkf", "PlanarParameters", "PlanarUkf"]

_WIDTH = ESTIMATE.itemsize // np.dtype(np.float64).itemsize
_COLUMNS = ("x_m", "y_m", "heading_rad", "vx_m_s", "vy_m_s", "wz_rad_s")


_SCALE_LEAST = 0.01  # another scale of the mice is reported from here on
_SPREAD = 0.02  # of the share of the turns that the mice show: reported from here on
# A mouse is reported as snapping to its axes after so many readings, as creeping after so many counts at rest, and as
# slow from this share of missing reports on.
_SNAP_READINGS, _CREEPS, _MISSING = 50.0, 5, 0.15
# A mouse is reported at another place beyond so much (m), and so many standard deviations.
_MOVED_M, _MOVED_Z = 0.008, 5.0


def _names(indices: Iterable[int]) -> str:
    """Mice by their ports, such as "mice 1, 3"; empty for none."""
    ports = [str(i + 1) for i in indices]
    return f"{'mouse' if len(ports) == 1 else 'mice'} {', '.join(ports)}" if ports else ""


@dataclass(frozen=True, slots=True)
class FoundMouse:
    """A mouse (1 for the first) as the drive has shown it, with standard deviations."""

    mouse: int
    counts_per_m: float
    counts_per_m_std: float
    angle_deg: float
    angle_std_deg: float
    x_m: float
    y_m: float
    position_std_m: float


class _PlanarFilter:
    """Either filter over blocks of samples."""

    name: str
    _is_ukf: bool

    def __init__(
        self, rig: Rig, parameters: MiceParameters | None = None, planar: PlanarParameters | None = None
    ) -> None:
        """The rig must place at least one mouse. Raises CannotRun for mice that all sit at one place."""
        check_placement(rig.mouse)
        self.parameters, self.planar = parameters or MiceParameters(), planar or PlanarParameters()
        self._rig = rig
        self._placed, self._mice = mouse_records(rig.mouse)[: len(rig.mouse)], mouse_records(rig.mouse)
        self._parameters, self._planar = record_of(self.parameters), record_of(self.planar)
        self._mice_state = fresh_state(len(rig.mouse), BIAS_STD)
        self._tangent, self._points = zeros(int(not self._is_ukf), TANGENT), zeros(int(self._is_ukf), SIGMA)
        self.state = fresh_planar_state(len(rig.mouse), self.planar, rig.imu.gyro_noise_rad_s**2)
        self.excluded_mice = ExcludedMice()

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the estimate's columns, the unit last."""
        prefix = self.name.replace("-", "_")
        split = [name.partition("_")[::2] for name in _COLUMNS]
        return (
            *(f"{prefix}_{name}" for name in _COLUMNS),
            *(f"{prefix}_{quantity}_std_{unit}" for quantity, unit in split),
        )

    @property
    def rejected(self) -> int:
        """Readings so far that gave no measurement of a mouse."""
        return int(self.state[0].rejected + self._mice_state[0].rejected)

    @property
    def distrusted(self) -> int:
        """Bit mask of the mice that are excluded now; bit 0 is mouse 1."""
        return int(self._mice_state[0].excluded)

    @property
    def gyro_bias_rad_s(self) -> float:
        """Bias of the gyro about the vertical so far, beyond the rig's."""
        return float(self.state[0].at.bias)

    @property
    def gyro_jumps(self) -> GyroJumps:
        """Jumps of the gyro's bias so far."""
        state = self.state[0]
        return GyroJumps(int(state.jumps), float(state.jump), float(state.jump_time))

    @property
    def found_mice(self) -> tuple[FoundMouse, ...]:
        """Calibration of each mouse so far."""
        return tuple(self._found(i) for i in range(len(self._rig.mouse)))

    @property
    def moved_mice(self) -> tuple[MovedMouse, ...]:
        """Mice that the turns show elsewhere than the rig states, by 5 standard deviations and by 8 mm."""
        moved = []
        for found, mouse in zip(self.found_mice, self._rig.mouse, strict=True):
            off_m = math.hypot(found.x_m - mouse.x_m, found.y_m - mouse.y_m)
            if off_m > max(_MOVED_M, _MOVED_Z * found.position_std_m):
                moved.append(MovedMouse(found.mouse, found.x_m, found.y_m, off_m))
        return tuple(moved)

    @property
    def mouse_causes(self) -> dict[int, str]:
        """Why mice were excluded so far (1 for the first; 0: all together)."""
        return causes(self._mice_state[0], self._mice)

    @property
    def mice_remarks(self) -> list[str]:
        """Faults that all mice share, as the turns have shown them, and mice that count in an unusual way."""
        places = remarks_on_places(self._mice_state[0], self._mice, self._placed)
        return [*places, *self._remarks_on_all(), *self._remarks_on_each()]

    def _remarks_on_all(self) -> Iterator[str]:
        state, limit = self.state[0], float(self._mice_state[0].speed_limit)
        if limit > 0.0:
            yield (
                f"the mice show no speed above {limit:.2f} m/s, where gyro or accelerometer show more: this is the "
                "limit of their sensors. Where the robot was faster, the path is too short, and the σ of the position "
                "includes it. Drive slower, or use mice for higher speeds"
            )
        if state.resolution.changes:
            yield (
                f"in two turns in a row, all mice count {state.resolution.factor:.2f} times as much as before, found "
                f"at {state.resolution.time:.1f} s by the gyro: their resolution was switched, or they slip in turns"
            )
        if state.gyro_std > 0.0 and abs(self.scale_change[0] - 1.0) < _SCALE_LEAST:  # else the scale is reported
            yield (
                f"over all turns, gyro and mice differ by {100 * abs(state.all_product / state.all_square - 1):.1f} %: "
                "the gyro's scale is off (its data sheet allows 3 %), the mice slip in turns, or the floor is another "
                "one. Turns do not show which, and σ includes each of them"
            )
        if state.turn_spread > _SPREAD**2:
            yield (
                f"from turn to turn, the mice show {100 * math.sqrt(state.turn_spread):.0f} % more or less than the "
                "gyro: they slip, the floor changes, or the gyro's scale is off. The σ of the position includes this "
                "share of the way"
            )

    def _remarks_on_each(self) -> Iterator[str]:
        mice, causes = self._mice[: len(self._rig.mouse)], self.mouse_causes
        slow = (i for i, m in enumerate(mice) if m["missing"] > _MISSING * m["reports"])
        if names := _names(i for i in slow if i + 1 not in causes):
            yield (
                f"{names}: readings without counts during motion; the report rate is lower than the sample rate. The "
                "motion between two reports is interpolated"
            )
        if names := _names(i for i, m in enumerate(mice) if m["creeps"] > _CREEPS):
            yield f"{names}: single counts while the robot rests. They are not taken for motion. Check the surface"
        snapping = (i for i, m in enumerate(mice) if m["snaps"] and m["snap_readings"] > _SNAP_READINGS)
        if names := _names(i for i in snapping if i + 1 not in causes):
            yield (
                f"{names}: no counts across an axis while the motion is almost along the other one (angle "
                "snapping). In bends, the position is less accurate. Use mice without this function"
            )

    @property
    def scale_change(self) -> tuple[float, float]:
        """Common factor of the mice's counts per metre in turns relative to the rig, and its standard deviation."""
        state, mice = self.state[0], len(self._rig.mouse)
        at = [int(MICE + OF_MOUSE * i + SCALE) for i in range(mice)]
        factor = float(state.turn_factor * np.exp(-np.mean(state["mean"][at])))
        return factor, math.sqrt(float(np.mean(state["covariance"][np.ix_(at, at)])))

    def _found(self, i: int) -> FoundMouse:
        state, mouse, at = self.state[0], self._rig.mouse[i], int(MICE + OF_MOUSE * i)
        std = np.sqrt(np.diag(state["covariance"]))
        per_m = mouse.counts_per_m * math.exp(-state["mean"][at + SCALE])
        return FoundMouse(
            mouse=i + 1,
            counts_per_m=per_m,
            counts_per_m_std=float(per_m * std[at + SCALE]),
            angle_deg=mouse.angle_deg + math.degrees(state["mean"][at + ANGLE]),
            angle_std_deg=math.degrees(std[at + ANGLE]),
            x_m=float(mouse.x_m + state["mean"][at + POSITION]),
            y_m=float(mouse.y_m + state["mean"][at + POSITION + 1]),
            position_std_m=float(std[at + POSITION]),
        )

    def process(self, block: Measurements) -> Floats:
        """x, y, heading (in [−π, π)), v_x, v_y, ω and their standard deviations at each of the N samples: (N, 12)."""
        out = np.empty(len(block), ESTIMATE)
        process(
            sample_records(block, self._rig.imu), self._parameters, self._planar, self._placed, self._mice,
            self._mice_state, self._tangent, self._points, self.state, out,
        )  # fmt: skip
        self.excluded_mice.add(block, out["excluded"].astype(np.int64))
        return out.view(np.float64).reshape(len(block), _WIDTH)[:, : len(self.columns)]


class PlanarEkf(_PlanarFilter):
    """The extended Kalman filter."""

    name = "planar-ekf"
    _is_ukf = False


class PlanarUkf(_PlanarFilter):
    """The unscented Kalman filter, with the thesis's plain transform."""

    name = "planar-ukf"
    _is_ukf = True
