"""The registry of filters: what each needs and offers. A filter and its compiler (numba) are imported on creation."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import CannotRun, MissingJ2S, SensorMissing, UncertainJ2S, UnknownFilter
from linkpose.exclusions import ExcludedMice
from linkpose.sensors.devices import DEVICE_NAMES, DEVICES, MAX_MICE, Sensors
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Mouse, Rig

Floats = NDArray[np.float64]

ALL_SENSORS = Sensors.MPU6050 | Sensors.BMP180 | Sensors.IMU2 | Sensors.MAG


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Requirements and features of a filter, used by the estimator, the choice of a smoother, scores and plots."""

    module: str  # below linkpose.filters
    cls: str
    sensors: Sensors  # without which it cannot run
    # J2S, the vector from the joint centre to the sensor. "guess": a rough value suffices, the filter estimates it.
    j2s: Literal["none", "guess", "known"] = "none"
    needs_mice: bool = False
    is_odometric: bool = False  # its pose is relative to the robot's pose at the first sample
    smoother: str | None = None  # module below linkpose.filters and class that replace it for a whole recording

    @property
    def is_barometric(self) -> bool:
        """Whether the height comes from the air pressure, whose noise is decimetres."""
        return bool(self.sensors & Sensors.BMP180)


_IMU, _ANY = Sensors.MPU6050, Sensors(0)

# Best first: the order of columns, tables and legends.
REGISTRY: dict[str, Capabilities] = {
    "joint-inertial": Capabilities(
        "joint_inertial", "JointInertialFilter", _IMU, "guess", smoother="smoother.JointInertialSmoother"
    ),
    "tilt-inertial": Capabilities("tilt_inertial", "TiltInertialFilter", _IMU),
    "joint": Capabilities("joint", "JointFilter", _IMU, "known"),
    "tilt": Capabilities("tilt", "TiltFilter", _IMU),
    "chain": Capabilities("chain", "ChainFilter", _IMU | Sensors.IMU2, smoother="chain.smoother.ChainSmoother"),
    "imu-baro": Capabilities("imu_baro", "ImuBaroFilter", _IMU | Sensors.BMP180),
    "baro": Capabilities("baro", "BaroFilter", Sensors.BMP180),
    "planar-ekf": Capabilities("planar", "PlanarEkf", _ANY, needs_mice=True, is_odometric=True),
    "planar-ukf": Capabilities("planar", "PlanarUkf", _ANY, needs_mice=True, is_odometric=True),
    "mice": Capabilities("mice", "MiceFilter", _ANY, needs_mice=True, is_odometric=True),
}
NAMES = tuple(REGISTRY)


def capabilities(name: str) -> Capabilities | None:
    """The filter's capabilities; None for a name outside this registry, such as `ekf` of `localize`."""
    return REGISTRY.get(name)


def required_sensors(name: str) -> list[str]:
    """The sensors without which a filter cannot run, as in Health.sensors: imu, baro, ...; none of an unknown name."""
    needed = REGISTRY[name].sensors if name in REGISTRY else _ANY
    return [sensor for flag, sensor in zip(DEVICES, DEVICE_NAMES, strict=True) if flag & needed]


class Filter(Protocol):
    """Interface of every filter. The state continues from block to block; blocks may have any length."""

    @property
    def name(self) -> str: ...

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the estimate's columns, the unit last."""

    @property
    def rejected(self) -> int:
        """Number of samples so far that were unusable and bridged by prediction alone."""

    def process(self, block: Measurements) -> Floats:
        """The estimate at each of the block's N samples: (N, len(columns)); NaN where unknown so far."""


@runtime_checkable
class HasRemarks(Protocol):
    """Further interface of a filter that checks its readings."""

    @property
    def remarks(self) -> list[str]:
        """What is wrong with the readings so far, one sentence with its cure for each fault."""


@runtime_checkable
class FindsMiceScale(Protocol):
    """Further interface of a filter that compares the mice with the gyro."""

    @property
    def scale_change(self) -> tuple[float, float]:
        """Counts per metre, common to all mice, relative to the rig file, and the standard deviation of this factor."""


class GyroJumps(NamedTuple):
    """Jumps of the gyro's bias that mice or a rest have shown: how many, and the last one."""

    times: int
    last_rad_s: float
    last_time_s: float  # when it was found


class MovedMouse(NamedTuple):
    """A mouse (1 for the first) that the turns show at another place than the rig file states."""

    mouse: int
    x_m: float
    y_m: float
    off_m: float  # distance between both places


@runtime_checkable
class FindsMovedMice(Protocol):
    """Further interface of a filter that estimates the places of the mice."""

    @property
    def moved_mice(self) -> tuple[MovedMouse, ...]:
        """Mice whose places differ significantly from the rig file."""


@runtime_checkable
class ExcludesMice(Protocol):
    """Further interface of a filter that excludes mice and has no column for them."""

    excluded_mice: ExcludedMice


