"""The filters, by name. A filter and its compiler (numba) are imported only when it is made."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from linkpose.errors import LinkposeError
from linkpose.sensors.measurements import Measurements
from linkpose.sensors.rig import Mouse, Rig
from linkpose.wire.messages import Sensors

Floats = NDArray[np.float64]

ALL_SENSORS = Sensors.MPU6050 | Sensors.BMP180
MOST_MICE = 4  # the firmware's ports


class _Entry(NamedTuple):
    """Where a filter is, and what it cannot do without."""

    module: str
    cls: str
    sensors: Sensors
    needs_j2s: bool
    needs_mice: bool = False


_FILTERS = {
    "joint": _Entry("joint", "JointFilter", Sensors.MPU6050, True),
    "tilt": _Entry("tilt", "TiltFilter", Sensors.MPU6050, False),
    "imu-baro": _Entry("imu_baro", "ImuBaroFilter", ALL_SENSORS, False),
    "baro": _Entry("baro", "BaroFilter", Sensors.BMP180, False),
    "joint-inertial": _Entry("joint_inertial", "JointInertialFilter", Sensors.MPU6050, True),
    "tilt-inertial": _Entry("tilt_inertial", "TiltInertialFilter", Sensors.MPU6050, False),
    "mice": _Entry("mice", "MiceFilter", Sensors(0), False, True),
    "planar-ekf": _Entry("planar", "PlanarEkf", Sensors(0), False, True),
    "planar-ukf": _Entry("planar", "PlanarUkf", Sensors(0), False, True),
}
NAMES = tuple(_FILTERS)


class Filter(Protocol):
    """What every filter offers. State goes on from block to block, whatever their lengths."""

    @property
    def name(self) -> str: ...

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the estimate's columns, the unit last."""

    @property
    def rejected(self) -> int:
        """How many samples so far could not be used and were passed by prediction alone."""

    def process(self, block: Measurements) -> Floats:
        """The estimate at each of the block's N samples: (N, len(columns)); NaN where there is none yet."""


@runtime_checkable
class FindsJ2s(Protocol):
    """What a filter offers beyond that when it estimates J2S."""

    @property
    def j2s_m(self) -> tuple[Floats, Floats]:
        """J2S so far, and its covariance: (3,) m, (3, 3) m²."""


class CannotRun(LinkposeError):
    """The rig or the sensors do not allow a filter; the text says why and what to type."""


def create(name: str, rig: Rig, sensors: Sensors = ALL_SENSORS, mice: int = MOST_MICE) -> Filter:
    """A fresh filter for measurements of these sensors and of mice at ports 1 to `mice`.

    Raises CannotRun where the rig or the sensors do not allow it, LinkposeError for no such name.
    """
    if name not in _FILTERS:
        raise LinkposeError(f"there is no filter {name!r}: take {', '.join(NAMES)}")
    entry = _FILTERS[name]
    for missing in entry.sensors & ~sensors:
        raise CannotRun(f"{name} needs the {missing.name}, which does not answer: check its wiring")
    if entry.needs_j2s and rig.joint.j2s_m is None:
        raise CannotRun(f"{name} needs J2S: type `linkpose calibrate joint`, or give it with --j2s X,Y,Z")
    if name == "joint" and rig.joint.known_j2s_m is None:
        raise CannotRun("joint needs a J2S that is known; joint-inertial is the filter that estimates it")
    if entry.needs_mice:
        _check_mice(rig, sensors, mice)
    made: Filter = getattr(importlib.import_module(f"linkpose.filters.{entry.module}"), entry.cls)(rig)
    return made


def _check_mice(rig: Rig, sensors: Sensors, mice: int) -> None:
    """Raises CannotRun where there are no mice, or nobody knows where they sit, or a lone one lacks the gyro."""
    if not mice:
        raise CannotRun("no mouse gives counts; if there is one, check its wiring")
    if not rig.mouse:
        raise CannotRun("the rig file does not say where the mice sit: add [[mouse]] with x_m and y_m, port by port")
    if min(mice, len(rig.mouse)) == 1 and not sensors & Sensors.MPU6050:
        raise CannotRun("one mouse cannot tell a turn without the MPU6050's rate: add a second mouse")


def warm_up(names: Iterable[str] = NAMES) -> None:
    """Compiles the filters, or loads them compiled, so that no sample waits for a compiler."""
    rig = Rig(mouse=(Mouse(0.1, 0.0), Mouse(-0.1, 0.0))).with_j2s((0.0, 0.0, 1.0))
    for name in names:
        create(name, rig).process(_two_samples_at_rest())


def _two_samples_at_rest() -> Measurements:
    return Measurements(
        time_s=np.array([0.0, 0.01]),
        accel_m_s2=np.array([[0.0, 0.0, 9.8]] * 2),
        gyro_rad_s=np.zeros((2, 3)),
        imu_temp_degC=np.full(2, 25.0),
        pressure_Pa=np.full(2, 1e5),
        baro_temp_degC=np.full(2, 25.0),
        baro_fresh=np.ones(2, np.bool_),
        mice_counts=np.zeros((2, 2, 2)),
        flags=np.zeros(2, np.uint16),
    )
