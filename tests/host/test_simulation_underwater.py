"""The underwater simulator: each of Tables 2.2 to 2.9 by its statistics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from linkpose.simulation.underwater import (
    BEACONS,
    PERIODS_S,
    UnderwaterErrors,
    correlation,
    measurement_time,
    motion_data,
    motion_model,
    outlier_times,
    self_check,
    simulate_underwater,
    true_range,
)

ERRORS = UnderwaterErrors()


def test_table_2_2_truth_is_the_dead_reckoning_of_command_plus_noise():
    motion = motion_data(np.random.default_rng(0), ERRORS, 5.0)
    for i in (0, 77, 400):
        assert np.allclose(motion.pose[i + 1], motion_model(motion.pose[i], motion.twist[i], 0.01))
    still = motion_data(np.random.default_rng(0), replace(ERRORS, motion_velocity_m_s=0.0, motion_rate_rad_s=0.0), 5.0)
    noise = motion.twist - still.twist
    assert noise[:, :3].std() == pytest.approx(0.05, rel=0.1)
    assert noise[:, 3:].std() == pytest.approx(0.01, rel=0.1)


def test_motion_model_turns_body_velocity_into_the_world():
    """Yawed by 90 degrees, forward is y; pitched down by 90 degrees about y, forward is -z."""
    assert motion_model(np.array([0, 0, 0, 0, 0, np.pi / 2]), np.array([1.0, 0, 0, 0, 0, 0.2]), 0.5) == pytest.approx(
        [0, 0.5, 0, 0, 0, np.pi / 2 + 0.1], abs=1e-12
    )
    down = motion_model(np.array([0, 0, 0, 0, 1.2, 0]), np.array([1.0, 0, 0, 0, 0, 0]), 1.0)
    assert down[:3] == pytest.approx([np.cos(1.2), 0, -np.sin(1.2)])


def test_table_2_3_times():
    rng = np.random.default_rng(1)
    assert measurement_time(rng, 0.2, 0.0, 2.0) == pytest.approx(0.2 * np.arange(1, 10))
    late = measurement_time(rng, 0.1, 0.05, 1000.0)
    assert (np.diff(late) > 0).all()
    assert np.std(late - 0.1 * np.arange(1, len(late) + 1)) == pytest.approx(0.005, rel=0.05)


def test_table_2_4_periods():
    assert {"dvl": 0.20, "ahrs": 0.01, "range1": 0.10, "range4": 0.10, "depth": 0.02}.items() <= PERIODS_S.items()


def test_table_2_6_range_is_to_the_true_pose_of_that_instant():
    motion = motion_data(np.random.default_rng(2), ERRORS, 2.0)
    between = motion_model(motion.pose[30], motion.twist[30], 0.004)[:3]
    assert true_range(motion, np.array([0.304]), BEACONS["2"]) == pytest.approx(np.linalg.norm(between - BEACONS["2"]))


def test_table_2_8_common_error_is_redrawn_every_interval():
    values = correlation(np.random.default_rng(3), ERRORS, 5000.0)
    assert len(values) == 5001
    assert values.std() == pytest.approx(0.15, rel=0.05)


def test_table_2_9_as_many_outliers_as_asked_for():
    parts = outlier_times(np.random.default_rng(4), replace(ERRORS, outliers=25), [100, 50, 100])
    assert [len(part) for part in parts] == [100, 50, 100]
    assert sum(int(part.sum()) for part in parts) == 25


@pytest.mark.parametrize("synchronous", [False, True])
def test_statistics_computed_back_are_those_asked_for(synchronous):
    """(21): all errors at once; the common error within four standard errors of its 60 draws."""
    rows = {row.check: row for row in self_check(simulate_underwater(5, ERRORS, 60.0, synchronous))}
    for name in ("velocity_std_m_s", "attitude_std_rad", "depth_std_m", "range_std_m", "outlier_m"):
        assert rows[name].measured == pytest.approx(rows[name].asked, rel=0.1)
    assert rows["correlation_std_m"].measured == pytest.approx(0.15, rel=4 / np.sqrt(2 * 60))
    assert rows["outliers"].measured == rows["outliers"].asked
    assert ("ahrs_time_std_s" in rows) is not synchronous


def test_without_errors_the_log_is_the_truth():
    none = UnderwaterErrors(0, 0, 0, 0, 0, 0, 0, 0, 1.0, 0, 0)
    run = simulate_underwater(0, none, 5.0)
    for k, (beacon, place) in enumerate(BEACONS.items(), 1):
        assert np.allclose(run.ranges_m[beacon], true_range(run.motion, run.times_s[f"range{k}"], place))
    assert np.allclose(run.depth_m, -run.motion.at(run.times_s["depth"])[:, 2])