@runtime_checkable
class ExplainsMice(Protocol):
    """Further interface of a filter that excludes mice."""

    @property
    def mouse_causes(self) -> dict[int, str]:
        """For a mouse (1 for the first; 0: all together), why it was excluded, as the end of a sentence."""


@runtime_checkable
class RemarksOnMice(Protocol):
    """Further interface of a filter that compares the mice with the gyro turn by turn."""

    @property
    def mice_remarks(self) -> list[str]:
        """What the mice did wrong together, one sentence with its cure for each fault."""


@runtime_checkable
class FindsGyroJumps(Protocol):
    """Further interface of a filter that finds jumps of the gyro's bias."""

    @property
    def gyro_jumps(self) -> GyroJumps:
        """Jumps so far."""


@runtime_checkable
class FindsJ2s(Protocol):
    """Further interface of a filter that estimates J2S."""

    @property
    def j2s_m(self) -> tuple[Floats, Floats]:
        """J2S so far, and its covariance: (3,) m, (3, 3) m²."""


def create(name: str, rig: Rig, sensors: Sensors = ALL_SENSORS, mice: int = MAX_MICE) -> Filter:
    """Creates a filter. Its `process(block)` returns a row for each sample, with a column for each name in `columns`.

    Args:
        name: such as "joint-inertial"; underscores are accepted.
        rig: sensor placement and calibration; J2S in the sensor's axes (m), positions of mice in the robot's frame (m).
        sensors: the sensors that supply the measurements. Default: all.
        mice: number of mouse ports in use, 3 if the last mouse is at port 3. Default: all ports.

    Raises:
        UnknownFilter: there is no filter of this name.
        CannotRun: the rig or the sensors do not support the filter.
    """
    name = name.replace("_", "-")
    if name not in REGISTRY:
        raise UnknownFilter(name, NAMES)
    needs = REGISTRY[name]
    for missing in needs.sensors & ~sensors:
        raise SensorMissing(name, missing.name or str(missing))
    _check_j2s(name, needs, rig)
    if needs.needs_mice:
        _check_mice(rig, sensors, mice)
    made: Filter = getattr(importlib.import_module(f"linkpose.filters.{needs.module}"), needs.cls)(rig)
    return made


def create_smoother(name: str, rig: Rig) -> Filter:
    """The smoother named in a filter's capabilities; it replaces the filter and processes one whole recording."""
    smoother = REGISTRY[name].smoother
    if smoother is None:
        raise CannotRun(f"{name} has no smoother")
    module, _, cls = smoother.rpartition(".")
    made: Filter = getattr(importlib.import_module(f"linkpose.filters.{module}"), cls)(rig)
    return made


def _check_j2s(name: str, needs: Capabilities, rig: Rig) -> None:
    """Raises CannotRun where J2S is missing, or too uncertain for the filter."""
    if needs.j2s != "none" and rig.joint.j2s_m is None:
        raise MissingJ2S(name)
    if needs.j2s == "known" and rig.joint.known_j2s_m is None:
        raise UncertainJ2S(name, [other for other, able in REGISTRY.items() if able.j2s == "guess"])


def _check_mice(rig: Rig, sensors: Sensors, mice: int) -> None:
    """Raises CannotRun without mice, without their positions, or with a single mouse and no gyro."""
    if not mice:
        raise CannotRun("no mouse gives counts; if there is one, check its wiring")
    if not rig.mouse:
        raise CannotRun(
            "the rig file lacks the positions of the mice; add one [[mouse]] table with x_m and y_m for each port"
        )
    if min(mice, len(rig.mouse)) == 1 and not sensors & Sensors.MPU6050:
        raise CannotRun("one mouse cannot measure a turn without the MPU-6050's rate: add a second mouse")


def warm_up(names: Iterable[str] = NAMES) -> None:
    """Compile the filters, or load them from the cache, so that no sample waits for the compiler."""
    rig = Rig(mouse=(Mouse(0.1, 0.0), Mouse(-0.1, 0.0))).with_j2s((0.0, 0.0, 1.0))
    for name in names:
        create(name, rig).process(_two_samples_at_rest())


def _two_samples_at_rest() -> Measurements:
    return Measurements(
        time_s=np.array([0.0, 0.01]),
        accel_m_s2=np.array([[0.0, 0.0, 9.8]] * 2),
        gyro_rad_s=np.zeros((2, 3)),
        accel2_m_s2=np.array([[0.0, 0.0, 9.8]] * 2),
        gyro2_rad_s=np.zeros((2, 3)),
        imu_temp_degC=np.full(2, 25.0),
        pressure_Pa=np.full(2, 1e5),
        baro_temp_degC=np.full(2, 25.0),
        baro_fresh=np.ones(2, np.bool_),
        mice_counts=np.zeros((2, 2, 2)),
        flags=np.zeros(2, np.uint32),
    )
