"""The vocabulary of quantities, and the filters' registry that is written in its terms."""

from __future__ import annotations

import numpy as np
import pytest

from linkpose import filters, quantities
from linkpose.errors import LinkposeError
from linkpose.estimation import Estimator
from linkpose.sensors.rig import Joint, Mouse, Rig

RIG = Rig(Joint((0.0, 0.0, 1.0)), mouse=(Mouse(0.1, 0.0), Mouse(-0.1, 0.0)))


@pytest.mark.parametrize("name", filters.NAMES)
def test_each_column_of_each_filter_is_in_the_vocabulary(name):
    columns = filters.create(name, RIG).columns
    for column in columns:
        part = quantities.split(column)
        assert part is not None and part.filter == name
        if part.is_std:
            assert any(quantities.std_column(other) == column for other in columns)


@pytest.mark.parametrize(
    ("column", "prefix", "quantity", "is_std"),
    [
        ("height_m", "", "height_m", False),
        ("joint_inertial_height_std_m", "joint_inertial", "height_m", True),
        ("joint_inertial_yaw_std_deg", "joint_inertial", "yaw_deg", True),
        ("planar_ekf_wz_std_rad_s", "planar_ekf", "wz_rad_s", True),
        ("mice_excluded", "mice", "excluded", False),
        ("chain_angle_std_deg", "chain", "angle_deg", True),
        ("chain_height1_m", "chain", "height1_m", False),
        ("chain_qw", "chain", "qw", False),
        ("imu2_accel_x_m_s2", "imu2", "accel_x_m_s2", False),
        ("mouse4_dy_counts", "mouse4", "dy_counts", False),
    ],
)
def test_columns_are_taken_apart(column, prefix, quantity, is_std):
    part = quantities.split(column)
    assert part is not None
    assert (part.prefix, part.quantity.column, part.is_std) == (prefix, quantity, is_std)


@pytest.mark.parametrize("column", ["time_s", "seq", "flags", "baro_fresh", "", "_", "height", "m"])
def test_columns_that_hold_no_quantity(column):
    assert quantities.split(column) is None and quantities.std_column(column) is None


def test_names_are_unambiguous():
    columns = [quantity.column for quantity in quantities.ALL]
    assert len(set(columns)) == len(columns)
    assert not set(columns) & {quantity.std_column for quantity in quantities.ALL}


def test_the_sigma_of_a_quaternion_is_that_of_the_whole_rotation():
    assert {quantities.std_column(f"chain_q{axis}") for axis in "wxyz"} == {"chain_rotation_std_deg"}


def test_best_filter_first_in_columns():
    estimator = Estimator((), Rig(Joint((0.0, 0.0, 1.0))), filters.ALL_SENSORS)
    assert [f.name for f in estimator.filters][:3] == ["joint-inertial", "tilt-inertial", "joint"]
    assert list(quantities.by_filter(estimator.columns)) == [f.name for f in estimator.filters]


def test_a_filter_needs_what_its_capabilities_say():
    for name, needs in filters.REGISTRY.items():
        if needs.j2s != "none":
            with pytest.raises(filters.CannotRun, match="needs J2S"):
                filters.create(name, Rig())
        if needs.j2s == "known":
            with pytest.raises(filters.CannotRun, match="joint-inertial is the filter that estimates it"):
                filters.create(name, Rig(Joint((0.0, 0.0, 0.0), 1.0)))
        if needs.needs_mice:
            with pytest.raises(filters.CannotRun, match="lacks the positions of the mice"):
                filters.create(name, Rig())


def test_smoothing_needs_a_filter_with_a_smoother():
    with pytest.raises(LinkposeError, match=r"no filter that can be smoothed \(joint-inertial, chain\) runs"):
        Estimator(("tilt",), RIG, filters.ALL_SENSORS).smooth()
    estimator = Estimator(("tilt", "joint-inertial"), RIG, filters.ALL_SENSORS)
    estimator.smooth()
    assert [f.name for f in estimator.filters] == ["tilt", "joint-inertial"]
    assert type(estimator.filters[1]).__name__ == "JointInertialSmoother"


def test_counts_of_mice_left_out_are_whole_numbers_in_files():
    assert quantities.decimals("mice_excluded") == 0 and quantities.decimals("joint_height_m") == 6
    assert np.isclose(quantities.HEADING.radians, 1.0) and np.isclose(quantities.ROLL.radians, np.pi / 180)
